"""Delays: the last values of each world, read back a number of steps later."""

from __future__ import annotations

import math

import torch
from torch import Tensor


class DelayLine:
    """The last values of N worlds, newest first.

    All work is done in fixed buffers, so that it can be captured in a graph.
    """

    def __init__(self, like: Tensor, longest: float, *, by_column: bool = False) -> None:
        """Allocate.

        Args:
            like: [N, D] the delayed quantity.
            longest: largest delay [steps].
            by_column: whether each of the D numbers has a delay of its own.
        """
        self.values = torch.zeros(
            like.shape[0], math.ceil(longest) + 1, like.shape[1], device=like.device
        )
        """[N, K, D]"""
        self.delay = torch.zeros_like(like if by_column else like[:, :1])
        """[N, 1] steps, or [N, D]."""

    def fill(self, fresh: Tensor, value: Tensor) -> None:
        """Make a value [N, D] the whole past of the worlds of a mask [N]."""
        self.values.copy_(torch.where(fresh[:, None, None], value[:, None], self.values))

    def push(self, value: Tensor, delay: Tensor | None = None) -> Tensor:
        """Add the newest value [N, D] and return the delayed one [N, D], interpolated between whole steps.

        Args:
            delay: delay in this step, like :attr:`delay`; None: this attribute.
        """
        self.values.copy_(torch.cat((value[:, None], self.values[:, :-1]), dim=1))
        delay = self.delay if delay is None else delay
        whole = delay.floor()
        at = whole.long()[:, None].expand(-1, 1, value.shape[1])
        newer = self.values.gather(1, at)[:, 0]
        older = self.values.gather(1, (at + 1).clamp_max(self.values.shape[1] - 1))[:, 0]
        return newer + (delay - whole) * (older - newer)
