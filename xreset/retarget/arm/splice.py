"""One path made of pieces of several that were followed from different ends: where each fails, another may not.

Shape letters: S sequences, K paths, T frames, n joints, C chosen frames.
"""

from __future__ import annotations

import torch
from torch import Tensor


def splice(paths: Tensor, *, worth: Tensor, cost: Tensor, annotated: Tensor, jump: float, switch_cost: float) -> Tensor:
    """The best path that follows one of the given ones in every frame, by dynamic programming over the frames.

        maximise sum_t worth[k_t, t] [not a jump at t] - cost[k_t, t] - switch_cost [k_t != k_{t-1}]

    A jump is a joint's change by more than ``jump`` since an annotated frame before.

    Args:
        paths: [S, K, T, n] joints.
        worth: [S, K, T] of a frame of a path, if the joints do not jump there.
        cost: [S, K, T] of a frame of a path, jump or not.
        annotated: [S, T] bool.
        jump: [rad or m].
        switch_cost: of changing from one path to another.

    Returns:
        [S, T, n] joints.
    """
    sequences, number, frames, _ = paths.shape
    switch = switch_cost * (1.0 - torch.eye(number, dtype=paths.dtype))
    value = worth[:, :, 0] - cost[:, :, 0]
    came_from: list[Tensor] = []
    for t in range(1, frames):
        change = (paths[:, None, :, t] - paths[:, :, None, t - 1]).abs().amax(-1)  # [S, K before, K now]
        jumps = (change > jump) & annotated[:, t - 1, None, None]
        total = value[:, :, None] - switch + worth[:, None, :, t] * (~jumps).to(paths.dtype)
        best, before = total.max(dim=1)
        value = best - cost[:, :, t]
        came_from.append(before)
    rows = torch.arange(sequences)
    chosen = [value.argmax(dim=1)]
    for before in reversed(came_from):
        chosen.append(before[rows, chosen[-1]])
    return paths[rows[:, None], torch.stack(chosen[::-1], dim=1), torch.arange(frames)]


def spread_over(flags: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """At most ``count`` of the set frames of each row of ``flags`` [S, T], evenly spread over them: rows [C], ascending, and frames [C]."""
    rows: list[Tensor] = []
    frames: list[Tensor] = []
    for row, flagged in enumerate(flags):
        places = flagged.nonzero()[:, 0]
        number = min(count, len(places))
        frames.append(places[((torch.arange(number) + 0.5) * len(places) / max(number, 1)).long()])
        rows.append(torch.full((number,), row))
    return torch.cat(rows), torch.cat(frames)
