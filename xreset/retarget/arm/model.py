"""A robot as its arm's inverse kinematics sees it, what the arm should do, and how well joints do it.

Shape letters: S sequences, T frames, B batch, n arm joints, J_hand hand joints, J all joints, L links, H support points of the hand.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from xreset.errors import RobotError
from xreset.geometry.collision import SelfCollision, height_above_table, table_points
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.rotations import matrix_to_quat, quat_angle
from xreset.retarget.validity import Measures
from xreset.spec import RobotSpec, TableSpec
from xreset.tensors import Tensors

_SELF_SEARCH = 0.02
"""Distances between shapes are measured up to here [m]."""
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


class ArmModel:
    """A robot as its arm's inverse kinematics sees it."""

    def __init__(self, robot: RobotSpec, table: TableSpec | None = None) -> None:
        """Raises ``RobotError`` if a joint of the arm lies behind the hand root, and ``XResetError`` if coal is missing."""
        self.robot = robot
        self.table = table or TableSpec()
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

        support = table_points(robot, self.kinematics)
        points, radii = torch.as_tensor(support.points), torch.as_tensor(support.radii)
        of_hand = torch.tensor([link in in_hand for link in support.links], dtype=torch.bool)
        self.hand_links = tuple(link for link in support.links if link in in_hand)
        """Link of each of the hand's support points (length H)."""
        self.hand_points, self.hand_radii = points[of_hand], radii[of_hand]
        self.carriers: tuple[str, ...] = (robot.hand_root, *(link for link in self.kinematics.link_names if link not in in_hand))
        """Links whose motion the arm's joints determine: the hand root, which carries the hand, then the arm's links."""
        rows = {link: [i for i, name in enumerate(support.links) if name == link] for link in support.links if link not in in_hand}
        self.arm_support = [(self.carriers.index(link), points[of_link], radii[of_link]) for link, of_link in rows.items()]
        """Per arm link with shapes: its index among the carriers, its support points and radii."""
        self.carrier_of = torch.tensor([0 if name in in_hand else self.carriers.index(name) for name in self.kinematics.link_names])
        """[L] index of the carrier of every link."""
        self.arm_collision = SelfCollision(robot, self.kinematics, moved_by_arm=True)
        """Distances that the arm's joints change."""
        self._hand_collision = SelfCollision(robot, hand, only=robot.self_collision_links)

    def hand_support(self, hand_joints: Tensor) -> Tensor:
        """[..., H, 3] the hand's support points in the frame of the hand root."""
        return self.hand.points(hand_joints, self.hand_links, self.hand_points)

    def hand_clearance(self, hand_joints: Tensor) -> Tensor:
        """[...] smallest signed distance between those of the hand's shapes that collide in physics [m]."""
        poses = self.hand.link_poses(hand_joints.flatten(0, -2)).numpy()
        return torch.as_tensor(self._hand_collision.clearance(poses, _SELF_SEARCH)).view(hand_joints.shape[:-1])

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
    root = poses[:, model.kinematics.link_index(model.robot.hand_root)]
    quat = matrix_to_quat(root[:, :3, :3])
    heights = [torch.full((len(poses), 1), torch.inf, dtype=poses.dtype)]  # what a robot without shapes would keep
    heights += [height_above_table(_place(root, model.hand_support(targets.hand_joints).flatten(0, 1)), model.hand_radii, model.table)]
    for carrier, points, radii in model.arm_support:
        link = poses[:, model.kinematics.link_index(model.carriers[carrier])]
        heights.append(height_above_table(_place(link, points), radii, model.table))
    apart = torch.as_tensor(model.arm_collision.clearance(poses.numpy(), _SELF_SEARCH)).view(sequences, frames)
    return Measures(
        annotated=targets.annotated,
        hand_error=targets.hand_error,
        wrist_position=(root[:, :3, 3].view(sequences, frames, 3) - targets.root_pos).norm(dim=-1),
        wrist_orientation=quat_angle(quat.view(sequences, frames, 4), targets.root_quat),
        at_limit=((joints <= model.lower + _AT_LIMIT) | (joints >= model.upper - _AT_LIMIT)).any(-1),
        arm_jump=arm_jump(joints, targets.annotated),
        table_clearance=torch.cat(heights, dim=1).amin(1).view(sequences, frames),
        self_clearance=torch.minimum(apart, targets.hand_clearance),
    )


def arm_jump(joints: Tensor, annotated: Tensor) -> Tensor:
    """[..., T] largest change of a joint since the frame before, along paths [..., T, n]; 0 where that is not annotated [..., T]."""
    change = joints.diff(dim=-2).abs().amax(-1).masked_fill(~annotated[..., :-1], 0.0)
    return torch.cat((torch.zeros_like(joints[..., :1, 0]), change), dim=-1)


def _place(T: Tensor, points: Tensor) -> Tensor:
    """[B, H, 3] points given in the frames T [B, 4, 4], in the world."""
    return points @ T[:, :3, :3].mT + T[:, None, :3, 3]
