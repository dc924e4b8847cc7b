"""What a training shows while it runs: a line of progress, learning curves, and the lift clock."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from xreset.errors import XResetError, needs
from xreset.files.storage import read_json
from xreset.learning.clock import Lift, read_lift, write_lift

RECENT = 20
"""Iterations over which returns and lengths of episodes are averaged."""
_LINE_SECONDS = 10.0
"""Least time between two lines [s]."""


def wandb_init() -> Any:
    """Return the function that starts a run of Weights & Biases; ``XResetError`` if the package is missing."""
    with needs("wandb, which sends learning curves,", "wandb"):
        from wandb import init  # pyright: ignore[reportMissingImports]
    return init


class TrainingLog:
    """Sums the numbers of an iteration on the device, so that nothing waits for a GPU. Then it writes a line and the
    curves."""

    def __init__(
        self,
        folder: Path,
        num_envs: int,
        device: str,
        total: int | None,
        wandb: str | None = None,
        *,
        minutes: float | None = None,
        done: int = 0,
    ) -> None:
        """Start the log of a run.

        Args:
            folder: run folder.
            num_envs: number of worlds.
            device: where rewards are.
            total: number of iterations in all; None: any number.
            minutes: time of the training in all; None: any time.
            done: number of iterations that have been done. What was logged after them is forgotten.
            wandb: project of Weights & Biases to which the curves and ``run.json`` are sent; None: nothing is sent.

        Raises:
            XResetError: the package wandb is missing.
        """
        self._online = None
        if wandb is not None:
            self._online = wandb_init()(
                project=wandb,
                name=os.environ.get("WANDB_NAME", folder.name),
                dir=str(folder),
                config=read_json(folder / "run.json"),
            )
        self._folder = folder
        self.lift = read_lift(folder).up_to(done) if done else Lift()
        """The last iteration's success from home is 0 as long as a teacher acts in some worlds."""
        with self._written():
            self._curves = _EventFile(folder)
        self._returns = torch.zeros(num_envs, device=device)
        self._lengths = torch.zeros(num_envs, device=device)
        # after a break, the first episode of each world is cut short, and its return would be a dent in the curve
        self._counts = torch.full((num_envs,), float(done == 0), device=device)
        # sum of returns, sum of lengths, number of episodes
        self._finished = torch.zeros(3, device=device)
        self._recent: deque[list[float]] = deque(maxlen=RECENT)
        self._names: tuple[str, ...] = ()
        self._steps: list[Tensor] = []
        self._of_total = "" if total is None else f"/{total}"
        self._of_minutes = "" if minutes is None else f"/{minutes:g}"
        self._line = ""
        """What the newest iteration would print; empty: it is printed."""
        self._last_line = 0.0

    def add(self, reward: Tensor, done: Tensor, log: dict[str, Tensor]) -> None:
        """Take one control step into account: reward [N], done [N] and the step's numbers."""
        ended = done.float()
        self._returns += reward
        self._lengths += 1
        counted = ended * self._counts
        self._finished += torch.stack(
            ((self._returns * counted).sum(), (self._lengths * counted).sum(), counted.sum())
        )
        self._counts = torch.maximum(self._counts, ended)
        self._returns *= 1 - ended
        self._lengths *= 1 - ended
        self._names = tuple(log)
        self._steps.append(torch.stack(list(log.values())))

    def write(
        self, iteration: int, env_steps: int, elapsed: float, scalars: dict[str, float]
    ) -> None:
        """Write an iteration's curves and line, and start the sums of the next one.

        Args:
            iteration: number of iterations done.
            env_steps: control steps of all worlds until now.
            elapsed: time of training until now [s].
            scalars: the iteration's further curves, by tag; with ``speed/env_steps_per_second``, and in a distillation
                with ``policy/teacher_share``.
        """
        total = sum(self._steps, torch.zeros_like(self._steps[0]))
        means = dict(zip(self._names, (total / len(self._steps)).tolist(), strict=True))
        self._recent.append(self._finished.tolist())
        returns, lengths, episodes = (sum(column) for column in zip(*self._recent, strict=True))
        curves = means | scalars
        if episodes:
            curves |= {"episode/return": returns / episodes, "episode/length": lengths / episodes}
        with self._written():
            self._curves.add(iteration, curves)
        if self._online is not None:
            self._online.log(curves, step=iteration)
        from_home = means["task/success_from_home"]
        before = self.lift
        # while a teacher acts in some worlds, their success is not the student's
        own = 0.0 if scalars.get("policy/teacher_share") else from_home
        self.lift = before.after(own, iteration=iteration, env_steps=env_steps, seconds=elapsed)
        if self.lift.passed != before.passed:
            self.write_lift()
        self._line = (
            f"iteration {iteration}{self._of_total}, {elapsed / 60:.1f}{self._of_minutes} min  "
            f"return {returns / max(episodes, 1):7.3f}  "
            f"grasped {means['task/grasped']:5.1%}  success {means['task/success']:5.1%}, "
            f"from home {from_home:5.1%}  {scalars['speed/env_steps_per_second']:,.0f} steps/s"
        )
        if time.monotonic() - self._last_line > _LINE_SECONDS:
            self._print_line()
        self._finished.zero_()
        self._steps.clear()

    def _print_line(self) -> None:
        if self._line:
            print(self._line, flush=True)
        self._line = ""
        self._last_line = time.monotonic()

    def write_lift(self) -> None:
        """Write the lift clock."""
        write_lift(self._folder, self.lift)

    def close(self) -> None:
        """Print the last line, and end the files."""
        self._print_line()
        with self._written():
            self._curves.close()
        if self._online is not None:
            self._online.finish()
        if self.lift.iteration:  # else there is nothing new
            self.write_lift()

    @contextmanager
    def _written(self) -> Iterator[None]:
        """Say which files cannot be written, and what to do."""
        try:
            yield
        except OSError as error:
            raise XResetError(
                f"cannot write the learning curves into {self._folder}: {error.strerror or error}. The newest"
                " checkpoint is as it was. Free some space, and give the same command again."
            ) from error


class _EventFile:
    """A file of curves for TensorBoard. Each iteration is on disk at once, and an error is raised where it happens:
    torch's own writer has a thread, which prints a traceback of its own."""

    def __init__(self, folder: Path) -> None:
        from tensorboard.compat.proto.event_pb2 import Event  # pyright: ignore[reportMissingImports]
        from tensorboard.summary.writer.record_writer import RecordWriter

        folder.mkdir(parents=True, exist_ok=True)
        self._event = Event
        self._file = RecordWriter((folder / f"events.out.tfevents.{time.time_ns()}").open("xb"))
        self._write(Event(wall_time=time.time(), file_version="brain.Event:2"))

    def add(self, iteration: int, curves: dict[str, float]) -> None:
        """Write the values of an iteration: tag -> value."""
        event = self._event(wall_time=time.time(), step=iteration)
        for tag, value in curves.items():
            event.summary.value.add(tag=tag, simple_value=value)
        self._write(event)

    def _write(self, event: Any) -> None:
        self._file.write(event.SerializeToString())
        self._file.flush()

    def close(self) -> None:
        """End the file."""
        self._file.close()
