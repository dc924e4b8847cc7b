"""When an episode ends, as pure functions."""

from __future__ import annotations

from torch import Tensor

from xreset.spec import TableSpec
from xreset.task.config import TerminationConfig


def out_of_bounds(object_pos: Tensor, table: TableSpec, c: TerminationConfig) -> Tensor:
    """[N] bool: the object has left the manipulation scene (the box above the table, with a margin).

    Args:
        object_pos: [N, 3] origin of the object, world frame [m].
        table: the table of the scene.
        c: the bounds.
    """
    x, y, z = object_pos.unbind(dim=-1)
    is_far = (x - table.center[0]).abs() > table.half_size[0] + c.margin
    is_far |= (y - table.center[1]).abs() > table.half_size[1] + c.margin
    return is_far | (z < c.object_low) | (z > c.object_high)
