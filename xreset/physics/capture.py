"""Sequences of torch operations, replayed as CUDA graphs: hundreds of small kernels for the price of one launch."""

from __future__ import annotations

from collections.abc import Callable

import torch


class GraphRunner:
    """Calls functions that read and write fixed tensors; on a GPU each is captured once and replayed from then on.

    Such a function takes no arguments, keeps every tensor that lives on between calls where it is (writes in place),
    never waits for the GPU, and queues the same operations every time. On a CPU it is simply called.
    """

    WARM_UP = 2
    """Plain calls before a function is captured: libraries allocate and choose kernels at first."""

    def __init__(self, device: torch.device, generator: torch.Generator | None = None) -> None:
        """Prepare for a device; the functions may draw from ``generator`` and from torch's own, which move on at every
        replay."""
        self._device = device
        self.active = device.type == "cuda"
        self._generator = generator
        self._stream = torch.cuda.Stream(device) if self.active else None
        self._calls: dict[str, int] = {}
        self._graphs: dict[str, torch.cuda.CUDAGraph] = {}

    def run(self, function: Callable[[], object]) -> None:
        """Call ``function`` (a bound method; known by its name), or replay it."""
        if not self.active or self._stream is None:
            function()
            return
        name = function.__name__  # pyright: ignore[reportFunctionMemberAccess]
        if name not in self._graphs:
            self._calls[name] = self._calls.get(name, 0) + 1
            if self._calls[name] <= self.WARM_UP:
                # on the stream that will be captured, because autograd's nodes that outlive a call run
                # on the stream of their first call
                caller = torch.cuda.current_stream(self._device)
                self._stream.wait_stream(caller)
                with torch.cuda.stream(self._stream):
                    function()
                caller.wait_stream(self._stream)
                return
            graph = torch.cuda.CUDAGraph()
            if self._generator is not None:
                graph.register_generator_state(self._generator)
            # NCCL's watchdog asks for events in a thread of its own, which may not end a capture
            with torch.cuda.graph(graph, stream=self._stream, capture_error_mode="thread_local"):
                function()
            self._graphs[name] = graph
        self._graphs[name].replay()
