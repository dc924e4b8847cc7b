"""The processes that train together, as ``torchrun`` starts them.

Each has worlds of its own. They average the gradients of every minibatch (rsl-rl's ``reduce_parameters``) and, after
every rollout, the moments of observations and returns and the demonstrations' rates of success. The first one writes
the run's files.
"""

from __future__ import annotations

import os

import torch

from xreset.files.checks import frozen

SEED_STRIDE = 7919
"""Difference between the seeds of two processes, so that each simulates other episodes."""


@frozen
class Processes:
    """This process among those that train together."""

    rank: int = 0
    local_rank: int = 0
    """Rank among the processes of this machine, and index of its GPU."""
    count: int = 1

    @classmethod
    def of_environment(cls) -> Processes:
        """Read what ``torchrun`` has put into the environment; without it there is one process."""
        return cls(
            rank=int(os.environ.get("RANK", 0)),
            local_rank=int(os.environ.get("LOCAL_RANK", 0)),
            count=int(os.environ.get("WORLD_SIZE", 1)),
        )

    @property
    def ranks(self) -> dict[str, int] | None:
        """Rank and count as rsl-rl's algorithms take them; None: there is one process."""
        return {"global_rank": self.rank, "world_size": self.count} if self.count > 1 else None

    @property
    def is_main(self) -> bool:
        """Whether this process writes the run's files."""
        return self.rank == 0

    def device(self, wanted: str) -> str:
        """Return the device of this process: with several processes, each has its own GPU."""
        if self.count > 1 and wanted.startswith("cuda"):
            return f"cuda:{self.local_rank}"
        return wanted

    def seed(self, seed: int) -> int:
        """Return the seed of this process."""
        return seed + SEED_STRIDE * self.rank

    def join(self, device: str) -> None:
        """Make the process group that averages models: NCCL for GPUs, Gloo for CPUs. One process needs none."""
        if self.count > 1 and not torch.distributed.is_initialized():
            kind = "nccl" if device.startswith("cuda") else "gloo"
            torch.distributed.init_process_group(kind)

    def sum(self, values: torch.Tensor) -> torch.Tensor:
        """Return the sum of a tensor over all processes."""
        if self.count > 1:
            values = values.clone()
            torch.distributed.all_reduce(values)
        return values

    def mean(self, values: torch.Tensor) -> torch.Tensor:
        """Return the mean of a tensor over all processes."""
        return self.sum(values) / self.count


def leave() -> None:
    """End the process group, if there is one."""
    if torch.distributed.is_initialized():
        torch.distributed.destroy_process_group()
