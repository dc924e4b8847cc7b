"""Where two recordings of the same action sequence diverge: joints, object and contacts; when, where and by how much.

Shape letters: T control steps, J joints, E fingertips.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from scipy.ndimage import binary_opening

from xreset.eval.engines.recording import Recording
from xreset.geometry.rotations import quat_angle
from xreset.geometry.urdf import robot_tree
from xreset.spec import RobotSpec

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


def differences(found: Recording, reference: Recording, robot: RobotSpec, dt: float, *, world: int = 0) -> Differences:
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
    position = (found.object_pos[:, world] - reference.object_pos[:, 0]).double().norm(dim=-1).numpy()
    angle = quat_angle(found.object_quat[:, world].double(), reference.object_quat[:, 0].double()).numpy()
    broken = ~np.isfinite(np.column_stack((joint, position, angle, force, other))).all(axis=1)
    steps = slice(int(broken.argmax()) if broken.any() else len(joint))
    force = _averaged(force[steps], dt)
    other = _averaged(other[steps], dt)
    change = np.abs(force - other)
    touch = force >= TOUCH
    differs = touch != (other >= TOUCH)
    contacts = []
    for row, touches in zip(differs, touch, strict=True):
        names = [f"{fingers[i]} {'touches' if touches[i] else 'does not touch'}" for i in np.flatnonzero(row)]
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
        out.append(replace(first, end=max(d.end for d in same), largest=max(d.largest for d in same)))
    return tuple(out)


def _averaged(force: np.ndarray, dt: float) -> np.ndarray:
    """[T, E] mean over the window that ends at each step; shorter at the beginning."""
    steps = max(1, round(WINDOW / dt))
    return pd.DataFrame(force).rolling(steps, min_periods=1).mean().to_numpy()
