"""Putting demonstrations onto the table: its true normal, and its height under each object (the paper, appendix D.a)."""

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
"""Largest height above the table that an object which stands on it may seem to have [m]. In 270 sequences of DexYCB all but one are within
12 mm, and that one is 44 mm up."""


def levelled(demos: Demos) -> Demos:
    """The same in a frame whose z axis is the true table's normal, by ``T_level_from_table``; unchanged if there is none.

    DexYCB's tag plane is tilted by about one degree against the table.

    Raises:
        DemoError: some subjects have a transform, but another does not.
    """
    if demos.T_level_from_table is None or demos.subjects is None:
        return demos
    index = {name: i for i, name in enumerate(demos.subjects.tolist())}
    missing = sorted(set(demos.subject.tolist()) - set(index))
    if missing:
        raise DemoError(f"T_level_from_table is given for {', '.join(index)}, but not for {', '.join(missing)}.")
    T = demos.T_level_from_table[[index[name] for name in demos.subject.tolist()]][demos.sequence_of_frame]
    turn = Rotation.from_matrix(T[:, :3, :3]).as_quat()

    def moved(points: np.ndarray) -> np.ndarray:
        return (
            np.einsum("fij,f...j->f...i", T[:, :3, :3], points) + T[:, :3, 3].reshape(-1, *[1] * (points.ndim - 2), 3)
        ).astype(points.dtype)

    def turned(quats: np.ndarray, known: np.ndarray) -> np.ndarray:
        out = quats.copy()
        out[known] = (Rotation.from_quat(turn[known]) * Rotation.from_quat(quats[known], scalar_first=True)).as_quat(
            scalar_first=True
        )
        return out

    return replace(
        demos,
        hand_keypoints=moved(demos.hand_keypoints),
        wrist_quat_wxyz=turned(demos.wrist_quat_wxyz, demos.hand_valid),
        object_pos=moved(demos.object_pos),
        object_quat_wxyz=turned(demos.object_quat_wxyz, np.ones(demos.num_frames, dtype=bool)),
        T_level_from_table=np.broadcast_to(np.eye(4), demos.T_level_from_table.shape).copy(),
    )


def start_height(demos: Demos, objects: Mapping[str, ObjectSpec]) -> np.ndarray:
    """[S] height of the object's lowest vertex in each sequence's first frame [m]."""
    pos, quat = demos.start_pose
    return np.array(
        [
            z - rest_height(objects[name], q)
            for name, z, q in zip(demos.object_name.tolist(), pos[:, 2], quat, strict=True)
        ]
    )


def on_something(demos: Demos, objects: Mapping[str, ObjectSpec]) -> np.ndarray:
    """[S] bool: whether a sequence's object starts so high that it must stand on something else than the table."""
    return start_height(demos, objects) > CALIBRATION_ERROR


def grounded(demos: Demos, objects: Mapping[str, ObjectSpec]) -> Demos:
    """The same with every sequence shifted along z so that its object's lowest vertex is at z = 0 in the first frame.

    A sequence whose object starts on top of something else stays where it is: lowered, its hand would reach into the table. Whatever the
    object stood on is not in the scene, so in physics it drops by that height first.
    """
    height = np.where(on_something(demos, objects), 0.0, start_height(demos, objects))
    shift = np.zeros((demos.num_frames, 3))
    shift[:, 2] = -height[demos.sequence_of_frame]
    return replace(
        demos,
        hand_keypoints=(demos.hand_keypoints + shift[:, None]).astype(demos.hand_keypoints.dtype),
        object_pos=(demos.object_pos + shift).astype(demos.object_pos.dtype),
    )
