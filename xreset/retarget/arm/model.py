"""A robot as its arm's inverse kinematics sees it, the path that the arm should follow, and how well joints do it.

Shape letters: S sequences, T frames, B batch, n arm joints, J_hand hand joints, J all joints, C carriers, Q support
points.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Self

import numpy as np
import torch
from torch import Tensor

from xreset.errors import RobotError
from xreset.geometry.collision import (
    SelfCollision,
    height_above_table,
    table_points,
)
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.rotations import matrix_to_quat, matvec, quat_angle
from xreset.retarget.arm.config import ArmConfig
from xreset.retarget.validity import Measures, Thresholds, classify
from xreset.spec import RobotSpec, TableSpec
from xreset.tensors import Tensors

_SEARCH = 0.02
"""Distances between shapes, and heights above the table, are measured up to here [m]."""
_AT_LIMIT = 1e-6
"""A joint this near its limit is at it [rad or m]."""


@dataclass(frozen=True, kw_only=True)
class ArmTargets(Tensors):
    """The path that the arm should follow."""

    root_pos: Tensor
    """[S, T, 3] position of the hand root."""
    root_quat: Tensor
    """[S, T, 4] orientation of the hand root."""
    hand_joints: Tensor
    """[S, T, J_hand]"""
    annotated: Tensor
    """[S, T] bool"""
    hand_error: Tensor
    """[S, T] mean fingertip error of the hand's retargeting [m]."""
    hand_clearance: Tensor
    """[S, T] smallest signed distance between the hand's own shapes [m]; the arm cannot change it."""

    def reversed(self) -> Self:
        """Return the path from the last frame to the first."""
        return self.map(lambda x: x.flip(1))


class ArmModel:
    """A robot as its arm's inverse kinematics sees it."""

    def __init__(self, robot: RobotSpec) -> None:
        """Prepare the arm.

        Raises:
            RobotError: a joint of the arm is below the hand root.
            XResetError: coal is not installed.
        """
        self.robot = robot
        self.table = TableSpec()
        self.kinematics = Kinematics(robot)
        self.hand = Kinematics(robot, root=robot.hand_root)
        if set(self.hand.joint_indices) & set(robot.arm_indices):
            raise RobotError(
                f"robot {robot.name!r}: an arm joint is below the hand root {robot.hand_root!r}. "
                "Choose a hand root with hand joints only below it."
            )
        self.arm = torch.as_tensor(robot.arm_indices)
        """[n] indices of the arm's joints."""
        self.home = torch.as_tensor(robot.home[robot.arm_indices])
        """[n] arm joints at home."""
        self.lower = self.kinematics.lower[self.arm]
        self.upper = self.kinematics.upper[self.arm]
        in_hand = self.hand.link_names
        names = self.kinematics.link_names
        self.carriers: tuple[str, ...] = (
            robot.hand_root,
            *(link for link in names if link not in in_hand),
        )
        """Links whose motion the arm's joints determine: the hand root, which carries the hand, then the arm's
        links."""
        self.arm_collision = SelfCollision(robot, self.kinematics, moved_by_arm=True)
        """Distances that the arm's joints change."""
        self._hand_collision = SelfCollision(robot, self.hand, only=robot.self_collision_links)

        support = table_points(robot, self.kinematics)
        carrier = np.array(
            [0 if link in in_hand else self.carriers.index(link) for link in support.links]
        )
        order = np.argsort(carrier, kind="stable")
        starts = np.searchsorted(carrier[order], np.arange(len(self.carriers) + 1)).tolist()
        self._own = [slice(*ends) for ends in pairwise(starts)]
        """Support points of each carrier."""
        self._hand_links = [support.links[i] for i in order[self._own[0]]]
        """Link of each of the hand's support points."""
        self._points = torch.as_tensor(support.points[order])
        self._radii = torch.as_tensor(support.radii[order])

    def support_points(self, hand_joints: Tensor) -> Tensor:
        """[..., Q, 3] points that may touch the table, in the frames of their carriers: only the hand's move there."""
        points = self._points.repeat(*hand_joints.shape[:-1], 1, 1)
        hand = self._own[0]
        if self._hand_links:
            points[..., hand, :] = self.hand.points(
                hand_joints, self._hand_links, self._points[hand]
            )
        return points

    def lowest(self, pos: Tensor, rot: Tensor, support: Tensor) -> tuple[Tensor, Tensor]:
        """Find the lowest point of each carrier's shapes.

        Args:
            pos: [B, C, 3] carriers' origins.
            rot: [B, C, 3, 3] their orientations.
            support: [B, Q, 3] see :meth:`support_points`.

        Returns:
            Its height [B, C] above the table [m], infinite where there is none, and the lever [B, C, 3] from the
            carrier's origin to the center of the lowest ball, along the world's axes [m].
        """
        height = pos.new_full(pos.shape[:2], torch.inf)
        lever = torch.zeros_like(pos)
        for carrier, own in enumerate(self._own):
            if own.start < own.stop:
                levers = matvec(rot[:, carrier, None], support[:, own])
                heights = height_above_table(
                    levers + pos[:, carrier, None], self._radii[own], self.table
                )
                height[:, carrier], lowest = heights.min(dim=1)
                lever[:, carrier] = levers[torch.arange(len(pos)), lowest]
        return height, lever

    def hand_clearance(self, hand_joints: Tensor) -> Tensor:
        """[...] smallest signed distance between those of the hand's shapes that collide in physics [m]."""
        poses = self.hand.link_poses(hand_joints.flatten(0, -2)).numpy()
        return torch.as_tensor(self._hand_collision.clearance(poses, _SEARCH)).view(
            hand_joints.shape[:-1]
        )

    def full(self, arm: Tensor, hand_joints: Tensor | float) -> Tensor:
        """[..., J] all joints in joint order."""
        q = arm.new_zeros(*arm.shape[:-1], len(self.robot.joints))
        q[..., self.arm] = arm
        q[..., torch.as_tensor(self.hand.joint_indices)] = hand_joints
        return q


@dataclass(frozen=True, kw_only=True)
class ArmProblem(ArmTargets):
    """Targets that paths are searched for. An index selects sequences, or some of their frames."""

    support: Tensor
    """[S, T, Q, 3] see :meth:`ArmModel.support_points`; computed once from the targets."""
    model: ArmModel
    thresholds: Thresholds
    config: ArmConfig

    def repeated(self, count: int) -> ArmProblem:
        """Return the problem with every sequence repeated, copies next to each other: [S count, ...]."""
        return self[torch.arange(len(self.support)).repeat_interleave(count)]

    def measures(self, joints: Tensor) -> Measures:
        """Measure every frame [S, T] of the paths ``joints`` [S, T, n]."""
        model = self.model
        shape = joints.shape[:2]
        poses = model.kinematics.link_poses(model.full(joints, self.hand_joints).flatten(0, 1))
        carriers = poses[:, [model.kinematics.link_index(link) for link in model.carriers]]
        height, _ = model.lowest(
            carriers[..., :3, 3], carriers[..., :3, :3], self.support.flatten(0, 1)
        )
        clearance = torch.as_tensor(model.arm_collision.clearance(poses.numpy(), _SEARCH)).view(
            shape
        )
        root = carriers[:, 0]
        at_limit = (joints <= model.lower + _AT_LIMIT) | (joints >= model.upper - _AT_LIMIT)
        return Measures(
            annotated=self.annotated,
            hand_error=self.hand_error,
            wrist_position=(root[:, :3, 3].view(*shape, 3) - self.root_pos).norm(dim=-1),
            wrist_orientation=quat_angle(
                matrix_to_quat(root[:, :3, :3]).view(*shape, 4), self.root_quat
            ),
            at_limit=at_limit.any(-1),
            arm_jump=arm_jump(joints, self.annotated),
            table_clearance=height.amin(1).clamp_max(_SEARCH).view(shape),
            self_clearance=torch.minimum(clearance, self.hand_clearance),
        )

    def reasons(self, joints: Tensor) -> Tensor:
        """[S, T] reason of each frame of the paths [S, T, n], 0 where valid: see
        :func:`~xreset.retarget.validity.classify`."""
        return classify(self.measures(joints), self.thresholds)


def arm_jump(joints: Tensor, annotated: Tensor) -> Tensor:
    """[..., T] largest change of a joint since the frame before, along paths [..., T, n]; 0 where that frame is not
    annotated."""
    change = joints.diff(dim=-2).abs().amax(-1).masked_fill(~annotated[..., :-1], 0.0)
    return torch.cat((torch.zeros_like(joints[..., :1, 0]), change), dim=-1)
