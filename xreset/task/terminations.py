"""When an episode ends, as pure functions."""

from __future__ import annotations

from torch import Tensor

from xreset.spec import TableSpec
from xreset.task.config import TerminationConfig


def out_of_bounds(object_pos: Tensor, table: TableSpec, c: TerminationConfig) -> Tensor:
    """[N] bool: the object has left the manipulation scene (the box above the table, with a margin).

    Args:
        object_pos: [N, 3] origin of the object, world frame.
    """
    offset = [
        (object_pos[:, k] - table.center[k]).abs() > table.half_size[k] + c.margin for k in range(2)
    ]
    beside = offset[0] | offset[1]
    return beside | (object_pos[:, 2] < c.object_low) | (object_pos[:, 2] > c.object_high)
