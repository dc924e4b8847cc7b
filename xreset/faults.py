"""Records worlds that broke: their state before, their actions and the result."""

from __future__ import annotations

from collections.abc import Mapping
from math import prod

import numpy as np
import torch
from torch import Tensor


class FaultRecorder:
    """Keeps the last :attr:`CAPACITY` faults on the device. Nothing waits for it, so a captured graph can record."""

    CAPACITY = 256

    def __init__(self, shapes: Mapping[str, tuple[int, ...]], device: torch.device) -> None:
        """Allocate room.

        Args:
            shapes: name -> shape of one world's values.
        """
        self._shapes = dict(shapes)
        width = sum(prod(shape) for shape in self._shapes.values())
        self._rows = torch.zeros(self.CAPACITY + 1, width, device=device)  # the last row takes what is not kept
        self._kept = torch.zeros((), dtype=torch.long, device=device)

    def record(self, faulty: Tensor, values: Mapping[str, Tensor]) -> None:
        """Keep the faulty worlds; the first ones, if there are more than the capacity.

        Args:
            faulty: [N] bool.
            values: name -> [N, ...] values of all worlds, kept as float32.
        """
        row = torch.cat([values[name].reshape(len(faulty), -1).to(self._rows.dtype) for name in self._shapes], dim=1)
        number = faulty.long().cumsum(0) - 1
        keep = faulty & (number < self.CAPACITY)
        self._rows.index_copy_(0, torch.where(keep, (self._kept + number) % self.CAPACITY, self.CAPACITY), row)
        self._kept += keep.sum()

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the values of the F faults that are kept, by name: [F, ...] float32, the oldest first."""
        kept = int(self._kept)
        order = np.arange(max(0, kept - self.CAPACITY), kept) % self.CAPACITY
        rows = self._rows.cpu().numpy()[order]
        ends = np.cumsum([prod(shape) for shape in self._shapes.values()])[:-1]
        parts = np.split(rows, ends, axis=1)
        return {name: part.reshape(-1, *shape) for (name, shape), part in zip(self._shapes.items(), parts, strict=True)}
