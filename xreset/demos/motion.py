"""Motion of hand and object in a synthetic demonstration: random timing, approach, lift and goal."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from xreset.demos import hand
from xreset.demos.grasp import Grasp, best_of, handedness

LIFT = (0.14, 0.41)
"""Range of heights to which objects are lifted [m]: the 5th and 95th percentile of 180 right-hand DexYCB sequences."""

_TRIES = 12
_CLEAR = 0.001
"""A path is good if no keypoint comes nearer than this to object or table [m]; a fingertip in contact is at about 2
mm."""
_OPENING = np.array([0.0, 0.4, 0.2] * 4 + [-0.15, -0.1, 0.0, 0.3, 0.3])
"""[17] joint angles by which a hand opens before a grasp [rad]."""


@dataclass(frozen=True, kw_only=True)
class Timing:
    """Events of a demonstration, as numbers of frames."""

    frames: int
    """T, all frames."""
    reach: int
    """The hand has arrived."""
    close: int
    """The fingers are on the object."""
    lift: int
    """The object begins to move."""
    end: int
    """The object is at the goal."""


@dataclass(frozen=True, kw_only=True)
class HandPath:
    """A hand's motion up to the grasp, [T] frames; the grasp holds to the end."""

    grasp: Grasp
    wrist_pos: np.ndarray
    """[T, 3]"""
    wrist_rot: Rotation
    """T orientations."""
    angles: np.ndarray
    """[T, 17] joint angles."""
    gap: float
    """Smallest distance of a keypoint to object and table until the lift [m]."""


def random_timing(fps: float, rng: np.random.Generator) -> Timing:
    """Draw the timing of a demonstration of about 2.4 s whose object leaves the table after about 1.15 s."""
    durations = [
        rng.uniform(*span)
        for span in ((0.75, 0.95), (0.15, 0.25), (0.05, 0.1), (0.8, 1.0), (0.25, 0.45))
    ]
    reach, close, lift, end, last = (
        round(float(seconds) * fps) for seconds in np.cumsum(durations)
    )
    return Timing(frames=last + 1, reach=reach, close=close, lift=lift, end=end)


def object_path(
    pos: np.ndarray, rest: Rotation, timing: Timing, rng: np.random.Generator
) -> tuple[np.ndarray, Rotation]:
    """Draw the object's motion: at rest, lifted, turned, at the goal.

    Args:
        pos: [3] position at rest.
        rest: orientation at rest.

    Returns:
        Positions [T, 3] and T orientations.
    """
    goal = pos + np.array([rng.uniform(-0.06, 0.06), rng.uniform(-0.14, 0.0), rng.uniform(*LIFT)])
    heading = rng.uniform(0, 2 * np.pi)
    tilt = np.radians(rng.uniform(10.0, 40.0)) * np.array([np.cos(heading), np.sin(heading), 0.0])
    turn = Rotation.from_rotvec(tilt) * Rotation.from_euler(
        "z", np.radians(rng.uniform(-45.0, 45.0))
    )
    frame = np.arange(timing.frames)
    rise = _minimum_jerk(frame, timing.lift, timing.end)
    clear_of_table = timing.lift + 0.2 * (timing.end - timing.lift)
    turned = _minimum_jerk(frame, clear_of_table, timing.end)
    object_rot = Rotation.from_rotvec(turned[:, None] * turn.as_rotvec()) * rest
    return pos + rise[:, None] * (goal - pos), object_rot


def clear_approach(grasp: Grasp, timing: Timing, rng: np.random.Generator) -> HandPath:
    """Return the first of some random approaches that stays clear of object and table, or else the one with the largest
    gap."""
    return best_of(
        _TRIES,
        lambda: _approach(grasp, timing, rng),
        is_good=lambda path: path.gap > _CLEAR,
        cost=lambda path: -path.gap,
    )


def place_hand(pos: np.ndarray, rotation: Rotation, angles: np.ndarray, side: str) -> np.ndarray:
    """[T, 21, 3] keypoints of a hand for wrist positions [T, 3], T wrist orientations and joint angles [T, 17]."""
    return (
        np.einsum("nij,nkj->nki", rotation.as_matrix(), hand.keypoints(angles, side)) + pos[:, None]
    )


def _approach(grasp: Grasp, timing: Timing, rng: np.random.Generator) -> HandPath:
    """Move to a place before the object while the hand opens, then forward, then close: minimum-jerk motions that
    overlap."""
    frame = np.arange(timing.frames)
    mirror = handedness(grasp.side)
    x = grasp.solid.pos[0] - mirror * rng.uniform(-0.05, 0.20)
    y = rng.uniform(0.60, 0.80)
    z = grasp.wrist_pos[2] + rng.uniform(0.02, 0.18)
    start = np.array([x, y, z])
    start_rot = Rotation.from_rotvec(rng.normal(0.0, 0.2, 3)) * grasp.wrist_rot
    fingers = grasp.wrist_rot.apply([-mirror, 0.0, 0.0])
    palm = grasp.wrist_rot.apply([0.0, -1.0, 0.0])
    inward = fingers + 0.6 * palm
    before = grasp.wrist_pos - rng.uniform(0.07, 0.10) * inward / np.linalg.norm(inward)
    before[2] = max(before[2], grasp.wrist_pos[2])

    coming = _minimum_jerk(frame, 0, 0.75 * timing.reach)[:, None]
    entering = _minimum_jerk(frame, 0.5 * timing.reach, timing.close)[:, None]
    wrist_pos = start + coming * (before - start) + entering * (grasp.wrist_pos - before)
    turning = _minimum_jerk(frame, 0, 0.85 * timing.reach)[:, None]
    wrist_rot = (
        Rotation.from_rotvec((1 - turning) * (start_rot * grasp.wrist_rot.inv()).as_rotvec())
        * grasp.wrist_rot
    )

    opened = np.clip(grasp.angles - _OPENING, hand.LOWER, hand.UPPER)
    opening = _minimum_jerk(frame, 0.1 * timing.reach, 0.65 * timing.reach)[:, None]
    closing = _minimum_jerk(frame, 0.8 * timing.reach, timing.close)[:, None]
    angles = hand.RELAXED + opening * (opened - hand.RELAXED) + closing * (grasp.angles - opened)
    points = place_hand(wrist_pos, wrist_rot, angles, grasp.side)[: timing.lift]
    gap = min(grasp.solid.distance(points).min(), points[..., 2].min())
    return HandPath(
        grasp=grasp, wrist_pos=wrist_pos, wrist_rot=wrist_rot, angles=angles, gap=float(gap)
    )


def _minimum_jerk(frame: np.ndarray, start: float, end: float) -> np.ndarray:
    """Return 0 until ``start``, 1 from ``end``, and between them the smoothest path of human reaching (Flash and Hogan
    1985)."""
    s = np.clip((frame - start) / (end - start), 0.0, 1.0)
    return s**3 * (10 + s * (6 * s - 15))
