"""The cost of hand retargeting over whole trajectories, and its Gauss-Newton approximation.

    sum over frames of  bone vectors and directions + keypoints + contact + clearance + a jaw's pads
    + sum over neighboring frames of  joint and root smoothness, and a wall against joint jumps

Shape letters: S sequences padded to T frames, B frames of a chunk, P mapped keypoints, C pairs of keypoints, n = J + 6
variables, W distances of a frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from xreset.geometry.rotations import (
    matvec,
    quat_conjugate,
    quat_multiply,
    quat_to_axis_angle,
)
from xreset.retarget.hand import terms
from xreset.retarget.hand.clearance import (
    Distances,
    Objects,
    pad_distances,
    too_near,
)
from xreset.retarget.hand.config import HandConfig
from xreset.retarget.hand.model import Bodies, HandModel, HandState, HandTargets
from xreset.tensors import Tensors

_FRAMES_PER_CHUNK = {"cpu": 256, "cuda": 2048}
"""On a CPU as many as fit its caches; on a GPU enough to fill it."""


@dataclass(frozen=True)
class HandSystem(Tensors):
    """Cost and its Gauss-Newton approximation, a symmetric block-tridiagonal system per sequence."""

    cost: Tensor
    """[S]"""
    diagonal: Tensor
    """[S, T, n, n] diagonal blocks."""
    coupling: Tensor
    """[S, T-1, n] diagonals of the blocks next to the diagonal."""
    gradient: Tensor
    """[S, T, n] half the gradient."""


def system(model: HandModel, targets: HandTargets, config: HandConfig, state: HandState) -> HandSystem:
    """Compute the cost of every sequence and its Gauss-Newton approximation."""
    sequences, frames, joints = state.joints.shape
    rows = torch.arange(sequences, device=state.joints.device)
    size = max(1, _FRAMES_PER_CHUNK[state.joints.device.type] // frames)
    chunks = [_frames(model, targets[part], config, state[part]) for part in rows.split(size)]
    cost, gradient, diagonal = (
        torch.cat(parts).unflatten(0, (sequences, frames)) for parts in zip(*chunks, strict=True)
    )

    turn = quat_to_axis_angle(quat_multiply(state.root_quat[:, 1:], quat_conjugate(state.root_quat[:, :-1])))
    changes = torch.cat((state.joints.diff(dim=1), state.root_pos.diff(dim=1), turn), dim=-1)
    weight = changes.new_full((joints + 6,), config.smoothness_weight)
    weight[joints : joints + 3] /= config.length_scale**2
    limit = torch.full_like(weight, float("inf"))
    limit[:joints] = config.jump_limit
    change = terms.change(changes, weight, limit, config.jump_weight)
    diagonal.diagonal(dim1=-2, dim2=-1)[:, 1:] += change.curvature
    diagonal.diagonal(dim1=-2, dim2=-1)[:, :-1] += change.curvature
    gradient[:, 1:] += change.gradient
    gradient[:, :-1] -= change.gradient
    return HandSystem(
        cost=cost.sum(1) + change.cost.sum(1),
        diagonal=diagonal,
        coupling=-change.curvature,
        gradient=gradient,
    )


def _frames(
    model: HandModel, targets: HandTargets, config: HandConfig, state: HandState
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the cost [B], half the gradient [B, n] and half the Gauss-Newton Hessian [B, n, n] of single frames."""
    scale = config.length_scale
    frames = targets.annotated.shape[1]
    annotated = targets.annotated.flatten()
    bodies = model.bodies(*(value.flatten(0, 1) for value in vars(state).values()))
    cost, gradient, hessian = _keypoint_terms(model, targets, config, bodies)

    objects = Objects.at(
        targets.object_pos.flatten(0, 1),
        targets.object_quat.flatten(0, 1),
        targets.object_index.repeat_interleave(frames),
        targets.fields,
    )
    near = too_near(
        model,
        bodies,
        objects,
        annotated,
        config.object_clearance,
        config.self_depth,
    )
    value, slope = _by_frame(near, len(annotated))
    value = value / scale
    slope = slope / scale
    cost = cost + config.clearance_weight * value.square().sum(1)
    gradient = gradient + config.clearance_weight * matvec(slope.mT, value)
    hessian = hessian + config.clearance_weight * (slope.mT @ slope)

    if config.pad_weight and len(model.pad_balls):
        held = (targets.held & targets.annotated).flatten().nonzero()[:, 0]
        value, slope = pad_distances(model, bodies, objects, held)
        value = (value - config.object_clearance) / scale
        slope = slope / scale
        pads = terms.attraction(
            value,
            config.pad_weight * model.pad_shares,
            config.pad_reach / scale,
        )
        cost[held] += pads.cost
        gradient[held] += matvec(slope.mT, pads.gradient)
        hessian[held] += (slope.mT * pads.curvature[:, None]) @ slope
    return cost, gradient, hessian


def _keypoint_terms(
    model: HandModel, targets: HandTargets, config: HandConfig, bodies: Bodies
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the terms of the keypoints and of the bones between them; results as in :func:`_frames`."""
    scale = config.length_scale
    x, J = (values / scale for values in model.keypoints_of(bodies))
    human = targets.keypoints.flatten(0, 1) / scale
    touched = targets.contact_points.flatten(0, 1) / scale
    on = targets.annotated.flatten().to(x.dtype)[:, None]
    a, b = model.pairs.unbind(1)

    bones = x[:, b] - x[:, a]
    human_bones = human[:, b] - human[:, a]
    local = on.expand(-1, len(a)) * (config.local_weight / len(a))
    on_bones = terms.difference(bones, human_bones, local) + terms.direction(bones, human_bones, local)
    alignment = on * config.global_weight * torch.where(model.is_tip, config.tip_factor, 1.0).to(x.dtype)
    in_contact = on * config.contact_weight * targets.in_contact.flatten(0, 1)
    contact = terms.contact(
        x,
        touched,
        in_contact,
        config.contact_margin / scale,
        config.contact_knee / scale,
    )
    on_points = terms.difference(x, human, alignment) + contact

    moves = torch.cat((J[:, b] - J[:, a], J), dim=1)  # [B, C + P, 3, n]
    curvature = torch.cat((on_bones.curvature, on_points.curvature), dim=1)
    slope = torch.cat((on_bones.gradient, on_points.gradient), dim=1)
    rows = moves.flatten(1, 2)
    gradient = matvec(rows.mT, slope.flatten(1, 2))
    hessian = rows.mT @ (curvature @ moves).flatten(1, 2)
    return on_bones.cost + on_points.cost, gradient, hessian


def _by_frame(distances: Distances, frames: int) -> tuple[Tensor, Tensor]:
    """Return distances [B, W] and slopes [B, W, n] by frame, padded with zeros to the most that one frame has."""
    frame = distances.frame
    count = torch.bincount(frame, minlength=frames)
    slot = torch.arange(len(frame), device=frame.device) - (count.cumsum(0) - count)[frame]
    width = int(count.max()) if len(frame) else 0
    value = distances.value.new_zeros(frames, width)
    slope = value.new_zeros(frames, width, distances.slope.shape[-1])
    value[frame, slot] = distances.value
    slope[frame, slot] = distances.slope
    return value, slope
