"""Observations (the paper's appendix C), as pure functions, and the layout that a policy file carries.

Groups: ``policy`` (object pose, goal pose, gravity fraction, previous action), ``proprio`` (joints, palm, fingertips,
contact forces), ``perception`` (cloud history or paired points) and, for the critic only, ``privileged``. With cameras
there are also ``goal`` (goal pose, previous action) and ``view`` (images or points).
Shape letters: N worlds, J joints, E fingertips, P points, K numbers per point, H history.
"""

from __future__ import annotations

from math import prod

import torch
from torch import Tensor

from xreset.cameras.config import VisionConfig
from xreset.checks import frozen
from xreset.geometry.rotations import (
    quat_conjugate,
    quat_from_axis_angle,
    quat_multiply,
    quat_rotate,
    quat_to_axis_angle,
    quat_to_matrix,
)
from xreset.physics import Links, State
from xreset.task.config import ObservationConfig


@frozen
class ObservationInput:
    """Quantities that observations are made of: world frame, quaternions (w, x, y, z).

    The object's origin is that of the task (``TaskConfig.object_frame``).
    """

    state: State
    """[N, ...] true state. The policy observes ``observed_pos`` and ``observed_quat`` instead of its object pose."""
    links: Links
    """[N, 1 + E, ...] the palm, then the fingertips."""
    joint_target: Tensor
    """[N, J] targets of the drives [rad, m]."""
    joint_lower: Tensor
    """[J] joint limits [rad, m]."""
    joint_upper: Tensor
    """[J]"""
    points: Tensor
    """[N, P, 3] surface points of each world's object, from its origin along the mesh frame's axes [m]."""
    observed_pos: Tensor
    """[N, 3] object position as the tracker reports it [m]: late, wrong, or old (``task.randomization``)."""
    observed_quat: Tensor
    """[N, 4]"""
    goal_pos: Tensor
    """[N, 3] m"""
    goal_quat: Tensor
    """[N, 4]"""
    start_quat: Tensor
    """[N, 4] object orientation at the start of the episode."""
    gravity_fraction: Tensor
    """[N] share of the object's weight that acts."""
    previous_action: Tensor
    """[N, J] in [-1, 1]."""
    tip_force: Tensor
    """[N, E, 3] force on the object [N]."""
    tip_distance: Tensor
    """[N, E] distance from each fingertip to the object's surface points [m]."""
    reward: Tensor
    """[N] of the last step, scaled; 0 when an episode begins."""


def layout(
    num_joints: int, num_tips: int, c: ObservationConfig, vision: VisionConfig | None = None
) -> dict[str, dict[str, int]]:
    """Return the number of values of every term, by group, in order. A policy fits a task only if its layout is equal.

    ``perception`` has H * P * K values. With cameras the groups are ``goal``, ``proprio`` and ``view``.
    """
    rotation = "rotation"
    width = 6
    if c.rotation == "quaternion":
        rotation = "quat"
        width = 4
    if c.content == "published":
        policy = {"tip_to_object": 3 * num_tips, "palm_distance": 1}
        proprio = {"joint_pos": num_joints, "target_pos": num_joints}
    else:
        poses = {
            "object_pos": 3,
            f"object_{rotation}": width,
            "goal_pos": 3,
            f"goal_{rotation}": width,
        }
        if c.rotation == "to_goal":
            poses = {"object_pos": 3, "goal_pos": 3, "rotation_to_goal": 6}
        policy = poses | {"gravity_fraction": 1, "previous_action": num_joints}
        proprio = {
            "joint_pos": num_joints,
            "joint_vel": num_joints,
            "palm_pos": 3,
            f"palm_{rotation}": width,
            "palm_linvel": 3,
            "palm_angvel": 3,
            "tip_pos": 3 * num_tips,
            "tip_force": 3 * num_tips,
        }
        if c.joint_target:
            proprio["joint_target"] = num_joints
    if vision is None or not vision.cameras:
        cloud = "cloud" if c.cloud == "history" else "paired_cloud"
        return {"policy": policy, "proprio": proprio, "perception": {cloud: prod(c.cloud_shape)}}
    goal_rotation = "rotation_from_start" if c.rotation == "to_goal" else f"goal_{rotation}"
    return {
        "goal": {"goal_pos": 3, goal_rotation: width, "previous_action": num_joints},
        "proprio": proprio,
        "view": {vision.view: prod(vision.view_shape)},
    }


def policy_group(x: ObservationInput, c: ObservationConfig, generator: torch.Generator) -> Tensor:
    """[N, 15 + J] object pose (noisy), goal pose, gravity fraction, previous action.

    With ``rotation="matrix"`` there are four numbers more, with ``to_goal`` two less. With ``content="published"``,
    [N, 3 E + 1] vectors from the fingertips to the object's nearest points, and the palm's distance to its nearest
    point [m].
    """
    if c.content == "published":
        return _vectors_to_object(x)
    pos = _noisy(x.observed_pos, c.noise.object_pos, generator)
    error = quat_from_axis_angle(c.noise.object_rot * _normal(x.observed_pos, generator))
    quat = quat_multiply(error, x.observed_quat)
    if c.rotation == "to_goal":
        to_goal = quat_multiply(x.goal_quat, quat_conjugate(quat))
        poses = (pos, x.goal_pos, _encoded(to_goal, c))
    else:
        poses = (pos, _encoded(quat, c), x.goal_pos, _encoded(x.goal_quat, c))
    return torch.cat((*poses, x.gravity_fraction[:, None], x.previous_action), dim=-1)


def _vectors_to_object(x: ObservationInput) -> Tensor:
    """[N, 3 E + 1] vectors from the fingertips to the object's nearest points, and the palm's distance to its own."""
    offsets = _world_points(x)[:, None] - x.links.pos[:, :, None]
    nearest = offsets.square().sum(dim=-1).argmin(dim=-1)
    vectors = offsets.gather(2, nearest[:, :, None, None].expand(-1, -1, 1, 3))[:, :, 0]
    square = vectors[:, 0].square().sum(dim=-1, keepdim=True)
    # Some processors round torch's square root of float32 differently; xreset.runtime always rounds correctly.
    palm_distance = square.double().sqrt().to(square.dtype)
    return torch.cat((vectors[:, 1:].flatten(1), palm_distance), dim=-1)


def goal_group(x: ObservationInput, c: ObservationConfig) -> Tensor:
    """[N, 7 + J] goal pose, previous action. Without quaternions there are two numbers more.

    With ``rotation="to_goal"``, the goal's orientation is given as the rotation from the start of the episode to the
    goal, because no image shows the axes in which a mesh was drawn.
    """
    rotation = x.goal_quat
    if c.rotation == "to_goal":
        rotation = quat_multiply(x.goal_quat, quat_conjugate(x.start_quat))
    return torch.cat((x.goal_pos, _encoded(rotation, c), x.previous_action), dim=-1)


def proprio_group(x: ObservationInput, c: ObservationConfig, generator: torch.Generator) -> Tensor:
    """[N, 2 J + 13 + 6 E] joints, palm, fingertips and limited contact forces, in the order of :func:`layout`.

    Palm and fingertips are in the world frame. Joint positions are scaled to [-1, 1] between their limits. Without
    quaternions there are two numbers more, with ``joint_target`` J more. With ``content="published"``, [N, 2 J]
    positions and drives' targets, both scaled.
    """
    pos = _noisy(x.state.joint_pos, c.noise.joint_pos, generator)
    if c.content == "published":
        return torch.cat((_scaled(pos, x), _scaled(x.joint_target, x)), dim=-1)
    terms = [
        _scaled(pos, x),
        c.joint_vel_scale * _noisy(x.state.joint_vel, c.noise.joint_vel, generator),
        x.links.pos[:, 0],
        _encoded(x.links.quat[:, 0], c),
        x.links.linvel[:, 0],
        x.links.angvel[:, 0],
        x.links.pos[:, 1:].flatten(1),
        _limited_force(x, c),
    ]
    if c.joint_target:
        terms.append(x.joint_target - x.state.joint_pos)
    return torch.cat(terms, dim=-1)


def privileged_group(x: ObservationInput, c: ObservationConfig) -> Tensor:
    """[N, 15] object velocities, pose error (a vector [m] and a rotation vector [rad]), least fingertip distance [m],
    gravity fraction and reward; for the critic only.

    With ``content="published"``, [N, 15 + J + 3 E]: joint velocities and contact forces follow, because the policy
    does not observe them.
    """
    to_goal = quat_multiply(x.goal_quat, quat_conjugate(x.state.object_quat))
    terms = [
        x.state.object_linvel,
        x.state.object_angvel,
        x.goal_pos - x.state.object_pos,
        quat_to_axis_angle(to_goal),
        x.tip_distance.min(dim=-1, keepdim=True).values,
        x.gravity_fraction[:, None],
        x.reward[:, None],
    ]
    if c.content == "published":
        terms += [c.joint_vel_scale * x.state.joint_vel, _limited_force(x, c)]
    return torch.cat(terms, dim=-1)


def cloud_frame(x: ObservationInput, c: ObservationConfig, generator: torch.Generator) -> Tensor:
    """[N, P, K] one frame of the object's points in the world frame, times ``cloud_scale``.

    The present positions are noisy. With ``cloud="paired"`` the goal positions and the differences follow them.
    """
    cloud = _noisy(_world_points(x), c.noise.cloud, generator)
    if c.cloud == "history":
        return c.cloud_scale * cloud
    goal = quat_rotate(x.goal_quat[:, None], x.points) + x.goal_pos[:, None]
    return c.cloud_scale * torch.cat((cloud, goal, goal - cloud), dim=-1)


def _world_points(x: ObservationInput) -> Tensor:
    """[N, P, 3] the object's points in the world frame, at the pose that the tracker reports [m]."""
    return quat_rotate(x.observed_quat[:, None], x.points) + x.observed_pos[:, None]


def _scaled(joint_pos: Tensor, x: ObservationInput) -> Tensor:
    """[N, J] joint positions between their limits, in [-1, 1]."""
    return 2.0 * (joint_pos - x.joint_lower) / (x.joint_upper - x.joint_lower) - 1.0


def _limited_force(x: ObservationInput, c: ObservationConfig) -> Tensor:
    """[N, 3 E] fingertip forces, scaled and limited to [-1, 1]."""
    return (c.contact_force_scale * x.tip_force).clamp(-1.0, 1.0).flatten(1)


def _noisy(values: Tensor, std: float, generator: torch.Generator) -> Tensor:
    return values + std * _normal(values, generator)


def _normal(like: Tensor, generator: torch.Generator) -> Tensor:
    return torch.randn(like.shape, generator=generator, device=like.device, dtype=like.dtype)


def _encoded(quat: Tensor, c: ObservationConfig) -> Tensor:
    """[..., 4] or [..., 6] a rotation as the policy observes it: the same numbers for q and -q."""
    if c.rotation == "quaternion":
        return torch.where(quat[..., :1] < 0, -quat, quat)
    return quat_to_matrix(quat)[..., :2].mT.flatten(-2)
