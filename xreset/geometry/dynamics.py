"""The inertia that a joint's drive feels: what drive gains are chosen by."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from xreset.geometry.kinematics import Kinematics
from xreset.spec import DriveSpec, JointSpec, RobotSpec


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


def drive_shares(robot: RobotSpec) -> np.ndarray:
    """[J, J + Q] how the torque of each drive is shared by its joint and the Q mimic joints, those that follow it.

    A drive on one joint of several that move as one would have to push the others through their coupling, which then gives way; and what
    an engine integrates implicitly in the drive's damping would slow that joint alone. With U [J + Q, J] the rates of all joints by those
    of the actuated ones and M their mass matrix at home, armature included, the shares W = (U^T M U)^-1 U^T M accelerate all joints as they
    are coupled, so that the coupling has nothing to do; and W U = 1: along coupled motion a drive is what its figures say.
    """
    joints, mimics = robot.joints, robot.mimics
    U = np.eye(len(joints) + len(mimics), len(joints))
    if not mimics:
        return U
    idle = DriveSpec(kp=0.0, kd=0.0, effort=0.0)
    free = []
    for row, mimic in zip(U[len(joints) :], mimics, strict=True):
        source = robot.joint_names.index(mimic.source)
        row[source] = mimic.multiplier
        free.append(
            JointSpec(
                name=mimic.joint, group="hand", drive=idle, home=mimic.multiplier * robot.home[source] + mimic.offset
            )
        )
    uncoupled = replace(robot, joints=(*joints, *free), mimics=())
    M = mass_matrix(uncoupled, uncoupled.home) + np.diag([joint.drive.armature for joint in uncoupled.joints])
    return np.linalg.solve(U.T @ M @ U, U.T @ M)


def drive_inertia(robot: RobotSpec, joint_pos: np.ndarray) -> np.ndarray:
    """[J] inertia that each drive feels when it alone moves, armature included: the diagonal of the mass matrix [kg m^2 or kg]."""
    return np.diag(mass_matrix(robot, joint_pos)) + np.array([joint.drive.armature for joint in robot.joints])


def damping_ratio(robot: RobotSpec, joint_pos: np.ndarray) -> np.ndarray:
    """[J] kd / (2 sqrt(kp I)) of each drive, 1 being critical damping, with I from :func:`drive_inertia`."""
    kp = np.array([joint.drive.kp for joint in robot.joints])
    kd = np.array([joint.drive.kd for joint in robot.joints])
    return kd / (2 * np.sqrt(kp * drive_inertia(robot, joint_pos)))
