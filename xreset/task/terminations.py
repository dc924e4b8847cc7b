"""When an episode ends, as pure functions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from xreset.spec import TableSpec

if TYPE_CHECKING:
    from torch import Tensor

# The paper names this termination, not its bounds.
OBJECT_LOW = -0.05
"""The object is out of bounds when its origin is below this height [m]: it has left the table."""
OBJECT_HIGH = 1.0
"""The object is out of bounds when its origin is above this height [m]."""
MARGIN = 0.10
"""The object is out of bounds when its origin is farther than this outside the table's edges [m]."""


def out_of_bounds(object_pos: Tensor | np.ndarray, table: TableSpec) -> Any:
    """[N] bool, of the same library: the object has left the scene (the box above the table, with a margin).

    Args:
        object_pos: [N, 3] origin of the object, world frame [m].
        table: the table of the scene.
    """
    x, y, z = (object_pos[..., i] for i in range(3))
    is_far = abs(x - table.center[0]) > table.half_size[0] + MARGIN
    is_far |= abs(y - table.center[1]) > table.half_size[1] + MARGIN
    return is_far | (z < OBJECT_LOW) | (z > OBJECT_HIGH)
