"""More states where a hand lifts an object: grasps from the air, carried back to where the object starts.

At 30 frames a second, a demonstration shows only a few frames between the table and a height of some centimetres, and
in them the retargeted fingers often do not touch the object. So few states lead from the table to the grasps that hold
in the air. Here such grasps are moved to the object at rest on the table, and to small heights above it. The
arm follows by inverse kinematics. A hand that would go into the table gives way, as long as the thumb and another
finger stay at the object. As many grasps do not fit on the table, those of other demonstrations of the same object are
tried, too. Physics judges the new states like the others.

Shape letters: M states, S sequences, J joints, n joints of the arm.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from xreset.geometry.rotations import matrix_to_quat, quat_angle
from xreset.geometry.shapes import turn_of
from xreset.physics import Backend, State
from xreset.progress import Progress, unseen
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
_BORROWED = 4
"""For each grasp that may be kept, so many grasps of other demonstrations are tried."""
_GIVES_WAY = Thresholds(wrist_position=0.02, wrist_orientation=float(np.radians(15.0)))
"""How far the hand may be from its place in the grasp, so that it clears the table."""
_AT_A_TIME = 2048
"""Number of states of which the arm's joints are found at a time: they take 0.2 GB."""

Poses = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Joint positions [M, J], object positions [M, 3] and quaternions [M, 4]."""


def grasp_frames(
    retargeted: Retargeted, robot: RobotSpec, objects: Sequence[ObjectSpec]
) -> np.ndarray:
    """Return the frames with a grasp in the air, ascending: the thumb and another finger are at the object."""
    owner = retargeted.sequence_of_frame
    height = retargeted.object_pos[:, 2]
    raised = height - height[retargeted.frame_offsets[:-1]][owner] > RAISED
    frames = np.flatnonzero(retargeted.valid & raised)
    poses = (
        retargeted.joint_pos[frames],
        retargeted.object_pos[frames],
        retargeted.object_quat_wxyz[frames],
    )
    return frames[_is_grasp(robot, objects, retargeted.object_name[owner[frames]], poses)]


def carries(backend: Backend, start: State) -> Tensor:
    """Return whether the object is still where the hand held it: [N] bool, within 2 cm and 30 degrees."""
    state = backend.state()
    moved = (state.object_pos - start.object_pos).norm(dim=-1)
    turned = quat_angle(state.object_quat, start.object_quat)
    return (moved < 0.02) & (turned < math.radians(30.0))


def lift_states(
    retargeted: Retargeted,
    robot: RobotSpec,
    objects: Sequence[ObjectSpec],
    frames: np.ndarray,
    start_pos: np.ndarray,
    start_quat: np.ndarray,
    config: LiftConfig,
    progress: Progress = unseen,
) -> tuple[np.ndarray, Poses]:
    """Carry grasps to where the objects of all demonstrations start.

    Args:
        retargeted: the motion.
        robot: its robot.
        objects: its objects.
        frames: ascending frames of the motion with a grasp (:func:`grasp_frames`). Of each sequence's frames up to
            ``config.grasps`` are used, evenly spread.
        start_pos: [S, 3] where each sequence's object rests on the table [m].
        start_quat: [S, 4] its orientation there.
        config: heights above the table, and how many grasps are kept at each.
        progress: called with (poses tried, poses in all).

    Returns:
        The sequence of each state [M], ascending, and the poses.
    """
    frames = frames[_spread_in_groups(retargeted.sequence_of_frame[frames], config.grasps)]
    count = len(config.heights)
    tried = []  # of every sequence, at every height
    for grasps in _tried(retargeted, frames, config.grasps):
        tried += [grasps] * count
    grasp = np.concatenate(tried)
    group = np.repeat(np.arange(len(tried)), [len(grasps) for grasps in tried])
    sequence, height = np.divmod(group, count)
    object_pos = start_pos[sequence].astype(np.float64)
    object_pos[:, 2] += np.asarray(config.heights)[height]
    object_quat = start_quat[sequence].astype(np.float64)
    model = ArmModel(robot)
    joint_pos = retargeted.joint_pos[grasp].astype(np.float64)
    fits = np.zeros(len(sequence), dtype=bool)
    for first in range(0, len(sequence), _AT_A_TIME):
        rows = slice(first, first + _AT_A_TIME)
        held = grasp[rows]
        grasped = (
            joint_pos[rows],
            retargeted.object_pos[held],
            retargeted.object_quat_wxyz[held],
        )
        joint_pos[rows], reached = _carried(model, grasped, object_pos[rows], object_quat[rows])
        poses = (joint_pos[rows], object_pos[rows], object_quat[rows])
        names = retargeted.object_name[sequence[rows]]
        fits[rows] = reached & _is_grasp(robot, objects, names, poses)
        progress(first + len(held), len(sequence))
    kept = np.flatnonzero(fits)
    kept = kept[_spread_in_groups(group[kept], config.grasps)]
    return sequence[kept], (joint_pos[kept], object_pos[kept], object_quat[kept])


def _tried(retargeted: Retargeted, frames: np.ndarray, count: int) -> list[np.ndarray]:
    """Return for each sequence the frames whose grasps it tries: its own, then those of others."""
    owner = retargeted.sequence_of_frame[frames]
    name = retargeted.object_name
    grasps = []
    for sequence in range(len(name)):
        others = frames[(owner != sequence) & (name[owner] == name[sequence])]
        borrowed = others[_spread(len(others), _BORROWED * count)]
        grasps.append(np.concatenate((frames[owner == sequence], borrowed)))
    return grasps


def _spread(number: int, count: int) -> np.ndarray:
    """Return up to ``count`` of the indices below ``number``, evenly spread."""
    return np.linspace(0, number - 1, min(count, number)).round().astype(int)


def _spread_in_groups(group: np.ndarray, count: int) -> np.ndarray:
    """Return ascending indices of up to ``count`` entries of each group, evenly spread; groups are ascending."""
    _, first, size = np.unique(group, return_index=True, return_counts=True)
    chosen = [start + _spread(number, count) for start, number in zip(first, size, strict=True)]
    return np.concatenate(chosen) if chosen else np.zeros(0, dtype=int)


def _is_grasp(
    robot: RobotSpec, objects: Sequence[ObjectSpec], object_name: np.ndarray, poses: Poses
) -> np.ndarray:
    """Return whether the thumb and another finger are at the object [M]."""
    fingers = fingers_of(robot, objects, object_name, *poses)
    return fingers.grasp(SqueezeConfig().reach).numpy()


@one_thread()
def _carried(
    model: ArmModel, grasped: Poses, object_pos: np.ndarray, object_quat: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Carry grasps to objects at other poses [M, 3], [M, 4].

    Returns:
        Joint positions [M, J], and whether the hand comes near enough to its place, above the table [M].
    """
    joints = torch.as_tensor(grasped[0])
    root = model.kinematics.link_poses(joints, [model.robot.hand_root])[:, 0].numpy()
    moved = turn_of(object_quat) * turn_of(grasped[2]).inv()
    root_pos = torch.as_tensor(object_pos + moved.apply(root[:, :3, 3] - grasped[1]))
    root_quat = matrix_to_quat(torch.as_tensor(moved.as_matrix() @ root[:, :3, :3]))
    hand_joints = joints[:, torch.as_tensor(model.hand.joint_indices)]
    targets = ArmTargets.of_poses(root_pos, root_quat, hand_joints[:, None])
    arm, measures = track(model, targets, _GIVES_WAY, QUICK)
    reached = (classify(measures, _GIVES_WAY) == 0)[:, 0].numpy()
    return model.full(arm[:, 0], hand_joints).numpy(), reached
