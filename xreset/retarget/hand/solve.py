"""Hand retargeting: hand joints and hand pose that follow human keypoints, over whole trajectories at once (the paper, appendix D.b).

The variables of a frame are the hand's joints and the pose of the link that carries the hand; the cost is that of ``cost``. It is
minimised by Levenberg-Marquardt with analytic Jacobians and exact joint limits (projected steps). Neighbouring frames couple through the
changes between them alone, so each step solves a block-tridiagonal system. All of it runs on the hand model's device.

Shape letters: S sequences padded to T frames, P mapped keypoints, J hand joints, n = J + 6.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from xreset.geometry.rotations import matrix_to_quat, quat_from_axis_angle, quat_multiply, quat_normalize
from xreset.retarget.hand.config import HandConfig
from xreset.retarget.hand.cost import System, system
from xreset.retarget.hand.model import HandModel
from xreset.retarget.hand.problem import HandState, HandTargets
from xreset.retarget.least_squares import free_to_move, minimise, solve_chain
from xreset.tensors import Tensors

__all__ = ["HandConfig", "HandMotion", "HandTargets", "retarget_hand"]


@dataclass(frozen=True, kw_only=True)
class HandMotion(Tensors):
    """A hand's motion."""

    joints: Tensor
    """[S, T, J] hand joint positions, within limits."""
    root_pos: Tensor
    """[S, T, 3] position of the hand root."""
    root_quat: Tensor
    """[S, T, 4] orientation of the hand root."""
    keypoints: Tensor
    """[S, T, P, 3] the robot's keypoints."""
    cost: Tensor
    """[S] final cost."""


def retarget_hand(
    model: HandModel,
    targets: HandTargets,
    config: HandConfig | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> HandMotion:
    """Hand motions that minimise the cost; sequences are independent of one another.

    Args:
        model: the hand; its device does the work.
        targets: what to follow; a sequence must have at least one annotated frame.
        progress: called with the fraction of iterations that is done.

    Returns:
        The motions, on the targets' device.
    """
    config, home = config or HandConfig(), targets.keypoints.device
    targets = targets.to(model.device)
    sequences, frames = targets.annotated.shape
    root_pos, root_quat = _align_root(model, targets)
    state = HandState(model.kinematics.clamp(model.home).expand(sequences, frames, -1), root_pos, root_quat)
    shares = config.clearance_growth if config.clearance_weight else ()
    stages = [
        replace(config, clearance_weight=share * config.clearance_weight, iterations=config.growth_iterations)
        for share in shares
    ]
    stages.append(config)
    steps, cost = sum(stage.iterations for stage in stages), targets.keypoints.new_zeros(sequences)
    for number, stage in enumerate(stages):
        before = sum(earlier.iterations for earlier in stages[:number])
        state, cost = _minimise(model, targets, stage, state, lambda n, before=before: progress((before + n) / steps))
    keypoints = model.keypoints(state.joints, state.root_pos, state.root_quat)
    return HandMotion(
        joints=state.joints, root_pos=state.root_pos, root_quat=state.root_quat, keypoints=keypoints, cost=cost
    ).to(home)


def _minimise(
    model: HandModel, targets: HandTargets, config: HandConfig, start: HandState, progress: Callable[[int], None]
) -> tuple[HandState, Tensor]:
    """The best state that is found from a first guess, and its cost [S]."""

    def done(_before: HandState, _after: HandState, cost: Tensor, tried: Tensor, damping: Tensor) -> Tensor:
        return ((tried < cost) & ((cost - tried) / cost.clamp_min(1e-12) < config.tolerance)) | (damping > 1e6)

    return minimise(
        start,
        lambda state, rows: system(model, targets[rows], config, state),
        lambda state, here, damping: _retract(model, state, _limited_step(model, state, here, damping)),
        done,
        config.iterations,
        progress=progress,
    )


def _align_root(model: HandModel, targets: HandTargets) -> tuple[Tensor, Tensor]:
    """First guess of the root: the rigid motion that carries the hand's keypoints at home onto the human's (Kabsch's method)."""
    human, at_home = targets.keypoints, model.at_home
    centre_home, centre_human = at_home.mean(0), human.mean(-2, keepdim=True)
    U, _, Vt = torch.linalg.svd((human - centre_human).mT @ (at_home - centre_home))
    flip = human.new_ones(*U.shape[:-2], 3)
    flip[..., 2] = torch.det(U) * torch.det(Vt)
    rot = (U * flip[..., None, :]) @ Vt
    pos = centre_human[..., 0, :] - (rot @ centre_home[:, None])[..., 0]
    nearest = _nearest_annotated(targets.annotated)
    rows = torch.arange(len(nearest), device=nearest.device)[:, None]
    return pos[rows, nearest], matrix_to_quat(rot)[rows, nearest]


def _nearest_annotated(annotated: Tensor) -> Tensor:
    """[S, T] index of the annotated frame that is nearest in time; ``ValueError`` if a sequence has none."""
    if not bool(annotated.any(dim=1).all()):
        raise ValueError("a sequence has no annotated frame")
    time = torch.arange(annotated.shape[1], device=annotated.device)
    distance = (time[:, None] - time).abs().expand(len(annotated), -1, -1)
    return distance.masked_fill(~annotated[:, None, :], len(time) * 2).argmin(dim=-1)


def _retract(model: HandModel, state: HandState, step: Tensor) -> HandState:
    count = state.joints.shape[-1]
    return HandState(
        joints=model.kinematics.clamp(state.joints + step[..., :count]),
        root_pos=state.root_pos + step[..., count : count + 3],
        root_quat=quat_normalize(quat_multiply(quat_from_axis_angle(step[..., count + 3 :]), state.root_quat)),
    )


def _limited_step(model: HandModel, state: HandState, here: System, damping: Tensor) -> Tensor:
    """[S, T, n] Levenberg-Marquardt step in which joints at a limit stay there if the cost pulls them outwards.

    The damping of the root knows no direction, so that the step turns with the scene.
    """
    joints = state.joints
    count = joints.shape[-1]
    free = torch.ones_like(here.gradient)
    free[..., :count] = free_to_move(joints, here.gradient[..., :count], model.kinematics.lower, model.kinematics.upper)
    size = here.diagonal.diagonal(dim1=-2, dim2=-1).clamp_min(1e-6)
    root = (
        size[..., count:].unflatten(-1, (2, 3)).mean(-1, keepdim=True).expand(-1, -1, -1, 3).flatten(-2)
    )  # the same in all directions
    ridge = damping[:, None, None] * torch.cat((size[..., :count], root), dim=-1) * free + (1.0 - free)
    H = here.diagonal * free[..., :, None] * free[..., None, :] + torch.diag_embed(ridge)
    return solve_chain(H, here.coupling * free[:, 1:] * free[:, :-1], -here.gradient * free)
