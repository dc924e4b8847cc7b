"""Where two recordings of the same action sequence part: of joints, object and contacts, when, where and by how much.

Shape letters: T control steps, J joints, E fingertips.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from xreset.eval.engines.episodes import Recording
from xreset.geometry.rotations import quat_angle
from xreset.geometry.urdf import robot_tree
from xreset.spec import RobotSpec


@dataclass(frozen=True, kw_only=True)
class Thresholds:
    """From which difference on two engines count as parted."""

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
    """How long other fingers must touch than in the reference for the contact sets to have parted [s]."""
    window: float = 0.05
    """Forces are averaged over the last of these seconds: one step's contact force says little."""


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
    """When it is that [s]."""
    largest_where: str
    """Where it is that."""


@dataclass(frozen=True, kw_only=True)
class Differences:
    """Differences of one world to the reference, over time, up to the last step at which both are finite."""

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
    """Compare a world of a recording with the first one of the reference's.

    Args:
        reference: the reference's, of the same length.
        dt: control step [s].
        thresholds: of touch, and the window of the forces.
        world: of ``found``.
    """
    force, other_force = (
        _averaged(recording.tip_force[:, i].norm(dim=-1).double().numpy(), max(1, round(thresholds.window / dt)))
        for recording, i in ((found, world), (reference, 0))
    )
    joint = (found.joint_pos[:, world] - reference.joint_pos[:, 0]).abs().double().numpy()
    position = (found.object_pos[:, world] - reference.object_pos[:, 0]).double().norm(dim=-1).numpy()
    angle = quat_angle(found.object_quat[:, world].double(), reference.object_quat[:, 0].double()).numpy()
    broken = np.flatnonzero(~np.isfinite(np.column_stack((joint, position, angle, force, other_force))).all(axis=1))
    steps = int(broken[0]) if len(broken) else len(joint)
    return Differences(
        time=(np.arange(steps) + 1) * dt,
        joint=joint[:steps],
        position=position[:steps],
        angle=angle[:steps],
        force=np.abs(force - other_force)[:steps],
        touch=(force >= thresholds.touch)[:steps],
        reference_touch=(other_force >= thresholds.touch)[:steps],
    )


def partings(d: Differences, robot: RobotSpec, thresholds: Thresholds) -> tuple[Parting, ...]:
    """How each quantity parts; in the order joints, object position, object orientation, contacts, contact force.

    Joints are compared by their difference as a share of the threshold of their kind; the joint that differs most is named.
    """
    if not len(d.time):
        return ()
    tree = robot_tree(robot)
    limit = np.array(
        [thresholds.travel if tree.joint(n).type == "prismatic" else thresholds.joint for n in robot.joint_names]
    )
    fingers = robot.fingertip_names
    return (
        _joints(d, robot.joint_names, limit, thresholds),
        _parting("object position", "m", d.time, d.position, thresholds.position),
        _parting("object orientation", "rad", d.time, d.angle, thresholds.angle),
        _contacts(d, fingers, thresholds),
        _parting(
            "contact force",
            "N",
            d.time,
            d.force.max(axis=1),
            thresholds.force,
            lambda step: fingers[int(d.force[step].argmax())],
        ),
    )


def worst(several: Sequence[tuple[Parting, ...]]) -> tuple[Parting, ...]:
    """Of the partings of several worlds, for each quantity the earliest time and the largest differences."""
    out = []
    for same in zip(*several, strict=True):
        first = min(same, key=lambda p: math.inf if p.time is None else p.time)
        most = max(same, key=lambda p: p.largest / p.threshold)
        end = max(p.end for p in same if p.unit == most.unit)
        out.append(replace(most, quantity=first.quantity, time=first.time, where=first.where, end=end))
    return tuple(out)


def first_of(found: Sequence[Parting]) -> Parting | None:
    """The quantity that parts first; None if none does."""
    parted = [p for p in found if p.time is not None]
    return min(parted, key=lambda p: p.time or 0.0, default=None)


def _parting(
    quantity: str, unit: str, time: np.ndarray, value: np.ndarray, threshold: float,
    where: Callable[[int], str] = lambda step: "", beyond: np.ndarray | None = None,
) -> Parting:  # fmt: skip
    """How a difference [T] parts: from the first step that is ``beyond`` [T] bool on; default: that reaches the threshold."""
    beyond = value >= threshold if beyond is None else beyond
    first, most = (int(beyond.argmax()) if beyond.any() else None), int(value.argmax())
    return Parting(
        quantity=quantity, unit=unit, threshold=threshold, time=None if first is None else float(time[first]),
        where="" if first is None else where(first), end=float(value[-1]), largest=float(value[most]), largest_time=float(time[most]),
        largest_where=where(most),
    )  # fmt: skip


def _joints(d: Differences, names: Sequence[str], limit: np.ndarray, thresholds: Thresholds) -> Parting:
    """In rad, or in m where the joint that differs most is prismatic; never a mixture: the joint is chosen first, then its unit."""
    share = d.joint / limit
    most = int(share.max(axis=1).argmax())
    joint = int(share[most].argmax())
    kind, unit = limit == limit[joint], "rad" if limit[joint] == thresholds.joint else "m"
    found = _parting("joints", unit, d.time, share.max(axis=1), 1.0, lambda step: names[int(share[step].argmax())])
    return replace(
        found, threshold=float(limit[joint]), end=float(d.joint[-1, kind].max()), largest=float(d.joint[most, joint])
    )


def _contacts(d: Differences, fingers: Sequence[str], thresholds: Thresholds) -> Parting:
    """The difference is the number of fingers that touch in one and not in the other."""
    other = d.touch != d.reference_touch
    number = other.sum(axis=1)
    lasting = _runs(number > 0, max(1, round(thresholds.contact_time / float(d.time[0]))))

    def describe(step: int) -> str:
        touched = np.flatnonzero(other[step]).tolist()
        return ", ".join(f"{fingers[i]} {'touches' if d.touch[step, i] else 'does not touch'}" for i in touched)

    return _parting("contacts", "fingers", d.time, number, 1.0, describe, lasting)


def _runs(flags: np.ndarray, need: int) -> np.ndarray:
    """[T] bool: the flags that are part of a run of at least ``need``."""
    out = np.zeros_like(flags)
    edges = np.flatnonzero(np.diff(np.concatenate(([0], flags.astype(np.int8), [0]))))
    for start, stop in edges.reshape(-1, 2):
        out[start:stop] = stop - start >= need
    return out


def _averaged(values: np.ndarray, window: int) -> np.ndarray:
    """[T, E] mean of the last ``window`` values, of fewer at the beginning."""
    total = np.cumsum(np.concatenate((np.zeros((1, values.shape[1])), values)), axis=0)
    stop = np.arange(1, len(values) + 1)
    start = np.maximum(stop - window, 0)
    return (total[stop] - total[start]) / (stop - start)[:, None]


def lifted(recording: Recording, world: int = 0) -> float:
    """How much higher the object is at the end than where it began [m]; NaN if it is nowhere."""
    height = recording.object_pos[-1, world, 2] - recording.start.object_pos[world, 2]
    return float(height) if bool(torch.isfinite(height)) else math.nan
