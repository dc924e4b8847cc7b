"""The object-centric rewards of both versions of the paper, as a pure function.

The draft (appendix D.d):
r = r_reach + r_grasp + 4 r_p + 4 r_R + 10 r_success - 0.005 |a_t|^2 - 0.005 |a_t - a_{t-1}|^2 - 500 r_oob

The published paper, with the sum P of the fingertips' distances and the distance M of the palm to the object, the mean
distance d of surface points to the goal, and G = 1 where P <= 0.6 and M <= 0.2:
r = -2.5 min(P, 3) - 2.5 min(M, 0.5) + G 3 (1.4 - 3 d) + G [d <= 0.02] 15 / (1 + 10 d) - 0.005 |a_t|^2
- 0.05 |arm's a_t - a_{t-1}|^2 - 0.005 |hand's a_t - a_{t-1}|^2 - 500 r_oob

The learner gets ``scale`` r. Weights and widths are fields of :class:`~xreset.task.config.RewardConfig`.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any, cast

import torch
from torch import Tensor

from xreset.checks import frozen
from xreset.errors import RunError
from xreset.geometry.rotations import quat_angle, quat_rotate
from xreset.physics import State
from xreset.task.config import RewardConfig


@frozen
class RewardInput:
    """What the reward is computed from; N worlds, J joints, E fingertips with the thumb first.

    Positions are in the world frame [m], and those of the object are of its origin in the task
    (``TaskConfig.object_frame``).
    """

    tip_distance: Tensor
    """[N, E] distance from each fingertip to the object's surface [m]."""
    best_reach: Tensor
    """[N] smallest mean fingertip distance of the episode, this step included [m]."""
    tip_force: Tensor
    """[N, E, 3] force of each finger's contact links on the object [N], world frame, in the last internal step."""
    state: State
    """[N, ...] state of joints and object, without noise."""
    goal_pos: Tensor
    """[N, 3]"""
    goal_quat: Tensor
    """[N, 4] (w, x, y, z)"""
    start_pos: Tensor
    """[N, 3] position of the object at the start of the demonstration, without the episode's own perturbation."""
    start_quat: Tensor
    """[N, 4]"""
    action: Tensor
    """[N, J] this step's action, limited to [-1, 1] unless ``raw_actions`` is set."""
    previous_action: Tensor
    """[N, J] 0 in the first step of an episode."""
    out_of_bounds: Tensor
    """[N] bool: the object has left the scene, and the episode ends."""
    palm_distance: Tensor
    """[N] distance from the palm to the object's surface [m]."""
    points: Tensor
    """[N, 64, 3] :func:`xreset.objects.sampling.metric_points` of each world's object, in its frame [m]."""
    is_arm: Tensor
    """[J] bool: the joint is one of the arm's; the others are the hand's."""
    success_position: Tensor
    """[] largest distance to the goal that counts as success [m]: the configuration's, or a schedule's."""

    @property
    def object_pos(self) -> Tensor:
        """[N, 3] present position of the object, of ``state``."""
        return self.state.object_pos

    @property
    def object_quat(self) -> Tensor:
        """[N, 4] present orientation of the object, of ``state``."""
        return self.state.object_quat


@frozen
class Reward:
    """The reward, its terms and their conditions."""

    total: Tensor
    """[N] sum of the terms, times ``scale``: what the learner gets."""
    terms: dict[str, Tensor]
    """Name -> [N] weighted term, before ``scale``."""
    grasped: Tensor
    """[N] bool: the thumb and at least one other finger press on the object."""
    gate: Tensor
    """[N] bool: position, rotation, points and success are paid."""
    success: Tensor
    """[N] bool: the gate is open, and the object is at its goal (``success_shape``)."""


OwnTerm = Callable[[RewardInput], Tensor]
"""A reward term of the user: returns [N] before its weight. On a GPU it is replayed as part of a graph, so it must not
ask for the value of a tensor (``if``, ``item``, ``nonzero``)."""


def own_term(name: str) -> OwnTerm:
    """Return the function that ``task.reward.own`` names as ``module:function``, as it is now: a notebook may have
    defined it again.

    Raises:
        RunError: the module cannot be imported, or has no such function.
    """
    module, _, function = name.partition(":")
    try:
        found: Any = getattr(import_module(module), function)
    except Exception as error:  # a user's module may fail in any way
        reason = f"{type(error).__name__}: {error}"
        raise RunError(
            f"the reward term {name!r} cannot be loaded ({reason}). Is its folder in PYTHONPATH?"
        ) from error
    if not callable(found):
        raise RunError(
            f"the reward term {name!r} is {found!r}, expected a function of a RewardInput."
        )
    return cast(OwnTerm, found)


def contact_gate(tip_force: Tensor, threshold: float, *, opposing: bool = False) -> Tensor:
    """[N] bool: whether the thumb (first) and at least one other finger press on the object.

    Args:
        tip_force: [N, E, 3] contact forces on the object [N].
        threshold: force [N] from which a finger presses.
        opposing: whether that other finger's force must be more than 90 degrees from the thumb's.
    """
    pressing = tip_force.norm(dim=-1) > threshold
    others = pressing[:, 1:]
    if opposing:
        others = others & ((tip_force[:, :1] * tip_force[:, 1:]).sum(dim=-1) < 0)
    return pressing[:, 0] & others.any(dim=-1)


def point_distances(
    pos: Tensor, quat: Tensor, goal_pos: Tensor, goal_quat: Tensor, points: Tensor
) -> Tensor:
    """[N, P] distance |o_i - g_i| of each object-frame point [N, P, 3] from its place at the goal [m].

    The draft's pose error is the largest distance of four keypoints, the published paper's is the mean over surface
    points.
    """
    here = pos[:, None] + quat_rotate(quat[:, None], points)
    goal = goal_pos[:, None] + quat_rotate(goal_quat[:, None], points)
    return (here - goal).norm(dim=-1)


def compute_reward(x: RewardInput, c: RewardConfig) -> Reward:
    """Return the reward of one control step."""
    grasped = contact_gate(x.tip_force, c.contact_threshold)
    gate = grasped
    if c.contact == "opposing":
        gate = contact_gate(x.tip_force, c.contact_threshold, opposing=True)
    if c.contact == "near":
        gate = (x.tip_distance.sum(dim=-1) <= c.near_tips) & (x.palm_distance <= c.near_palm)
    position_error = (x.object_pos - x.goal_pos).norm(dim=-1)
    rotation_error = quat_angle(x.object_quat, x.goal_quat)
    points_error = position_error  # replaced below if a term needs the mean over the points
    if c.points or c.success_shape == "points":
        distances = point_distances(x.object_pos, x.object_quat, x.goal_pos, x.goal_quat, x.points)
        points_error = distances.mean(dim=-1)
    if c.success_shape == "points":
        success = gate & (points_error <= x.success_position)
        success_reward = c.success * success / (1.0 + 10.0 * points_error)
    else:
        is_near = position_error < x.success_position
        success = gate & is_near & (rotation_error < c.success_rotation)
        success_reward = c.success * success
    change = (x.action - x.previous_action).square()
    if c.action_rate_arm is None:
        action_rate = c.action_rate * change.sum(dim=-1)
    else:
        action_rate = (torch.where(x.is_arm, c.action_rate_arm, c.action_rate) * change).sum(dim=-1)
    reach = x.best_reach if c.reach_distance == "best" else x.tip_distance.mean(dim=-1)
    terms = {
        "reach": c.reach * (1.0 - torch.tanh(reach / c.reach_width)),
        "reach_near": c.reach_near * (1.0 - torch.tanh(reach / c.reach_near_width)),
        "grasp": c.grasp * grasped,
        "position": c.position * gate * (1.0 - torch.tanh(position_error / c.position_width)),
        "rotation": c.rotation * gate * (1.0 - torch.tanh(rotation_error / c.rotation_width)),
        "success": success_reward,
        "action": c.action * x.action.square().sum(dim=-1),
        "action_rate": action_rate,
        "out_of_bounds": c.out_of_bounds * x.out_of_bounds,
    }
    if c.proximity:
        terms["proximity"] = c.proximity * x.tip_distance.sum(dim=-1).clamp_max(c.proximity_cap)
    if c.palm_proximity:
        terms["palm_proximity"] = c.palm_proximity * x.palm_distance.clamp_max(c.palm_proximity_cap)
    if c.points:
        terms["points"] = c.points * gate * (1.0 - points_error / c.points_zero)
    for name, weight in c.own.items():
        terms[name] = weight * _checked(name, own_term(name)(x), position_error)
    total = c.scale * torch.stack(list(terms.values())).sum(dim=0)
    return Reward(total=total, terms=terms, grasped=grasped, gate=gate, success=success)


def _checked(name: str, value: Tensor, like: Tensor) -> Tensor:
    if not isinstance(value, Tensor) or value.shape != like.shape:
        found = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
        raise RunError(
            f"The reward term {name!r} gave {found}. Return a tensor of shape {tuple(like.shape)}: one value a world."
        )
    return value.to(like.dtype)
