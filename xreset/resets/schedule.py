"""Distribution of worlds over objects. A world always holds the same object."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from xreset.errors import XResetError
from xreset.files.checks import frozen
from xreset.files.text import quantity


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

    Each further world goes to the object with the most items per world, which keeps the longest queue shortest.

    Args:
        item_object: [I] object index of each item.
        max_worlds: largest number of worlds. If there are more objects, each may have two: with one for each, most
            worlds would wait for the object with the most items.
    """
    objects, counts = np.unique(item_object, return_counts=True)
    worlds = np.ones_like(counts)
    most = max_worlds if len(objects) <= max_worlds else 2 * len(objects)
    for _ in range(min(most, len(item_object)) - len(objects)):
        worlds[np.argmax(counts / worlds)] += 1
    num_rounds = np.max(-(-counts // worlds))  # rounded up
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


def shared_worlds(
    names: Sequence[str], num_envs: int, share: Mapping[str, float]
) -> np.ndarray | None:
    """Return the object [N] of each world; None: world i holds object i modulo their number.

    Worlds that remain after rounding down go to the largest remainders, so that each object's number of worlds is as
    near as possible to its share. :func:`schedule` shortens the longest queue instead; a training has no queues.

    Args:
        names: names of the objects.
        num_envs: N.
        share: ``task.reset.object_share``.

    Raises:
        XResetError: an unknown name, or an object gets no world.
    """
    if num_envs < len(names):
        raise XResetError(
            f"{quantity(num_envs, 'world')} cannot hold {len(names)} objects, so some would never be trained. "
            f"Take at least {len(names)} worlds (--num-envs), or fewer objects."
        )
    if not share:
        return None
    if unknown := sorted(set(share) - set(names)):
        raise XResetError(
            f"object_share names {', '.join(unknown)}, but the objects are {', '.join(names)}. Use these names."
        )
    wanted = np.array([share.get(name, 1.0) for name in names])
    exact = num_envs * wanted / wanted.sum()
    worlds = np.floor(exact).astype(int)
    by_remainder = np.argsort(worlds - exact, kind="stable")
    worlds[by_remainder[: num_envs - worlds.sum()]] += 1
    if not worlds.all():
        raise XResetError(
            f"With {quantity(num_envs, 'world')} and this object_share, {names[worlds.argmin()]} gets no world. "
            "Take more worlds (--num-envs)."
        )
    return np.repeat(np.arange(len(names)), worlds)
