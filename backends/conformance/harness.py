"""The worlds that the checks run in, and how they are compared."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from functools import cached_property
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from xreset.backends.conformance.results import Measure, Skipped
from xreset.backends.conformance.scene import gripper
from xreset.geometry.collision import height_above_table, table_points
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.rotations import quat_normalize
from xreset.physics import Backend, Parameter, State
from xreset.plugins import backend_status, make_backend
from xreset.spec import SceneSpec

_NEARER = 6
"""Times that a random configuration is brought half the way home, while it reaches into the table."""


class MakeBackend(Protocol):
    """Builds the backend under test."""

    def __call__(self, scene: SceneSpec, num_worlds: int, *, object_index: Tensor | None = None) -> Backend:
        """Build ``num_worlds`` worlds."""
        ...


REFERENCE = "mujoco"
"""Backend that others are compared with."""
REFINEMENT = 8
"""How much finer the steps are of the reference that the reference is compared with."""


class Bench:
    """The backend under test on a scene, built once and shared by the checks, which each begin from a known state.

    World i of the shared worlds holds object i modulo the number of objects.
    """

    NUM_WORLDS = 4

    def __init__(self, make: MakeBackend, scene: SceneSpec) -> None:
        self._make = make
        self.scene = scene
        self.own_robot = scene.robot.name == gripper().name
        self.kinematics = Kinematics(scene.robot)
        self.object_index = torch.arange(self.NUM_WORLDS) % len(scene.objects)
        self._shared: Backend | None = None
        self._altered = False

    @property
    def objects(self) -> list:
        """The object of each shared world."""
        return [self.scene.objects[i] for i in self.object_index.tolist()]

    def backend(self) -> Backend:
        """The shared worlds in their initial state, with nominal parameters."""
        if self._shared is None:
            self._shared = self._make(self.scene, self.NUM_WORLDS, object_index=self.object_index)
        backend = self._shared
        if self._altered:
            _set_nominal(backend, self.objects, self.scene)
            self._altered = False
        backend.set_state(self.start(backend.device))
        return backend

    def altered(self) -> Backend:
        """The same, for a check that changes physical parameters: they are put back before the next check."""
        backend = self.backend()
        self._altered = True
        return backend

    @contextmanager
    def other(self, scene: SceneSpec, num_worlds: int, object_index: Tensor | None = None) -> Iterator[Backend]:
        """Worlds of another scene, closed at the end of the block."""
        backend = self._make(scene, num_worlds, object_index=object_index)
        try:
            yield backend
        finally:
            backend.close()

    @contextmanager
    def reference(
        self, scene: SceneSpec, num_worlds: int, object_index: Tensor | None = None
    ) -> Iterator[tuple[Backend, int]]:
        """The same worlds in the reference engine, and how many of its steps make one step of the scene.

        The reference itself, if it is what is tested, is compared with finer steps of its own.
        """
        status = backend_status(REFERENCE)
        if status.reason is not None:
            raise Skipped(f"it compares with the reference engine: {status.reason}")
        finer = REFINEMENT if self.backend().name == REFERENCE else 1
        scene = replace(scene, timestep=scene.timestep / finer)
        with make_backend(REFERENCE, scene, num_worlds, object_index=object_index, workers=0) as backend:
            yield backend, finer

    def start(self, device: torch.device | str = "cpu") -> State:
        """[N] initial states, the object resting where the robot is not."""
        return self.placed(State.initial(self.scene, self.object_index)).to(device)

    def placed(self, state: State) -> State:
        """The same states with the object moved to where the robot is not, at the same height."""
        place = torch.tensor(self.place).expand(len(state.object_pos), 2)
        return replace_fields(state, object_pos=torch.cat((place, state.object_pos[:, 2:]), dim=1))

    @cached_property
    def place(self) -> tuple[float, float]:
        """See :func:`free_place`."""
        return free_place(self.scene)

    def close(self) -> None:
        """Close the shared worlds."""
        if self._shared is not None:
            self._shared.close()


def free_place(scene: SceneSpec) -> tuple[float, float]:
    """A place on the table, far from the robot's base and from its hand at home, from which an object can slide."""
    robot, (x, y), (hx, hy, _) = scene.robot, scene.table.center, scene.table.half_size
    corners = [(x + sx * (hx - 0.25), y + sy * (hy - 0.2)) for sx in (-1, 1) for sy in (-1, 1)]
    palm = Kinematics(robot).link_poses(torch.as_tensor(robot.home), [robot.palm])[0, :2, 3].numpy()
    avoid = np.stack((palm, np.array(robot.base_pos[:2])))
    return max(corners, key=lambda c: float(np.linalg.norm(avoid - np.array(c), axis=1).min()))


def replace_fields(state: State, **changes: Tensor) -> State:
    """The state with some fields replaced; values broadcast over the worlds."""
    values = {f.name: getattr(state, f.name) for f in fields(State)}
    for name, value in changes.items():
        values[name] = (
            torch.as_tensor(value, dtype=torch.float32, device=values[name].device).expand_as(values[name]).clone()
        )
    return State(**values)


def snapshot(state: State) -> State:
    """A copy that later steps do not change, on the CPU."""
    return state.to("cpu").clone()


def advanced(backend: Backend, start: State, steps: int) -> State:
    """What becomes of a state [N, ...] in some physics steps, on the CPU."""
    backend.set_state(start.to(backend.device))
    backend.step(steps)
    return snapshot(backend.state())


def worst_of(what: str, values: Tensor | Sequence[float], tolerance: float, unit: str, names: Sequence[str]) -> Measure:
    """The largest of some values [N], a NaN before all, and whose it is."""
    worst = int(np.nan_to_num(np.asarray(values), nan=np.inf).argmax())
    return Measure(what, float(values[worst]), tolerance, unit, names[worst])


def largest(difference: Tensor) -> float:
    """The largest absolute value; NaN if there is one."""
    return float(difference.detach().abs().double().max()) if difference.numel() else 0.0


def rotation_angle(a: Tensor, b: Tensor) -> Tensor:
    """[...] angle between the orientations of unit quaternions [..., 4]: precise for small ones, where the arc cosine is not."""
    (aw, av), (bw, bv) = (q.split((1, 3), dim=-1) for q in (a.double(), b.double()))
    vector = aw * bv - bw * av - torch.linalg.cross(av, bv)  # of conjugate(a) b
    return 2.0 * torch.atan2(vector.norm(dim=-1), (a.double() * b.double()).sum(-1).abs())


def random_state(
    bench: Bench, scene: SceneSpec, num_worlds: int, seed: int, device: torch.device | str = "cpu"
) -> State:
    """[N] states with every field away from its default: joints well within their limits, the object in the air, spinning.

    A robot that would reach into the table is brought nearer to home until it does not: an arm deep inside it is thrown out, and no two
    engines, nor the same one in two scenes, need do that alike.
    """
    random = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return 2.0 * torch.rand(*shape, generator=random) - 1.0

    joints = Kinematics(scene.robot)
    home = torch.as_tensor(scene.robot.home, dtype=torch.float64)
    lower, upper = joints.lower.clamp_min(-3.0), joints.upper.clamp_max(3.0)
    reach = 0.3 * (upper - lower)
    count = len(home)
    pos = (home + reach * uniform(num_worlds, count)).clamp(lower + 0.1 * reach, upper - 0.1 * reach)
    support = table_points(scene.robot, joints)
    points, radii = torch.tensor(support.points), torch.tensor(support.radii)
    for _ in range(_NEARER):
        inside = (height_above_table(joints.points(pos, support.links, points), radii, scene.table) < 0).any(dim=1)
        if not inside.any():
            break
        pos = torch.where(inside[:, None], (home + pos) / 2, pos)
    return State(
        joint_pos=pos.float(),
        joint_vel=0.5 * uniform(num_worlds, count),
        joint_target=(pos + 0.2 * reach * uniform(num_worlds, count)).float(),
        object_pos=torch.tensor([*bench.place, 1.5]) + 0.05 * uniform(num_worlds, 3),
        object_quat=quat_normalize(uniform(num_worlds, 4)),
        object_linvel=uniform(num_worlds, 3),
        object_angvel=4.0 * uniform(num_worlds, 3),
    ).to(device)


def small_motion(kinematics: Kinematics) -> Tensor:
    """[J] a small way for each joint, towards the middle of its range."""
    home = torch.as_tensor(kinematics.robot.home, dtype=torch.float64)
    lower, upper = kinematics.lower.clamp_min(-3.0), kinematics.upper.clamp_max(3.0)
    step = 0.05 * (upper - lower)
    return torch.where(home > (lower + upper) / 2, -step, step).float()


def compare_states(
    found: State, expected: State, tolerances: Mapping[str, tuple[float, str]], of: str = ""
) -> list[Measure]:
    """A measure for each field, named after what it is a state ``of``; quaternions are the same with the opposite sign."""
    measures = []
    for name, (tolerance, unit) in tolerances.items():
        a, b = getattr(found, name).cpu(), getattr(expected, name).cpu()
        if name == "object_quat":
            a = torch.where((a * b).sum(-1, keepdim=True) < 0, -a, a)
        measures.append(Measure(what=f"{of} {name}".strip(), measured=largest(a - b), tolerance=tolerance, unit=unit))
    return measures


ROUND_TRIP: dict[str, tuple[float, str]] = {
    "joint_pos": (2e-6, "rad, m"),
    "joint_vel": (2e-5, "rad/s, m/s"),
    "joint_target": (2e-6, "rad, m"),
    "object_pos": (2e-6, "m"),
    "object_quat": (2e-6, ""),
    "object_linvel": (2e-5, "m/s"),
    "object_angvel": (2e-5, "rad/s"),
}
"""Tolerance of a state that is read back: the rounding of float32, and of a change of frame."""


def _set_nominal(backend: Backend, objects: list, scene: SceneSpec) -> None:
    n, device = backend.num_worlds, backend.device
    friction, one = scene.friction, torch.ones(n)
    nominal: dict[Parameter, Tensor] = {
        "friction": torch.tensor([friction.tip, friction.link, friction.table]).repeat(n, 1),
        "torsional_friction": friction.torsional * one,
        "object_mass": torch.tensor([o.mass for o in objects]),
        "object_inertia": one,
        "object_com": torch.zeros(n, 3),
        "object_gravity": one,
        "drives": torch.ones(n, 3, len(scene.robot.joints)),
    }
    for name, value in nominal.items():
        if name in backend.capabilities:
            getattr(backend, f"set_{name}")(value.float().to(device))
