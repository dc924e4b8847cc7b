"""What a training shows while it runs: a line of progress, learning curves, and the lift clock."""

from __future__ import annotations

import time
from collections import deque
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from torch import Tensor

from xreset.learning.clock import LiftClock
from xreset.learning.curves import CurveFile

RECENT = 20
"""Iterations over which returns and lengths of episodes are averaged."""
_LINE_SECONDS = 10.0
"""Least time between two lines where the output is not a terminal [s]."""


class TrainingLog:
    """Sums on the device during an iteration, so that nothing waits for a GPU; one line and one set of curves after
    it."""

    def __init__(self, folder: Path, num_envs: int, device: str, total: int, wandb: str | None = None) -> None:
        """Start a log in a run folder; ``total`` is the number of iterations in all. See :class:`CurveFile` for
        ``wandb``."""
        self.clock = LiftClock(folder)
        self._curves = CurveFile(folder, wandb)
        self._returns = torch.zeros(num_envs, device=device)
        self._lengths = torch.zeros(num_envs, device=device)
        self._finished = torch.zeros(3, device=device)  # sum of returns, sum of lengths, number of episodes
        self._recent: deque[list[float]] = deque(maxlen=RECENT)
        self._names: tuple[str, ...] = ()
        self._sums: Tensor | float = 0.0
        self._steps = 0
        self._total = total
        self._last_line = 0.0
        self._console = Console()
        self._progress = Progress(
            TextColumn("iteration"),
            MofNCompleteColumn(),
            BarColumn(bar_width=20),
            TextColumn("{task.fields[text]}"),
            TimeRemainingColumn(),
            console=self._console,
            disable=not self._console.is_terminal,
        )
        self._progress.start()
        self._task = self._progress.add_task("training", total=total, text="")

    def add(self, reward: Tensor, done: Tensor, log: dict[str, Tensor]) -> None:
        """Take one control step into account: reward [N], done [N] and the step's numbers."""
        ended = done.float()
        self._returns += reward
        self._lengths += 1
        self._finished += torch.stack(((self._returns * ended).sum(), (self._lengths * ended).sum(), ended.sum()))
        self._returns *= 1 - ended
        self._lengths *= 1 - ended
        self._names = tuple(log)
        self._sums = self._sums + torch.stack(list(log.values()))
        self._steps += 1

    def state(self) -> dict[str, Any]:
        """Return the running means, for :meth:`restore`."""
        return {"returns": self._returns, "lengths": self._lengths, "recent": list(self._recent)}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue with the running means of a checkpoint of the same number of worlds."""
        self._returns = state["returns"].clone()
        self._lengths = state["lengths"].clone()
        self._recent.extend(state["recent"])

    def write(self, iteration: int, env_steps: int, elapsed: float, scalars: dict[str, float]) -> None:
        """Write an iteration's curves and line, and start the sums of the next one.

        Args:
            iteration: number of iterations done.
            env_steps: control steps of all worlds until now.
            elapsed: time of training until now [s].
            scalars: the iteration's further curves, by tag; with ``speed/env_steps_per_second``.
        """
        assert isinstance(self._sums, Tensor), "an iteration has at least one step"
        means = dict(zip(self._names, (self._sums / self._steps).tolist(), strict=True))
        self._recent.append(self._finished.tolist())
        returns, lengths, episodes = (sum(column) for column in zip(*self._recent, strict=True))
        curves = means | scalars
        if episodes:
            curves |= {"episode/return": returns / episodes, "episode/length": lengths / episodes}
        self._curves.write(iteration, curves)
        from_home = means["task/success_from_home"]
        self.clock.tick(from_home, iteration=iteration, env_steps=env_steps, seconds=elapsed)
        speed = scalars["speed/env_steps_per_second"]
        text = (
            f"return {returns / max(episodes, 1):7.3f}  grasped {means['task/grasped']:5.1%}  "
            f"success {means['task/success']:5.1%}, from home {from_home:5.1%}  {speed:,.0f} steps/s"
        )
        self._progress.update(self._task, completed=iteration, text=text)
        is_due = time.monotonic() - self._last_line > _LINE_SECONDS or iteration == self._total
        if is_due and not self._console.is_terminal:
            self._last_line = time.monotonic()
            print(f"iteration {iteration}/{self._total}  {text}", flush=True)
        self._finished.zero_()
        self._sums = 0.0
        self._steps = 0

    def close(self, *, stopped: bool) -> None:
        """End the files; ``stopped`` says whether the training ended before its last iteration."""
        self._progress.stop()
        self._curves.close()
        self.clock.write()
        if stopped:
            self._console.print("stopped after the current iteration; a checkpoint is written.")
