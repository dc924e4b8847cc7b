"""Doubts about demonstrations whose numbers are all allowed: units, orders and frames that another convention would
explain."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from xreset.demos.archive import Demos
from xreset.demos.hand import bone_lengths
from xreset.demos.info import start_to_goal
from xreset.demos.keypoints import ORDERS
from xreset.spec import ObjectSpec

_SHORTER = 0.8
"""A skeleton that is shorter by this factor in another order is in that order: bones of a wrong order cross the
palm."""
_HEIGHTS = (-0.1, 0.6)
"""Heights of the origins of objects at the start, on a table or a stand on it [m]."""
_ALONG = 0.9
"""Cosine of wrist and fingers: at least 0.983 in 270 sequences of DexYCB; 0.35 and -0.67 at the median if read in a
wrong order."""
_TILT = 0.01
"""Largest height of the lowest point of an object on the table [m]: 99 % of these sequences; 25 % if read in a wrong
order."""
_SAME_PLACE = 0.02
"""Distance from the start within which the goal counts as reached [m] (:class:`xreset.eval.metrics.MetricsConfig`)."""
_SAME_TURN = np.radians(15.0)
"""The same for the angle [rad]."""
_WXYZ_FROM_XYZW = [3, 0, 1, 2]


def doubts(demos: Demos, objects: Mapping[str, ObjectSpec] | None = None) -> list[str]:
    """Return a sentence for each doubt.

    Args:
        objects: the demonstrations' objects by name; without them the objects' orientations are not checked.
    """
    found = []
    valid = np.asarray(demos.hand_valid)
    hand = demos.hand_keypoints[valid].astype(float)
    if len(hand):
        length = np.median(bone_lengths(hand).sum(axis=1))
        mano_length = np.median(bone_lengths(hand[:, ORDERS["mano"]]).sum(axis=1))
        if mano_length < _SHORTER * length:
            found.append(
                f"The hand's bones are {length:.2f} m long together, but {mano_length:.2f} m if the keypoints are in"
                " MANO's order."
                " Put them into the order of xreset.spec.KEYPOINTS."
            )
        right = (demos.hand_side[demos.sequence_of_frame] == "right")[valid]
        wrist = demos.wrist_quat_wxyz[valid].astype(float)
        cosine = _along_fingers(hand, wrist, right)
        if cosine < _ALONG:
            hint = "Are they MANO's root, in the table frame?"
            if _along_fingers(hand, wrist[:, _WXYZ_FROM_XYZW], right) > _ALONG:
                hint = "Read as (x, y, z, w) they would: put w first, also in the objects' orientations."
            found.append(
                f"The wrist's orientations do not point along the fingers (cosine {cosine:.2f}, expected 1). {hint}"
            )
    start_pos, start_quat = demos.start_pose
    height = start_pos[:, 2]
    odd = (height < _HEIGHTS[0]) | (height > _HEIGHTS[1])
    if odd.any():
        found.append(
            f"{_count(odd, demos)} with the object at a height of {height[np.argmax(odd)]:.2f} m."
            " Are these coordinates of a camera? The table's top is z = 0."
        )
    elif objects:
        specs = [objects[name] for name in demos.object_name.tolist()]
        share = _standing(specs, height, start_quat)
        other_share = _standing(specs, height, start_quat[:, _WXYZ_FROM_XYZW])
        if share < 0.5 < other_share:
            found.append(
                f"{share:.0%} of the objects stand on the table if their orientations are (w, x, y, z), "
                f"{other_share:.0%} if they are (x, y, z, w). Put w first."
            )
    distance, angle = start_to_goal(demos)
    same = (distance < _SAME_PLACE) & (angle < _SAME_TURN)
    if same.any():
        found.append(
            f"{_count(same, demos)} at its goal already. A policy that leaves the object untouched solves such a"
            " demonstration."
        )
    return found


def _along_fingers(hand: np.ndarray, quat_wxyz: np.ndarray, right: np.ndarray) -> float:
    """Return the median cosine between the fingers and the wrist's -x axis, of a left hand +x, over frames [F]."""
    fingers = hand[:, [5, 9, 13, 17]].mean(axis=1) - hand[:, 0]
    fingers /= np.linalg.norm(fingers, axis=1, keepdims=True).clip(1e-9)
    axes = Rotation.from_quat(quat_wxyz, scalar_first=True).apply([1.0, 0.0, 0.0])
    return float(np.median(np.where(right, -1.0, 1.0) * (axes * fingers).sum(axis=1)))


def _standing(objects: list[ObjectSpec], height: np.ndarray, quat_wxyz: np.ndarray) -> float:
    """Return the share of objects whose lowest point is at the table's height."""
    turns = Rotation.from_quat(quat_wxyz, scalar_first=True)
    lowest = []
    for obj, z, turn in zip(objects, height, turns, strict=True):
        lowest.append(z + turn.apply(obj.vertices)[:, 2].min())
    return float(np.mean(np.abs(lowest) < _TILT))


def _count(which: np.ndarray, demos: Demos) -> str:
    """Return such as '3 of 9 sequences begin (first: NAME)'."""
    verb = "begins" if which.sum() == 1 else "begin"
    return f"{which.sum()} of {len(which)} sequences {verb} (first: {demos.sequence_name[np.argmax(which)]})"
