"""Which links of a robot collide in the frames that are invalid because of it."""

from __future__ import annotations

from collections import Counter

import torch

from xreset.geometry.collision import SelfCollision
from xreset.geometry.kinematics import Kinematics
from xreset.retarget.file import Retargeted
from xreset.retarget.validity import REASONS, Thresholds
from xreset.spec import RobotSpec


def colliding_links(
    result: Retargeted, robot: RobotSpec, thresholds: Thresholds | None = None
) -> dict[tuple[str, str], int]:
    """Count, for pairs of links, the frames lost to ``self collision`` in which the pair is too deep; most frequent
    pair first.

    A frame in which several pairs collide counts for each of them.

    Args:
        result: trajectories of this robot.
        robot: the robot.
        thresholds: limits that the frames were judged by.
    """
    lost = result.reason == REASONS.index("self collision")
    if not lost.any():
        return {}
    depth = (thresholds or Thresholds()).self_depth
    joints = torch.as_tensor(result.joint_pos[lost])
    whole = Kinematics(robot)
    hand = Kinematics(robot, root=robot.hand_root)
    found: set[tuple[int, str, str]] = set()
    for kinematics, collision in (
        (whole, SelfCollision(robot, whole, moved_by_arm=True)),
        (hand, SelfCollision(robot, hand, only=robot.self_collision_links)),
    ):
        poses = kinematics.link_poses(joints[:, torch.as_tensor(kinematics.joint_indices)])
        found.update(collision.near(poses.numpy(), -depth))
    return dict(Counter(sorted((a, b) for _, a, b in found)).most_common())
