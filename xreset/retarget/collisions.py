"""Which links of a robot run into each other, in the frames that are not valid because of it."""

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
    """Pair of links -> number of frames lost to ``self collision`` in which it is too deep; the most frequent first.

    A frame in which several pairs meet counts for each of them.

    Args:
        result: trajectories of this robot.
        thresholds: that the frames were judged by.
    """
    lost = result.reason == REASONS.index("self collision")
    if not lost.any():
        return {}
    depth = (thresholds or Thresholds()).self_depth
    joints = torch.as_tensor(result.joint_pos[lost])
    whole, hand = Kinematics(robot), Kinematics(robot, root=robot.hand_root)
    found: set[tuple[int, tuple[str, str]]] = set()
    for kinematics, collision in (
        (whole, SelfCollision(robot, whole, moved_by_arm=True)),
        (hand, SelfCollision(robot, hand, only=robot.self_collision_links)),
    ):
        near = collision.near(
            kinematics.link_poses(joints[:, torch.as_tensor(kinematics.joint_indices)]).numpy(), -depth
        )
        names = kinematics.link_names
        found |= {
            (int(frame), (names[a], names[b]))
            for frame, (a, b) in zip(near.configuration, near.links.tolist(), strict=True)
        }
    return dict(Counter(pair for _, pair in found).most_common())
