"""Console and progress bars of the commands. Text comes from files, so square brackets are shown and not read as
markup.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from time import perf_counter
from typing import Any

import rich.console
import rich.progress
from rich.text import Text

_LOG_SECONDS = 20.0


class Console(rich.console.Console):
    """A console without markup, which leaves the breaking of lines to the terminal; a file or a pipe gets tables of 160
    columns.
    """

    def __init__(self, **options: Any) -> None:
        known = sys.stdout.isatty() or os.environ.get("COLUMNS")
        options.setdefault("width", None if known else 160)
        super().__init__(markup=False, emoji=False, highlight=False, **options)

    def print(self, *objects: Any, **options: Any) -> None:
        """See :meth:`rich.console.Console.print`."""
        if all(isinstance(value, str | Text) for value in objects):
            options.setdefault("soft_wrap", True)
        super().print(*objects, **options)


console = Console()
"""Where commands print."""


class Progress(rich.progress.Progress):
    """Progress bars, which vanish at the end. A log, which cannot show a bar, gets a line every 20 seconds."""

    def __init__(self, where: Console = console) -> None:
        super().__init__(
            rich.progress.TextColumn("{task.description}", style="progress.description", markup=False),
            rich.progress.BarColumn(),
            rich.progress.TaskProgressColumn(),
            rich.progress.TimeRemainingColumn(),
            console=where,
            transient=True,
        )
        self._said = perf_counter()

    def update(self, task_id: rich.progress.TaskID, **changes: Any) -> None:
        """See :meth:`rich.progress.Progress.update`."""
        super().update(task_id, **changes)
        if not self.console.is_terminal and (now := perf_counter()) - self._said > _LOG_SECONDS:
            self._said = now
            task = self._tasks[task_id]
            self.console.print(f"{task.description}: {task.percentage:.0f} %")

    def count(self, what: str) -> Callable[[float, float], None]:
        """Add a bar; returns the function that moves it: (done, in all)."""
        task = self.add_task(what, total=None)
        return lambda done, total: self.update(task, completed=done, total=total)
