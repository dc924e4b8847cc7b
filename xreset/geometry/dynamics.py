"""The inertia that a joint's drive must accelerate, which drive gains are chosen by."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from xreset.geometry.kinematics import Kinematics, PointJacobian, on_host
from xreset.geometry.urdf import Link
from xreset.spec import DriveSpec, JointSpec, RobotSpec

if TYPE_CHECKING:
    from torch import Tensor


def com_jacobian(kinematics: Kinematics, q: Tensor) -> tuple[list[Link], PointJacobian]:
    """Return the L links, and the Jacobian of their centers of mass at joint positions [..., J]."""
    links = [kinematics.tree.link(name) for name in kinematics.link_names]
    com = kinematics.array([link.com for link in links])
    return links, kinematics.jacobian(q, kinematics.link_names, com)


def mass_matrix(robot: RobotSpec, joint_pos: np.ndarray) -> np.ndarray:
    """[J, J] mass matrix of the robot without armature [kg m^2, kg for a prismatic joint].

    M(q) = sum over links of m Jv^T Jv + Jw^T I Jw, with Jv and Jw the Jacobians of the link's center of mass and of its
    orientation, and I its inertia about the center of mass. A mimic joint counts through the joint that it follows.

    Args:
        robot: the robot.
        joint_pos: [J] position [rad or m].
    """
    kinematics = on_host(robot)
    links, jacobian = com_jacobian(kinematics, kinematics.array(joint_pos))
    _, rot, linear, angular = map(np.asarray, jacobian)
    mass = np.array([link.mass for link in links])
    inertia = rot @ np.stack([link.inertia for link in links]) @ rot.transpose(0, 2, 1)
    return np.einsum("l,lai,laj->ij", mass, linear, linear) + np.einsum(
        "lai,lab,lbj->ij", angular, inertia, angular
    )


def drive_shares(robot: RobotSpec) -> np.ndarray:
    """[J, J + Q] how each drive's torque is shared by its joint and the Q mimic joints that follow it.

    A drive on only one of several coupled joints would push the others through their coupling, which then gives way.
    Also, the damping of the drive that an engine integrates implicitly would slow that joint alone.

    U [J + Q, J] are the rates of all joints per rate of the actuated ones, M is their mass matrix at home, armature
    included. The shares W = (U^T M U)^-1 U^T M accelerate all joints as they are coupled, so the coupling has nothing
    to do. Because W U = 1, the drive keeps its stated figures for coupled motion.
    """
    joints = len(robot.joints)
    U = np.eye(joints + len(robot.mimics), joints)
    if not robot.mimics:
        return U
    idle = DriveSpec(kp=0.0, kd=0.0, effort=0.0)
    followers = []
    for row, mimic in zip(U[joints:], robot.mimics, strict=True):
        source = robot.joint_names.index(mimic.source)
        row[source] = mimic.multiplier
        home = mimic.multiplier * robot.home[source] + mimic.offset
        followers.append(JointSpec(name=mimic.joint, group="hand", drive=idle, home=home))
    uncoupled = replace(robot, joints=(*robot.joints, *followers), mimics=())
    M = mass_matrix(uncoupled, uncoupled.home) + np.diag(drive_values(uncoupled, "armature"))
    return np.linalg.solve(U.T @ M @ U, U.T @ M)


def drive_inertia(robot: RobotSpec, joint_pos: np.ndarray) -> np.ndarray:
    """[J] inertia of each joint when it moves alone, armature included: the mass matrix' diagonal [kg m^2 or kg]."""
    return np.diag(mass_matrix(robot, joint_pos)) + drive_values(robot, "armature")


def damping_ratio(robot: RobotSpec, joint_pos: np.ndarray) -> np.ndarray:
    """[J] kd / (2 sqrt(kp I)) of each drive, 1 being critical damping, with I from :func:`drive_inertia`."""
    stiffness = drive_values(robot, "kp") * drive_inertia(robot, joint_pos)
    return drive_values(robot, "kd") / (2 * np.sqrt(stiffness))


def jaw_stiffness(robot: RobotSpec) -> float | None:
    """Return the force on each fingertip of a jaw for each unit by which its drive's target is beyond the joint [N/rad
    or N/m], at home; None for a hand with more than one joint or other than two fingertips.

    With the drive's work kp (target - q) dq = f d(opening), f is the same on both fingertips.
    """
    hand = robot.hand_indices
    if len(hand) != 1 or len(robot.fingertips) != 2:
        return None
    kinematics = on_host(robot)
    links = [tip.link for tip in robot.fingertips]
    first, second = kinematics.points(kinematics.home, links)
    across = (second - first) / max(np.linalg.norm(second - first), 1e-12)
    moves = kinematics.jacobian(kinematics.home, links).linear[..., hand[0]]
    closing = abs(float((moves[1] - moves[0]) @ across))
    return float(drive_values(robot, "kp")[hand[0]]) / max(closing, 1e-6)


def drive_values(robot: RobotSpec, name: str) -> np.ndarray:
    """[J] an entry of each joint's :class:`~xreset.spec.DriveSpec`."""
    return np.array([getattr(joint.drive, name) for joint in robot.joints])
