"""Learning curves for TensorBoard, and for Weights & Biases if asked for.

They are written in this thread, so that a full disk becomes an error of the training. TensorBoard's own writer works in
a thread that prints a traceback.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from xreset.errors import XResetError, needs
from xreset.files import read_json


class CurveFile:
    """An event file of a training; each start of a training writes its own."""

    def __init__(self, folder: Path, wandb: str | None = None) -> None:
        """Start the file.

        Args:
            folder: run folder.
            wandb: project of Weights & Biases to which the curves and ``run.json`` are sent; None: nothing is sent.

        Raises:
            XResetError: the file cannot be written, or the package wandb is missing.
        """
        from tensorboard.compat.proto.event_pb2 import Event  # pyright: ignore[reportMissingImports]
        from tensorboard.summary.writer.record_writer import RecordWriter

        self._folder = folder
        self._event = Event
        name = f"events.out.tfevents.{time.time_ns()}.{socket.gethostname()}.{os.getpid()}"
        with self._writing():
            folder.mkdir(parents=True, exist_ok=True)
            self._records = RecordWriter(open(folder / name, "xb"))  # noqa: SIM115
        self._add(Event(wall_time=time.time(), file_version="brain.Event:2"))
        self._online = None
        if wandb is not None:
            with needs("wandb, which sends learning curves,", "wandb"):
                from wandb import init  # pyright: ignore[reportMissingImports]
            self._online = init(
                project=wandb, name=folder.name, dir=str(folder), config=read_json(folder / "run.json"), reinit=True
            )

    def write(self, step: int, scalars: Mapping[str, float]) -> None:
        """Add values by tag.

        Raises:
            XResetError: the file cannot be written.
        """
        event = self._event(wall_time=time.time(), step=step)
        for tag, value in scalars.items():
            event.summary.value.add(tag=tag, simple_value=value)
        self._add(event)
        if self._online is not None:
            self._online.log(dict(scalars), step=step)

    def close(self) -> None:
        """End the file."""
        self._records.close()
        if self._online is not None:
            self._online.finish()

    def _add(self, event) -> None:
        with self._writing():
            self._records.write(event.SerializeToString())
            self._records.flush()

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise XResetError(
                f"cannot write the learning curves in {self._folder}: {error.strerror or error}. Free some space, then "
                f"continue from the last checkpoint: xreset train --out {self._folder} --resume"
            ) from error
