"""Find grasps in retargeted motion, and make the episodes that try them: close the hand, lift, shake.

A grasp is a frame in which the hand is at the object; it may fail in an engine. An episode is a sequence of joint
targets, made without an engine. The hand closes along the line between thumb and fingers, so the same code works for
every hand with a thumb and another finger. Shape letters: G grasps (one per world), J joints, H joints of
the hand, E fingertips, T control steps, R rows (chosen frames).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from xreset.errors import DemoError
from xreset.files.checks import frozen
from xreset.geometry.kinematics import Kinematics, on_host
from xreset.geometry.rotations import matrix_to_quat
from xreset.geometry.shapes import turn_of
from xreset.geometry.surface import prepared_surface
from xreset.physics import State
from xreset.physics.tensors import Tensors
from xreset.resets.programs import least_squares, palm_path, pressing_targets
from xreset.retarget.file import Retargeted
from xreset.spec import ObjectSpec, RobotSpec, SceneSpec, lowest_point

REST_DISTANCE = 0.010
"""Largest distance from its start of an object that counts as at rest on the table [m]."""
REST_ANGLE = np.radians(10.0)
"""Largest angle from its start of such an object [rad]."""
LIFTED = 0.030
"""Least height above its start of an object that counts as lifted [m]."""
CLEARANCE = 0.0005
"""Least height of an object above the table [m]. Demonstrated objects may be sunk into it, and engines eject them."""
NEAR = 0.025
"""A fingertip nearer than this to the object's collision surface may touch it when the hand closes [m]."""


@frozen
class Grasps(Tensors):
    """G grasps: how a hand is about to hold an object."""

    label: tuple[str, ...]
    """Sequence and frame."""
    object_index: Tensor
    """[G] index into the objects."""
    start: State
    """[G, ...] of the hand and the object, at rest; joint positions in double precision."""

    def __len__(self) -> int:
        """G"""
        return len(self.label)

    def __getitem__(self, rows: slice) -> Grasps:
        """Select grasps."""
        return replace(super().__getitem__(rows), label=self.label[rows], start=self.start[rows])


def find_grasps(
    motion: Retargeted,
    robot: RobotSpec,
    objects: Sequence[ObjectSpec],
    count: int,
    *,
    where: Literal["table", "air"],
) -> Grasps:
    """Choose grasps, equally many of each object and spread over the sequences; the same arguments give the same
    grasps.

    A frame counts if the thumb's tip and another tip are near the object's surface. ``table``: the object must be
    where it started; the last such frame of a sequence, just before the lift, is preferred. ``air``: the object must be
    lifted; the middle frame is preferred.

    Args:
        motion: motion, of which valid frames after first contact are used.
        robot: the robot.
        objects: geometry; frames of other objects are ignored.
        count: largest number of grasps.
        where: the object's place.

    Raises:
        DemoError: no frame shows a grasp on the table.
    """
    names = [o.name for o in objects]
    rows = np.flatnonzero(motion.valid & motion.post_contact)
    moved = motion.shift(objects)[rows]
    if where == "table":
        start = turn_of(motion.start_pose[1][motion.sequence_of_frame[rows]])
        turned = (turn_of(motion.object_quat_wxyz[rows]) * start.inv()).magnitude()
        fits = (np.linalg.norm(moved, axis=1) < REST_DISTANCE) & (turned < REST_ANGLE)
    else:
        fits = moved[:, 2] > LIFTED
    near = [_at_hand(motion, rows[fits], robot, obj) for obj in objects]
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
    turns = turn_of(object_quat).as_matrix()
    for pos, i, turn in zip(object_pos, object_index, turns, strict=True):
        pos[2] = max(pos[2], CLEARANCE - lowest_point(objects[i].pieces, turn))
    joint_pos = torch.as_tensor(motion.joint_pos[chosen], dtype=torch.float64)
    poses = map(torch.as_tensor, (object_pos, object_quat))
    return Grasps(
        label=tuple(f"{motion.sequence_name[s]}:{f}" for s, f in zip(sequence, frame, strict=True)),
        object_index=torch.tensor(object_index, dtype=torch.long),
        start=replace(State.at_rest(joint_pos, *poses), joint_pos=joint_pos),
    )


def _at_hand(motion: Retargeted, rows: np.ndarray, robot: RobotSpec, obj: ObjectSpec) -> np.ndarray:
    """Return the rows [R] of an object in which the thumb's tip and another tip are near it."""
    rows = rows[motion.object_name[motion.sequence_of_frame[rows]] == obj.name]
    if not len(rows):
        return rows
    tips = on_host(robot).points(motion.joint_pos[rows].astype(float), robot.tracked_links[1:])
    turn = turn_of(motion.object_quat_wxyz[rows]).as_matrix()
    local = np.einsum("fji,fkj->fki", turn, tips - motion.object_pos[rows, None])
    near = prepared_surface(obj).signed_distance(local) < NEAR
    return rows[near[:, 0] & near[:, 1:].any(axis=1)]


def _in_turns(motion: Retargeted, rows: np.ndarray, *, last_first: bool) -> np.ndarray:
    """Order rows [R] so that objects take turns, then the sequences of an object; the best frame of each is first."""
    sequence = motion.sequence_of_frame[rows]
    table = pd.DataFrame(
        {"row": rows, "sequence": sequence, "object": motion.object_name[sequence]}
    )
    size = table.groupby("sequence")["row"].transform("size").to_numpy()
    best = size - 1 if last_first else size // 2
    table["away"] = np.abs(table.groupby("sequence").cumcount().to_numpy() - best)
    table["rank"] = table.sort_values("away", kind="stable").groupby("sequence").cumcount()
    table["turn"] = table.sort_values("rank", kind="stable").groupby("object").cumcount()
    return table.sort_values("turn", kind="stable")["row"].to_numpy()


# Trying grasps --------------------------------------------------------------------------------------------------------

OPENING = 0.025
"""Distance by which the fingertips are opened at the start, away from the opposite fingertips [m]."""
REACH = 0.010
"""Distance that they close beyond the demonstrated grasp, in which they may not touch the object yet [m]."""
LIFT_HEIGHT = 0.10
"""Height by which the palm is lifted [m]."""
AMPLITUDE = 0.015
"""Amplitude of the shake [m]."""
_FREQUENCY = 2.5
"""Frequency of the shake [Hz]; its amplitude grows from zero and fades to zero."""
SQUEEZE = 12.0
"""Force with which thumb and fingers press against each other through the object [N]."""
SETTLE_TIME = 0.2
"""Time for the object to come to rest before the hand moves [s]."""
CLOSE_TIME = 0.6
"""Time for the fingers to close, at constant speed [s]."""
HOLD_TIME = 0.4
"""Time before and after the lift [s]."""
LIFT_TIME = 0.8
"""Time for the lift, with the least jerk [s]."""
SHAKE_TIME = 0.8
"""Time for the shake along x, and again along y [s]."""


def closing_steps(dt: float) -> int:
    """Return the number of control steps of :func:`closing_episode` before the lift begins; dt: control step [s]."""
    return sum(round(seconds / dt) for seconds in (SETTLE_TIME, CLOSE_TIME, HOLD_TIME))


def closing_episode(scene: SceneSpec, grasps: Grasps) -> tuple[State, Tensor]:
    """Return the start [G, ...] and the joint targets [T, G, J] of an episode: the hand, open around an object at rest,
    closes, lifts and shakes."""
    kinematics = Kinematics(scene.robot)
    dt = scene.control_dt
    held = grasps.start.joint_pos.double()
    opened = moved_fingertips(kinematics, held, -OPENING)
    closed = squeezed(kinematics, held)
    parts = (
        torch.zeros(round(SETTLE_TIME / dt)),
        torch.linspace(0, 1, round(CLOSE_TIME / dt) + 1)[1:],
        torch.ones(round(HOLD_TIME / dt)),
    )
    closing = opened + torch.cat(parts)[:, None, None] * (closed - opened)
    targets = torch.cat((closing, _carried(kinematics, closed, dt)))
    start = State.at_rest(opened, grasps.start.object_pos, grasps.start.object_quat)
    return start, targets.float()


def lifting_targets(scene: SceneSpec, start: State) -> Tensor:
    """[T, G, J] joint targets that lift and shake the held object, from the targets of the states [G, ...] on."""
    targets = start.joint_target.double()
    still = targets.expand(round(HOLD_TIME / scene.control_dt), *targets.shape)
    lifted = _carried(Kinematics(scene.robot), targets, scene.control_dt)
    return torch.cat((still, lifted)).float()


def _carried(kinematics: Kinematics, closed: Tensor, dt: float) -> Tensor:
    """[T, G, J] targets that lift, hold and shake the object in the closed hand [G, J]."""
    t = torch.linspace(0, 1, round(LIFT_TIME / dt) + 1)[1:]
    up = torch.zeros(len(t) + round(HOLD_TIME / dt), 3)
    up[:, 2] = LIFT_HEIGHT
    up[: len(t), 2] *= t**3 * (10 - 15 * t + 6 * t**2)
    steps = round(SHAKE_TIME / dt)
    t = torch.arange(1, steps + 1) / steps
    wave = AMPLITUDE * torch.sin(math.pi * t) * torch.sin(2 * math.pi * _FREQUENCY * SHAKE_TIME * t)
    shake = torch.zeros(2, steps, 3)
    shake[0, :, 0] = wave
    shake[1, :, 1] = wave
    shake[..., 2] = LIFT_HEIGHT
    return carried_palm(kinematics, closed, torch.cat((up, shake.flatten(0, 1))))


# Joint positions of a hand --------------------------------------------------------------------------------------------

_FINGER_STEPS = 4
_FINGER_DAMPING = 0.02
"""Damping of a finger step [m]: small against a finger's length, by which one radian moves its tip."""


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
        dq = least_squares(_tip_jacobian(kinematics, q), step, _FINGER_DAMPING)
        q = kinematics.clamp(q.index_add(-1, hand, dq))
    return q


def squeezed(kinematics: Kinematics, joint_pos: Tensor) -> Tensor:
    """Return joint targets [G, J] with which the hand reaches and squeezes.

    The targets are K^-1 J^T f beyond the end of the reach. If the object stops the fingers there, the drives give the
    torques J^T f of the fingertip forces f. The thumb presses as much as the other fingers together, which press
    equally.

    Args:
        kinematics: of the robot.
        joint_pos: [G, J] the hand as it holds the object (rad, m).
    """
    robot = kinematics.robot
    hand = torch.as_tensor(robot.hand_indices)
    q = moved_fingertips(kinematics, joint_pos, REACH)
    share = torch.full((len(robot.fingertips), 1), 1.0 / (len(robot.fingertips) - 1), dtype=q.dtype)
    share[0] = 1.0
    force = (_closing_direction(kinematics, joint_pos) * share * SQUEEZE).flatten(-2)
    torque = (_tip_jacobian(kinematics, q).mT @ force[..., None])[..., 0]
    return pressing_targets(kinematics, q, torch.zeros_like(q).index_add(-1, hand, torque))


def _closing_direction(kinematics: Kinematics, q: Tensor) -> Tensor:
    """[G, E, 3] unit vectors: the thumb's from its tip to the mean of the other tips, and theirs the other way."""
    tips = kinematics.points(q, kinematics.robot.tracked_links[1:])
    line = torch.nn.functional.normalize(tips[:, 1:].mean(1) - tips[:, 0], dim=-1)
    return torch.stack([line, *[-line] * (tips.shape[1] - 1)], dim=1)


def _tip_jacobian(kinematics: Kinematics, q: Tensor) -> Tensor:
    """[G, 3 E, H] Jacobian of the fingertips' positions."""
    linear = kinematics.jacobian(q, kinematics.robot.tracked_links[1:]).linear
    return linear[..., torch.as_tensor(kinematics.robot.hand_indices)].flatten(-3, -2)


def carried_palm(kinematics: Kinematics, joint_pos: Tensor, offset: Tensor) -> Tensor:
    """Return joint positions [T, G, J] that move the palm without turning it.

    Args:
        kinematics: of the robot.
        joint_pos: [G, J] first joint positions (rad, m); the hand's joints stay.
        offset: [T, 3] shift of the palm from its first position, world frame [m].
    """
    start = kinematics.link_poses(joint_pos, [kinematics.robot.palm])[:, 0]
    pos = start[:, :3, 3] + offset.to(joint_pos)[:, None]
    quat = matrix_to_quat(start[:, :3, :3]).expand(len(offset), -1, -1)
    path, _ = palm_path(kinematics, joint_pos, pos, quat, iterations=2, turn_length=0.3)
    return path
