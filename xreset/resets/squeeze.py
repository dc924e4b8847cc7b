"""Drive targets that press: states after contact whose fingers hold on, and do not only stand where they are.

A finger that presses on the object with a normal force f needs joint torques J^T f, and a drive gives them where its target lies J^T f / kp
beyond the joint. What the other parts of the hand would have to do for balance is left to them: drives are soft, and the object moves by
millimetres until what it rests against presses back.
"""

from __future__ import annotations

import numpy as np
import torch

from xreset.geometry.kinematics import Kinematics
from xreset.resets.config import SqueezeConfig
from xreset.resets.fingers import Fingers
from xreset.spec import RobotSpec


def squeeze_targets(robot: RobotSpec, fingers: Fingers, joint_pos: np.ndarray, config: SqueezeConfig) -> np.ndarray:
    """[M, J] targets: the joints' positions, and for hand joints what presses, within joint limits and the drives' largest torques.

    Args:
        robot: its hand's drives.
        fingers: where they are, in M states.
        joint_pos: [M, J]
        config: force, and which fingers are at the object.
    """
    q = torch.as_tensor(joint_pos, dtype=torch.float64)
    kinematics = Kinematics(robot)
    jacobian = kinematics.jacobian(q, fingers.links, fingers.point).linear
    pressing = fingers.leading & (fingers.gap < config.reach)
    torque = torch.einsum("mgi,mgij->mj", config.force * pressing[..., None] * fingers.inward, jacobian)
    drives = [joint.drive for joint in robot.joints]
    effort, kp = (torch.tensor([getattr(drive, name) for drive in drives], dtype=torch.float64) for name in ("effort", "kp"))
    is_hand = torch.tensor([joint.group == "hand" and joint.drive.kp > 0 for joint in robot.joints])
    beyond = torch.where(is_hand, torque.clamp(-effort, effort) / kp.clamp_min(1e-9), 0.0)
    return torch.where(beyond != 0, kinematics.clamp(q + beyond), q).numpy()
