"""Where two recordings of the same action sequence part: of joints, object and contacts, when, where and by how much.

Shape letters: T control steps, J joints, E fingertips.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from xreset.eval.engines.recording import Recording
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

    def as_dict(self) -> dict[str, Any]:
        """JSON-able content."""
        return {f: getattr(self, f) for f in self.__dataclass_fields__}


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
    found: Recording, reference: Recording, dt: float, thresholds: Thresholds, *, world: int = 0, reference_world: int = 0
) -> Differences:
    """Compare a world of a recording with one of the reference's.

    Args:
        found: the engine's.
        reference: the reference's, of the same length.
        dt: control step [s].
        thresholds: of touch, and the window of the forces.
        world: of ``found``.
        reference_world: of ``reference``.
    """
    force, other_force = (
        _averaged(recording.tip_force[:, i].norm(dim=-1).double().numpy(), max(1, round(thresholds.window / dt)))
        for recording, i in ((found, world), (reference, reference_world))
    )
    joint = (found.joint_pos[:, world] - reference.joint_pos[:, reference_world]).abs().double().numpy()
    position = (found.object_pos[:, world] - reference.object_pos[:, reference_world]).double().norm(dim=-1).numpy()
    angle = quat_angle(found.object_quat[:, world].double(), reference.object_quat[:, reference_world].double()).numpy()
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
    limit = np.array([thresholds.travel if tree.joint(n).type == "prismatic" else thresholds.joint for n in robot.joint_names])
    fingers = robot.fingertip_names
    return (
        _joints(d, robot.joint_names, limit, thresholds),
        _plain("object position", "m", d.time, d.position, thresholds.position),
        _plain("object orientation", "rad", d.time, d.angle, thresholds.angle),
        _contacts(d, fingers, thresholds),
        _plain("contact force", "N", d.time, d.force.max(axis=1), thresholds.force, [fingers[i] for i in d.force.argmax(axis=1)]),
    )


def worst(several: Sequence[tuple[Parting, ...]]) -> tuple[Parting, ...]:
    """Of the partings of several worlds, for each quantity the earliest time and the largest differences."""
    out = []
    for same in zip(*several, strict=True):
        first = min(same, key=lambda p: math.inf if p.time is None else p.time)
        most = max(same, key=lambda p: p.largest / p.threshold)
        out.append(
            Parting(
                quantity=first.quantity,
                unit=most.unit,
                threshold=most.threshold,
                time=first.time,
                where=first.where,
                end=max(p.end for p in same if p.unit == most.unit),
                largest=most.largest,
                largest_time=most.largest_time,
                largest_where=most.largest_where,
            )
        )
    return tuple(out)


def first_of(found: Sequence[Parting]) -> Parting | None:
    """The quantity that parts first; None if none does."""
    parted = [p for p in found if p.time is not None]
    return min(parted, key=lambda p: p.time or 0.0, default=None)


def _plain(quantity: str, unit: str, time: np.ndarray, value: np.ndarray, threshold: float, where: list[str] | None = None) -> Parting:
    beyond = np.flatnonzero(value >= threshold)
    first, most = (int(beyond[0]) if len(beyond) else None), int(value.argmax())
    return Parting(
        quantity=quantity,
        unit=unit,
        threshold=threshold,
        time=None if first is None else float(time[first]),
        where="" if where is None or first is None else where[first],
        end=float(value[-1]),
        largest=float(value[most]),
        largest_time=float(time[most]),
        largest_where="" if where is None else where[most],
    )


def _joints(d: Differences, names: Sequence[str], limit: np.ndarray, thresholds: Thresholds) -> Parting:
    """In rad, or in m where the joint that differs most is prismatic; never a mixture: the joint is chosen first, then its unit."""
    share = d.joint / limit
    which = share.argmax(axis=1)
    beyond = np.flatnonzero(share.max(axis=1) >= 1.0)
    most = int(share.max(axis=1).argmax())
    joint = int(which[most])
    first = int(beyond[0]) if len(beyond) else None
    same_kind = limit == limit[joint]
    return Parting(
        quantity="joints",
        unit="rad" if limit[joint] == thresholds.joint else "m",
        threshold=float(limit[joint]),
        time=None if first is None else float(d.time[first]),
        where="" if first is None else names[int(which[first])],
        end=float(d.joint[-1, same_kind].max()),
        largest=float(d.joint[most, joint]),
        largest_time=float(d.time[most]),
        largest_where=names[joint],
    )


def _contacts(d: Differences, fingers: Sequence[str], thresholds: Thresholds) -> Parting:
    """The difference is the number of fingers that touch in one and not in the other."""
    other = d.touch != d.reference_touch
    number = other.sum(axis=1)
    dt = float(d.time[0])
    need = max(1, round(thresholds.contact_time / dt))
    lasting = _runs(number > 0, need)
    first, most = (int(np.argmax(lasting)) if lasting.any() else None), int(number.argmax())

    def describe(step: int) -> str:
        parts = []
        for i in np.flatnonzero(other[step]).tolist():
            parts.append(f"{fingers[i]} touches" if d.touch[step, i] else f"{fingers[i]} does not touch")
        return ", ".join(parts)

    return Parting(
        quantity="contacts",
        unit="fingers",
        threshold=1.0,
        time=None if first is None else float(d.time[first]),
        where="" if first is None else describe(first),
        end=float(number[-1]),
        largest=float(number[most]),
        largest_time=float(d.time[most]),
        largest_where=describe(most),
    )


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
