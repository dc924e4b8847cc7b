"""What is odd about demonstrations although every number is allowed: units, orders and frames that another convention would explain."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from xreset.demos.archive import Demos
from xreset.demos.hand import bone_lengths
from xreset.demos.keypoints import ORDERS
from xreset.spec import ObjectSpec

_SHORTER = 0.8
"""A skeleton that is so much shorter in another order is in that order: bones of a wrong order cross the palm."""
_HEIGHTS = (-0.1, 0.6)
"""[m] Of objects at the start: origins of their meshes, above a table or a stand on it."""
_ALONG = 0.9
"""Of recorded sequences the cosine is 0.983 at least (270 of DexYCB); read in a wrong order it is 0.35 and -0.67 at the median."""
_TILT = 0.01
"""[m] An object that stands on the table has its lowest point nearer to it than this (99 % of those 270); read in a wrong order 25 %."""
_SAME = (0.02, np.radians(15.0))
"""Distance [m] and angle [rad] from the start within which the goal counts as reached (:class:`xreset.eval.metrics.MetricsConfig`)."""


def doubts(demos: Demos, objects: Mapping[str, ObjectSpec] | None = None) -> list[str]:
    """Sentences; none if nothing is odd.

    Args:
        objects: their objects by name; without them it is not seen whether they stand on the table.
    """
    found = []
    valid = np.asarray(demos.hand_valid)
    hand = demos.hand_keypoints[valid].astype(float)
    if len(hand):
        ours, mano = (np.median(bone_lengths(points).sum(axis=1)) for points in (hand, hand[:, ORDERS["mano"]]))
        if mano < _SHORTER * ours:
            found.append(
                f"the hand's bones are {ours:.2f} m long together, but {mano:.2f} m if the keypoints are in MANO's order. "
                "Put them into the order of xreset.spec.KEYPOINTS."
            )
        wxyz = demos.wrist_quat_wxyz[valid].astype(float)
        right = (demos.hand_side[demos.sequence_of_frame] == "right")[valid]
        along, other = _along_fingers(hand, wxyz, right), _along_fingers(hand, wxyz[:, [3, 0, 1, 2]], right)
        if along < _ALONG:
            order = (
                "Read as (x, y, z, w) they would: put w first."
                if other > _ALONG
                else "Are they MANO's root, in the table frame?"
            )
            found.append(
                f"the wrist's orientations do not point along the fingers (cosine {along:.2f}, expected 1). {order} "
                "Are the objects' in the right order?"
            )
    start, goal = demos.start_pose, demos.goal_pose
    odd = (start[0][:, 2] < _HEIGHTS[0]) | (start[0][:, 2] > _HEIGHTS[1])
    if odd.any():
        i = int(np.argmax(odd))
        found.append(
            f"{_some(odd)} with the object at a height of {start[0][i, 2]:.2f} m ({demos.sequence_name[i]}): "
            "are these coordinates of a camera? The table's top is z = 0."
        )
    elif objects:
        names = demos.object_name.tolist()
        ours, other = (
            _standing(objects, names, start[0][:, 2], start[1][:, order]) for order in ([0, 1, 2, 3], [3, 0, 1, 2])
        )
        if ours < 0.5 < other:
            found.append(
                f"{ours:.0%} of the objects stand on the table if their orientations are (w, x, y, z), "
                f"{other:.0%} if they are (x, y, z, w). Put w first."
            )
    turned = (
        Rotation.from_quat(start[1], scalar_first=True).inv() * Rotation.from_quat(goal[1], scalar_first=True)
    ).magnitude()
    same = (np.linalg.norm(goal[0] - start[0], axis=1) < _SAME[0]) & (turned < _SAME[1])
    if same.any():
        i = int(np.argmax(same))
        found.append(
            f"{_some(same, 'ends')} where it starts ({demos.sequence_name[i]}): whatever lets the object stand solves it."
        )
    return found


def _along_fingers(hand: np.ndarray, quat_wxyz: np.ndarray, right: np.ndarray) -> float:
    """Median cosine between where the fingers point and where the wrist's frames [F, 4] say: along -x, of a left hand along +x."""
    fingers = hand[:, [5, 9, 13, 17]].mean(axis=1) - hand[:, 0]
    fingers /= np.linalg.norm(fingers, axis=1, keepdims=True).clip(1e-9)
    axes = Rotation.from_quat(quat_wxyz, scalar_first=True).apply([1.0, 0.0, 0.0])
    return float(np.median(np.where(right, -1.0, 1.0) * (axes * fingers).sum(axis=1)))


def _standing(objects: Mapping[str, ObjectSpec], names: list[str], height: np.ndarray, quat_wxyz: np.ndarray) -> float:
    """Share of objects whose lowest point is at the table's height."""
    turns = Rotation.from_quat(quat_wxyz, scalar_first=True)
    lowest = [
        z + turn.apply(objects[name].vertices)[:, 2].min() for name, z, turn in zip(names, height, turns, strict=True)
    ]
    return float(np.mean(np.abs(lowest) < _TILT))


def _some(which: np.ndarray, verb: str = "begins") -> str:
    return f"{int(which.sum())} of {len(which)} sequences {verb if which.sum() == 1 else verb.removesuffix('s')}"
