"""Delays of actions and observations."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from xreset.physics.tensors import where
from xreset.task.worlds import Sample, Worlds


class DelayLine:
    """The last values of N worlds, newest first, each read back after a delay that is drawn at a reset.

    All work is done in fixed buffers, so that it can be captured in a graph. A line without delay has no buffers.
    """

    def __init__(
        self,
        worlds: Worlds,
        name: str,
        width: int,
        longest: float,
        sample: Sample,
        *,
        by_column: bool = False,
    ) -> None:
        """Allocate.

        Args:
            worlds: state of the worlds; the line adds its buffers.
            name: prefix of the buffers' names.
            width: D, numbers of a value.
            longest: largest delay [steps].
            sample: draws the delays [steps].
            by_column: whether each of the D numbers has a delay of its own.
        """
        self.longest = longest
        if longest:
            steps = math.ceil(longest) + 1
            self.values = worlds.keep(f"{name}.values", worlds.zeros(steps, width))
            """[N, K, D]"""
            delays = worlds.zeros(width if by_column else 1)
            self.delay = worlds.keep(f"{name}.delay", delays, sample)
            """[N, 1] steps, or [N, D]."""

    def fill(self, fresh: Tensor, value: Tensor) -> None:
        """Make the value [N, D] the whole past of the worlds of a mask [N]."""
        if self.longest:
            self.values.copy_(where(fresh, value[:, None], self.values))

    def push(self, value: Tensor, delay: Tensor | None = None) -> Tensor:
        """Add the newest value and return the delayed one [N, D], interpolated between whole steps.

        Args:
            value: [N, D] the newest value.
            delay: [N, 1] or [N, D] delay in this step; None: :attr:`delay`.
        """
        if not self.longest:
            return value
        self.values.copy_(torch.cat((value[:, None], self.values[:, :-1]), dim=1))
        delay = self.delay if delay is None else delay
        whole = delay.floor()
        index = whole.long()[:, None].expand(-1, 1, value.shape[1])
        next_index = (index + 1).clamp_max(self.values.shape[1] - 1)
        newer = self.values.gather(1, index)[:, 0]
        older = self.values.gather(1, next_index)[:, 0]
        return newer + (delay - whole) * (older - newer)
