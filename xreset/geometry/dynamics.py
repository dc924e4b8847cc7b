"""The inertia that a joint's drive feels: what drive gains are chosen by."""

from __future__ import annotations

import numpy as np
import torch

from xreset.geometry.kinematics import Kinematics
from xreset.spec import RobotSpec


def mass_matrix(robot: RobotSpec, joint_pos: np.ndarray) -> np.ndarray:
    """[J, J] mass matrix of the robot without armature [kg m^2, kg for a prismatic joint].

    M(q) = sum over links of m Jv^T Jv + Jw^T I Jw, with Jv and Jw the Jacobians of the link's centre of mass and of its orientation, and I
    its inertia about the centre of mass; mimic joints count through the joint that they follow.

    Args:
        robot: the robot.
        joint_pos: [J] position [rad or m].
    """
    kinematics = Kinematics(robot)
    links = [kinematics.tree.link(name) for name in kinematics.link_names]
    com = torch.tensor(np.stack([link.com for link in links]))
    jacobian = kinematics.jacobian(torch.as_tensor(joint_pos, dtype=torch.float64), kinematics.link_names, com)
    linear, angular, rot = jacobian.linear.numpy(), jacobian.angular.numpy(), jacobian.rot.numpy()
    mass = np.array([link.mass for link in links])
    inertia = rot @ np.stack([link.inertia for link in links]) @ rot.transpose(0, 2, 1)
    return np.einsum("l,lai,laj->ij", mass, linear, linear) + np.einsum("lai,lab,lbj->ij", angular, inertia, angular)


def drive_inertia(robot: RobotSpec, joint_pos: np.ndarray) -> np.ndarray:
    """[J] inertia that each drive feels when it alone moves, armature included: the diagonal of the mass matrix [kg m^2 or kg]."""
    return np.diag(mass_matrix(robot, joint_pos)) + np.array([joint.drive.armature for joint in robot.joints])


def damping_ratio(robot: RobotSpec, joint_pos: np.ndarray) -> np.ndarray:
    """[J] kd / (2 sqrt(kp I)) of each drive, 1 being critical damping, with I from :func:`drive_inertia`."""
    kp = np.array([joint.drive.kp for joint in robot.joints])
    kd = np.array([joint.drive.kd for joint in robot.joints])
    return kd / (2 * np.sqrt(kp * drive_inertia(robot, joint_pos)))
