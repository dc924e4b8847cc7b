"""Grasps that demonstrations show: frames in which the hand is at the object, whatever any engine makes of them.

Shape letters: F frames, G grasps, J joints, E fingertips.
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

REST_DISTANCE, REST_ANGLE = 0.010, np.radians(10.0)
"""How far [m, rad] an object may be from where it started and still count as at rest on the table."""
LIFTED = 0.030
"""How far [m] an object must be above where it started to count as lifted."""
CLEARANCE = 0.0005
"""Height [m] of an object over the table, at least: demonstrated poses may be sunk into it, and engines throw such objects up."""
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
    """[F, 3] where the object was in the sequence's first frame."""
    start_quat: np.ndarray
    """[F, 4]"""

    @classmethod
    def of_retargeted(cls, data: Retargeted) -> Frames:
        """Every valid frame after the first contact: no engine has had a say."""
        rows = np.flatnonzero(data.valid & data.post_contact)
        sequence, (start_pos, start_quat) = data.sequence_of_frame[rows], data.start_pose
        return cls(
            joint_pos=data.joint_pos[rows],
            object_pos=data.object_pos[rows],
            object_quat=data.object_quat_wxyz[rows],
            object_name=np.asarray(data.object_name)[sequence],
            sequence_name=np.asarray(data.sequence_name)[sequence],
            frame=rows - data.frame_offsets[sequence],
            start_pos=start_pos[sequence],
            start_quat=start_quat[sequence],
        )

    @classmethod
    def of_bank(cls, bank: ResetBank) -> Frames:
        """The states after the first contact; only those that the bank's engines have found stable."""
        rows = np.flatnonzero(bank.post_contact)
        sequence = bank.sequence_index[rows]
        return cls(
            joint_pos=bank.joint_pos[rows],
            object_pos=bank.object_pos[rows],
            object_quat=bank.object_quat_wxyz[rows],
            object_name=np.asarray(bank.object_name)[rows],
            sequence_name=np.asarray(bank.sequence_name)[sequence],
            frame=bank.frame_index[rows],
            start_pos=bank.start_pos[sequence],
            start_quat=bank.start_quat_wxyz[sequence],
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
    """Choose grasps, alike many of each object and spread over the sequences; the same arguments give the same grasps.

    In the frames that count, the thumb's tip and another are near the object's surface. ``table``: the object still rests where it started;
    of a sequence, the last such frame comes first, in which the person is about to lift. ``air``: the object is lifted; the middle one
    comes first.

    Args:
        objects: geometry; frames of other objects are left out.
        count: G at most; there are fewer where the frames show fewer.

    Raises:
        DemoError: on the table, there is none.
    """
    names = [o.name for o in objects]
    turned = (
        Rotation.from_quat(frames.object_quat, scalar_first=True)
        * Rotation.from_quat(frames.start_quat, scalar_first=True).inv()
    ).magnitude()
    if where == "table":
        fits = (np.linalg.norm(frames.object_pos - frames.start_pos, axis=1) < REST_DISTANCE) & (turned < REST_ANGLE)
    else:
        fits = frames.object_pos[:, 2] - frames.start_pos[:, 2] > LIFTED
    rows = np.flatnonzero(fits & np.isin(frames.object_name, names))
    rows = rows[_at_hand(frames, rows, robot, objects)]
    rows = rows[_turns(frames, rows, last_first=where == "table")[:count]]
    object_index = [names.index(name) for name in frames.object_name[rows].tolist()]
    object_pos = frames.object_pos[rows].astype(np.float64)
    lowest = [_lowest(objects[i], quat) for i, quat in zip(object_index, frames.object_quat[rows], strict=True)]
    object_pos[:, 2] = np.maximum(object_pos[:, 2], CLEARANCE - np.array(lowest))
    if not len(rows) and where == "table":
        raise DemoError(
            f"no grasp was found in {len(frames.frame)} frames after first contact: in none does an object of "
            f"{', '.join(names)} rest on the table with the thumb and another fingertip within {1e3 * NEAR:.0f} mm of it. "
            "Retarget more demonstrations."
        )
    return Grasps(
        label=tuple(f"{frames.sequence_name[row]}:{frames.frame[row]}" for row in rows),
        object_index=torch.tensor(object_index, dtype=torch.long),
        joint_pos=torch.as_tensor(frames.joint_pos[rows], dtype=torch.float64),
        object_pos=torch.as_tensor(object_pos),
        object_quat=torch.as_tensor(frames.object_quat[rows], dtype=torch.float64),
    )


def _lowest(thing: ObjectSpec, quat: np.ndarray) -> float:
    """Smallest z of the collision pieces, relative to the mesh frame's origin, when the object is turned so [m]."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(quat, scalar_first=True).as_matrix()
    return lowest_point([replace(piece, T_body_shape=T @ piece.T_body_shape) for piece in thing.pieces])


def _at_hand(frames: Frames, rows: np.ndarray, robot: RobotSpec, objects: Sequence[ObjectSpec]) -> np.ndarray:
    """[len(rows)] bool: whether the thumb's tip and another are near the object."""
    out = np.zeros(len(rows), dtype=bool)
    kinematics, links = Kinematics(robot), [tip.link for tip in robot.fingertips]
    for thing in objects:
        mine = np.flatnonzero(frames.object_name[rows] == thing.name)
        if not len(mine):
            continue
        chosen = rows[mine]
        tips = kinematics.points(torch.as_tensor(frames.joint_pos[chosen], dtype=torch.float64), links)
        pos, quat = (
            torch.as_tensor(x[chosen], dtype=torch.float64)[:, None] for x in (frames.object_pos, frames.object_quat)
        )
        local = quat_rotate_inverse(quat.expand(-1, len(links), -1), tips - pos)
        distance, _ = Surface(thing).signed_distance(local.flatten(0, 1))
        near = (distance < NEAR).view(len(chosen), len(links)).numpy()
        out[mine] = near[:, 0] & near[:, 1:].any(axis=1)
    return out


def _turns(frames: Frames, rows: np.ndarray, *, last_first: bool) -> np.ndarray:
    """Order of the rows in which objects take turns, of an object its sequences, and of a sequence the best frame comes first."""
    rank = np.zeros(len(rows), dtype=int)
    for name in dict.fromkeys(frames.sequence_name[rows].tolist()):
        mine = np.flatnonzero(frames.sequence_name[rows] == name)
        best = len(mine) - 1 if last_first else len(mine) // 2
        rank[mine[np.argsort(np.abs(np.arange(len(mine)) - best), kind="stable")]] = np.arange(len(mine))
    by_rank = np.argsort(rank, kind="stable")
    turn = np.zeros(len(rows), dtype=int)
    for name in dict.fromkeys(frames.object_name[rows].tolist()):
        mine = by_rank[frames.object_name[rows][by_rank] == name]
        turn[mine] = np.arange(len(mine))
    return np.argsort(turn, kind="stable")
