"""More states where a hand lifts an object: grasps of later frames, carried back to where the object starts.

At 30 frames a second, a demonstration shows only a few frames between the table and a height of some centimetres, and
in them the retargeted fingers often do not touch the object. So few states lead from the table to the grasps that hold
in the air. Here a grasp from the air is moved to the object at rest on the table, and to small heights above it. The
arm follows by inverse kinematics. A hand that would go into the table gives way, as long as the thumb and another
finger stay at the object. Physics judges the new states like the others.

Shape letters: M states, S sequences, J joints, n joints of the arm.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from xreset.geometry.rotations import matrix_to_quat
from xreset.geometry.shapes import turn_of
from xreset.resets.config import LiftConfig, SqueezeConfig
from xreset.resets.fingers import fingers_of
from xreset.retarget.arm.config import QUICK
from xreset.retarget.arm.model import ArmModel, ArmTargets
from xreset.retarget.arm.solve import track
from xreset.retarget.file import Retargeted
from xreset.retarget.validity import Thresholds, classify
from xreset.spec import ObjectSpec, RobotSpec
from xreset.tensors import one_thread

RAISED = 0.02
"""An object that is higher above its start than this is in the air [m]."""
_GIVES_WAY = Thresholds(wrist_position=0.02, wrist_orientation=float(np.radians(15.0)))
"""How far the hand may be from its place in the grasp, so that it clears the table."""

Poses = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Joint positions [M, J], object positions [M, 3] and quaternions [M, 4]."""


def grasp_frames(
    retargeted: Retargeted, robot: RobotSpec, objects: Sequence[ObjectSpec], count: int
) -> np.ndarray:
    """Choose frames with a grasp in the air: the thumb and another finger are at the object.

    Returns:
        Ascending frames, at most ``count`` of each sequence, spread evenly over those that qualify.
    """
    owner = retargeted.sequence_of_frame
    height = retargeted.object_pos[:, 2]
    raised = height - height[retargeted.frame_offsets[:-1]][owner] > RAISED
    frames = np.flatnonzero(retargeted.valid & raised)
    poses = (
        retargeted.joint_pos[frames],
        retargeted.object_pos[frames],
        retargeted.object_quat_wxyz[frames],
    )
    names = retargeted.object_name[owner[frames]]
    frames = frames[_is_grasp(robot, objects, names, poses)]
    chosen = []
    for sequence in np.unique(owner[frames]):
        own = frames[owner[frames] == sequence]
        places = np.linspace(0, len(own) - 1, min(count, len(own)))
        chosen.append(own[places.round().astype(int)])
    return np.concatenate(chosen) if chosen else frames


def lift_states(
    retargeted: Retargeted,
    robot: RobotSpec,
    objects: Sequence[ObjectSpec],
    frames: np.ndarray,
    start_pos: np.ndarray,
    start_quat: np.ndarray,
    config: LiftConfig,
) -> tuple[np.ndarray, Poses]:
    """Carry grasps back to where their objects start.

    Args:
        retargeted: the motion.
        robot: its robot.
        objects: its objects.
        frames: frames of the motion with a grasp (:func:`grasp_frames`).
        start_pos: [S, 3] where each sequence's object rests on the table [m].
        start_quat: [S, 4] its orientation there.
        config: heights above the table.

    Returns:
        For each state the frame whose grasp it has [M], ascending, and the poses.
    """
    frame = np.repeat(frames, len(config.heights))
    sequence = retargeted.sequence_of_frame[frame]
    object_pos = start_pos[sequence].astype(np.float64)
    object_pos[:, 2] += np.tile(config.heights, len(frames))
    object_quat = start_quat[sequence]
    model = ArmModel(robot)
    joints = torch.as_tensor(retargeted.joint_pos[frame], dtype=torch.float64)
    root = model.kinematics.link_poses(joints, [robot.hand_root])[:, 0].numpy()
    moved = turn_of(object_quat) * turn_of(retargeted.object_quat_wxyz[frame]).inv()
    root_pos = object_pos + moved.apply(root[:, :3, 3] - retargeted.object_pos[frame])
    root_turn = torch.as_tensor(moved.as_matrix() @ root[:, :3, :3])
    hand_joints = joints[:, torch.as_tensor(model.hand.joint_indices)]
    arm, reached = _follow(model, torch.as_tensor(root_pos), matrix_to_quat(root_turn), hand_joints)
    poses = (model.full(arm, hand_joints).numpy(), object_pos, object_quat)
    kept = reached & _is_grasp(robot, objects, retargeted.object_name[sequence], poses)
    return frame[kept], (poses[0][kept], poses[1][kept], poses[2][kept])


def _is_grasp(
    robot: RobotSpec, objects: Sequence[ObjectSpec], object_name: np.ndarray, poses: Poses
) -> np.ndarray:
    """Return whether the thumb and another finger are at the object [M]."""
    fingers = fingers_of(robot, objects, object_name, *poses)
    at_object = fingers.gap < SqueezeConfig().reach
    thumb = fingers.finger == 0
    return (at_object[:, thumb].any(dim=1) & at_object[:, ~thumb].any(dim=1)).numpy()


@one_thread()
def _follow(
    model: ArmModel, root_pos: Tensor, root_quat: Tensor, hand_joints: Tensor
) -> tuple[Tensor, np.ndarray]:
    """Return the arm's joints [M, n], and whether the hand comes near enough to its pose, above the table [M]."""
    targets = ArmTargets.of_poses(root_pos, root_quat, hand_joints[:, None])
    arm, measures = track(model, targets, _GIVES_WAY, QUICK)
    return arm[:, 0], (classify(measures, _GIVES_WAY) == 0)[:, 0].numpy()
