"""The cost of one frame of hand retargeting, term by term (the paper, appendix D.b).

Every term is a function of points: of the robot's keypoints, or of the vectors between them. It returns its cost [B],
half its gradient [B, K, 3] and half its Gauss-Newton Hessian [B, K, 3, 3] by each point. The chain rule through the
hand's kinematics comes after (``cost``). Lengths are divided by a length scale, so they are comparable to the radians
of other terms.

Shape letters: B frames, K points.
"""

from __future__ import annotations

import torch
from torch import Tensor

from xreset.retarget.least_squares import Quadratic

_TINY = 1e-9


def difference(x: Tensor, target: Tensor, weight: Tensor) -> Quadratic:
    """E = w |x - h|^2 for every point: positions, or vectors between keypoints, against those of the human hand.

    Args:
        x: [B, K, 3] points of the robot, in units of the length scale.
        target: [B, K, 3] points h of the human, in the same units.
        weight: [B, K] w.
    """
    off = x - target
    w = weight[..., None]
    identity = torch.eye(3, dtype=x.dtype, device=x.device)
    return Quadratic((weight * off.square().sum(-1)).sum(-1), w * off, w[..., None] * identity)


def direction(x: Tensor, target: Tensor, weight: Tensor) -> Quadratic:
    """E = w |u - v|^2 with u = x / |x| and v = h / |h|: twice w (1 - cosine) of the angle between two vectors.

    du = (I - u u^T) dx / |x|. Arguments as in :func:`difference`.
    """
    length = x.norm(dim=-1, keepdim=True).clamp_min(_TINY)
    u = x / length
    v = target / target.norm(dim=-1, keepdim=True).clamp_min(_TINY)
    w = weight[..., None]
    across = torch.eye(3, dtype=x.dtype, device=x.device) - u[..., :, None] * u[..., None, :]
    gradient = w / length * (u * (u * v).sum(-1, keepdim=True) - v)
    return Quadratic(
        (weight * (u - v).square().sum(-1)).sum(-1),
        gradient,
        (w / length.square())[..., None] * across,
    )


def contact(
    x: Tensor, contact_point: Tensor, weight: Tensor, margin: float, knee: float
) -> Quadratic:
    """The paper's contact term, E = w [|c - x| - margin]_+, with its corner rounded, as iteratively reweighted least
    squares.

    With e = [|c - x| - margin]_+ the cost is Huber's: w e^2 / (2 knee) below the knee, w (e - knee / 2) above. Its
    curvature is that of s^2 e^2 with s^2 = w / (2 max(e, knee)) held constant, because above the knee the L1 cost has
    no second derivative.

    Args:
        x: [B, K, 3] contact points of the robot.
        contact_point: [B, K, 3] contact points c of the object; any finite values where the weight is 0.
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
    curvature = pull[..., None, None] * n[..., :, None] * n[..., None, :]
    return Quadratic(cost.sum(-1), (pull * excess)[..., None] * n, curvature)


def attraction(distance: Tensor, weight: Tensor, reach: float) -> Quadratic:
    """E = w c^2/3 [1 - (1 - (d/c)^2)^3], w c^2/3 beyond c: w d^2 near 0, and no pull from afar.

    Tukey's biweight (Beaton and Tukey, Technometrics 16, 1974), as iteratively reweighted least squares: its weight is
    w (1 - (d/c)^2)^2.

    Args:
        distance: [B, N] d.
        weight: [N] w.
        reach: c, in the units of the distances.

    Returns:
        Cost [B], half the gradient [B, N] and half the Hessian's diagonal [B, N].
    """
    left = (1.0 - (distance / reach).square()).clamp_min(0.0)
    pull = weight * left.square()
    cost = weight * reach**2 / 3.0 * (1.0 - left**3)
    return Quadratic(cost.sum(-1), pull * distance, pull)
