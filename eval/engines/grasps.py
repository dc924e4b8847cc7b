"""Grasps that demonstrations show: frames in which the hand is at the object, whatever an engine makes of them.

Shape letters: G grasps, J joints, R rows (chosen frames).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import pandas as pd
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from xreset.errors import DemoError
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.rotations import quat_rotate_inverse
from xreset.geometry.surface import Surface
from xreset.retarget.file import Retargeted
from xreset.spec import ObjectSpec, RobotSpec, lowest_point
from xreset.tensors import Tensors

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
class Grasps(Tensors):
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

    def __getitem__(self, rows: slice) -> Grasps:
        """Select grasps."""
        return replace(super().__getitem__(rows), label=self.label[rows])


def find_grasps(
    motion: Retargeted, robot: RobotSpec, objects: Sequence[ObjectSpec], count: int, *, where: Literal["table", "air"]
) -> Grasps:
    """Choose grasps, equally many of each object and spread over the sequences; the same arguments give the same
    grasps.

    In the frames that count, the thumb's tip and another tip are near the object's surface. ``table``: the object is
    still where it started; of a sequence, the last such frame comes first, in which the person is about to lift.
    ``air``: the object is lifted; the middle frame comes first.

    Args:
        motion: where to look, in the valid frames after first contact.
        robot: the robot.
        objects: geometry; frames of other objects are left out.
        count: largest G; there are fewer grasps where the frames show fewer.
        where: the object's place.

    Raises:
        DemoError: there is no grasp on the table.
    """
    names = [o.name for o in objects]
    rows = np.flatnonzero(motion.valid & motion.post_contact)
    start_pos, start_quat = (values[motion.sequence_of_frame[rows]] for values in motion.start_pose)
    moved = motion.object_pos[rows] - start_pos
    if where == "table":
        start = Rotation.from_quat(start_quat, scalar_first=True)
        turned = (Rotation.from_quat(motion.object_quat_wxyz[rows], scalar_first=True) * start.inv()).magnitude()
        fits = (np.linalg.norm(moved, axis=1) < REST_DISTANCE) & (turned < REST_ANGLE)
    else:
        fits = moved[:, 2] > LIFTED
    near = [_at_hand(motion, rows[fits], robot, thing) for thing in objects]
    chosen = _in_turns(motion, np.sort(np.concatenate(near)), last_first=where == "table")[:count]
    if not len(chosen) and where == "table":
        raise DemoError(
            f"no grasp was found in {len(rows)} frames after first contact: in none is an object of "
            f"{', '.join(names)} on the table with the thumb and another fingertip within {1e3 * NEAR:.0f} mm of it. "
            "Retarget more demonstrations."
        )
    sequence = motion.sequence_of_frame[chosen]
    frame = chosen - motion.frame_offsets[sequence]
    object_index = [names.index(name) for name in motion.object_name[sequence].tolist()]
    object_quat = motion.object_quat_wxyz[chosen]
    object_pos = motion.object_pos[chosen].astype(np.float64)
    lowest = [_lowest(objects[i], quat) for i, quat in zip(object_index, object_quat, strict=True)]
    object_pos[:, 2] = np.maximum(object_pos[:, 2], CLEARANCE - np.array(lowest))
    return Grasps(
        label=tuple(f"{motion.sequence_name[s]}:{f}" for s, f in zip(sequence, frame, strict=True)),
        object_index=torch.tensor(object_index, dtype=torch.long),
        joint_pos=torch.as_tensor(motion.joint_pos[chosen], dtype=torch.float64),
        object_pos=torch.as_tensor(object_pos),
        object_quat=torch.as_tensor(object_quat, dtype=torch.float64),
    )


def _lowest(thing: ObjectSpec, quat: np.ndarray) -> float:
    """Return the smallest z of the object turned by ``quat``, relative to the origin of its mesh frame [m]."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(quat, scalar_first=True).as_matrix()
    return lowest_point([replace(piece, T_body_shape=T @ piece.T_body_shape) for piece in thing.pieces])


def _at_hand(motion: Retargeted, rows: np.ndarray, robot: RobotSpec, thing: ObjectSpec) -> np.ndarray:
    """Return the rows [R] of an object in which the thumb's tip and another tip are near it."""
    rows = rows[motion.object_name[motion.sequence_of_frame[rows]] == thing.name]
    if not len(rows):
        return rows
    links = [tip.link for tip in robot.fingertips]
    tips = Kinematics(robot).points(torch.as_tensor(motion.joint_pos[rows], dtype=torch.float64), links)
    pos = torch.as_tensor(motion.object_pos[rows], dtype=torch.float64)[:, None]
    quat = torch.as_tensor(motion.object_quat_wxyz[rows], dtype=torch.float64)[:, None]
    local = quat_rotate_inverse(quat.expand(-1, len(links), -1), tips - pos)
    distance, _ = Surface(thing).signed_distance(local.flatten(0, 1))
    near = (distance < NEAR).view(len(rows), len(links)).numpy()
    return rows[near[:, 0] & near[:, 1:].any(axis=1)]


def _in_turns(motion: Retargeted, rows: np.ndarray, *, last_first: bool) -> np.ndarray:
    """Order rows [R]: objects take turns, then an object's sequences; a sequence's best frame comes first."""
    sequence = motion.sequence_of_frame[rows]
    table = pd.DataFrame({"row": rows, "sequence": sequence, "object": motion.object_name[sequence]})
    size = table.groupby("sequence")["row"].transform("size").to_numpy()
    best = size - 1 if last_first else size // 2
    table["away"] = np.abs(table.groupby("sequence").cumcount().to_numpy() - best)
    table["rank"] = table.sort_values("away", kind="stable").groupby("sequence").cumcount()
    table["turn"] = table.sort_values("rank", kind="stable").groupby("object").cumcount()
    return table.sort_values("turn", kind="stable")["row"].to_numpy()
