"""Warp next to torch: one stream for both, and no line for each kernel."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import torch
import warp as wp

from xreset.physics.plugins import silence


@contextmanager
def quiet() -> Iterator[None]:
    """Hold back the line that Warp prints for each of some hundred kernels, in this block only; and its warning that
    there is no GPU."""
    level = wp.config.log_level
    wp.config.log_level = wp.LOG_WARNING
    try:
        with nullcontext() if torch.cuda.is_available() else silence():
            wp.init()
        yield
    finally:
        wp.config.log_level = level


class TorchStream:
    """Makes Warp work on torch's current stream, so that the work of both is done in the order of the program."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._warp_device = wp.device_from_torch(device)
        self._streams: dict[int, Any] = {}

    @contextmanager
    def __call__(self) -> Iterator[None]:
        """Enter a block whose Warp work is queued on torch's current stream."""
        with wp.ScopedDevice(self._warp_device):
            if not self._warp_device.is_cuda:
                yield
                return
            stream = torch.cuda.current_stream(self._device)
            known = self._streams.get(stream.cuda_stream)
            if known is None:
                known = self._streams[stream.cuda_stream] = wp.stream_from_torch(stream)
            with wp.ScopedStream(known, sync_enter=False):
                yield
