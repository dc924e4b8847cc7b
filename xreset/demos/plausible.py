"""Doubts about demonstrations whose numbers are all allowed, but would make sense in another convention."""

from __future__ import annotations

import numpy as np

from xreset.demos.archive import Demos
from xreset.demos.hand import bone_lengths
from xreset.demos.keypoints import ORDERS
from xreset.geometry.shapes import turn_of

_SHORTER = 0.8
"""A skeleton that is shorter by this factor in another order is in that order: bones of a wrong order cross the
palm."""
_HEIGHTS = (-0.1, 0.6)
"""Heights of the origins of objects at the start, on a table or a stand on it [m]."""
_ALONG = 0.9
"""Cosine of wrist and fingers: at least 0.983 in 270 sequences of DexYCB; 0.35 and -0.67 at the median if read in a
wrong order."""
_SAME_PLACE = 0.02
"""Distance from the start within which the goal counts as reached [m] (:data:`xreset.eval.metrics.GOAL_DISTANCE`)."""
_SAME_TURN = np.radians(15.0)
"""The same for the angle [rad]."""
_FASTEST = 5.0
"""Speed of an object from frame to frame [m/s]: at most 1.7 in 599 of 600 sequences of DexYCB, 3.2 in the other."""


def doubts(demos: Demos) -> list[str]:
    """Return a sentence for each doubt."""
    found = []
    valid = demos.hand_valid
    hand = demos.hand_keypoints[valid].astype(float)
    if len(hand):
        length = np.median(bone_lengths(hand).sum(axis=1))
        mano_length = np.median(bone_lengths(hand[:, ORDERS["mano"]]).sum(axis=1))
        if mano_length < _SHORTER * length:
            found.append(
                f"The hand's bones are {length:.2f} m long together, but {mano_length:.2f} m if the keypoints are in"
                " MANO's order. Put them into the order of xreset.spec.KEYPOINTS."
            )
        # a right hand's fingers point along the wrist's -x axis, a left hand's along +x
        fingers = hand[:, [5, 9, 13, 17]].mean(axis=1) - hand[:, 0]
        fingers /= np.linalg.norm(fingers, axis=1, keepdims=True).clip(1e-9)
        wrist = turn_of(demos.wrist_quat_wxyz[valid])
        along = (wrist.apply([1.0, 0.0, 0.0]) * fingers).sum(axis=1)
        is_right = demos.hand_side[demos.sequence_of_frame][valid] == "right"
        cosine = np.median(np.where(is_right, -along, along))
        if cosine < _ALONG:
            found.append(
                f"The wrist's orientations do not point along the fingers (cosine {cosine:.2f}, expected 1). Are they"
                " MANO's root, in the table frame, and quaternions (w, x, y, z)? Check those of the objects too."
            )
    height = demos.start_pose[0][:, 2]
    distance, angle = start_to_goal(demos)
    owner = demos.sequence_of_frame
    speed = demos.fps * np.linalg.norm(np.diff(demos.object_pos, axis=0), axis=1)
    jumps = (speed > _FASTEST) & (np.diff(owner) == 0)
    for wrong, sentence in (
        (
            (height < _HEIGHTS[0]) | (height > _HEIGHTS[1]),
            "begin with the object far from the table's top, z = 0. Are these coordinates of a camera?",
        ),
        (
            (distance < _SAME_PLACE) & (angle < _SAME_TURN),
            "begin with the object at its goal already. A policy that leaves the object untouched solves such a"
            " demonstration.",
        ),
        (
            np.bincount(owner[1:], jumps) > 0,
            f"have an object that jumps from frame to frame, faster than {_FASTEST:g} m/s. Repair them, or leave them"
            " out (xreset demos split).",
        ),
    ):
        if wrong.any():
            first = demos.sequence_name[np.argmax(wrong)]
            found.append(f"{wrong.sum()} of {len(demos)} sequences {sentence} First: {first}.")
    return found


def start_to_goal(demos: Demos) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance [S] in metres and the angle [S] in radians from each object's first to its last pose."""
    start_pos, start_quat = demos.start_pose
    goal_pos, goal_quat = demos.goal_pose
    turn = turn_of(goal_quat) * turn_of(start_quat).inv()
    return np.linalg.norm(goal_pos - start_pos, axis=1), turn.magnitude()
