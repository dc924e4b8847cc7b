"""Replaying an action sequence in several engines: when, where and by how much they diverge from a reference.

The reference also starts from states that differ by next to nothing. Shape letters: T control steps, J joints, E
fingertips.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
import torch
from scipy.ndimage import binary_opening

from xreset.errors import XResetError
from xreset.eval.engines.actions import Actions
from xreset.eval.engines.recording import Recording, play
from xreset.eval.trial import Engine
from xreset.geometry.rotations import quat_angle
from xreset.geometry.urdf import robot_tree
from xreset.physics import State
from xreset.spec import RobotSpec

SCHEMA = "xreset-divergence/1"
PERTURBED = 4
"""Perturbed starts in the reference. Long contact is chaotic: what such a start does to the reference itself is no
fault of an engine."""
PERTURBATION = 1e-6
"""Each joint [rad, m] and each coordinate of the object [m] is moved by plus or minus this."""
THRESHOLDS = {
    "joints": 0.02,
    "object position": 0.005,
    "object orientation": math.radians(5.0),
    "contacts": 1.0,
    "contact force": 2.0,
}
"""Differences from which engines count as diverged: of the joint that differs most [rad; 1 m of a prismatic joint
counts as 10 rad], of the object's origin [m] and orientation [rad], the number of fingers that touch in one engine
only, and of the magnitude of a fingertip's force [N]."""
WINDOW = 0.05
"""Forces are averaged over the last of these seconds: the contact force of one step says little."""
TOUCH = 0.1
"""Averaged force [N] from which a fingertip counts as touching."""
CONTACT_TIME = 0.05
"""How long other fingers than in the reference must touch for the contacts to have diverged [s]."""


@dataclass(frozen=True, kw_only=True)
class Divergence:
    """How one quantity of :data:`THRESHOLDS` diverges from the reference."""

    quantity: str
    time: float | None
    """When the difference first reaches the threshold [s]; None if never."""
    where: str
    """Which joint, or which fingers, at that time; empty if never, or where there is no choice."""
    end: float
    """Difference at the end."""
    largest: float
    """Largest difference."""


@dataclass(frozen=True, kw_only=True)
class Differences:
    """Differences of one world to the reference over time, up to the last step at which both are finite."""

    time: np.ndarray
    """[T] end of each control step [s]."""
    value: dict[str, np.ndarray]
    """[T] difference of each quantity."""
    where: dict[str, list[str]]
    """[T] names of joint or fingers, for the quantities that have them."""
    diverged: dict[str, np.ndarray]
    """[T] bool: whether the difference counts."""

    def first(self) -> tuple[Divergence, ...]:
        """Return how each quantity diverges; nothing if no step is finite."""
        found = []
        for quantity, value in self.value.items() if len(self.time) else ():
            step = int(self.diverged[quantity].argmax())
            diverges = bool(self.diverged[quantity][step])
            found.append(
                Divergence(
                    quantity=quantity,
                    time=float(self.time[step]) if diverges else None,
                    where=self.where[quantity][step] if diverges and quantity in self.where else "",
                    end=float(value[-1]),
                    largest=float(value.max()),
                )
            )
        return tuple(found)


def differences(
    found: Recording, reference: Recording, robot: RobotSpec, dt: float, *, world: int = 0
) -> Differences:
    """Compare a world of a recording with the first world of the reference's recording, which is as long.

    Args:
        found: the tested recording.
        reference: the reference's recording.
        robot: names joints and fingers.
        dt: control step [s].
        world: world of ``found``.
    """
    tree = robot_tree(robot)
    scale = [10.0 if tree.joint(name).type == "prismatic" else 1.0 for name in robot.joint_names]
    fingers = robot.fingertip_names
    force = found.tip_force[:, world].norm(dim=-1).double().numpy()
    other = reference.tip_force[:, 0].norm(dim=-1).double().numpy()
    joint = (found.joint_pos[:, world] - reference.joint_pos[:, 0]).abs().double().numpy() * scale
    position = (
        (found.object_pos[:, world] - reference.object_pos[:, 0]).double().norm(dim=-1).numpy()
    )
    angle = quat_angle(
        found.object_quat[:, world].double(), reference.object_quat[:, 0].double()
    ).numpy()
    broken = ~np.isfinite(np.column_stack((joint, position, angle, force, other))).all(axis=1)
    steps = slice(int(broken.argmax()) if broken.any() else len(joint))
    force = _averaged(force[steps], dt)
    other = _averaged(other[steps], dt)
    change = np.abs(force - other)
    touch = force >= TOUCH
    differs = touch != (other >= TOUCH)
    contacts = []
    for row, touches in zip(differs, touch, strict=True):
        names = [
            f"{fingers[i]} {'touches' if touches[i] else 'does not touch'}"
            for i in np.flatnonzero(row)
        ]
        contacts.append(", ".join(names))
    value = {
        "joints": joint[steps].max(axis=1),
        "object position": position[steps],
        "object orientation": angle[steps],
        "contacts": differs.sum(axis=1),
        "contact force": change.max(axis=1),
    }
    diverged = {quantity: values >= THRESHOLDS[quantity] for quantity, values in value.items()}
    lasting = np.ones(max(1, round(CONTACT_TIME / dt)))
    diverged["contacts"] = binary_opening(diverged["contacts"], lasting)
    return Differences(
        time=(np.arange(len(touch)) + 1) * dt,
        value=value,
        where={
            "joints": [robot.joint_names[i] for i in joint[steps].argmax(axis=1)],
            "contacts": contacts,
            "contact force": [fingers[i] for i in change.argmax(axis=1)],
        },
        diverged=diverged,
    )


def worst(several: Sequence[tuple[Divergence, ...]]) -> tuple[Divergence, ...]:
    """Return, for each quantity, the earliest time and the largest differences of several worlds."""
    out = []
    for same in zip(*several, strict=True):
        first = min(same, key=lambda d: math.inf if d.time is None else d.time)
        out.append(
            replace(first, end=max(d.end for d in same), largest=max(d.largest for d in same))
        )
    return tuple(out)


def _averaged(force: np.ndarray, dt: float) -> np.ndarray:
    """[T, E] mean over the window that ends at each step; shorter at the beginning."""
    steps = max(1, round(WINDOW / dt))
    return pd.DataFrame(force).rolling(steps, min_periods=1).mean().to_numpy()


# Replays --------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class EngineTrace:
    """What one engine did, and where it diverges from the reference."""

    engine: Engine
    recording: Recording
    """Its first world is the sequence's own."""
    differences: Differences

    @property
    def name(self) -> str:
        """Name of the engine."""
        return self.engine.name

    @property
    def divergences(self) -> tuple[Divergence, ...]:
        """How each quantity diverges; empty if no step is finite."""
        return self.differences.first()

    @property
    def lifted(self) -> float | None:
        """Height of the object at the end above its start [m]; None if it is not finite."""
        height = float(self.recording.lifted[0])
        return height if math.isfinite(height) else None


@dataclass(frozen=True, kw_only=True)
class TraceResult:
    """The outcome of :func:`trace`."""

    actions: Actions
    reference: EngineTrace
    engines: tuple[EngineTrace, ...]
    """The other engines."""
    noise: tuple[Differences, ...]
    """The reference from each perturbed start against itself."""

    @property
    def worst_noise(self) -> tuple[Divergence, ...]:
        """The worst of the perturbed starts for each quantity."""
        return worst([noise.first() for noise in self.noise])

    def within_noise(self, found: Divergence) -> bool:
        """Whether the reference diverges as far from itself, and no later, from a start that hardly differs."""
        for noise in self.worst_noise:
            if noise.quantity == found.quantity and found.largest <= noise.largest:
                return found.time is None or (noise.time is not None and noise.time <= found.time)
        return False

    def as_dict(self) -> dict[str, Any]:
        """Return JSON-able content."""
        actions = self.actions
        engines = []
        for e in (self.reference, *self.engines):
            engines.append(
                {
                    "name": e.name,
                    "version": e.engine.version,
                    "device": e.engine.device,
                    "lifted_m": e.lifted,
                    "finite_steps": len(e.differences.time),
                    "divergences": [
                        asdict(d) | {"within_noise": self.within_noise(d)} for d in e.divergences
                    ],
                }
            )
        return {
            "schema": SCHEMA,
            "label": actions.label,
            "robot": actions.robot.name,
            "object": actions.object.name,
            "steps": len(actions.joint_target),
            "thresholds": THRESHOLDS,
            "reference": self.reference.name,
            "noise": [asdict(d) for d in self.worst_noise],
            "engines": engines,
        }


def trace(
    actions: Actions,
    reference: Engine,
    engines: Sequence[Engine],
    *,
    seed: int = 0,
    progress: Callable[[str], None] = lambda name: None,
) -> TraceResult:
    """Replay a sequence in each engine and compare with the reference.

    Args:
        actions: the sequence.
        reference: engine that the others are compared with.
        engines: the others.
        seed: seed of the perturbed starts.
        progress: called with the name of each engine as it begins.

    Raises:
        XResetError: the reference itself does not stay finite.
    """
    dt = actions.scene.control_dt

    def replayed(engine: Engine, start: State) -> Recording:
        progress(engine.name)
        worlds = len(start.joint_pos)
        targets = actions.joint_target[:, None].expand(-1, worlds, -1).contiguous()
        with engine.make(actions.scene, worlds, torch.zeros(worlds, dtype=torch.long)) as backend:
            return play(backend, start, targets)

    def compared(engine: Engine, recording: Recording) -> EngineTrace:
        found = differences(recording, expected, actions.robot, dt)
        return EngineTrace(engine=engine, recording=recording, differences=found)

    expected = replayed(reference, _perturbed(actions.start, seed))
    base = compared(reference, expected)
    steps = len(base.differences.time)
    if steps < len(actions.joint_target):
        raise XResetError(
            f"the reference {reference.name!r} is not finite after {steps * dt:.3f} s of this sequence, so nothing can "
            "be compared with it. Choose another --reference, or another sequence."
        )
    noise = [
        differences(expected, expected, actions.robot, dt, world=1 + i) for i in range(PERTURBED)
    ]
    return TraceResult(
        actions=actions,
        reference=base,
        engines=tuple(compared(engine, replayed(engine, actions.start)) for engine in engines),
        noise=tuple(noise),
    )


def _perturbed(start: State, seed: int) -> State:
    """[1 + PERTURBED] the start itself, then perturbed copies."""
    generator = torch.Generator().manual_seed(seed)
    copies = {name: value.expand(1 + PERTURBED, -1).clone() for name, value in vars(start).items()}
    for name in ("joint_pos", "object_pos"):
        rows = copies[name][1:]
        rows += PERTURBATION * (2.0 * torch.randint(2, rows.shape, generator=generator) - 1.0)
    return State(**copies)
