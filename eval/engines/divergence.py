"""Where two recordings of the same action sequence part: joints, object and contacts; when, where and by how much.

Shape letters: T control steps, J joints, E fingertips.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from xreset.eval.engines.recording import Recording
from xreset.geometry.rotations import quat_angle
from xreset.geometry.urdf import robot_tree
from xreset.spec import RobotSpec


@dataclass(frozen=True, kw_only=True)
class Thresholds:
    """The differences from which two engines count as parted."""

    joint: float = 0.02
    """A joint's angle [rad]."""
    travel: float = 0.002
    """A prismatic joint's position [m]."""
    position: float = 0.005
    """The object's origin [m]."""
    angle: float = math.radians(5.0)
    """The object's orientation [rad]."""
    force: float = 2.0
    """The magnitude of a fingertip's force on the object [N], averaged over ``window``."""
    touch: float = 0.1
    """Force [N], averaged over ``window``, from which a fingertip counts as touching."""
    contact_time: float = 0.05
    """How long other fingers than in the reference must touch for the contacts to have parted [s]."""
    window: float = 0.05
    """Forces are averaged over the last of these seconds: the contact force of one step says little."""


@dataclass(frozen=True, kw_only=True)
class Parting:
    """How one quantity parts from the reference."""

    quantity: str
    """``joints``, ``object position``, ``object orientation``, ``contacts`` or ``contact force``."""
    unit: str
    threshold: float
    time: float | None
    """When the difference first reaches the threshold [s]; None if never."""
    where: str
    """Which joint, or which fingers, at that time; empty if never, or where there is no choice."""
    end: float
    """Difference at the end."""
    largest: float
    """Largest difference."""
    largest_time: float
    """Time of the largest difference [s]."""
    largest_where: str
    """Joint or fingers of the largest difference."""


@dataclass(frozen=True, kw_only=True)
class Differences:
    """Differences of one world to the reference over time, up to the last step at which both are finite."""

    time: np.ndarray
    """[T] end of each control step [s]."""
    joint: np.ndarray
    """[T, J] magnitude, rad (m)."""
    position: np.ndarray
    """[T] m"""
    angle: np.ndarray
    """[T] rad"""
    force: np.ndarray
    """[T, E] difference of the forces' magnitudes, averaged over the window [N]."""
    touch: np.ndarray
    """[T, E] bool: which fingers touch."""
    reference_touch: np.ndarray
    """[T, E] bool"""


def differences(
    found: Recording, reference: Recording, dt: float, thresholds: Thresholds, *, world: int = 0
) -> Differences:
    """Compare a world of a recording with the first world of the reference's recording, which is as long.

    Args:
        found: the tested recording.
        reference: the reference's recording.
        dt: control step [s].
        thresholds: of touch, and the window of the forces.
        world: world of ``found``.
    """
    window = max(1, round(thresholds.window / dt))
    force = _averaged(found.tip_force[:, world].norm(dim=-1).double().numpy(), window)
    other = _averaged(reference.tip_force[:, 0].norm(dim=-1).double().numpy(), window)
    joint = (found.joint_pos[:, world] - reference.joint_pos[:, 0]).abs().double().numpy()
    position = (found.object_pos[:, world] - reference.object_pos[:, 0]).double().norm(dim=-1).numpy()
    angle = quat_angle(found.object_quat[:, world].double(), reference.object_quat[:, 0].double()).numpy()
    broken = ~np.isfinite(np.column_stack((joint, position, angle, force, other))).all(axis=1)
    steps = int(broken.argmax()) if broken.any() else len(joint)
    return Differences(
        time=(np.arange(steps) + 1) * dt,
        joint=joint[:steps],
        position=position[:steps],
        angle=angle[:steps],
        force=np.abs(force - other)[:steps],
        touch=(force >= thresholds.touch)[:steps],
        reference_touch=(other >= thresholds.touch)[:steps],
    )


def partings(d: Differences, robot: RobotSpec, thresholds: Thresholds) -> tuple[Parting, ...]:
    """Return how each quantity parts: joints, object position, object orientation, contacts, contact force.

    Joints are compared by their difference as a share of the threshold of their kind; the joint that differs most is
    named.
    """
    if not len(d.time):
        return ()
    tree = robot_tree(robot)
    prismatic = np.array([tree.joint(name).type == "prismatic" for name in robot.joint_names])
    fingers = robot.fingertip_names

    def finger(step: int) -> str:
        return fingers[int(d.force[step].argmax())]

    return (
        _joints(d, robot.joint_names, np.where(prismatic, thresholds.travel, thresholds.joint), prismatic),
        _parting("object position", "m", d.time, d.position, thresholds.position),
        _parting("object orientation", "rad", d.time, d.angle, thresholds.angle),
        _contacts(d, fingers, thresholds),
        _parting("contact force", "N", d.time, d.force.max(axis=1), thresholds.force, finger),
    )


def worst(several: Sequence[tuple[Parting, ...]]) -> tuple[Parting, ...]:
    """Return, for each quantity, the earliest time and the largest differences of several worlds."""
    out = []
    for same in zip(*several, strict=True):
        first = min(same, key=lambda p: math.inf if p.time is None else p.time)
        most = max(same, key=lambda p: p.largest / p.threshold)
        end = max(p.end for p in same if p.unit == most.unit)
        out.append(replace(most, quantity=first.quantity, time=first.time, where=first.where, end=end))
    return tuple(out)


def first_of(found: Sequence[Parting]) -> Parting | None:
    """Return the quantity that parts first; None if none does."""
    parted = [p for p in found if p.time is not None]
    return min(parted, key=lambda p: p.time or 0.0, default=None)


def _parting(
    quantity: str,
    unit: str,
    time: np.ndarray,
    value: np.ndarray,
    threshold: float,
    where: Callable[[int], str] = lambda step: "",
    beyond: np.ndarray | None = None,
) -> Parting:
    """Describe a difference [T], which parts at the first flag of ``beyond`` [T]; default: beyond the threshold."""
    beyond = value >= threshold if beyond is None else beyond
    first = int(beyond.argmax())
    parts = bool(beyond[first])
    most = int(value.argmax())
    return Parting(
        quantity=quantity,
        unit=unit,
        threshold=threshold,
        time=float(time[first]) if parts else None,
        where=where(first) if parts else "",
        end=float(value[-1]),
        largest=float(value[most]),
        largest_time=float(time[most]),
        largest_where=where(most),
    )


def _joints(d: Differences, names: Sequence[str], limit: np.ndarray, prismatic: np.ndarray) -> Parting:
    """Choose the joint that differs most, then its unit: rad, or m if it is prismatic; never a mixture."""
    share = d.joint / limit
    found = _parting("joints", "rad", d.time, share.max(axis=1), 1.0, lambda step: names[int(share[step].argmax())])
    most = int(share.max(axis=1).argmax())
    joint = int(share[most].argmax())
    return replace(
        found,
        unit="m" if prismatic[joint] else "rad",
        threshold=float(limit[joint]),
        end=float(d.joint[-1, prismatic == prismatic[joint]].max()),
        largest=float(d.joint[most, joint]),
    )


def _contacts(d: Differences, fingers: Sequence[str], thresholds: Thresholds) -> Parting:
    """The difference is the number of fingers that touch in one engine and not in the other."""
    other = d.touch != d.reference_touch
    number = other.sum(axis=1)
    lasting = np.zeros(len(number), dtype=bool)
    need = max(1, round(thresholds.contact_time / float(d.time[0])))
    for start, stop in runs(number > 0):
        lasting[start:stop] = stop - start >= need

    def describe(step: int) -> str:
        parts = []
        for i in np.flatnonzero(other[step]).tolist():
            parts.append(f"{fingers[i]} {'touches' if d.touch[step, i] else 'does not touch'}")
        return ", ".join(parts)

    return _parting("contacts", "fingers", d.time, number, 1.0, describe, lasting)


def runs(flags: np.ndarray) -> np.ndarray:
    """Return first step and end [n, 2] of every run of set flags [T]."""
    edges = np.diff(np.concatenate(([0], flags.astype(np.int8), [0])))
    return np.flatnonzero(edges).reshape(-1, 2)


def _averaged(values: np.ndarray, window: int) -> np.ndarray:
    """[T, E] mean of the last ``window`` values, of fewer at the beginning."""
    total = np.cumsum(np.concatenate((np.zeros((1, values.shape[1])), values)), axis=0)
    stop = np.arange(1, len(values) + 1)
    start = np.maximum(stop - window, 0)
    return (total[stop] - total[start]) / (stop - start)[:, None]
