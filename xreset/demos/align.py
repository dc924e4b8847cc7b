"""Put demonstrations onto the table: its true normal, and its height under each object (the paper, appendix D.a)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from xreset.demos.archive import Demos
from xreset.errors import DemoError
from xreset.objects.rest import rest_height
from xreset.spec import ObjectSpec

CALIBRATION_ERROR = 0.020
"""Largest height above the table at which an object counts as standing on it [m]. In 270 sequences of DexYCB all but
one are within 12 mm; that one is 44 mm up."""


def levelled(demos: Demos) -> Demos:
    """Return the demonstrations in a frame whose z axis is the true table's normal, by ``T_level_from_table``.

    DexYCB's tag plane is tilted by about one degree against the table. Demonstrations without the transforms stay
    unchanged.

    Raises:
        DemoError: some subjects have a transform, but another does not.
    """
    if demos.T_level_from_table is None or demos.subjects is None:
        return demos
    known = demos.subjects.tolist()
    missing = sorted(set(demos.subject.tolist()) - set(known))
    if missing:
        raise DemoError(f"T_level_from_table is given for {', '.join(known)}, but not for {', '.join(missing)}.")
    subject = np.array([known.index(name) for name in demos.subject.tolist()])
    T = demos.T_level_from_table[subject[demos.sequence_of_frame]]
    R = T[:, :3, :3]
    turn = Rotation.from_matrix(R)

    def rotate(quats: np.ndarray) -> np.ndarray:
        return (turn * Rotation.from_quat(quats, scalar_first=True)).as_quat(scalar_first=True).astype(quats.dtype)

    kind = demos.object_pos.dtype
    known_wrist = np.where(demos.hand_valid[:, None], demos.wrist_quat_wxyz, [1.0, 0.0, 0.0, 0.0])
    wrist = rotate(known_wrist.astype(demos.wrist_quat_wxyz.dtype))
    keypoints = np.einsum("fij,f...j->f...i", R, demos.hand_keypoints) + T[:, None, :3, 3]
    return replace(
        demos,
        hand_keypoints=keypoints.astype(demos.hand_keypoints.dtype),
        wrist_quat_wxyz=np.where(demos.hand_valid[:, None], wrist, demos.wrist_quat_wxyz),
        object_pos=(np.einsum("fij,f...j->f...i", R, demos.object_pos) + T[:, :3, 3]).astype(kind),
        object_quat_wxyz=rotate(demos.object_quat_wxyz),
        T_level_from_table=np.tile(np.eye(4), (len(known), 1, 1)),
    )


def start_height(demos: Demos, objects: Mapping[str, ObjectSpec]) -> np.ndarray:
    """[S] height of the object's lowest vertex in each sequence's first frame [m]."""
    heights = []
    for name, pos, quat in zip(demos.object_name.tolist(), *demos.start_pose, strict=True):
        heights.append(pos[2] - rest_height(objects[name], quat))
    return np.array(heights)


def on_something(demos: Demos, objects: Mapping[str, ObjectSpec]) -> np.ndarray:
    """[S] bool: whether the object starts so high that it must stand on something else than the table."""
    return start_height(demos, objects) > CALIBRATION_ERROR


def grounded(demos: Demos, objects: Mapping[str, ObjectSpec]) -> Demos:
    """Shift every sequence along z so that its object's lowest vertex is at z = 0 in the first frame.

    A sequence whose object starts on top of something else stays where it is: its hand would else reach into the table.
    The scene does not have the thing below the object, so in physics the object first drops by that height.
    """
    height = start_height(demos, objects)
    height[height > CALIBRATION_ERROR] = 0.0
    shift = np.zeros((demos.num_frames, 3))
    shift[:, 2] = -height[demos.sequence_of_frame]
    return replace(
        demos,
        hand_keypoints=(demos.hand_keypoints + shift[:, None]).astype(demos.hand_keypoints.dtype),
        object_pos=(demos.object_pos + shift).astype(demos.object_pos.dtype),
    )
