"""The worlds that the checks run in, and how states are compared."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from functools import cached_property
from itertools import product

import numpy as np
import torch
from torch import Tensor

from xreset.backends.conformance.results import Measured, Skipped
from xreset.backends.conformance.scene import gripper
from xreset.geometry.collision import table_clearance
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.rotations import quat_normalize
from xreset.geometry.urdf import robot_tree
from xreset.physics import Backend, Contacts, Links, Parameter, Parameters, State
from xreset.physics.plugins import backend_status, make_backend
from xreset.spec import ObjectSpec, RobotSpec, SceneSpec

MakeBackend = Callable[..., Backend]
"""Builds the backend under test: ``make(scene, num_worlds, object_index=...)``."""

REFERENCE = "mujoco"
"""Backend that others are compared with."""
REFINEMENT = 8
"""How much finer the reference's steps are: their numerical damping is no part of what is asked of an engine."""
_HALVINGS = 6
"""How often a random configuration is moved half the way home while the robot reaches into the table."""
SETTLE = 120
"""Physics steps in which objects come to rest."""
FRICTIONS = torch.tensor([[0.8, 0.4, 0.3], [0.7, 0.5, 0.9], [0.6, 0.3, 0.45], [0.9, 0.6, 0.2]])
"""[N, 3] friction of the pairs, different in each of the shared worlds."""


class Worlds:
    """A backend seen from the CPU.

    Inputs are moved to the backend's device, and rows without a world dimension are repeated for every world; readings
    are copies on the CPU, which later steps do not change.
    """

    def __init__(self, backend: Backend, finer: int = 1) -> None:
        """Wrap a backend whose steps are ``finer`` times smaller than those of the scene."""
        self.backend = backend
        self._finer = finer
        self.altered = False
        """Whether a physical parameter has been set."""

    @property
    def exact(self) -> bool:
        """Whether the same input gives the same bits: only CPUs add numbers in the same order every time."""
        return self.backend.device.type == "cpu"

    def set(self, state: State, worlds: Sequence[int] | None = None) -> None:
        """Set the state of all worlds, or of the given ones from their rows."""
        if worlds is not None:
            state = state[list(worlds)]
        self.backend.set_state(state.to(self.backend.device), self._index(worlds))

    def set_targets(self, targets: Tensor) -> None:
        """Set the drive targets, [J] or [N, J]."""
        self.backend.set_joint_targets(self._for_all(targets))

    def push(self, force: Tensor, torque: Tensor) -> None:
        """Set force and torque on the object, [3] or [N, 3]."""
        self.backend.set_object_wrench(self._for_all(force), self._for_all(torque))

    def set_parameter(
        self, name: Parameter, value: Tensor, worlds: Sequence[int] | None = None
    ) -> None:
        """Set a physical parameter [N, ...] of all worlds, or of the given ones from their rows."""
        self.altered = True
        if worlds is not None:
            value = value[list(worlds)]
        getattr(self.backend, f"set_{name}")(
            value.float().to(self.backend.device), self._index(worlds)
        )

    def set_where(
        self, worlds: Sequence[int], state: State, parameters: dict[Parameter, Tensor]
    ) -> None:
        """Set state and parameters through a mask."""
        self.altered = True
        device = self.backend.device
        mask = torch.zeros(self.backend.num_worlds, dtype=torch.bool, device=device)
        mask[list(worlds)] = True
        values = {name: value.float().to(device) for name, value in parameters.items()}
        self.backend.set_where(mask, state.to(device), Parameters(**values))

    def step(self, steps: int) -> None:
        """Advance by some physics steps of the scene; one control step is the default of an engine."""
        count = steps * self._finer
        self.backend.step(None if count == self.backend.scene.substeps else count)

    def advance(self, start: State, steps: int) -> State:
        """Return what becomes of a state [N, ...] in some physics steps of the scene."""
        self.set(start)
        self.step(steps)
        return self.state()

    def path(self, start: State, targets: Iterable[Tensor], steps: int) -> Tensor:
        """[T, N, J] joint positions after some physics steps with each of the drive targets, one after the other."""
        self.set(start)
        path = []
        for target in targets:
            self.set_targets(target)
            self.step(steps)
            path.append(self.state().joint_pos)
        return torch.stack(path)

    def state(self) -> State:
        """Return the state."""
        return self.backend.state().to("cpu").clone()

    def links(self) -> Links:
        """Return the tracked links."""
        return self.backend.links().to("cpu").clone()

    def contacts(self) -> Contacts:
        """Return the contact forces."""
        return self.backend.contacts().to("cpu").clone()

    def nonfinite(self) -> Tensor:
        """Return which worlds are not finite."""
        return self.backend.health().nonfinite.cpu().clone()

    def _index(self, worlds: Sequence[int] | None) -> Tensor | None:
        return None if worlds is None else torch.tensor(worlds, device=self.backend.device)

    def _for_all(self, value: Tensor) -> Tensor:
        rows = value.float().expand(self.backend.num_worlds, value.shape[-1])
        return rows.contiguous().to(self.backend.device)


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
        self.object_index = [i % len(scene.objects) for i in range(self.NUM_WORLDS)]
        """Index of the object of each shared world."""

    @property
    def objects(self) -> list[ObjectSpec]:
        """The object of each shared world."""
        return [self.scene.objects[i] for i in self.object_index]

    def by_object(self, errors: Mapping[str, Tensor]) -> Measured:
        """Return errors [N, ...] of the shared worlds, named by their objects."""
        return named([obj.name for obj in self.objects], errors)

    @property
    def masses(self) -> Tensor:
        """[N] mass of each shared world's object."""
        return torch.tensor([obj.mass for obj in self.objects])

    @property
    def twins(self) -> list[int]:
        """The two shared worlds that hold the first object."""
        return [0, len(self.scene.objects)]

    @property
    def backend(self) -> Backend:
        """The backend of the shared worlds."""
        return self._shared.backend

    @cached_property
    def _shared(self) -> Worlds:
        return self._made(self.scene, self.object_index)

    def worlds(self) -> Worlds:
        """Return the shared worlds in their initial state, with nominal parameters."""
        worlds = self._shared
        if worlds.altered:
            nominal = Parameters.nominal(self.scene, torch.tensor(self.object_index))
            for name, value in nominal.given().items():
                if name in worlds.backend.capabilities:
                    worlds.set_parameter(name, value)
            worlds.altered = False
        worlds.set(self.start())
        return worlds

    @contextmanager
    def other(self, scene: SceneSpec, object_index: Sequence[int] = (0,)) -> Iterator[Worlds]:
        """Worlds of another scene with the given objects, closed at the end of the block."""
        worlds = self._made(scene, object_index)
        with worlds.backend:
            yield worlds

    def _made(self, scene: SceneSpec, object_index: Sequence[int]) -> Worlds:
        return Worlds(self._make(scene, len(object_index), object_index=torch.tensor(object_index)))

    @contextmanager
    def reference(self, scene: SceneSpec, object_index: Sequence[int]) -> Iterator[Worlds]:
        """The same worlds in the reference engine, with finer steps."""
        status = backend_status(REFERENCE)
        if status.reason is not None:
            raise Skipped(f"it compares with the reference engine: {status.reason}")
        scene = replace(scene, timestep=scene.timestep / REFINEMENT)
        with make_backend(
            REFERENCE, scene, len(object_index), object_index=torch.tensor(object_index), workers=0
        ) as backend:
            yield Worlds(backend, REFINEMENT)

    def start(self) -> State:
        """Return [N] initial states, the object resting where the robot is not."""
        return self.initial(self.scene, self.object_index)

    def initial(self, scene: SceneSpec, object_index: Sequence[int]) -> State:
        """Return initial states of worlds of a scene with the given objects, which rest where the robot is not."""
        state = State.initial(scene, torch.tensor(object_index))
        state.object_pos[:, :2] = torch.tensor(self.place)
        return state

    def in_the_air(self) -> State:
        """Return [N] initial states with the object high above everything."""
        return replace_fields(self.start(), object_pos=torch.tensor([*self.place, 1.5]))

    def random_state(
        self, seed: int, robot: RobotSpec | None = None, num_worlds: int = NUM_WORLDS
    ) -> State:
        """Return random states [N] of the shared worlds, or of worlds with another robot.

        Every field is away from its default: joints are within their limits, the object spinning in the air.

        A robot that would reach into the table is moved towards home until it does not: engines may differ in how they
        push an arm out of the table.
        """
        random = torch.Generator().manual_seed(seed)

        def uniform(*shape: int) -> Tensor:
            return 2.0 * torch.rand(*shape, generator=random) - 1.0

        joints = Kinematics(robot or self.scene.robot)
        home = joints.home
        lower, upper = finite_limits(joints)
        reach = 0.3 * (upper - lower)
        count = len(home)
        pos = (home + reach * uniform(num_worlds, count)).clamp(
            lower + 0.1 * reach, upper - 0.1 * reach
        )
        for _ in range(_HALVINGS):
            inside = table_clearance(joints, pos, self.scene.table) < 0
            pos = torch.where(inside[:, None], (home + pos) / 2, pos)
        return State(
            joint_pos=pos.float(),
            joint_vel=0.5 * uniform(num_worlds, count),
            joint_target=(pos + 0.2 * reach * uniform(num_worlds, count)).float(),
            object_pos=torch.tensor([*self.place, 1.5]) + 0.05 * uniform(num_worlds, 3),
            object_quat=quat_normalize(uniform(num_worlds, 4)),
            object_linvel=uniform(num_worlds, 3),
            object_angvel=4.0 * uniform(num_worlds, 3),
        )

    @cached_property
    def free_scene(self) -> SceneSpec:
        """The scene with a robot whose links touch neither one another nor the table."""
        robot = self.scene.robot
        links = robot_tree(robot).link_names
        free = replace(robot, self_collision_links=(), table_exclude=links)
        return replace(self.scene, robot=free)

    @cached_property
    def place(self) -> tuple[float, float]:
        """A place on the table from which an object can slide, far from the robot's base and its hand at home."""
        robot = self.scene.robot
        x, y = self.scene.table.center
        half_x, half_y, _ = self.scene.table.half_size
        palm = self.kinematics.points(self.kinematics.home, [robot.palm])[0, :2].numpy()
        avoid = np.stack((palm, robot.base_pos[:2]))
        xs = (x - (half_x - 0.25), x + (half_x - 0.25))
        ys = (y - (half_y - 0.2), y + (half_y - 0.2))
        return max(product(xs, ys), key=lambda corner: np.linalg.norm(avoid - corner, axis=1).min())

    def close(self) -> None:
        """Close the shared worlds."""
        if "_shared" in vars(self):
            self._shared.backend.close()


def replace_fields(state: State, **changes: Tensor) -> State:
    """Return the state with some fields replaced; values broadcast over the worlds."""
    new = {}
    for name, value in changes.items():
        new[name] = value.float().expand_as(getattr(state, name))
    return replace(state, **new).clone()


def finite_limits(kinematics: Kinematics, most: float = 3.0) -> tuple[Tensor, Tensor]:
    """Lower and upper joint limits [J], cut to at most ``most``."""
    return kinematics.lower.clamp_min(-most), kinematics.upper.clamp_max(most)


def small_motion(kinematics: Kinematics) -> Tensor:
    """[J] a small distance for each joint, towards the middle of its range. It is at most 0.2 rad: an arm that turns
    farther gets to the table."""
    lower, upper = finite_limits(kinematics)
    step = (0.05 * (upper - lower)).clamp(max=0.2)
    return torch.where(kinematics.home > (lower + upper) / 2, -step, step).float()


def named(names: Iterable[str], errors: Mapping[str, Tensor], dim: int = 0) -> Measured:
    """Return errors whose rows along a dimension have names: of joints, links or objects."""
    parts = list(names)
    return {
        what: list(zip(parts, error.movedim(dim, 0), strict=True)) for what, error in errors.items()
    }


def state_errors(found: State, expected: State, words: str = "") -> dict[str, Tensor]:
    """Return the difference of each field, named with ``words`` before it; the sign of quaternions is ignored."""
    errors = {}
    for field in fields(State):
        a = getattr(found, field.name)
        b = getattr(expected, field.name)
        if field.name == "object_quat":
            a = torch.where((a * b).sum(-1, keepdim=True) < 0, -a, a)
        errors[f"{words} {field.name}".strip()] = a - b
    return errors


def stacked(cases: Iterable[dict[str, Tensor]]) -> dict[str, Tensor]:
    """Return the errors of several cases [T, ...], by name."""
    errors = defaultdict(list)
    for case in cases:
        for what, error in case.items():
            errors[what].append(error)
    return {what: torch.stack(rows) for what, rows in errors.items()}
