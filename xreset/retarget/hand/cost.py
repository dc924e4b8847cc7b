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
    quat_to_matrix,
)
from xreset.retarget.hand import terms
from xreset.retarget.hand.clearance import Distances, Objects, pad_distances, too_near
from xreset.retarget.hand.config import HandWeights
from xreset.retarget.hand.model import Bodies, HandModel, HandState, HandTargets
from xreset.retarget.least_squares import Quadratic, change_cost

_FRAMES_PER_CHUNK = {"cpu": 256, "cuda": 2048}
"""On a CPU, as many frames as fit its caches; on a GPU, enough frames to fill it."""


@dataclass(frozen=True)
class HandSystem(Quadratic):
    """Cost [S], half the gradient [S, T, n], and the diagonal blocks [S, T, n, n] of half the Gauss-Newton Hessian, a
    block-tridiagonal matrix."""

    coupling: Tensor
    """[S, T-1, n] diagonals of the blocks next to the diagonal."""


def system(
    model: HandModel, targets: HandTargets, config: HandWeights, state: HandState
) -> HandSystem:
    """Compute the cost of every sequence and its Gauss-Newton approximation."""
    sequences, frames, joints = state.joints.shape
    rows = torch.arange(sequences, device=state.joints.device)
    size = max(1, _FRAMES_PER_CHUNK[state.joints.device.type] // frames)
    chunks = [_frame_costs(model, targets[part], config, state[part]) for part in rows.split(size)]
    single = Quadratic.cat(chunks).map(lambda x: x.unflatten(0, (sequences, frames)))

    rotation_change = quat_to_axis_angle(
        quat_multiply(state.root_quat[:, 1:], quat_conjugate(state.root_quat[:, :-1]))
    )
    changes = torch.cat(
        (state.joints.diff(dim=1), state.root_pos.diff(dim=1), rotation_change), dim=-1
    )
    weight = changes.new_full((joints + 6,), config.smoothness_weight)
    weight[joints : joints + 3] /= config.length_scale**2
    limit = torch.full_like(weight, float("inf"))
    limit[:joints] = config.jump_limit
    inside = targets.inside
    apart = ~(inside[:, 1:] & inside[:, :-1])
    change = change_cost(changes, weight, limit, config.jump_weight)
    change = change.map(lambda x: x.masked_fill(apart.view(*apart.shape, *[1] * (x.dim() - 2)), 0))
    diagonal = single.curvature.diagonal(dim1=-2, dim2=-1)
    diagonal[~inside] = 1.0  # these frames do not move
    diagonal[:, 1:] += change.curvature
    diagonal[:, :-1] += change.curvature
    single.gradient[:, 1:] += change.gradient
    single.gradient[:, :-1] -= change.gradient
    return HandSystem(
        cost=single.cost.sum(1) + change.cost.sum(1),
        gradient=single.gradient,
        curvature=single.curvature,
        coupling=-change.curvature,
    )


def _frame_costs(
    model: HandModel, targets: HandTargets, config: HandWeights, state: HandState
) -> Quadratic:
    """Compute the cost [B] of single frames and its approximation."""
    scale = config.length_scale
    frames = targets.annotated.shape[1]
    annotated = targets.annotated.flatten()
    bodies = model.bodies(state.map(lambda x: x.flatten(0, 1)))
    found = _keypoint_terms(model, targets, config, bodies)

    objects = Objects(
        targets.object_pos.flatten(0, 1),
        quat_to_matrix(targets.object_quat.flatten(0, 1)),
        targets.object_index.repeat_interleave(frames),
        targets.fields,
    )
    near = too_near(model, bodies, objects, annotated, config.object_clearance, config.self_depth)
    value, slope = _by_frame(near, len(annotated))
    found = found + Quadratic.of_residuals(value / scale, slope / scale) * config.clearance_weight

    if config.pad_weight and len(model.pad_balls):
        held = targets.held.flatten().nonzero()[:, 0]
        value, slope = pad_distances(model, bodies, objects, held)
        value = (value - config.object_clearance) / scale
        slope = slope / scale
        weight = config.pad_weight * model.pad_shares
        pads = terms.attraction(value, weight, config.pad_reach / scale)
        found.cost[held] += pads.cost
        found.gradient[held] += matvec(slope.mT, pads.gradient)
        found.curvature[held] += (slope.mT * pads.curvature[:, None]) @ slope
    return found


def _keypoint_terms(
    model: HandModel, targets: HandTargets, config: HandWeights, bodies: Bodies
) -> Quadratic:
    """Compute the terms of the keypoints and of the bones between them."""
    scale = config.length_scale
    x = bodies.pos[:, model.keypoint_body] / scale
    J = bodies.moves(model.keypoint_body).div_(scale)  # [B, P, 3, m]
    human = targets.keypoints.flatten(0, 1) / scale
    touched = targets.contact_points.flatten(0, 1) / scale
    on = targets.annotated.flatten().to(x.dtype)[:, None]
    a, b = model.pairs.unbind(1)

    bones = x[:, b] - x[:, a]
    human_bones = human[:, b] - human[:, a]
    local = on.expand(-1, len(a)) * (config.local_weight / len(a))
    on_bones = terms.difference(bones, human_bones, local) + terms.direction(
        bones, human_bones, local
    )
    alignment = (
        on * config.global_weight * torch.where(model.is_tip, config.tip_factor, 1.0).to(x.dtype)
    )
    in_contact = on * config.contact_weight * targets.in_contact.flatten(0, 1)
    margin = config.contact_margin / scale
    contact = terms.contact(x, touched, in_contact, margin, config.contact_knee / scale)
    on_points = terms.difference(x, human, alignment) + contact

    # index_select copies large rows twice as fast as an index
    of_bones = J.index_select(1, b).sub_(J.index_select(1, a))
    moves = torch.cat((of_bones, J), dim=1)  # [B, C + P, 3, m]
    curvature = torch.cat((on_bones.curvature, on_points.curvature), dim=1)
    slope = torch.cat((on_bones.gradient, on_points.gradient), dim=1)
    rows = moves.flatten(1, 2)
    coupling = bodies.coupling
    return Quadratic(
        cost=on_bones.cost + on_points.cost,
        gradient=matvec(rows.mT, slope.flatten(1, 2)) @ coupling,
        curvature=coupling.mT @ (rows.mT @ (curvature @ moves).flatten(1, 2)) @ coupling,
    )


def _by_frame(distances: Distances, frames: int) -> tuple[Tensor, Tensor]:
    """Return distances [B, W] and slopes [B, W, n] by frame, padded with zeros to the most that one frame has."""
    count = torch.bincount(distances.frame, minlength=frames)
    taken = torch.arange(int(count.max()), device=count.device) < count[:, None]
    value = distances.value.new_zeros(taken.shape)
    slope = value.new_zeros(*taken.shape, distances.slope.shape[-1])
    value[taken] = distances.value
    slope[taken] = distances.slope
    return value, slope
