"""Shares work among worlds. A world always holds the same object, so it works through items of one object."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from xreset.checks import frozen


@frozen
class Schedule:
    """Which world processes which item in which round."""

    object_index: np.ndarray
    """[N] object of each world."""
    rounds: np.ndarray
    """[R, N] item of each world and round. A world without items left repeats its object's last item."""
    fresh: np.ndarray
    """[R, N] bool: False where an item is repeated."""

    def __iter__(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Iterate over the rounds: items [N], fresh [N]."""
        return iter(zip(self.rounds, self.fresh, strict=True))


def schedule(item_object: np.ndarray, max_worlds: int) -> Schedule:
    """Spread items over worlds in the fewest rounds.

    One world after the other goes to the object whose worlds have most to do, which keeps the longest queue shortest.
    :func:`xreset.env.shared_worlds` rounds shares to the nearest numbers instead, and cannot do this work: of 10 items
    of one object and 1 of another, it would give all of four worlds to the first.

    Args:
        item_object: [I] object index of each item.
        max_worlds: largest number of worlds; more are used if there are more objects.
    """
    objects, counts = np.unique(item_object, return_counts=True)
    worlds = np.ones_like(counts)
    for _ in range(min(max_worlds, len(item_object)) - len(objects)):
        worlds[np.argmax(counts / worlds)] += 1  # the object whose worlds have most to do
    num_rounds = np.max(-(-counts // worlds))
    columns = []
    fresh = []
    for number, count, width in zip(objects, counts, worlds, strict=True):
        queue = np.flatnonzero(item_object == number)
        position = np.arange(num_rounds * width).reshape(num_rounds, width)
        columns.append(queue[np.minimum(position, count - 1)])
        fresh.append(position < count)
    return Schedule(
        object_index=np.repeat(objects, worlds),
        rounds=np.concatenate(columns, axis=1),
        fresh=np.concatenate(fresh, axis=1),
    )
