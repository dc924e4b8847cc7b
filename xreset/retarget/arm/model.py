"""The model of a robot for its arm's inverse kinematics, the path that the arm should follow, and measures of a path.

Shape letters: S sequences, T frames, B batch, n arm joints, J_hand hand joints, J all joints, L links, C carriers, G
links with support points.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Self

import torch
from torch import Tensor

from xreset.errors import RobotError
from xreset.files.checks import frozen
from xreset.geometry.balls import bounding_balls, joined, members
from xreset.geometry.collision import SelfCollision, height_above_table, table_points
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.rotations import matrix_to_quat, matvec, quat_angle, quat_to_matrix
from xreset.physics.tensors import Tensors
from xreset.retarget.arm.config import ArmSearch
from xreset.retarget.validity import Measures, Thresholds, classify
from xreset.spec import RobotSpec, TableSpec

_SEARCH = 0.02
"""Heights above the table are measured up to this one [m]."""
_AT_LIMIT = 1e-6
"""A joint this near its limit is at it [rad or m]."""


@frozen
class ArmTargets(Tensors):
    """The path that the arm should follow."""

    root_pos: Tensor
    """[S, T, 3] position of the hand root."""
    root_quat: Tensor
    """[S, T, 4] orientation of the hand root."""
    hand_joints: Tensor
    """[S, T, J_hand] rad (m)"""
    annotated: Tensor
    """[S, T] bool: whether the human hand was annotated."""
    hand_error: Tensor
    """[S, T] mean fingertip error of the hand's retargeting [m]."""
    hand_clearance: Tensor
    """[S, T] smallest signed distance between the hand's own shapes, at most 0 [m]; the arm cannot change it."""

    @staticmethod
    def of_poses(root_pos: Tensor, root_quat: Tensor, hand_joints: Tensor) -> ArmTargets:
        """Return a path of one frame for each pose [S, 3], [S, 4] of the hand root; the hand has joints [J_hand], or
        [S, 1, J_hand]."""
        count = len(root_pos)
        zero = root_pos.new_zeros(count, 1)
        return ArmTargets(
            root_pos=root_pos[:, None],
            root_quat=root_quat[:, None],
            hand_joints=hand_joints.expand(count, 1, -1),
            annotated=torch.ones(count, 1, dtype=torch.bool),
            hand_error=zero,
            hand_clearance=zero,
        )

    def reversed(self) -> Self:
        """Return the path from the last frame to the first."""
        return self.map(lambda x: x.flip(1))


@frozen
class LowPoints(Tensors):
    """Points of the robot that are low above the table (length A)."""

    frame: Tensor
    """[A] index in the batch."""
    carrier: Tensor
    """[A] index of the link that carries the point."""
    height: Tensor
    """[A] height of the robot's shape above the table at this point [m]."""
    point: Tensor
    """[A, 3] center of the lowest ball [m]."""


class ArmModel:
    """The model of a robot for its arm's inverse kinematics."""

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
        self.carriers = (robot.hand_root, *(link for link in names if link not in in_hand))
        """Links that only the arm's joints move: the hand root, which carries the hand, then the arm's links."""
        carrier_of = {link: 0 if link in in_hand else self.carriers.index(link) for link in names}
        self.arm_collision = SelfCollision(self.kinematics, moved_by_arm=True)
        """Distances that the arm's joints change."""
        self._hand_collision = SelfCollision(self.hand, only=robot.self_collision_links)

        support = table_points(self.kinematics)
        links = sorted(support, key=lambda link: link not in in_hand)
        self._supported_in_hand = [link for link in links if link in in_hand]
        """Links of the hand with support points. They come first among all links with support points."""
        self._carrier = torch.tensor([carrier_of[link] for link in links], dtype=torch.long)
        """[G] carrier of each link with support points."""
        points = [support[link][0] for link in links]
        radii = [support[link][1] for link in links]
        self._count = torch.tensor([len(own) for own in radii], dtype=torch.long)
        """[G] number of support points of each link. The points are stored link by link."""
        self._first = self._count.cumsum(0) - self._count
        self._points = joined(points, 3)
        self._radii = joined(radii)
        self._middles, self._reach = bounding_balls(points, radii)
        """Center [G, 3], in the link's frame, and radius [G] of a ball around the support points of each link [m]."""

    def hand_poses(self, hand_joints: Tensor) -> Tensor:
        """[..., G, 4, 4] poses of the links with support points in their carriers' frames, in which only links of the
        hand move."""
        poses = torch.eye(4, dtype=hand_joints.dtype).repeat(
            *hand_joints.shape[:-1], len(self._carrier), 1, 1
        )
        if moving := self._supported_in_hand:
            poses[..., : len(moving), :, :] = self.hand.link_poses(hand_joints, moving)
        return poses

    def low_points(
        self,
        pos: Tensor,
        rot: Tensor,
        middles: Tensor,
        hand_poses: Tensor,
        rows: Tensor,
        below: float,
    ) -> LowPoints:
        """Find the lowest point of each carrier's shapes, where it is lower above the table than ``below`` [m].

        Args:
            pos: [B, C, 3] carriers' origins.
            rot: [B, C, 3, 3] their orientations.
            middles: [S, G, 3] see :attr:`ArmProblem.middles`.
            hand_poses: [S, G, 4, 4] see :meth:`hand_poses`.
            rows: [B] row of ``middles`` and ``hand_poses`` of each element of the batch.
            below: largest height above the table [m].
        """
        up = rot[:, :, 2].index_select(1, self._carrier)
        height = pos[:, :, 2].index_select(1, self._carrier) + (up * middles[rows]).sum(-1)
        frame, link = (height - self._reach < below).nonzero(as_tuple=True)
        position, point = members(self._first[link], self._count[link])
        row = frame[position]
        own = link[position]
        carrier = self._carrier[own]
        T = hand_poses[rows[frame], link][position]
        local = T[:, :3, 3] + matvec(T[:, :3, :3], self._points[point])
        centers = matvec(rot[row, carrier], local) + pos[row, carrier]
        heights = height_above_table(centers, self._radii[point], self.table)
        low = (heights < below).nonzero()[:, 0]
        low = low[heights[low].argsort(stable=True)]
        key = row[low] * len(self.carriers) + carrier[low]
        order = key.argsort(stable=True)
        is_first = torch.ones_like(order, dtype=torch.bool)
        is_first[1:] = key[order].diff() != 0
        low = low[order[is_first]]
        return LowPoints(
            frame=row[low], carrier=carrier[low], height=heights[low], point=centers[low]
        )

    def hand_clearance(self, hand_joints: Tensor) -> Tensor:
        """[...] smallest signed distance between the hand's shapes that can collide in physics, at most 0 [m]."""
        poses = self.hand.link_poses(hand_joints.flatten(0, -2)).numpy()
        return torch.as_tensor(self._hand_collision.clearance(poses)).view(hand_joints.shape[:-1])

    def problem(
        self, targets: ArmTargets, thresholds: Thresholds, config: ArmSearch | None = None
    ) -> ArmProblem:
        """Return the search for a path, with the limits of a valid frame."""
        hand_poses = self.hand_poses(targets.hand_joints)
        return ArmProblem(
            **vars(targets),
            model=self,
            root_rot=quat_to_matrix(targets.root_quat),
            hand_poses=hand_poses,
            middles=matvec(hand_poses[..., :3, :3], self._middles) + hand_poses[..., :3, 3],
            thresholds=thresholds,
            config=config or ArmSearch(),
        )

    def full(self, arm: Tensor, hand_joints: Tensor | float) -> Tensor:
        """[..., J] all joints in the robot's order, given those of the arm [..., n] and of the hand [..., J_hand]."""
        q = arm.new_zeros(*arm.shape[:-1], len(self.robot.joints))
        q[..., self.arm] = arm
        q[..., torch.as_tensor(self.hand.joint_indices)] = hand_joints
        return q


@frozen
class ArmProblem(ArmTargets):
    """Targets, and everything else that the search for a path needs. An index selects sequences, or frames of them."""

    # computed once from the targets
    root_rot: Tensor
    """[S, T, 3, 3] orientation of the hand root."""
    hand_poses: Tensor
    """[S, T, G, 4, 4] see :meth:`ArmModel.hand_poses`."""
    middles: Tensor
    """[S, T, G, 3] centers of balls around the support points of each link, in its carrier's frame."""
    model: ArmModel
    thresholds: Thresholds
    config: ArmSearch

    def repeated(self, count: int) -> ArmProblem:
        """Return the problem with every sequence repeated, copies next to each other: [S count, ...]."""
        return self[torch.arange(len(self.hand_poses)).repeat_interleave(count)]

    def measures(self, joints: Tensor) -> Measures:
        """Measure every frame [S, T] of the paths ``joints`` [S, T, n].

        In frames that are invalid for another reason than a jump, ``self_clearance`` is the hand's own.
        """
        model = self.model
        shape = joints.shape[:2]
        poses = model.kinematics.link_poses(model.full(joints, self.hand_joints).flatten(0, 1))
        carriers = poses[:, [model.kinematics.link_index(link) for link in model.carriers]]
        low = model.low_points(
            carriers[..., :3, 3],
            carriers[..., :3, :3],
            self.middles.flatten(0, 1),
            self.hand_poses.flatten(0, 1),
            torch.arange(len(carriers)),
            _SEARCH,
        )
        height = poses.new_full((len(poses),), _SEARCH).scatter_reduce(
            0, low.frame, low.height, "amin"
        )
        root = carriers[:, 0]
        at_limit = (joints <= model.lower + _AT_LIMIT) | (joints >= model.upper - _AT_LIMIT)
        no_jumps = Measures(
            annotated=self.annotated,
            hand_error=self.hand_error,
            wrist_position=(root[:, :3, 3].view(*shape, 3) - self.root_pos).norm(dim=-1),
            wrist_orientation=quat_angle(
                matrix_to_quat(root[:, :3, :3]).view(*shape, 4), self.root_quat
            ),
            at_limit=at_limit.any(-1),
            arm_jump=poses.new_zeros(shape),
            table_clearance=height.view(shape),
            self_clearance=self.hand_clearance,
        )
        rows = (classify(no_jumps, self.thresholds) == 0).flatten()
        clearance = self.hand_clearance.flatten().clone()
        of_arm = torch.as_tensor(model.arm_collision.clearance(poses[rows].numpy()))
        clearance[rows] = torch.minimum(clearance[rows], of_arm)
        return replace(
            no_jumps,
            arm_jump=arm_jump(joints, self.annotated),
            self_clearance=clearance.view(shape),
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
