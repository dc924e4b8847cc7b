"""Sequences of torch operations, replayed as CUDA graphs: hundreds of small kernels for the price of one launch."""

from __future__ import annotations

from collections.abc import Callable

import torch


class GraphRunner:
    """Calls functions that read and write fixed tensors; on a GPU each is captured once and replayed from then on.

    Such a function takes no arguments, keeps every tensor that lives on between calls where it is (writes in place), never waits for the
    GPU, and queues the same operations every time. On a CPU it is simply called.
    """

    WARM_UP = 2
    """Plain calls before a function is captured: libraries allocate and choose kernels at first."""

    def __init__(self, device: torch.device, generator: torch.Generator) -> None:
        """Prepare for a device; the functions may draw from ``generator``, which moves on at every replay."""
        self.active = device.type == "cuda"
        self._generator = generator
        self._calls: dict[str, int] = {}
        self._graphs: dict[str, torch.cuda.CUDAGraph] = {}

    def run(self, function: Callable[[], object]) -> None:
        """Call ``function`` (a bound method; known by its name), or replay it."""
        if not self.active:
            function()
            return
        name = function.__name__  # pyright: ignore[reportFunctionMemberAccess]
        if name not in self._graphs:
            self._calls[name] = self._calls.get(name, 0) + 1
            if self._calls[name] <= self.WARM_UP:
                function()
                return
            graph = torch.cuda.CUDAGraph()
            graph.register_generator_state(self._generator)
            with torch.cuda.graph(graph):
                function()
            self._graphs[name] = graph
        self._graphs[name].replay()
