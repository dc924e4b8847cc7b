"""Levenberg-Marquardt with projected steps for a batch of independent problems, and block-tridiagonal linear systems.

Shape letters: B problems, R problems that are not done; S chains (sequences), T blocks (frames), n unknowns per block.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from typing import Any, Self

import torch
from torch import Tensor

from xreset.geometry.rotations import matvec
from xreset.physics.tensors import Tensors, where


@dataclass(frozen=True)
class Quadratic(Tensors):
    """Costs [B], and their Gauss-Newton approximation as a function of n variables."""

    cost: Tensor
    """[B]"""
    gradient: Tensor
    """[B, n] half the gradient."""
    curvature: Tensor
    """[B, n, n] half the Gauss-Newton Hessian: symmetric, positive semidefinite."""

    @staticmethod
    def of_residuals(residuals: Tensor, jacobian: Tensor) -> Quadratic:
        """Return the sum of the squares of residuals [B, R] with their derivatives [B, R, n]."""
        return Quadratic(
            residuals.square().sum(1), matvec(jacobian.mT, residuals), jacobian.mT @ jacobian
        )

    def __add__(self, other: Self) -> Self:
        """Return the sum of two costs of the same variables."""
        return self.map(torch.add, other)

    def __mul__(self, weight: float) -> Self:
        """Return the cost with a weight."""
        return self.map(lambda x: weight * x)


def change_cost(
    d: Tensor, weight: Tensor, limit: Tensor | float, excess_weight: float
) -> Quadratic:
    """Change of variables between neighboring frames: E = w d^2 + W [|d| - limit]_+^2.

    The first part is the paper's smoothness. The second is a wall against jumps, for which the first is too soft.

    Args:
        d: [..., n] changes.
        weight: [n] w.
        limit: [n], or one number: largest change without further cost; infinite where there is none.
        excess_weight: W.

    Returns:
        Cost [...], half the gradient [..., n] and half the Gauss-Newton Hessian's diagonal [..., n].
    """
    excess = (d.abs() - limit).clamp_min(0.0)
    cost = (weight * d.square() + excess_weight * excess.square()).sum(-1)
    gradient = weight * d + excess_weight * excess * d.sign()
    return Quadratic(cost, gradient, weight + excess_weight * (excess > 0))


def minimize(
    x: Any,
    evaluate: Callable[[Any, Tensor], Any],
    step: Callable[[Any, Any, Tensor], Any],
    done: Callable[[Any, Any, Tensor, Tensor, Tensor], Tensor],
    iterations: int,
    *,
    damping: float = 1e-3,
    damping_range: tuple[float, float] = (0.0, inf),
) -> Any:
    """Take damped Gauss-Newton steps. A problem keeps a step if it lowers the cost, and is left out when it is done.

    Args:
        x: first guess: a tensor, or a bundle of tensors (:class:`~xreset.physics.tensors.Tensors`), of B rows.
        evaluate: returns costs and their approximation, a bundle with ``cost`` [R], given x [R, ...] and the indices
            [R] of the problems.
        step: returns x after a damped step, given x, the approximation and the damping [R].
        done: returns whether problems are done [R], given x before and after the step, both costs [R], and the damping
            [R] of the next step.
        iterations: largest number of steps.
        damping: damping of the first step.
        damping_range: smallest and largest damping.

    Returns:
        The best x found.
    """
    first = x if isinstance(x, Tensor) else next(iter(vars(x).values()))
    rows = torch.arange(len(first), device=first.device)
    dampings = torch.full((len(rows),), damping, dtype=torch.float64, device=first.device)
    best = x.clone()
    now = x
    here = evaluate(x, rows)
    for _ in range(iterations):
        trial = step(now, here, dampings)
        there = evaluate(trial, rows)
        better = there.cost < here.cost
        dampings = torch.where(better, dampings * 0.2, dampings * 8.0).clamp(*damping_range)
        left = ~done(now, trial, here.cost, there.cost, dampings)
        now = where(better, trial, now)
        here = where(better, there, here)
        best[rows] = now
        if not left.any():
            break
        if not left.all():
            rows = rows[left]
            dampings = dampings[left]
            now = now[left]
            here = here[left]
    return best


def free_to_move(x: Tensor, gradient: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Return 1 for variables that may move, and 0 for variables at a bound that the cost pulls outwards (Bertsekas'
    projection)."""
    at_lower = (x <= lower) & (gradient > 0)
    at_upper = (x >= upper) & (gradient < 0)
    return (~(at_lower | at_upper)).to(gradient.dtype)


def damped(here: Quadratic, size: Tensor, damping: Tensor, free: Tensor) -> tuple[Tensor, Tensor]:
    """Return matrix [..., n, n] and right-hand side [..., n] of a Levenberg-Marquardt step.

    Args:
        here: the cost.
        size: [..., n] scale of each variable, by which its damping is multiplied.
        damping: [...] larger for shorter steps.
        free: [..., n] see :func:`free_to_move`. A variable that may not move gets a row of the identity.
    """
    ridge = damping[..., None] * size * free + (1.0 - free)
    matrix = here.curvature * free[..., :, None] * free[..., None, :] + torch.diag_embed(ridge)
    return matrix, -here.gradient * free


def solve_chain(diagonal: Tensor, coupling: Tensor, rhs: Tensor) -> Tensor:
    """Solve H x = b, where H has ``diagonal`` blocks D_t and diagonal matrices C_t between blocks t and t + 1.

    Block elimination (the matrix form of Thomas' algorithm): with A_0 = D_0,

        A_t = D_t - C_{t-1} A_{t-1}^-1 C_{t-1},   y_t = b_t - C_{t-1} A_{t-1}^-1 y_{t-1},   x_t = A_t^-1 (y_t - C_t
        x_{t+1}).

    The cost is linear in T; every step is batched over S.

    Args:
        diagonal: [S, T, n, n] symmetric blocks; H must be positive definite.
        coupling: [S, T-1, n] diagonals of the blocks next to the diagonal.
        rhs: [S, T, n] right-hand side b.

    Returns:
        [S, T, n] the solution.

    Raises:
        torch.linalg.LinAlgError: H is not positive definite.
    """
    inverses = []
    reduced = []
    for t in range(diagonal.shape[1]):
        block = diagonal[:, t]
        y = rhs[:, t]
        if t:
            link = coupling[:, t - 1]
            block = block - link[:, :, None] * inverses[-1] * link[:, None, :]
            y = y - link * matvec(inverses[-1], reduced[-1])
        inverses.append(torch.cholesky_inverse(torch.linalg.cholesky(block)))
        reduced.append(y)
    solution = [matvec(inverses[-1], reduced[-1])]
    for t in range(diagonal.shape[1] - 2, -1, -1):
        y = reduced[t] - coupling[:, t] * solution[-1]
        solution.append(matvec(inverses[t], y))
    return torch.stack(solution[::-1], dim=1)
