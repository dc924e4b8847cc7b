"""Linear systems of a chain in time: symmetric, block-tridiagonal, solved by block elimination over a batch of chains.

Shape letters: S chains (sequences), T blocks (frames), n unknowns per block.
"""

from __future__ import annotations

import torch
from torch import Tensor


def solve_chain(diagonal: Tensor, coupling: Tensor, rhs: Tensor) -> Tensor:
    """Solve H x = b, where H has ``diagonal`` blocks D_t and diagonal matrices C_t between blocks t and t + 1.

    Block elimination (the matrix form of Thomas' algorithm): with A_0 = D_0,

        A_t = D_t - C_{t-1} A_{t-1}^-1 C_{t-1},   y_t = b_t - C_{t-1} A_{t-1}^-1 y_{t-1},   x_t = A_t^-1 (y_t - C_t x_{t+1}).

    The cost is linear in T; every step is batched over S.

    Args:
        diagonal: [S, T, n, n] symmetric blocks; H must be positive definite.
        coupling: [S, T-1, n] diagonals of the blocks beside the diagonal.
        rhs: [S, T, n] right-hand side b.

    Returns:
        [S, T, n] the solution.

    Raises:
        torch.linalg.LinAlgError: H is not positive definite.
    """
    frames = diagonal.shape[1]
    inverses: list[Tensor] = []
    reduced: list[Tensor] = []
    block, y = diagonal[:, 0], rhs[:, 0]
    for t in range(frames):
        if t:
            link = coupling[:, t - 1]
            block = diagonal[:, t] - link[:, :, None] * inverses[-1] * link[:, None, :]
            y = rhs[:, t] - link * (inverses[-1] @ reduced[-1][..., None])[..., 0]
        inverses.append(torch.cholesky_inverse(torch.linalg.cholesky(block)))
        reduced.append(y)
    solution = [(inverses[-1] @ reduced[-1][..., None])[..., 0]]
    for t in range(frames - 2, -1, -1):
        y = reduced[t] - coupling[:, t] * solution[-1]
        solution.append((inverses[t] @ y[..., None])[..., 0])
    return torch.stack(solution[::-1], dim=1)
