"""What demonstrations contain, object by object."""

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


def summarize(demos: Demos) -> list[ObjectSummary]:
    """One summary per object, in order of name."""
    start_pos, start_quat = demos.start_pose
    goal_pos, goal_quat = demos.goal_pose
    lift = np.array([demos.object_pos[demos.frames(i), 2].max() for i in range(demos.num_sequences)]) - start_pos[:, 2]
    distance = np.linalg.norm(goal_pos - start_pos, axis=1)
    turn = Rotation.from_quat(goal_quat, scalar_first=True) * Rotation.from_quat(start_quat, scalar_first=True).inv()
    angle = turn.magnitude()
    frames = np.diff(demos.frame_offsets)
    hand_frames = np.add.reduceat(demos.hand_valid.astype(np.int64), demos.frame_offsets[:-1])
    out = []
    for name in sorted(set(demos.object_name.tolist())):
        own = demos.object_name == name
        out.append(
            ObjectSummary(
                object_name=name,
                sequences=int(own.sum()),
                right=int((demos.hand_side[own] == "right").sum()),
                frames=int(frames[own].sum()),
                hand_frames=int(hand_frames[own].sum()),
                lift=float(np.median(lift[own])),
                goal_distance=float(np.median(distance[own])),
                goal_angle=float(np.median(angle[own])),
            )
        )
    return out
