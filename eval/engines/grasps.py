"""Grasps that demonstrations show: frames in which the hand is at the object, whatever an engine makes of them.

Shape letters: F frames, G grasps, J joints, R rows (chosen frames).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from xreset.errors import DemoError
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.rotations import quat_rotate_inverse
from xreset.geometry.surface import Surface
from xreset.resets.bank import ResetBank
from xreset.retarget.file import Retargeted
from xreset.spec import ObjectSpec, RobotSpec, lowest_point

REST_DISTANCE = 0.010
"""Distance [m] from its start up to which an object counts as at rest on the table."""
REST_ANGLE = np.radians(10.0)
"""Angle [rad] from its start up to which it does."""
LIFTED = 0.030
"""Height [m] above its start from which an object counts as lifted."""
CLEARANCE = 0.0005
"""Least height [m] of an object above the table. Demonstrated poses may be sunk into it; engines eject such objects."""
NEAR = 0.025
"""A fingertip nearer than this [m] to the object's collision surface may touch it once the hand closes."""


@dataclass(frozen=True, kw_only=True)
class Frames:
    """Frames of robot trajectories after the first contact, in the order of their sequences."""

    joint_pos: np.ndarray
    """[F, J] rad (m)"""
    object_pos: np.ndarray
    """[F, 3]"""
    object_quat: np.ndarray
    """[F, 4]"""
    object_name: np.ndarray
    """[F]"""
    sequence_name: np.ndarray
    """[F]"""
    frame: np.ndarray
    """[F] number within the sequence."""
    start_pos: np.ndarray
    """[F, 3] position of the object in the sequence's first frame."""
    start_quat: np.ndarray
    """[F, 4]"""

    @classmethod
    def of(cls, data: Retargeted | ResetBank) -> Frames:
        """Return the frames after first contact: of motion the valid frames, of a bank its states."""
        if isinstance(data, ResetBank):
            rows = np.flatnonzero(data.post_contact)
            sequence = data.sequence_index[rows]
            frame = data.frame_index[rows]
            object_name = data.object_name[rows]
            start_pos = data.start_pos
            start_quat = data.start_quat_wxyz
        else:
            rows = np.flatnonzero(data.valid & data.post_contact)
            sequence = data.sequence_of_frame[rows]
            frame = rows - data.frame_offsets[sequence]
            object_name = data.object_name[sequence]
            start_pos, start_quat = data.start_pose
        return cls(
            joint_pos=data.joint_pos[rows],
            object_pos=data.object_pos[rows],
            object_quat=data.object_quat_wxyz[rows],
            object_name=object_name,
            sequence_name=data.sequence_name[sequence],
            frame=frame,
            start_pos=start_pos[sequence],
            start_quat=start_quat[sequence],
        )


@dataclass(frozen=True, kw_only=True)
class Grasps:
    """G grasps: how a hand is about to hold an object."""

    label: tuple[str, ...]
    """Sequence and frame."""
    object_index: Tensor
    """[G] index into the objects."""
    joint_pos: Tensor
    """[G, J] rad (m)"""
    object_pos: Tensor
    """[G, 3]"""
    object_quat: Tensor
    """[G, 4]"""

    def __len__(self) -> int:
        """G"""
        return len(self.label)


def find_grasps(
    frames: Frames, robot: RobotSpec, objects: Sequence[ObjectSpec], count: int, *, where: Literal["table", "air"]
) -> Grasps:
    """Choose grasps, equally many of each object and spread over the sequences; the same arguments give the same
    grasps.

    In the frames that count, the thumb's tip and another tip are near the object's surface. ``table``: the object is
    still where it started; of a sequence, the last such frame comes first, in which the person is about to lift.
    ``air``: the object is lifted; the middle frame comes first.

    Args:
        frames: where to look.
        robot: the robot.
        objects: geometry; frames of other objects are left out.
        count: largest G; there are fewer grasps where the frames show fewer.
        where: the object's place.

    Raises:
        DemoError: there is no grasp on the table.
    """
    names = [o.name for o in objects]
    if where == "table":
        start = Rotation.from_quat(frames.start_quat, scalar_first=True)
        turned = (Rotation.from_quat(frames.object_quat, scalar_first=True) * start.inv()).magnitude()
        moved = np.linalg.norm(frames.object_pos - frames.start_pos, axis=1)
        fits = (moved < REST_DISTANCE) & (turned < REST_ANGLE)
    else:
        fits = frames.object_pos[:, 2] - frames.start_pos[:, 2] > LIFTED
    rows = np.flatnonzero(fits & np.isin(frames.object_name, names))
    rows = rows[_at_hand(frames, rows, robot, objects)]
    rows = rows[_turns(frames, rows, last_first=where == "table")[:count]]
    if not len(rows) and where == "table":
        raise DemoError(
            f"no grasp was found in {len(frames.frame)} frames after first contact: in none is an object of "
            f"{', '.join(names)} on the table with the thumb and another fingertip within {1e3 * NEAR:.0f} mm of it. "
            "Retarget more demonstrations."
        )
    object_index = [names.index(name) for name in frames.object_name[rows].tolist()]
    object_pos = frames.object_pos[rows].astype(np.float64)
    lowest = [_lowest(objects[i], quat) for i, quat in zip(object_index, frames.object_quat[rows], strict=True)]
    object_pos[:, 2] = np.maximum(object_pos[:, 2], CLEARANCE - np.array(lowest))
    return Grasps(
        label=tuple(f"{frames.sequence_name[row]}:{frames.frame[row]}" for row in rows),
        object_index=torch.tensor(object_index, dtype=torch.long),
        joint_pos=torch.as_tensor(frames.joint_pos[rows], dtype=torch.float64),
        object_pos=torch.as_tensor(object_pos),
        object_quat=torch.as_tensor(frames.object_quat[rows], dtype=torch.float64),
    )


def _lowest(thing: ObjectSpec, quat: np.ndarray) -> float:
    """Return the smallest z of the object turned by ``quat``, relative to the origin of its mesh frame [m]."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(quat, scalar_first=True).as_matrix()
    return lowest_point([replace(piece, T_body_shape=T @ piece.T_body_shape) for piece in thing.pieces])


def _at_hand(frames: Frames, rows: np.ndarray, robot: RobotSpec, objects: Sequence[ObjectSpec]) -> np.ndarray:
    """[R] bool: whether the thumb's tip and another tip are near the object."""
    out = np.zeros(len(rows), dtype=bool)
    kinematics = Kinematics(robot)
    links = [tip.link for tip in robot.fingertips]
    for thing in objects:
        mine = np.flatnonzero(frames.object_name[rows] == thing.name)
        if not len(mine):
            continue
        chosen = rows[mine]
        tips = kinematics.points(torch.as_tensor(frames.joint_pos[chosen], dtype=torch.float64), links)
        pos = torch.as_tensor(frames.object_pos[chosen], dtype=torch.float64)[:, None]
        quat = torch.as_tensor(frames.object_quat[chosen], dtype=torch.float64)[:, None]
        local = quat_rotate_inverse(quat.expand(-1, len(links), -1), tips - pos)
        distance, _ = Surface(thing).signed_distance(local.flatten(0, 1))
        near = (distance < NEAR).view(len(chosen), len(links)).numpy()
        out[mine] = near[:, 0] & near[:, 1:].any(axis=1)
    return out


def _turns(frames: Frames, rows: np.ndarray, *, last_first: bool) -> np.ndarray:
    """Order rows [R]: objects take turns, then an object's sequences; a sequence's best frame comes first."""
    rank = np.zeros(len(rows), dtype=int)
    sequence_name = frames.sequence_name[rows]
    for name in dict.fromkeys(sequence_name.tolist()):
        mine = np.flatnonzero(sequence_name == name)
        best = len(mine) - 1 if last_first else len(mine) // 2
        rank[mine[np.argsort(np.abs(np.arange(len(mine)) - best), kind="stable")]] = np.arange(len(mine))
    by_rank = np.argsort(rank, kind="stable")
    turn = np.zeros(len(rows), dtype=int)
    object_name = frames.object_name[rows]
    for name in dict.fromkeys(object_name.tolist()):
        mine = by_rank[object_name[by_rank] == name]
        turn[mine] = np.arange(len(mine))
    return np.argsort(turn, kind="stable")
