"""The cost of one frame of hand retargeting, term by term (the paper, appendix D.b).

Every term is a function of points: of the robot's keypoints, or of the vectors between them. It returns its cost, half its gradient and
half its Gauss-Newton Hessian by each point; the chain rule through the hand's kinematics comes after (``cost``). Lengths are divided by a
length scale, so that they compare with the radians of the other terms.

Shape letters: B frames, K points.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

_TINY = 1e-9


class Term(NamedTuple):
    """A cost and how it changes with its points."""

    cost: Tensor
    """[B]"""
    gradient: Tensor
    """[B, K, 3] half the gradient."""
    curvature: Tensor
    """[B, K, 3, 3] half the Gauss-Newton Hessian: symmetric, not negative."""

    def __add__(self, other: Term) -> Term:  # type: ignore[override]
        """The sum of two terms of the same points."""
        return Term(self.cost + other.cost, self.gradient + other.gradient, self.curvature + other.curvature)


def difference(x: Tensor, target: Tensor, weight: Tensor) -> Term:
    """E = w |x - h|^2 for every point: positions against positions, or vectors between keypoints against those of the human hand.

    Args:
        x: [B, K, 3] the robot's, in units of the length scale.
        target: [B, K, 3] the human's, h, in the same units.
        weight: [B, K] w.
    """
    off, w = x - target, weight[..., None]
    identity = torch.eye(3, dtype=x.dtype, device=x.device)
    return Term((weight * off.square().sum(-1)).sum(-1), w * off, w[..., None] * identity)


def direction(x: Tensor, target: Tensor, weight: Tensor) -> Term:
    """E = w |u - v|^2 with u = x / |x| and v = h / |h|: twice w (1 - cosine) of the angle between two vectors.

    du = (I - u u^T) dx / |x|. Arguments as in :func:`difference`.
    """
    length = x.norm(dim=-1, keepdim=True).clamp_min(_TINY)
    u, v = x / length, target / target.norm(dim=-1, keepdim=True).clamp_min(_TINY)
    w = weight[..., None]
    across = torch.eye(3, dtype=x.dtype, device=x.device) - u[..., :, None] * u[..., None, :]
    gradient = w / length * (u * (u * v).sum(-1, keepdim=True) - v)
    return Term((weight * (u - v).square().sum(-1)).sum(-1), gradient, (w / length.square())[..., None] * across)


def contact(x: Tensor, contact_point: Tensor, weight: Tensor, margin: float, knee: float) -> Term:
    """The paper's contact term, E = w [|c - x| - margin]_+, with its corner rounded, as iteratively reweighted least squares.

    With e = [|c - x| - margin]_+ the cost is Huber's: w e^2 / (2 knee) below the knee, w (e - knee / 2) above. Its curvature is that of
    s^2 e^2 with s^2 = w / (2 max(e, knee)) held constant, because above the knee the L1 cost has no second derivative.

    Args:
        x: [B, K, 3] robot contact points.
        contact_point: [B, K, 3] object contact points c; anything finite where the weight is 0.
        weight: [B, K] w, 0 where a keypoint is not in contact.
        margin: distance that costs nothing, in units of the length scale.
        knee: excess below which the cost is quadratic.
    """
    gap = x - contact_point
    distance = gap.norm(dim=-1).clamp_min(_TINY)
    excess = (distance - margin).clamp_min(0.0)
    cost = weight * torch.where(excess < knee, excess**2 / (2.0 * knee), excess - knee / 2.0)
    pull = weight / (2.0 * excess.clamp_min(knee)) * (excess > 0)
    n = gap / distance[..., None]
    return Term(cost.sum(-1), (pull * excess)[..., None] * n, pull[..., None, None] * n[..., :, None] * n[..., None, :])


class Attraction(NamedTuple):
    """A cost of distances and how it changes with them."""

    cost: Tensor
    """[B]"""
    gradient: Tensor
    """[B, N] half the gradient."""
    curvature: Tensor
    """[B, N] half the Hessian's diagonal, as of a weighted least square."""


def attraction(distance: Tensor, weight: Tensor, reach: float) -> Attraction:
    """E = w c^2/3 [1 - (1 - (d/c)^2)^3], w c^2/3 beyond c: w d^2 near 0, and no pull from afar.

    Tukey's biweight (Beaton and Tukey, Technometrics 16, 1974), as iteratively reweighted least squares: its weight is w (1 - (d/c)^2)^2.

    Args:
        distance: [B, N] d.
        weight: [N] w.
        reach: c, in the units of the distances.
    """
    left = (1.0 - (distance / reach).square()).clamp_min(0.0)
    pull = weight * left.square()
    return Attraction((weight * reach**2 / 3.0 * (1.0 - left**3)).sum(-1), pull * distance, pull)


def change(d: Tensor, weight: Tensor, limit: Tensor, excess_weight: float) -> tuple[Tensor, Tensor, Tensor]:
    """Change of variables between neighbouring frames: E = w d^2 + W [|d| - limit]_+^2.

    The first part is the paper's smoothness; the second is a wall that the first, spread over a trajectory, is too soft to be.

    Args:
        d: [..., n] changes.
        weight: [n] w.
        limit: [n] largest change without further cost; infinite where there is none.
        excess_weight: W.

    Returns:
        [...] cost, [..., n] half the gradient, [..., n] half the Gauss-Newton Hessian's diagonal.
    """
    excess = (d.abs() - limit).clamp_min(0.0)
    cost = (weight * d.square() + excess_weight * excess.square()).sum(-1)
    return cost, weight * d + excess_weight * excess * d.sign(), weight + excess_weight * (excess > 0)
