"""Push a robot out of the object in frames that are invalid because of their exact depth alone.

Balls leave the edges of boxes and hulls bare, a grid rounds thin objects off, and the arm carries the hand with an
error of some millimeters. In such frames the robot is moved by a few millimeters, each frame for itself.

Shape letters: B frames, A overlaps, J joints.
"""

from __future__ import annotations

from dataclasses import replace
from math import inf

import torch
from torch import Tensor

from xreset.geometry.collision import ObjectCollision, Overlaps
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.rotations import matvec
from xreset.retarget.least_squares import Quadratic, damped, free_to_move
from xreset.retarget.validity import Thresholds

_AIM = 0.5 * Thresholds().object_depth
"""Depth that a push aims at [m]."""
_STEPS = 10
"""Largest number of steps."""
_LONGEST_STEP = 2e-3
"""Longest distance that a keypoint's link moves in a step [m]. Other pieces of the object may be near."""
_DEPTH_WEIGHT = 100.0
"""Weight of an overlap; the movement of a keypoint's link has weight 1."""
_DAMPING = 1e-4
"""Weight of the change of a joint [m^2/rad^2]; it decides about joints that move no keypoint's link."""
_FRAMES_AT_ONCE = 512
"""Limits the memory that this takes."""


def pushed_out(
    kinematics: Kinematics,
    collision: ObjectCollision,
    joint_pos: Tensor,
    object_index: Tensor,
    object_pos: Tensor,
    object_rot: Tensor,
    limit: float,
) -> tuple[Tensor, Tensor]:
    """Move frames until they are no deeper in the object than a limit.

    Args:
        kinematics: the whole robot.
        collision: the robot and the objects.
        joint_pos: [B, J]
        object_index: [B] object of each frame.
        object_pos: [B, 3]
        object_rot: [B, 3, 3]
        limit: largest depth [m].

    Returns:
        Joints [B, J] within their limits, and their depth [B] [m]; infinite in frames that stay deeper, whose joints do
        not change.
    """
    result = joint_pos.clone()
    result_depth = joint_pos.new_full((len(joint_pos),), inf)
    for frames in torch.arange(len(joint_pos)).split(_FRAMES_AT_ONCE):
        q = joint_pos[frames]
        for _ in range(_STEPS + 1):
            poses = kinematics.link_poses(q, collision.links)
            found = collision.overlaps(
                poses, object_index[frames], object_pos[frames], object_rot[frames]
            )
            depth = found.deepest(len(frames))
            deep = depth > limit
            done = frames[~deep]
            result[done] = q[~deep]
            result_depth[done] = depth[~deep]
            if not deep.any():
                break
            frames = frames[deep]
            found = found[deep[found.state]]
            found = replace(found, state=(deep.cumsum(0) - 1)[found.state])
            q = _stepped_out(kinematics, collision, q[deep], found)
    return result, result_depth


def _stepped_out(
    kinematics: Kinematics, collision: ObjectCollision, q: Tensor, found: Overlaps
) -> Tensor:
    """Return joints [B, J] after a step out of the object: as little movement of the keypoints' links as brings the
    overlaps to the depth that is aimed at."""
    keypoint_links = [spec.link for spec in kinematics.robot.keypoints]
    links = list(dict.fromkeys((*keypoint_links, *collision.links)))
    origins, _, linear, angular = kinematics.jacobian(q, links)
    followed = torch.tensor([links.index(link) for link in keypoint_links])
    moves = linear[:, followed].flatten(1, 2)
    link = torch.tensor([links.index(link) for link in collision.links])[found.shape]
    at = (found.state, link)
    lever = torch.linalg.cross(found.point - origins[at], found.outward)
    slope = matvec(linear[at].mT, found.outward) + matvec(angular[at].mT, lever)

    excess = (found.depth - _AIM).clamp_min(0.0)
    gradient = torch.zeros_like(q)
    gradient.index_add_(0, found.state, -_DEPTH_WEIGHT * excess[:, None] * slope)
    curvature = moves.mT @ moves
    curvature.index_add_(0, found.state, _DEPTH_WEIGHT * slope[:, :, None] * slope[:, None, :])
    here = Quadratic(gradient.square().sum(1), gradient, curvature)
    free = free_to_move(q, gradient, kinematics.lower, kinematics.upper)
    damping = q.new_full((len(q),), _DAMPING)
    step = torch.linalg.solve(*damped(here, torch.ones_like(q), damping, free))
    way = matvec(moves, step).unflatten(1, (-1, 3)).norm(dim=-1).amax(dim=1, keepdim=True)
    return kinematics.clamp(q + step * (_LONGEST_STEP / way).clamp_max(1.0))
