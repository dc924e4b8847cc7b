"""The cost of one frame of hand retargeting, term by term (the paper, appendix D.b).

Each term takes the robot's keypoints and their Jacobian and returns residuals and the residuals' Jacobian; a frame's cost is the sum of
squared residuals. Lengths are divided by a length scale, so that they compare with the radians of the other terms.

Shape letters: B frames, P mapped keypoints, C pairs of them, n variables.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

_TINY = 1e-9


class Residual(NamedTuple):
    """Weighted residuals and their Jacobian."""

    value: Tensor
    """[B, R]"""
    jacobian: Tensor
    """[B, R, n]"""


def bone_lengths(x: Tensor, J: Tensor, target: Tensor, pairs: Tensor, weight: Tensor) -> Residual:
    """Difference of the vectors between keypoints: r = sqrt(w) ((x_b - x_a) - (h_b - h_a)), for every pair (a, b).

    Args:
        x: [B, P, 3] robot keypoints, in units of the length scale.
        J: [B, P, 3, n] their Jacobian.
        target: [B, P, 3] human keypoints h, in the same units.
        pairs: [C, 2] indices a, b.
        weight: [B, C] w.
    """
    a, b = pairs.unbind(1)
    value = (x[:, b] - x[:, a]) - (target[:, b] - target[:, a])
    return _weighted(value, J[:, b] - J[:, a], weight)


def bone_directions(x: Tensor, J: Tensor, target: Tensor, pairs: Tensor, weight: Tensor) -> Residual:
    """Difference of the directions between keypoints: r = sqrt(w) (u - v), u and v the unit vectors of x_b - x_a and h_b - h_a.

    |u - v|^2 = 2 (1 - cos of the angle between them). du = (I - u u^T) dx / |x_b - x_a|. Arguments as in :func:`bone_lengths`.
    """
    a, b = pairs.unbind(1)
    d, h = x[:, b] - x[:, a], target[:, b] - target[:, a]
    length = d.norm(dim=-1, keepdim=True).clamp_min(_TINY)
    u, v = d / length, h / h.norm(dim=-1, keepdim=True).clamp_min(_TINY)
    dJ = (J[:, b] - J[:, a]) / length[..., None]
    dJ = dJ - u[..., None] * (u[..., None, :] @ dJ)
    return _weighted(u - v, dJ, weight)


def global_alignment(x: Tensor, J: Tensor, target: Tensor, weight: Tensor) -> Residual:
    """Difference of the keypoints themselves: r = sqrt(w) (x - h). Arguments as in :func:`bone_lengths`; weight [B, P]."""
    return _weighted(x - target, J, weight)


def contact(x: Tensor, J: Tensor, contact_point: Tensor, weight: Tensor, margin: float, knee: float) -> Residual:
    """The paper's contact term, w [|c - x| - margin]_+, as iteratively reweighted least squares.

    The square of r = s e, with e = [|c - x| - margin]_+ and s^2 = w / (2 max(e, knee)) held constant, has the gradient of that cost where
    e > knee; below it is quadratic, because there the L1 cost has no second derivative.

    Args:
        x: [B, P, 3] robot contact points.
        J: [B, P, 3, n]
        contact_point: [B, P, 3] object contact points c; anything finite where the weight is 0.
        weight: [B, P] w, 0 where a keypoint is not in contact.
        margin: distance that costs nothing, in units of the length scale.
        knee: excess below which the cost is quadratic.
    """
    gap = x - contact_point
    distance = gap.norm(dim=-1).clamp_min(_TINY)
    excess = (distance - margin).clamp_min(0.0)
    scale = (weight / (2.0 * excess.clamp_min(knee))).sqrt() * (excess > 0)
    direction = gap / distance[..., None]
    return Residual(scale * excess, scale[..., None] * (direction[..., None, :] @ J)[..., 0, :])


def contact_cost(x: Tensor, contact_point: Tensor, weight: Tensor, margin: float, knee: float) -> Tensor:
    """[B] the cost whose gradient :func:`contact` has, as a sum over contacts of Huber's function.

    It is w e^2 / (2 knee) below the knee and w (e - knee / 2) above: the paper's L1 cost with its corner rounded.
    """
    excess = ((x - contact_point).norm(dim=-1) - margin).clamp_min(0.0)
    return (weight * torch.where(excess < knee, excess**2 / (2.0 * knee), excess - knee / 2.0)).sum(-1)


def clearance(distance: Tensor, J: Tensor, frame: Tensor, frames: int, weight: float, least: float) -> Residual:
    """What keeps bodies apart: r = sqrt(w) [least - d]_+ for every distance d, in units of the length scale.

    Args:
        distance: [A] signed distances.
        J: [A, n] their derivatives.
        frame: [A] the frame of each, ascending.
        frames: B.
        weight: w.
        least: distance from which on there is no cost.
    """
    value = weight**0.5 * (least - distance).clamp_min(0.0)
    count = torch.bincount(frame, minlength=frames)
    slot = torch.arange(len(frame)) - (count.cumsum(0) - count)[frame]  # place among the frame's own, so that rows stay dense and few
    width = int(count.max()) if len(frame) else 0
    values, rows = J.new_zeros(frames, width), J.new_zeros(frames, width, J.shape[-1])
    values[frame, slot] = value
    rows[frame, slot] = -(weight**0.5) * (distance < least).to(J.dtype)[:, None] * J
    return Residual(values, rows)


def _weighted(value: Tensor, J: Tensor, weight: Tensor) -> Residual:
    scale = weight.sqrt()[..., None]
    return Residual((scale * value).flatten(1), (scale[..., None] * J).flatten(1, 2))
