"""Console and progress bars of the commands. Text comes from files, so square brackets are shown and not read as
markup.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from typing import Any

import rich.console
import rich.progress
from rich.text import Text


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
    """Progress bars, which vanish at the end."""

    def __init__(self, where: Console = console) -> None:
        super().__init__(
            rich.progress.TextColumn("{task.description}", style="progress.description", markup=False),
            rich.progress.BarColumn(),
            rich.progress.TaskProgressColumn(),
            rich.progress.TimeRemainingColumn(),
            console=where,
            transient=True,
        )

    def count(self, what: str) -> Callable[[float, float], None]:
        """Add a bar; returns the function that moves it: (done, in all)."""
        task = self.add_task(what, total=None)
        return lambda done, total: self.update(task, completed=done, total=total)
