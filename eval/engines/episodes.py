"""Action sequences that try a grasp: close the hand, lift, shake; and what an engine makes of them.

They are open loop, in joint targets, made without any engine.

The hand closes along the line between thumb and fingers, which any hand with a thumb and another finger has, whatever its joints are.
Shape letters: G grasps (one per world), J joints, E fingertips, T control steps, P surface points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from xreset.geometry.kinematics import Kinematics
from xreset.geometry.rotations import quat_rotate, quat_rotate_inverse
from xreset.physics import Backend, State
from xreset.spec import RobotSpec


@dataclass(frozen=True, kw_only=True)
class Motion:
    """How a grasp is tried. Durations in seconds."""

    opening: float = 0.025
    """How far the fingertips begin from where they hold, away from the opposite ones [m]."""
    reach: float = 0.010
    """How far they go on towards the opposite ones [m]: demonstrated fingertips need not touch the robot's object."""
    squeeze: float = 12.0
    """Force [N] with which thumb and fingers, if they have found the object there, press against each other."""
    settle: float = 0.2
    """For the object to come to rest before the hand moves."""
    close: float = 0.6
    """For the fingers to close, at constant speed."""
    hold: float = 0.4
    """Before and after the lift."""
    lift: float = 0.8
    """For the lift, with the least jerk."""
    height: float = 0.10
    """How high the palm is lifted [m]."""
    shake: float = 0.8
    """For the shake along x, and again along y."""
    amplitude: float = 0.015
    """Of the shake [m]."""
    frequency: float = 2.5
    """Of the shake [Hz]; it grows from nothing and fades again."""

    def closing_steps(self, dt: float) -> int:
        """Control steps of :func:`closing_episode` before the lift begins."""
        return sum(round(seconds / dt) for seconds in (self.settle, self.close, self.hold))


@dataclass(frozen=True, kw_only=True)
class Episode:
    """Where G worlds start, and what their drives are then told."""

    start: State
    """[G, ...]"""
    targets: Tensor
    """[T, G, J] joint targets of each control step."""

    def __len__(self) -> int:
        """T"""
        return len(self.targets)

    def first(self, steps: int) -> Episode:
        """Its first control steps."""
        return Episode(start=self.start, targets=self.targets[:steps])


@dataclass(frozen=True, kw_only=True)
class Recording:
    """What an engine did with an episode, after each control step, on the CPU."""

    start: State
    """[G, ...] where it began."""
    joint_pos: Tensor
    """[T, G, J] rad (m)"""
    joint_target: Tensor
    """[T, G, J]"""
    object_pos: Tensor
    """[T, G, 3]"""
    object_quat: Tensor
    """[T, G, 4]"""
    palm_pos: Tensor
    """[T, G, 3]"""
    palm_quat: Tensor
    """[T, G, 4]"""
    tip_force: Tensor
    """[T, G, E, 3] on the object, world frame [N]."""
    tip_touch: Tensor
    """[T, G, E] bool"""
    broken: Tensor
    """[G] bool: not finite, or contacts overflowed."""

    def state_after(self, step: int) -> State:
        """[G] the state after a control step, brought to rest: positions and targets, without velocities."""
        return State.at_rest(
            self.joint_pos[step], self.object_pos[step], self.object_quat[step], self.joint_target[step]
        )

    def in_palm(self, step: int, points: Tensor) -> Tensor:
        """[G, P, 3] where points [G, P, 3] of the objects (in their mesh frames) are in the palm's frame after a control step [m]."""
        world = self.object_pos[step][:, None] + quat_rotate(self.object_quat[step][:, None], points)
        return quat_rotate_inverse(self.palm_quat[step][:, None], world - self.palm_pos[step][:, None])


def play(backend: Backend, episode: Episode) -> Recording:
    """Set each world to its start and give the drives the episode's targets."""
    backend.set_state(episode.start.to(backend.device))
    rows: list[dict[str, Tensor]] = []
    for target in episode.targets.to(backend.device):
        backend.set_joint_targets(target)
        backend.step()
        state, links, contacts = backend.state(), backend.links(), backend.contacts()
        now = {
            "joint_pos": state.joint_pos, "object_pos": state.object_pos, "object_quat": state.object_quat, "palm_pos": links.pos[:, 0],
            "palm_quat": links.quat[:, 0], "tip_force": contacts.tip_force, "tip_touch": contacts.tip_touch,
        }  # fmt: skip
        rows.append({name: value.cpu().clone() for name, value in now.items()})
    health = backend.health()
    return Recording(
        start=episode.start.to("cpu"),
        joint_target=episode.targets.cpu(),
        broken=(health.nonfinite | health.overflow).cpu(),
        **{name: torch.stack([row[name] for row in rows]) for name in rows[0]},
    )


def closing_episode(
    robot: RobotSpec,
    joint_pos: Tensor,
    object_pos: Tensor,
    object_quat: Tensor,
    dt: float,
    motion: Motion | None = None,
) -> Episode:
    """A whole try: the open hand around an object at rest closes, lifts and shakes.

    Args:
        joint_pos: [G, J] the hand as it holds the object (rad, m).
        object_pos: [G, 3] where the object is [m].
        object_quat: [G, 4]
        dt: control step [s].
    """
    motion = motion or Motion()
    kinematics = Kinematics(robot)
    held = joint_pos.double()
    opened, closed = moved_fingertips(kinematics, held, -motion.opening), squeezed(kinematics, held, motion)
    settle, close, hold = (round(seconds / dt) for seconds in (motion.settle, motion.close, motion.hold))
    share = torch.cat((torch.zeros(settle), torch.linspace(0, 1, close + 1)[1:], torch.ones(hold)))[:, None, None]
    closing = opened + share * (closed - opened)
    targets = torch.cat((closing, _carried(kinematics, closed, motion, dt)))
    return Episode(start=State.at_rest(opened, object_pos, object_quat), targets=targets.float())


def lifting_episode(robot: RobotSpec, start: State, dt: float, motion: Motion | None = None) -> Episode:
    """Lift and shake what the hand holds in states [G, ...], with the targets of each; dt: control step [s]."""
    motion = motion or Motion()
    targets = start.joint_target.double().cpu()
    still = targets.expand(round(motion.hold / dt), *targets.shape)
    return Episode(start=start, targets=torch.cat((still, _carried(Kinematics(robot), targets, motion, dt))).float())


def holding_episode(start: State, seconds: float, dt: float) -> Episode:
    """Keep the targets of a state [G, ...] for some seconds."""
    return Episode(start=start, targets=start.joint_target.expand(round(seconds / dt), *start.joint_target.shape))


def squeezing_state(
    robot: RobotSpec, joint_pos: Tensor, object_pos: Tensor, object_quat: Tensor, motion: Motion | None = None
) -> State:
    """[G] a state at rest in which the drives already squeeze; arguments as in :func:`closing_episode`."""
    closed = squeezed(Kinematics(robot), joint_pos.double(), motion or Motion())
    return State.at_rest(joint_pos, object_pos, object_quat, closed)


def moved_fingertips(kinematics: Kinematics, joint_pos: Tensor, distance: float) -> Tensor:
    """[G, J] joint positions with the fingertips moved towards the opposite ones, the arm where it was.

    In a few steps of damped least squares, dq = J^T (J J^T + d^2)^-1 dx over the hand's joints, within their limits. Fingers that are
    stretched or at a limit move less.

    Args:
        joint_pos: [G, J] (rad, m).
        distance: how far [m]; negative: apart.
    """
    q, hand = joint_pos, torch.as_tensor(kinematics.robot.hand_indices)
    direction = _closing_direction(kinematics, q)
    for _ in range(_FINGER_STEPS):
        step = (direction * distance / _FINGER_STEPS).flatten(-2)
        q = kinematics.clamp(q.index_add(-1, hand, _least_squares(_tip_jacobian(kinematics, q), step, _FINGER_DAMPING)))
    return q


def squeezed(kinematics: Kinematics, joint_pos: Tensor, motion: Motion) -> Tensor:
    """[G, J] joint targets with which the hand reaches and squeezes.

    Held where the reach ends, each joint's drive gives the torque J^T f of the fingertip forces f, for its target lies K^-1 J^T f away.
    The thumb presses as much as the other fingers together, and these alike.

    Args:
        joint_pos: [G, J] the hand as it holds the object (rad, m).
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


def _closing_direction(kinematics: Kinematics, q: Tensor) -> Tensor:
    """[G, E, 3] unit vectors: the thumb's along the line from its tip to the mean of the other tips, the others' the other way."""
    tips = kinematics.points(q, [tip.link for tip in kinematics.robot.fingertips])
    line = torch.nn.functional.normalize(tips[:, 1:].mean(1) - tips[:, 0], dim=-1)
    return torch.stack([line, *[-line] * (tips.shape[1] - 1)], dim=1)


def _tip_jacobian(kinematics: Kinematics, q: Tensor) -> Tensor:
    """[G, 3 E, H] of the fingertips' positions, over the hand's joints."""
    robot = kinematics.robot
    return (
        kinematics.jacobian(q, [tip.link for tip in robot.fingertips])
        .linear[..., torch.as_tensor(robot.hand_indices)]
        .flatten(-3, -2)
    )


def carried_palm(kinematics: Kinematics, joint_pos: Tensor, offset: Tensor) -> Tensor:
    """[T, G, J] joint positions that move the palm without turning it: each step's arm follows from the one before.

    Args:
        joint_pos: [G, J] where to begin (rad, m); the hand's joints stay.
        offset: [T, 3] of the palm from where it begins, world frame [m].
    """
    robot, q = kinematics.robot, joint_pos
    arm = torch.as_tensor(robot.arm_indices)
    start = kinematics.link_poses(q, [robot.palm])[:, 0]
    path = []
    for here in offset.to(q):
        for _ in range(_ARM_ITERATIONS):
            palm = kinematics.jacobian(q, [robot.palm])
            R = palm.rot[:, 0]
            turn = 0.5 * torch.linalg.cross(R, start[:, :3, :3], dim=-2).sum(
                -1
            )  # rotation vector back to the start, for small angles
            error = torch.cat((start[:, :3, 3] + here - palm.pos[:, 0], _TURN_LENGTH * turn), dim=-1)
            jacobian = torch.cat((palm.linear[:, 0], _TURN_LENGTH * palm.angular[:, 0]), dim=-2)[..., arm]
            q = kinematics.clamp(q.index_add(-1, arm, _least_squares(jacobian, error, _ARM_DAMPING)))
        path.append(q)
    return torch.stack(path)


_FINGER_STEPS = 4
_FINGER_DAMPING = 0.02  # [m]: small beside a finger's length, which is what a radian moves its tip by
_ARM_ITERATIONS = 2
_ARM_DAMPING = 0.01  # [m]
_TURN_LENGTH = 0.3  # [m] that makes turning the palm comparable to moving it


def _least_squares(jacobian: Tensor, step: Tensor, damping: float) -> Tensor:
    """[..., J] the joint step that makes a step [..., R] as the Jacobian [..., R, J] says, damped."""
    square = jacobian @ jacobian.mT + damping**2 * torch.eye(jacobian.shape[-2]).to(jacobian)
    return (jacobian.mT @ torch.linalg.solve(square, step[..., None]))[..., 0]


def _carried(kinematics: Kinematics, closed: Tensor, motion: Motion, dt: float) -> Tensor:
    """[T, G, J] targets that lift, hold and shake what the closed hand [G, J] holds."""
    t = torch.linspace(0, 1, round(motion.lift / dt) + 1)[1:]
    up = torch.zeros(len(t) + round(motion.hold / dt), 3)
    up[:, 2] = motion.height
    up[: len(t), 2] *= t**3 * (10 - 15 * t + 6 * t**2)
    steps = round(motion.shake / dt)
    t = torch.arange(1, steps + 1) / steps
    wave = motion.amplitude * torch.sin(math.pi * t) * torch.sin(2 * math.pi * motion.frequency * motion.shake * t)
    shake = torch.zeros(2, steps, 3)
    shake[0, :, 0] = shake[1, :, 1] = wave
    shake[..., 2] = motion.height
    return carried_palm(kinematics, closed, torch.cat((up, shake.flatten(0, 1))))
