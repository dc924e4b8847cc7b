"""The cost of hand retargeting over whole trajectories, and its Gauss-Newton approximation.

    sum over frames of  bone vectors and directions + keypoints + contact + clearance + a jaw's pads
    + sum over neighbouring frames of  joint and root smoothness, and a wall against joint jumps

Shape letters: S sequences padded to T frames, B frames of a chunk, P mapped keypoints, C pairs of keypoints, n = J + 6 variables.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from xreset.geometry.rotations import quat_conjugate, quat_multiply, quat_to_axis_angle
from xreset.retarget.hand import terms
from xreset.retarget.hand.clearance import Distances, Objects, too_near
from xreset.retarget.hand.config import HandConfig
from xreset.retarget.hand.model import HandModel
from xreset.retarget.hand.pads import off_object
from xreset.retarget.hand.problem import HandState, HandTargets
from xreset.tensors import Tensors

_FRAMES_PER_CHUNK = {"cpu": 256, "cuda": 8192}
"""On a CPU what fits its caches; on a GPU what fills it."""


@dataclass(frozen=True)
class System(Tensors):
    """Cost and its Gauss-Newton approximation, a symmetric block-tridiagonal system per sequence."""

    cost: Tensor
    """[S]"""
    diagonal: Tensor
    """[S, T, n, n] diagonal blocks."""
    coupling: Tensor
    """[S, T-1, n] diagonals of the blocks beside the diagonal."""
    gradient: Tensor
    """[S, T, n] half the gradient."""


def system(model: HandModel, targets: HandTargets, config: HandConfig, state: HandState) -> System:
    """Cost of every sequence and its Gauss-Newton approximation."""
    sequences, frames, count = state.joints.shape
    n = count + 6
    cost, gradient, diagonal = (
        state.joints.new_zeros(sequences, *shape) for shape in ((frames,), (frames, n), (frames, n, n))
    )
    size = max(1, _FRAMES_PER_CHUNK[state.joints.device.type] // frames)
    for begin in range(0, sequences, size):
        part = slice(begin, begin + size)
        rows = torch.arange(sequences, device=state.joints.device)[part]
        values = _frames(model, targets[rows], config, state[rows])
        for whole, value in zip((cost, gradient, diagonal), values, strict=True):
            whole[part] = value.view(whole[part].shape)

    change, gradient_by_change, curvature = terms.change(_changes(state), *_change_weights(model, config))
    diagonal.diagonal(dim1=-2, dim2=-1)[:, 1:] += curvature
    diagonal.diagonal(dim1=-2, dim2=-1)[:, :-1] += curvature
    gradient[:, 1:] += gradient_by_change
    gradient[:, :-1] -= gradient_by_change
    return System(cost=cost.sum(1) + change.sum(1), diagonal=diagonal, coupling=-curvature, gradient=gradient)


def _changes(state: HandState) -> Tensor:
    """[S, T-1, n] change of every variable between neighbouring frames; rotations as rotation vectors in world axes."""
    turn = quat_to_axis_angle(quat_multiply(state.root_quat[:, 1:], quat_conjugate(state.root_quat[:, :-1])))
    return torch.cat((state.joints.diff(dim=1), state.root_pos.diff(dim=1), turn), dim=-1)


def _change_weights(model: HandModel, config: HandConfig) -> tuple[Tensor, Tensor, float]:
    """Smoothness weight [n] and largest free change [n] of every variable, and the weight of what is beyond."""
    joints = len(model.home)
    weight = torch.full((joints + 6,), config.smoothness_weight, dtype=torch.float64, device=model.device)
    weight[joints : joints + 3] /= config.length_scale**2
    limit = torch.full_like(weight, float("inf"))
    limit[:joints] = config.jump_limit
    return weight, limit, config.jump_weight


def _frames(
    model: HandModel, targets: HandTargets, config: HandConfig, state: HandState
) -> tuple[Tensor, Tensor, Tensor]:
    """Cost [B], half the gradient [B, n] and half the Gauss-Newton Hessian [B, n, n] of all terms of single frames."""
    scale = config.length_scale
    bodies = model.bodies(*(value.flatten(0, 1) for value in vars(state).values()))
    x, J = model.keypoints_of(bodies)
    x, J = x / scale, J / scale
    human, touched = targets.keypoints.flatten(0, 1) / scale, targets.contact_points.flatten(0, 1) / scale
    annotated = targets.annotated.flatten()
    on = annotated.to(x.dtype)[:, None]
    a, b = model.pairs.unbind(1)

    bones, bones_human = x[:, b] - x[:, a], human[:, b] - human[:, a]
    local = on.expand(-1, len(a)) * (config.local_weight / len(a))
    on_bones = terms.difference(bones, bones_human, local) + terms.direction(bones, bones_human, local)
    alignment = on * config.global_weight * torch.where(model.is_tip, config.tip_factor, 1.0).to(x.dtype)
    contact = on * config.contact_weight * targets.in_contact.flatten(0, 1)
    on_points = terms.difference(x, human, alignment) + terms.contact(
        x, touched, contact, config.contact_margin / scale, config.contact_knee / scale
    )

    moves = torch.cat((J[:, b] - J[:, a], J), dim=1)  # [B, C + P, 3, n]
    curved = torch.cat((on_bones.curvature, on_points.curvature), dim=1) @ moves
    slope = torch.cat((on_bones.gradient, on_points.gradient), dim=1)
    rows = moves.flatten(1, 2)
    gradient = (rows.mT @ slope.flatten(1, 2)[..., None])[..., 0]
    hessian = rows.mT @ curved.flatten(1, 2)
    cost = on_bones.cost + on_points.cost

    frames = targets.annotated.shape[1]
    objects = Objects.at(
        targets.object_pos.flatten(0, 1),
        targets.object_quat.flatten(0, 1),
        targets.object_index.repeat_interleave(frames),
        targets.fields,
    )
    value, row = _dense(too_near(model, bodies, objects, annotated, config.object_clearance, config.self_depth), len(x))
    value, row, weight = value / scale, row / scale, config.clearance_weight
    cost = cost + weight * value.square().sum(1)
    gradient = gradient + weight * (row.mT @ value[..., None])[..., 0]
    hessian = hessian + weight * (row.mT @ row)

    if config.pad_weight and len(model.pads.ball):
        held = (targets.held & targets.annotated).flatten().nonzero()[:, 0]
        value, row = off_object(model, bodies, objects, held)
        value, row = (value - config.object_clearance) / scale, row / scale
        pads = terms.attraction(value, config.pad_weight * model.pads.share, config.pad_reach / scale)
        cost[held] += pads.cost
        gradient[held] += (row.mT @ pads.gradient[..., None])[..., 0]
        hessian[held] += (row.mT * pads.curvature[:, None]) @ row
    return cost, gradient, hessian


def _dense(distances: Distances, frames: int) -> tuple[Tensor, Tensor]:
    """Distances [B, W] and slopes [B, W, n] by frame, padded with zeros to the most that one frame has."""
    frame = distances.frame
    count = torch.bincount(frame, minlength=frames)
    slot = torch.arange(len(frame), device=frame.device) - (count.cumsum(0) - count)[frame]
    width = int(count.max()) if len(frame) else 0
    value = distances.value.new_zeros(frames, width)
    slope = value.new_zeros(frames, width, distances.slope.shape[-1])
    value[frame, slot], slope[frame, slot] = distances.value, distances.slope
    return value, slope
