"""The object-centric rewards of both versions of the paper: terms as pure functions, and their weighted sum.

The draft (appendix D.d):
r = r_reach + r_grasp + 4 r_p + 4 r_R + 10 r_success - 0.005 |a_t|^2 - 0.005 |a_t - a_{t-1}|^2 - 500 r_oob

The published paper, with the sum P of the fingertips' distances and the distance M of the palm to the object, the mean
distance d of surface points to the goal, and G = 1 where P <= 0.6 and M <= 0.2:
r = -2.5 min(P, 3) - 2.5 min(M, 0.5) + G 3 (1.4 - 3 d) + G [d <= 0.02] 15 / (1 + 10 d) - 0.005 |a_t|^2
- 0.05 |arm's a_t - a_{t-1}|^2 - 0.005 |hand's a_t - a_{t-1}|^2 - 500 r_oob

:class:`~xreset.task.config.RewardConfig` and the recipes list terms of this module with weights. The learner gets
``scale`` r. To add a term, write a function here and name it in a recipe.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable
from dataclasses import field, replace
from functools import cached_property

import torch
from torch import Tensor

from xreset.errors import RunError
from xreset.files.checks import FiniteFloat, NonNegativeFloat, PositiveFloat, frozen
from xreset.geometry.rotations import quat_angle, quat_rotate
from xreset.physics import State
from xreset.task.config import RewardConfig
from xreset.task.terms import Functions

CONTACT_FORCE = 0.1
"""Force [N] from which a finger counts as in contact in curves and results. Not in the paper."""


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
    """[N, J] this step's action. Beyond [-1, 1] it has no more effect."""
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
    success_position: float
    """Largest distance to the goal that counts as success [m] (``task.reward``)."""
    gate: Tensor = field(default_factory=lambda: torch.tensor(True))
    """[N] bool: the condition ``task.reward.gate`` holds. The condition itself does not read it."""

    @property
    def object_pos(self) -> Tensor:
        """[N, 3] present position of the object, of ``state``."""
        return self.state.object_pos

    @property
    def object_quat(self) -> Tensor:
        """[N, 4] present orientation of the object, of ``state``."""
        return self.state.object_quat

    @cached_property
    def position_error(self) -> Tensor:
        """[N] distance of the object from its goal [m]."""
        return (self.object_pos - self.goal_pos).norm(dim=-1)

    @cached_property
    def rotation_error(self) -> Tensor:
        """[N] angle between the object's orientation and its goal [rad]."""
        return quat_angle(self.object_quat, self.goal_quat)

    @cached_property
    def points_error(self) -> Tensor:
        """[N] mean distance of the object's surface points from their places at the goal [m]."""
        distances = point_distances(
            self.object_pos, self.object_quat, self.goal_pos, self.goal_quat, self.points
        )
        return distances.mean(dim=-1)

    def actions(self, *, limited: bool) -> tuple[Tensor, Tensor]:
        """[N, J] this action and the previous one, limited to [-1, 1] or not.

        Only a penalty of the action without limits pulls a mean back that is beyond them, where exploration noise has
        no effect (as in Isaac Lab's action terms).
        """
        if not limited:
            return self.action, self.previous_action
        return self.action.clamp(-1.0, 1.0), self.previous_action.clamp(-1.0, 1.0)


# Conditions that open the gate ----------------------------------------------------------------------------------------

GATES = Functions("gate")
"""Name -> condition [N] bool of ``task.reward.gate``."""


@GATES.add
def touching(x: RewardInput, *, force: NonNegativeFloat) -> Tensor:
    """The thumb and another finger press with this force [N] at least (the paper)."""
    return contact_gate(x.tip_force, force)


@GATES.add
def opposing(x: RewardInput, *, force: NonNegativeFloat) -> Tensor:
    """As ``touching``, and their forces on the object are more than 90 degrees apart, as in a grasp."""
    return contact_gate(x.tip_force, force, opposing=True)


@GATES.add
def near(x: RewardInput, *, tips: PositiveFloat, palm: PositiveFloat) -> Tensor:
    """Fingertips and palm are near the object, whether or not they touch it (the published paper: 0.6 and 0.2).

    Args:
        x: the step.
        tips: largest sum of the fingertips' distances to the object [m].
        palm: largest distance of the palm to the object [m].
    """
    return (x.tip_distance.sum(dim=-1) <= tips) & (x.palm_distance <= palm)


# Terms ----------------------------------------------------------------------------------------------------------------

TERMS = Functions("reward term", own=True)
"""Name -> term [N] of ``task.reward.terms``, before its weight."""


@TERMS.add
def reach(x: RewardInput, *, width: PositiveFloat) -> Tensor:
    """1 - tanh(d / width), with d the mean distance of the fingertips to the object, as in Isaac Lab's dexterous lift.

    A hand that has missed stays near and tries again. One width is too little: 0.1 m pays nothing at home, 36 cm away,
    and with 0.4 m the last centimetres, in which fingers wrap around the object, pay less than moving costs.

    Args:
        x: the step.
        width: distance at which this falls to 0.24 [m]. Not in the paper.
    """
    return 1.0 - torch.tanh(x.tip_distance.mean(dim=-1) / width)


@TERMS.add
def best_reach(x: RewardInput, *, width: PositiveFloat) -> Tensor:
    """As ``reach``, for the smallest distance of the episode (the paper): a hand that moves away is still paid."""
    return 1.0 - torch.tanh(x.best_reach / width)


@TERMS.add
def grasp(x: RewardInput, *, force: NonNegativeFloat, opposing_jaw: bool = False) -> Tensor:
    """1 while the thumb and another finger press with this force [N] at least.

    Args:
        x: the step.
        force: smallest force of a finger [N].
        opposing_jaw: the two fingertips of a jaw must also oppose each other, as in the gate ``opposing``. Else a
            closed jaw that pushes an object with both tips has no more to gain, and policies stayed with that
            (docs/lab-book.md). This changes nothing for hands with more fingertips. Not in the paper.
    """
    is_jaw = x.tip_force.shape[1] == 2
    return contact_gate(x.tip_force, force, opposing=opposing_jaw and is_jaw)


@TERMS.add
def position(x: RewardInput, *, width: PositiveFloat) -> Tensor:
    """1 - tanh(position error / width [m]) while the gate is open."""
    return x.gate * (1.0 - torch.tanh(x.position_error / width))


@TERMS.add
def rotation(x: RewardInput, *, width: PositiveFloat) -> Tensor:
    """1 - tanh(rotation error / width [rad]) while the gate is open."""
    return x.gate * (1.0 - torch.tanh(x.rotation_error / width))


@TERMS.add
def points(x: RewardInput, *, zero: PositiveFloat) -> Tensor:
    """1 - d / zero while the gate is open, with d the mean distance of 64 surface points to the goal [m].

    The published paper's 3 (1.4 - 3 d) is weight 4.2 with ``zero`` 1.4 / 3.

    Args:
        x: the step.
        zero: distance beyond which this is negative [m].
    """
    return x.gate * (1.0 - x.points_error / zero)


@TERMS.add
def success(x: RewardInput, *, rotation: PositiveFloat) -> Tensor:
    """1 while the gate is open and the object's pose is near the goal (section V: 2 cm and 15 degrees).

    Args:
        x: the step; ``task.reward.success_position`` is the largest position error.
        rotation: largest rotation error [rad].
    """
    is_near = x.position_error < x.success_position
    return x.gate & is_near & (x.rotation_error < rotation)


@TERMS.add
def near_success(x: RewardInput, *, most: FiniteFloat) -> Tensor:
    """most / (1 + 10 d) while the gate is open and d, as in ``points``, is at most ``task.reward.success_position``
    (the published paper, with ``most`` 15)."""
    is_near = x.gate & (x.points_error <= x.success_position)
    return most * is_near / (1.0 + 10.0 * x.points_error)


@TERMS.add
def proximity(x: RewardInput, *, cap: PositiveFloat) -> Tensor:
    """Sum of the fingertips' distances to the object [m], at most ``cap`` (the published paper: 3, weight -2.5)."""
    return x.tip_distance.sum(dim=-1).clamp_max(cap)


@TERMS.add
def palm_proximity(x: RewardInput, *, cap: PositiveFloat) -> Tensor:
    """The palm's distance to the object [m], at most ``cap`` (the published paper: 0.5, weight -2.5)."""
    return x.palm_distance.clamp_max(cap)


@TERMS.add
def action(x: RewardInput, *, limited: bool) -> Tensor:
    """Sum of squares of the action; see :meth:`RewardInput.actions`."""
    now, _ = x.actions(limited=limited)
    return now.square().sum(dim=-1)


@TERMS.add
def action_rate(x: RewardInput, *, limited: bool) -> Tensor:
    """Sum of squares of the action's change since the last step."""
    now, before = x.actions(limited=limited)
    return (now - before).square().sum(dim=-1)


@TERMS.add
def action_rate_of_parts(
    x: RewardInput, *, arm: FiniteFloat, hand: FiniteFloat, limited: bool
) -> Tensor:
    """As ``action_rate``, with a factor for the arm and one for the hand (the published paper: 0.05 and 0.005)."""
    now, before = x.actions(limited=limited)
    return (torch.where(x.is_arm, arm, hand) * (now - before).square()).sum(dim=-1)


@TERMS.add
def out_of_bounds(x: RewardInput) -> Tensor:
    """1 when the object leaves the scene (``task.termination``)."""
    return x.out_of_bounds


# The sum --------------------------------------------------------------------------------------------------------------


@frozen
class Reward:
    """The reward, its terms and their conditions."""

    total: Tensor
    """[N] sum of the terms, times ``scale``: what the learner gets."""
    terms: dict[str, Tensor]
    """Name -> [N] weighted term, before ``scale``."""
    grasped: Tensor
    """[N] bool: the thumb and at least one other finger press on the object with :data:`CONTACT_FORCE`."""
    gate: Tensor
    """[N] bool: position, rotation, points and success are paid."""
    success: Tensor
    """[N] bool: the term ``success`` is not 0; no world without such a term."""


class RewardFunction:
    """The reward of a configuration: a function of a step."""

    def __init__(self, config: RewardConfig) -> None:
        """Find the functions; errors as for :meth:`xreset.task.terms.Functions.bound`."""
        (self._gate,) = GATES.bound("task.reward.gate", config.gate).values()
        self._scale = config.scale
        self._weights: dict[str, float] = {}
        used = {}
        for name, term in config.terms.items():
            parameters = dict(term)
            weight = parameters.pop("weight")
            if weight or name == "success":
                self._weights[name] = float(weight)
                used[name] = parameters
        self._terms = TERMS.bound("task.reward.terms", used)

    def __call__(self, x: RewardInput) -> Reward:
        """Return the reward of one control step."""
        grasped = contact_gate(x.tip_force, CONTACT_FORCE)
        gate = self._gate(x)
        x = replace(x, gate=gate)
        success = torch.zeros_like(gate)
        terms = {}
        for name, function in self._terms.items():
            value = _value(name, function, x)
            if name == "success":
                success = value.abs() > 0  # False where the value is NaN
            terms[name] = self._weights[name] * value
        values = list(terms.values()) or [torch.zeros_like(x.best_reach)]
        total = self._scale * torch.stack(values).sum(dim=0)
        return Reward(total=total, terms=terms, grasped=grasped, gate=gate, success=success)


def _value(name: str, function: Callable[[RewardInput], Tensor], x: RewardInput) -> Tensor:
    like = x.best_reach
    try:
        value = function(x)
    except Exception as error:
        if ":" not in name:
            raise
        place = traceback.extract_tb(error.__traceback__)[:2][-1]  # the line of the user's function
        what = f"{type(error).__name__}: {error}"
        raise RunError(
            f"The reward term {name!r} failed in line {place.lineno} of {place.filename}: {what}. Correct the function."
        ) from error
    if not isinstance(value, Tensor) or value.shape != like.shape:
        found = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
        raise RunError(
            f"The reward term {name!r} gave {found}. Return a tensor of shape {tuple(like.shape)}: one value a world."
        )
    return value.to(like.dtype)


# Geometry -------------------------------------------------------------------------------------------------------------


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
