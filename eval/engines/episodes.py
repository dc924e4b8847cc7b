"""Action sequences that try a grasp: close the hand, lift, shake. They are open loop, in joint targets, made without
any engine.

The hand closes along the line between thumb and fingers, which any hand with a thumb and another finger has, whatever
its joints are. Shape letters: G grasps (one per world), J joints, H joints of the hand, E fingertips, T control steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from xreset.eval.engines.grasps import Grasps
from xreset.geometry.kinematics import Kinematics
from xreset.physics import State
from xreset.spec import RobotSpec

_FINGER_STEPS = 4
_FINGER_DAMPING = 0.02
"""[m] Small against a finger's length, by which one radian moves its tip."""
_ARM_ITERATIONS = 2
_ARM_DAMPING = 0.01
"""[m]"""
_TURN_LENGTH = 0.3
"""[m] Makes turning the palm comparable to moving it."""


@dataclass(frozen=True, kw_only=True)
class GraspMotion:
    """How a grasp is tried. Durations in seconds."""

    opening: float = 0.025
    """Distance of the fingertips at the start from where they hold, away from the opposite fingertips [m]."""
    reach: float = 0.010
    """Distance that they move on towards the opposite ones [m]: demonstrated tips may not touch the robot's object."""
    squeeze: float = 12.0
    """Force [N] with which thumb and fingers press against each other if the object is there."""
    settle: float = 0.2
    """Time for the object to come to rest before the hand moves."""
    close: float = 0.6
    """Time for the fingers to close, at constant speed."""
    hold: float = 0.4
    """Time before and after the lift."""
    lift: float = 0.8
    """Time for the lift, with the least jerk."""
    height: float = 0.10
    """Height by which the palm is lifted [m]."""
    shake: float = 0.8
    """Time for the shake along x, and again along y."""
    amplitude: float = 0.015
    """Amplitude of the shake [m]."""
    frequency: float = 2.5
    """Frequency of the shake [Hz]; its amplitude grows from nothing and fades again."""

    def closing_steps(self, dt: float) -> int:
        """Return the number of control steps of :func:`closing_episode` before the lift begins."""
        return sum(round(seconds / dt) for seconds in (self.settle, self.close, self.hold))


STANDARD = GraspMotion()


def closing_episode(robot: RobotSpec, grasps: Grasps, dt: float, motion: GraspMotion) -> tuple[State, Tensor]:
    """Return start [G, ...] and targets [T, G, J] of a whole try: the open hand around an object at rest closes, lifts
    and shakes; dt: control step [s]."""
    kinematics = Kinematics(robot)
    held = grasps.joint_pos
    opened = moved_fingertips(kinematics, held, -motion.opening)
    closed = squeezed(kinematics, held, motion)
    parts = (
        torch.zeros(round(motion.settle / dt)),
        torch.linspace(0, 1, round(motion.close / dt) + 1)[1:],
        torch.ones(round(motion.hold / dt)),
    )
    closing = opened + torch.cat(parts)[:, None, None] * (closed - opened)
    targets = torch.cat((closing, _carried(kinematics, closed, motion, dt)))
    return State.at_rest(opened, grasps.object_pos, grasps.object_quat), targets.float()


def lifting_targets(robot: RobotSpec, start: State, dt: float, motion: GraspMotion) -> Tensor:
    """[T, G, J] targets that lift and shake what the hand holds in states [G, ...], from the targets of each state."""
    targets = start.joint_target.double()
    still = targets.expand(round(motion.hold / dt), *targets.shape)
    return torch.cat((still, _carried(Kinematics(robot), targets, motion, dt))).float()


def moved_fingertips(kinematics: Kinematics, joint_pos: Tensor, distance: float) -> Tensor:
    """Return joint positions [G, J] with the fingertips moved towards the opposite ones, and the arm unmoved.

    The hand's joints take a few steps of damped least squares, dq = J^T (J J^T + d^2)^-1 dx, within their limits.
    Fingers that are stretched or at a limit move less.

    Args:
        kinematics: of the robot.
        joint_pos: [G, J] (rad, m).
        distance: how far [m]; negative: apart.
    """
    q = joint_pos
    hand = torch.as_tensor(kinematics.robot.hand_indices)
    step = (_closing_direction(kinematics, q) * distance / _FINGER_STEPS).flatten(-2)
    for _ in range(_FINGER_STEPS):
        dq = _least_squares(_tip_jacobian(kinematics, q), step, _FINGER_DAMPING)
        q = kinematics.clamp(q.index_add(-1, hand, dq))
    return q


def squeezed(kinematics: Kinematics, joint_pos: Tensor, motion: GraspMotion) -> Tensor:
    """Return joint targets [G, J] with which the hand reaches and squeezes.

    Held where the reach ends, each joint's drive gives the torque J^T f of the fingertip forces f, because its target
    is K^-1 J^T f away. The thumb presses as much as the other fingers together, and each of these as much as another.

    Args:
        kinematics: of the robot.
        joint_pos: [G, J] the hand as it holds the object (rad, m).
        motion: reach and force.
    """
    robot = kinematics.robot
    hand = torch.as_tensor(robot.hand_indices)
    stiffness = torch.tensor([robot.joints[i].drive.kp for i in robot.hand_indices], dtype=joint_pos.dtype)
    q = moved_fingertips(kinematics, joint_pos, motion.reach)
    share = torch.full((len(robot.fingertips), 1), 1.0 / (len(robot.fingertips) - 1), dtype=q.dtype)
    share[0] = 1.0
    force = (_closing_direction(kinematics, joint_pos) * share * motion.squeeze).flatten(-2)
    torque = (_tip_jacobian(kinematics, q).mT @ force[..., None])[..., 0]
    return kinematics.clamp(q.index_add(-1, hand, torque / stiffness))


def _tip_links(kinematics: Kinematics) -> list[str]:
    return [tip.link for tip in kinematics.robot.fingertips]


def _closing_direction(kinematics: Kinematics, q: Tensor) -> Tensor:
    """[G, E, 3] unit vectors: the thumb's from its tip to the mean of the other tips, and theirs the other way."""
    tips = kinematics.points(q, _tip_links(kinematics))
    line = torch.nn.functional.normalize(tips[:, 1:].mean(1) - tips[:, 0], dim=-1)
    return torch.stack([line, *[-line] * (tips.shape[1] - 1)], dim=1)


def _tip_jacobian(kinematics: Kinematics, q: Tensor) -> Tensor:
    """[G, 3 E, H] Jacobian of the fingertips' positions."""
    linear = kinematics.jacobian(q, _tip_links(kinematics)).linear
    return linear[..., torch.as_tensor(kinematics.robot.hand_indices)].flatten(-3, -2)


def carried_palm(kinematics: Kinematics, joint_pos: Tensor, offset: Tensor) -> Tensor:
    """Return joint positions [T, G, J] that move the palm without turning it; each step starts from the arm's last
    pose.

    Args:
        kinematics: of the robot.
        joint_pos: [G, J] where to begin (rad, m); the hand's joints stay.
        offset: [T, 3] of the palm from where it begins, world frame [m].
    """
    robot = kinematics.robot
    q = joint_pos
    arm = torch.as_tensor(robot.arm_indices)
    start = kinematics.link_poses(q, [robot.palm])[:, 0]
    path = []
    for here in offset.to(q):
        for _ in range(_ARM_ITERATIONS):
            palm = kinematics.jacobian(q, [robot.palm])
            # For small angles, the rotation vector back to the start.
            turn = 0.5 * torch.linalg.cross(palm.rot[:, 0], start[:, :3, :3], dim=-2).sum(-1)
            error = torch.cat((start[:, :3, 3] + here - palm.pos[:, 0], _TURN_LENGTH * turn), dim=-1)
            jacobian = torch.cat((palm.linear[:, 0], _TURN_LENGTH * palm.angular[:, 0]), dim=-2)[..., arm]
            q = kinematics.clamp(q.index_add(-1, arm, _least_squares(jacobian, error, _ARM_DAMPING)))
        path.append(q)
    return torch.stack(path)


def _least_squares(jacobian: Tensor, step: Tensor, damping: float) -> Tensor:
    """[..., J] damped joint step for a step [..., R] with the Jacobian [..., R, J]."""
    square = jacobian @ jacobian.mT + damping**2 * torch.eye(jacobian.shape[-2]).to(jacobian)
    return (jacobian.mT @ torch.linalg.solve(square, step[..., None]))[..., 0]


def _carried(kinematics: Kinematics, closed: Tensor, motion: GraspMotion, dt: float) -> Tensor:
    """[T, G, J] targets that lift, hold and shake the object in the closed hand [G, J]."""
    t = torch.linspace(0, 1, round(motion.lift / dt) + 1)[1:]
    up = torch.zeros(len(t) + round(motion.hold / dt), 3)
    up[:, 2] = motion.height
    up[: len(t), 2] *= t**3 * (10 - 15 * t + 6 * t**2)
    steps = round(motion.shake / dt)
    t = torch.arange(1, steps + 1) / steps
    wave = motion.amplitude * torch.sin(math.pi * t) * torch.sin(2 * math.pi * motion.frequency * motion.shake * t)
    shake = torch.zeros(2, steps, 3)
    shake[0, :, 0] = wave
    shake[1, :, 1] = wave
    shake[..., 2] = motion.height
    return carried_palm(kinematics, closed, torch.cat((up, shake.flatten(0, 1))))
