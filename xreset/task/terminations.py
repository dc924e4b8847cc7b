"""When an episode ends, as pure functions."""

from __future__ import annotations

import torch
from torch import Tensor

from xreset.spec import TableSpec
from xreset.task.config import TerminationConfig


def out_of_bounds(object_pos: Tensor, table: TableSpec, c: TerminationConfig) -> Tensor:
    """[N] bool: the object has left the manipulation scene (the box above the table, with a margin).

    Args:
        object_pos: [N, 3] origin of the object, world frame.
    """
    center = torch.tensor(table.center, dtype=object_pos.dtype, device=object_pos.device)
    half = torch.tensor(table.half_size[:2], dtype=object_pos.dtype, device=object_pos.device) + c.margin
    beside = ((object_pos[:, :2] - center).abs() > half).any(dim=-1)
    return beside | (object_pos[:, 2] < c.object_low) | (object_pos[:, 2] > c.object_high)


def episode_steps(c: TerminationConfig, control_dt: float) -> int:
    """Control steps until the time limit."""
    return max(1, round(c.episode_seconds / control_dt))
