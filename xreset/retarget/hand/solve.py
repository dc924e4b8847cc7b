"""Hand retargeting: hand joints and hand pose that follow human keypoints, over whole trajectories at once (the paper,
appendix D.b).

The variables of a frame are the hand's joints and the pose of the link that carries the hand. The cost (``cost``) is
minimized by Levenberg-Marquardt with analytic Jacobians and exact joint limits (projected steps). Only neighboring
frames are coupled, so each step solves a block-tridiagonal system. The work runs on the hand model's device.

Shape letters: S sequences padded to T frames, P mapped keypoints, J hand joints, n = J + 6.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from xreset.geometry.rotations import (
    matrix_to_quat,
    matvec,
    quat_from_axis_angle,
    quat_multiply,
    quat_normalize,
)
from xreset.physics.tensors import one_thread
from xreset.retarget.hand.config import HandWeights
from xreset.retarget.hand.cost import HandSystem, system
from xreset.retarget.hand.model import HandModel, HandState, HandTargets
from xreset.retarget.least_squares import damped, free_to_move, minimize, solve_chain

_CLEARANCE_GROWTH = (0.01, 0.1)
"""Shares of the clearance's weight in the earlier stages; each stage starts from the result of the one before. A hand
that may pass through the object at first finds the right side of a handle or a rim."""
_GROWTH_STEPS = 6
"""Largest number of Levenberg-Marquardt steps of each earlier stage."""
_FIRST_DAMPING = 1.0
"""Damping of the first step of each stage. Longer steps touch the object elsewhere, so that most would be refused: from
1e-3 on, half of all steps are."""


@one_thread()
def retarget_hand(
    model: HandModel,
    targets: HandTargets,
    config: HandWeights | None = None,
) -> HandState:
    """Find hand motions that minimize the cost; sequences are independent of one another.

    Args:
        model: the hand.
        targets: human motion to follow; a sequence must have at least one annotated frame.
        config: weights and limits.

    Returns:
        The motions, on the targets' device; joints are within their limits.
    """
    config = config or HandWeights()
    device = targets.keypoints.device
    targets = targets.to(model.device)
    rows = torch.arange(len(targets.annotated), device=model.device)[:, None]
    nearest = nearest_annotated(targets.annotated)
    root_pos, root_quat = _align_root(model, targets.keypoints[rows, nearest])
    joints = model.kinematics.clamp(model.home).expand(*targets.annotated.shape, -1)
    state = HandState(joints, root_pos, root_quat)
    if config.clearance_weight:
        for share in _CLEARANCE_GROWTH:
            weight = share * config.clearance_weight
            stage = replace(config, clearance_weight=weight, iterations=_GROWTH_STEPS)
            state = _minimize(model, targets, stage, state)
    state = _minimize(model, targets, config, state)
    time = torch.arange(nearest.shape[1], device=model.device)
    return state[rows, torch.where(targets.inside, time, nearest)].to(device)


def _minimize(
    model: HandModel, targets: HandTargets, config: HandWeights, start: HandState
) -> HandState:
    """Return the best state that Levenberg-Marquardt finds from a first guess."""

    def evaluate(state: HandState, rows: Tensor) -> HandSystem:
        return system(model, targets[rows], config, state)

    def step(state: HandState, here: HandSystem, damping: Tensor) -> HandState:
        return _moved(model, state, _limited_step(model, state, here, damping))

    def done(
        _before: HandState, _after: HandState, cost: Tensor, tried: Tensor, damping: Tensor
    ) -> Tensor:
        gain = (cost - tried) / cost.clamp_min(1e-12)
        return ((tried < cost) & (gain < config.tolerance)) | (damping > 1e6)

    return minimize(start, evaluate, step, done, config.iterations, damping=_FIRST_DAMPING)


def _align_root(model: HandModel, human: Tensor) -> tuple[Tensor, Tensor]:
    """Return a first guess of the root: the rigid motion of the hand's keypoints at home onto the human's [S, T, P, 3]
    (Kabsch's method)."""
    center_home = model.at_home.mean(0)
    center_human = human.mean(-2, keepdim=True)
    U, _, Vt = torch.linalg.svd((human - center_human).mT @ (model.at_home - center_home))
    flip = human.new_ones(*U.shape[:-2], 3)
    flip[..., 2] = torch.det(U) * torch.det(Vt)
    rot = (U * flip[..., None, :]) @ Vt
    pos = center_human[..., 0, :] - matvec(rot, center_home)
    return pos, matrix_to_quat(rot)


def nearest_annotated(annotated: Tensor) -> Tensor:
    """[S, T] the annotated frame that is nearest to each frame.

    Raises:
        ValueError: a sequence has no annotated frame.
    """
    if not annotated.any(dim=1).all():
        raise ValueError("A sequence has no annotated frame. Select sequences that have one.")
    count = annotated.shape[1]
    time = torch.arange(count, device=annotated.device)
    before = torch.where(annotated, time, -count).cummax(dim=1).values
    after = torch.where(annotated, time, 2 * count).flip(1).cummin(dim=1).values.flip(1)
    return torch.where(time - before <= after - time, before, after)


def _moved(model: HandModel, state: HandState, step: Tensor) -> HandState:
    """Return the state after a step [S, T, n], within the joint limits."""
    joints, shift, turn = step.split((state.joints.shape[-1], 3, 3), dim=-1)
    return HandState(
        joints=model.kinematics.clamp(state.joints + joints),
        root_pos=state.root_pos + shift,
        root_quat=quat_normalize(quat_multiply(quat_from_axis_angle(turn), state.root_quat)),
    )


def _limited_step(model: HandModel, state: HandState, here: HandSystem, damping: Tensor) -> Tensor:
    """[S, T, n] Levenberg-Marquardt step in which joints at a limit stay there if the cost pulls them outwards.

    The damping of the root is the same in all directions, so the step turns with the scene.
    """
    count = state.joints.shape[-1]
    lower = model.kinematics.lower
    upper = model.kinematics.upper
    free = torch.ones_like(here.gradient)
    free[..., :count] = free_to_move(state.joints, here.gradient[..., :count], lower, upper)
    size = here.curvature.diagonal(dim1=-2, dim2=-1).clamp_min(1e-6)
    root = size[..., count:].unflatten(-1, (2, 3)).mean(-1).repeat_interleave(3, dim=-1)
    size = torch.cat((size[..., :count], root), dim=-1)
    matrix, rhs = damped(here, size, damping[:, None], free)
    return solve_chain(matrix, here.coupling * free[:, 1:] * free[:, :-1], rhs)
