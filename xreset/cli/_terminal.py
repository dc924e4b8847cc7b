"""What the commands print with. Names come from files, so text is shown as it is: square brackets are no markup here."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from time import perf_counter
from typing import Any

import rich.console
import rich.progress

_LOG_SECONDS = 20.0


class Console(rich.console.Console):
    """A console without markup; style whole texts instead. A file or a pipe, which has no width of its own, gets 160 columns."""

    def __init__(self, **options: Any) -> None:
        known = sys.stdout.isatty() or os.environ.get("COLUMNS")
        options.setdefault("width", None if known else 160)
        super().__init__(markup=False, emoji=False, **options)


class Progress(rich.progress.Progress):
    """Bars whose descriptions are no markup; they vanish at the end. A log, where no bar can be drawn, gets a line every 20 seconds."""

    def __init__(self, console: rich.console.Console) -> None:
        super().__init__(
            rich.progress.TextColumn("{task.description}", style="progress.description", markup=False),
            rich.progress.BarColumn(),
            rich.progress.TaskProgressColumn(),
            rich.progress.TimeRemainingColumn(),
            console=console,
            transient=True,
        )
        self._said = perf_counter()

    def update(self, task_id: rich.progress.TaskID, **changes: Any) -> None:
        """See :meth:`rich.progress.Progress.update`."""
        super().update(task_id, **changes)
        if not self.console.is_terminal and (now := perf_counter()) - self._said > _LOG_SECONDS:
            self._said = now
            task = self._tasks[task_id]
            self.console.print(f"{task.description}: {task.percentage:.0f} %", highlight=False, soft_wrap=True)

    def count(self, what: str) -> Callable[[float, float], None]:
        """Add a bar; gives the function that moves it: (done, in all)."""
        task = self.add_task(what, total=None)
        return lambda done, total: self.update(task, completed=done, total=total)
