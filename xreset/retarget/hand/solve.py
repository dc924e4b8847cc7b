"""Hand retargeting: hand joints and hand pose that follow human keypoints, over whole trajectories at once (the paper, appendix D.b).

The variables of a frame are the hand's joints and the pose of the link that carries the hand; the cost is that of ``cost``. It is
minimised by Levenberg-Marquardt with analytic Jacobians and exact joint limits (projected steps). Neighbouring frames couple through the
changes between them alone, so each step solves a block-tridiagonal system. All of it runs on the hand model's device.

Shape letters: S sequences padded to T frames, P mapped keypoints, J hand joints, n = J + 6.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from torch import Tensor

from xreset.geometry.rotations import matrix_to_quat, quat_from_axis_angle, quat_multiply, quat_normalize
from xreset.retarget.chain import solve_chain
from xreset.retarget.hand.config import HandConfig
from xreset.retarget.hand.cost import System, system
from xreset.retarget.hand.model import HandModel
from xreset.retarget.hand.problem import HandState, HandTargets
from xreset.retarget.hand.scale import hand_scale, resized

__all__ = ["HandConfig", "HandMotion", "HandTargets", "retarget_hand"]

_Batch = TypeVar("_Batch", HandState, System)


@dataclass(frozen=True, kw_only=True)
class HandMotion:
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

    def to(self, device: torch.device | str) -> HandMotion:
        """The same on another device."""
        return HandMotion(**{name: value.to(device) for name, value in vars(self).items()})


def retarget_hand(
    model: HandModel, targets: HandTargets, config: HandConfig | None = None, progress: Callable[[float], None] | None = None
) -> HandMotion:
    """Hand motions that minimise the cost; sequences are independent of one another.

    Args:
        model: the hand; its device does the work.
        targets: what to follow; a sequence must have at least one annotated frame.
        config: weights.
        progress: called with the fraction of iterations that is done.

    Returns:
        The motions, on the targets' device.
    """
    config, home = config or HandConfig(), targets.keypoints.device
    targets = targets.to(model.device)
    if config.user_scale:
        scale = hand_scale(model, targets.keypoints, targets.annotated)
        targets = replace(targets, keypoints=resized(targets.keypoints, scale, model.names))
    sequences, frames = targets.annotated.shape
    root_pos, root_quat = _align_root(model, targets)
    state = HandState(model.kinematics.clamp(model.home).expand(sequences, frames, -1), root_pos, root_quat)
    shares = config.clearance_growth if config.clearance_weight else ()
    stages = [replace(config, clearance_weight=share * config.clearance_weight, iterations=config.growth_iterations) for share in shares]
    stages.append(config)
    steps, cost = sum(stage.iterations for stage in stages), targets.keypoints.new_zeros(sequences)
    for number, stage in enumerate(stages):
        before = sum(earlier.iterations for earlier in stages[:number])
        state, cost = _minimise(model, targets, stage, state, lambda n, before=before: progress((before + n) / steps) if progress else None)
    keypoints = model.keypoints(state.joints, state.root_pos, state.root_quat)
    return HandMotion(joints=state.joints, root_pos=state.root_pos, root_quat=state.root_quat, keypoints=keypoints, cost=cost).to(home)


def _minimise(
    model: HandModel, targets: HandTargets, config: HandConfig, start: HandState, progress: Callable[[int], None]
) -> tuple[HandState, Tensor]:
    """Levenberg-Marquardt from a first guess: the best state found and its cost [S]. A sequence that is done costs nothing more."""
    state = HandState(**{name: value.clone() for name, value in vars(start).items()})
    sequences = len(state.joints)
    damping = torch.full((sequences,), 1e-3, dtype=torch.float64, device=model.device)
    active = torch.arange(sequences, device=model.device)
    now, here = state, system(model, targets, config, state)
    final = here.cost.clone()
    for iteration in range(config.iterations):
        progress(iteration)
        trial = _retract(model, now, _limited_step(model, now, here, damping))
        there = system(model, targets.select(active), config, trial)
        better = there.cost < here.cost
        gain = (here.cost - there.cost) / here.cost.clamp_min(1e-12)
        now, here = _chosen(better, trial, now), _chosen(better, there, here)
        damping = torch.where(better, damping * 0.2, damping * 8.0)
        for name, value in vars(now).items():
            getattr(state, name)[active] = value
        final[active] = here.cost
        left = ~((better & (gain < config.tolerance)) | (damping > 1e6))
        if not bool(left.any()):
            break
        active, damping, now, here = active[left], damping[left], now.select(left), here.select(left)
    return state, final


def _chosen(first: Tensor, yes: _Batch, no: _Batch) -> _Batch:
    """Sequence by sequence, one or the other."""
    parts = {name: torch.where(first.view(-1, *[1] * (value.dim() - 1)), value, getattr(no, name)) for name, value in vars(yes).items()}
    return type(yes)(**parts)


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
    """[S, T, n] Levenberg-Marquardt step in which joints at a limit stay there if the cost pulls them outwards (Bertsekas' projection).

    The damping of the root knows no direction, so that the step turns with the scene.
    """
    joints = state.joints
    count = joints.shape[-1]
    pull = here.gradient[..., :count]
    outward = ((joints <= model.kinematics.lower) & (pull > 0)) | ((joints >= model.kinematics.upper) & (pull < 0))
    free = torch.ones_like(here.gradient)
    free[..., :count] = (~outward).to(free.dtype)
    size = here.diagonal.diagonal(dim1=-2, dim2=-1).clamp_min(1e-6)
    root = size[..., count:].unflatten(-1, (2, 3)).mean(-1, keepdim=True).expand(-1, -1, -1, 3).flatten(-2)  # the same in all directions
    ridge = damping[:, None, None] * torch.cat((size[..., :count], root), dim=-1) * free + (1.0 - free)
    H = here.diagonal * free[..., :, None] * free[..., None, :] + torch.diag_embed(ridge)
    return solve_chain(H, here.coupling * free[:, 1:] * free[:, :-1], -here.gradient * free)
