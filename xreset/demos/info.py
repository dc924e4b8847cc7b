"""Summary of demonstrations, object by object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from xreset.demos.archive import Demos


@dataclass(frozen=True, kw_only=True)
class ObjectSummary:
    """The sequences of one object; lift and goal are medians over them."""

    object_name: str
    sequences: int
    right: int
    """Sequences of right hands; the others are of left hands."""
    frames: int
    hand_frames: int
    """Frames in which the hand is annotated."""
    lift: float
    """Highest point above the start [m]."""
    goal_distance: float
    """From start to goal position [m]."""
    goal_angle: float
    """From start to goal orientation [rad]."""


def start_to_goal(demos: Demos) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance [S] in metres and the angle [S] in radians from each object's first to its last pose."""
    start_pos, start_quat = demos.start_pose
    goal_pos, goal_quat = demos.goal_pose
    turn = Rotation.from_quat(goal_quat, scalar_first=True) * Rotation.from_quat(start_quat, scalar_first=True).inv()
    return np.linalg.norm(goal_pos - start_pos, axis=1), turn.magnitude()


def summarize(demos: Demos) -> list[ObjectSummary]:
    """Return one summary per object, sorted by name."""
    starts = demos.frame_offsets[:-1]
    lift = np.maximum.reduceat(demos.object_pos[:, 2], starts) - demos.object_pos[starts, 2]
    distance, angle = start_to_goal(demos)
    frames = np.diff(demos.frame_offsets)
    hand_frames = np.add.reduceat(demos.hand_valid.astype(np.int64), starts)
    summaries = []
    for name in sorted(set(demos.object_name.tolist())):
        own = demos.object_name == name
        summary = ObjectSummary(
            object_name=name,
            sequences=int(own.sum()),
            right=int((demos.hand_side[own] == "right").sum()),
            frames=int(frames[own].sum()),
            hand_frames=int(hand_frames[own].sum()),
            lift=float(np.median(lift[own])),
            goal_distance=float(np.median(distance[own])),
            goal_angle=float(np.median(angle[own])),
        )
        summaries.append(summary)
    return summaries
