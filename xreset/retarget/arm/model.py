"""A robot as its arm's inverse kinematics sees it, what the arm should do, and how well joints do it.

Shape letters: S sequences, T frames, B batch, n arm joints, J_hand hand joints, J all joints, L links, C carriers, G links with support
points.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from xreset.errors import RobotError
from xreset.geometry.balls import Spans, bounding_balls
from xreset.geometry.collision import SelfCollision, SupportPoints, height_above_table, table_points
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.rotations import matrix_to_quat, quat_angle
from xreset.retarget.validity import Measures
from xreset.spec import RobotSpec, TableSpec
from xreset.tensors import Tensors

_SEARCH = 0.02
"""Distances between shapes, and heights above the table, are measured up to here [m]."""
_AT_LIMIT = 1e-6
"""A joint this near its limit is at it [rad or m]."""


@dataclass(frozen=True, kw_only=True)
class ArmTargets(Tensors):
    """What the arm should do."""

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

    def reversed(self) -> ArmTargets:
        """The same from the last frame to the first."""
        return self.map(lambda x: x.flip(1))


@dataclass(frozen=True, kw_only=True)
class Lowest(Tensors):
    """Points of the robot that are low above the table (length A)."""

    frame: Tensor
    """[A] which of the batch."""
    carrier: Tensor
    """[A] index of the link that carries the point."""
    height: Tensor
    """[A] of the robot's shape there above the table [m]."""
    lever: Tensor
    """[A, 3] from the carrier's origin to the centre of the ball that is lowest, along the world's axes [m]."""


class ArmModel:
    """A robot as its arm's inverse kinematics sees it."""

    def __init__(self, robot: RobotSpec) -> None:
        """Raises ``RobotError`` if a joint of the arm lies behind the hand root, and ``XResetError`` if coal is missing."""
        self.robot = robot
        self.table = TableSpec()
        self.kinematics = Kinematics(robot)
        self.arm = torch.as_tensor(robot.arm_indices)
        """[n] indices of the arm's joints."""
        self.home = torch.as_tensor(robot.home[robot.arm_indices])
        """[n] arm joints at home."""
        self.lower, self.upper = self.kinematics.lower[self.arm], self.kinematics.upper[self.arm]
        hand = Kinematics(robot, root=robot.hand_root)
        if set(hand.joint_indices) & set(robot.arm_indices):
            raise RobotError(
                f"robot {robot.name!r}: an arm joint lies behind the hand root {robot.hand_root!r}, expected hand joints only."
            )
        self.hand = hand
        in_hand = set(hand.link_names)

        self.carriers: tuple[str, ...] = (
            robot.hand_root,
            *(link for link in self.kinematics.link_names if link not in in_hand),
        )
        """Links whose motion the arm's joints determine: the hand root, which carries the hand, then the arm's links."""
        self._hang(table_points(robot, self.kinematics), in_hand)
        self.carrier_of = torch.tensor(
            [0 if name in in_hand else self.carriers.index(name) for name in self.kinematics.link_names]
        )
        """[L] index of the carrier of every link."""
        self.arm_collision = SelfCollision(robot, self.kinematics, moved_by_arm=True)
        """Distances that the arm's joints change."""
        self._hand_collision = SelfCollision(robot, hand, only=robot.self_collision_links)

    def _hang(self, support: SupportPoints, in_hand: set[str]) -> None:
        """Which points stand for the shapes that may not touch the table, and what carries them."""
        links = list(dict.fromkeys(support.links))
        self._links = [link for link in links if link in in_hand] + [link for link in links if link not in in_hand]
        """Links with support points (length G), those of the hand first."""
        self._in_hand = [link for link in self._links if link in in_hand]
        self._carrier = torch.tensor(
            [0 if link in in_hand else self.carriers.index(link) for link in self._links], dtype=torch.long
        )
        rows = [[i for i, name in enumerate(support.links) if name == link] for link in self._links]
        self._spans = Spans.of(rows)
        order = [i for part in rows for i in part]
        self._points, self._radii = torch.as_tensor(support.points[order]), torch.as_tensor(support.radii[order])
        centers = [support.points[part] for part in rows]
        self._middles, self._reach = bounding_balls(centers, [support.radii[part] for part in rows])
        """Of a ball about each link's points, in the link's frame."""

    def hand_poses(self, hand_joints: Tensor) -> Tensor:
        """[..., G, 4, 4] the links with support points, in the frames of their carriers: only those of the hand move there."""
        poses = torch.eye(4, dtype=hand_joints.dtype).repeat(*hand_joints.shape[:-1], len(self._links), 1, 1)
        if self._in_hand:
            poses[..., : len(self._in_hand), :, :] = self.hand.link_poses(hand_joints, self._in_hand)
        return poses

    def lowest(self, pos: Tensor, rot: Tensor, hand_poses: Tensor, below: float) -> Lowest:
        """The lowest point of each carrier's shapes, where it is lower above the table than ``below`` [m].

        Args:
            pos: [B, C, 3] carriers' origins.
            rot: [B, C, 3, 3] their orientations.
            hand_poses: [B, G, 4, 4] see :meth:`hand_poses`.
            below: [m]
        """
        turn, shift = hand_poses[..., :3, :3], hand_poses[..., :3, 3]
        middle = shift + (turn @ self._middles[..., None])[..., 0]  # [B, G, 3]
        height = pos[:, self._carrier, 2] + (rot[:, self._carrier, 2] * middle).sum(-1)
        frame, link = (height - self._reach < below).nonzero(as_tuple=True)
        found: list[Lowest] = []
        for asking, point in self._spans.members(link):
            row, of = frame[asking], link[asking]
            carrier = self._carrier[of]
            local = shift[row, of] + (turn[row, of] @ self._points[point][..., None])[..., 0]
            lever = (rot[row, carrier] @ local[..., None])[..., 0]
            heights = height_above_table(
                lever[:, None] + pos[row, carrier][:, None], self._radii[point][:, None], self.table
            )[:, 0]
            found.append(Lowest(frame=row, carrier=carrier, height=heights, lever=lever)[heights < below])
        if not found:
            none = frame.new_zeros(0)
            return Lowest(frame=none, carrier=none, height=pos.new_zeros(0), lever=pos.new_zeros(0, 3))
        low = Lowest.cat(found)
        low = low[low.height.argsort(stable=True)]
        key = low.frame * len(self.carriers) + low.carrier
        order = key.argsort(stable=True)
        first = torch.ones_like(order, dtype=torch.bool)
        first[1:] = key[order][1:] != key[order][:-1]
        return low[order[first]]

    def hand_clearance(self, hand_joints: Tensor) -> Tensor:
        """[...] smallest signed distance between those of the hand's shapes that collide in physics [m]."""
        poses = self.hand.link_poses(hand_joints.flatten(0, -2)).numpy()
        return torch.as_tensor(self._hand_collision.clearance(poses, _SEARCH)).view(hand_joints.shape[:-1])

    def full(self, arm: Tensor, hand_joints: Tensor) -> Tensor:
        """[..., J] all joints in joint order."""
        q = arm.new_zeros(*arm.shape[:-1], len(self.robot.joints))
        q[..., self.arm] = arm
        q[..., torch.as_tensor(self.hand.joint_indices)] = hand_joints
        return q


def measure(model: ArmModel, targets: ArmTargets, joints: Tensor) -> Measures:
    """What is measured of every frame [S, T] of the paths ``joints`` [S, T, n]."""
    sequences, frames, _ = joints.shape
    poses = model.kinematics.link_poses(model.full(joints, targets.hand_joints).flatten(0, 1))
    carriers = poses[:, [model.kinematics.link_index(link) for link in model.carriers]]
    root = carriers[:, 0]
    quat = matrix_to_quat(root[:, :3, :3])
    low = model.lowest(
        carriers[..., :3, 3], carriers[..., :3, :3], model.hand_poses(targets.hand_joints).flatten(0, 1), _SEARCH
    )
    height = torch.full((len(poses),), _SEARCH, dtype=poses.dtype).scatter_reduce(0, low.frame, low.height, "amin")
    apart = torch.as_tensor(model.arm_collision.clearance(poses.numpy(), _SEARCH)).view(sequences, frames)
    return Measures(
        annotated=targets.annotated,
        hand_error=targets.hand_error,
        wrist_position=(root[:, :3, 3].view(sequences, frames, 3) - targets.root_pos).norm(dim=-1),
        wrist_orientation=quat_angle(quat.view(sequences, frames, 4), targets.root_quat),
        at_limit=((joints <= model.lower + _AT_LIMIT) | (joints >= model.upper - _AT_LIMIT)).any(-1),
        arm_jump=arm_jump(joints, targets.annotated),
        table_clearance=height.view(sequences, frames),
        self_clearance=torch.minimum(apart, targets.hand_clearance),
    )


def arm_jump(joints: Tensor, annotated: Tensor) -> Tensor:
    """[..., T] largest change of a joint since the frame before, along paths [..., T, n]; 0 where that is not annotated [..., T]."""
    change = joints.diff(dim=-2).abs().amax(-1).masked_fill(~annotated[..., :-1], 0.0)
    return torch.cat((torch.zeros_like(joints[..., :1, 0]), change), dim=-1)
