"""What arms and hands do in trials of grasps: joints that carry the palm along a path, and targets that press.

The trials themselves differ in what they ask. :mod:`xreset.robot_tools.judge` asks whether a robot holds, lifts and
turns an object, :mod:`xreset.eval.engines.grasps` whether engines agree, and :mod:`xreset.resets.transfer` whether a
state holds still.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from xreset.geometry.dynamics import drive_values
from xreset.geometry.kinematics import Kinematics, PointJacobian
from xreset.geometry.rotations import (
    matrix_to_quat,
    quat_conjugate,
    quat_multiply,
    quat_normalize,
    quat_to_axis_angle,
)

_DAMPING = 0.01
"""Damping of a step of the arm [m]."""
_LARGEST_STEP = 0.2
"""Largest change of a joint in a step [rad, m]."""


def palm_path(
    kinematics: Kinematics,
    joint_pos: Tensor,
    pos: Tensor,
    quat: Tensor,
    *,
    iterations: int,
    turn_length: float,
) -> tuple[Tensor, Tensor]:
    """Return joint positions that carry the palm along a path. The inverse kinematics of a pose starts from the joints
    of the pose before it, so the path must be dense.

    Shape letters: T poses, N worlds, J joints.

    Args:
        kinematics: of the robot.
        joint_pos: [N, J] joints before the first pose (rad, m); the hand's joints stay.
        pos: [T, N, 3] position of the palm, world frame [m].
        quat: [T, N, 4] orientation of the palm, world frame.
        iterations: steps of damped least squares to each pose.
        turn_length: length that makes turns of the palm comparable to shifts [m].

    Returns:
        [T, N, J] joints, and [N, 6] what is missing to the last pose at its joints: shift [m] and rotation vector
        [rad].
    """
    robot = kinematics.robot
    arm = torch.as_tensor(robot.arm_indices)
    scale = joint_pos.new_tensor([1.0] * 3 + [turn_length] * 3)
    q = joint_pos
    path = []
    for goal_pos, goal_quat in zip(pos, quat, strict=True):
        for _ in range(iterations):
            palm = kinematics.jacobian(q, [robot.palm])
            missing = _missing(palm, goal_pos, goal_quat)
            jacobian = torch.cat((palm.linear[:, 0], palm.angular[:, 0]), dim=-2)[..., arm]
            step = least_squares(scale[:, None] * jacobian, scale * missing, _DAMPING)
            q = q.index_add(-1, arm, step.clamp(-_LARGEST_STEP, _LARGEST_STEP))
            q = kinematics.clamp(q)
        path.append(q)
    palm = kinematics.jacobian(q, [robot.palm])
    return torch.stack(path), _missing(palm, pos[-1], quat[-1])


def _missing(palm: PointJacobian, pos: Tensor, quat: Tensor) -> Tensor:
    """[N, 6] shift [m] and rotation vector [rad] from the palm to poses [N, 3], [N, 4]."""
    away = quat_multiply(quat, quat_conjugate(matrix_to_quat(palm.rot[:, 0])))
    turn = quat_to_axis_angle(quat_normalize(away))
    return torch.cat((pos - palm.pos[:, 0], turn), dim=-1)


def least_squares(jacobian: Tensor, step: Tensor, damping: float) -> Tensor:
    """[..., J] damped joint step J^T (J J^T + d^2)^-1 dx for a step [..., R] with the Jacobian [..., R, J]."""
    square = jacobian @ jacobian.mT + damping**2 * torch.eye(jacobian.shape[-2]).to(jacobian)
    return (jacobian.mT @ torch.linalg.solve(square, step[..., None]))[..., 0]


def pressing_targets(kinematics: Kinematics, joint_pos: Tensor, torque: Tensor) -> Tensor:
    """Return drive targets [N, J] with which the hand's drives give torques where the object stops the joints: torque /
    stiffness beyond the joints, within the limits of the joints.

    If a drive is too weak for its torque, the whole hand presses with less: without the missing torque alone, its
    fingers would no longer be in balance.

    Args:
        kinematics: of the robot.
        joint_pos: [N, J] joints as the object stops them (rad, m).
        torque: [N, J] J^T f of the fingers' forces f [N m, N].
    """
    robot = kinematics.robot
    stiffness = torch.as_tensor(drive_values(robot, "kp"))
    presses = torch.as_tensor(~np.asarray(robot.is_arm)) & (stiffness > 0)
    torque = torch.where(presses, torque, 0.0)
    effort = torch.as_tensor(drive_values(robot, "effort"))
    possible = (effort / torque.abs()).amin(dim=-1, keepdim=True).clamp_max(1.0)
    beyond = possible * torque / stiffness.clamp_min(1e-9)
    return torch.where(beyond != 0, kinematics.clamp(joint_pos + beyond), joint_pos)
