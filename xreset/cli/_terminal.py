"""Console and progress bars of the commands. Square brackets are shown and not read as markup, because texts come from
files."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Sequence
from time import monotonic
from typing import Any

import rich.console
import rich.measure
import rich.progress
from rich.table import Table
from rich.text import Text


class Console(rich.console.Console):
    """A console without markup. The terminal breaks the lines; tables in a file or a pipe have 160 columns."""

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


_FIGURES = ("", *"-+.0123456789")
"""First characters of a cell with a number; an empty cell counts as one."""


class Progress(rich.progress.Progress):
    """Progress bars, which vanish at the end. Without a terminal, a line once a minute."""

    def __init__(self, where: Console = console) -> None:
        super().__init__(
            rich.progress.TextColumn(
                "{task.description}", style="progress.description", markup=False
            ),
            rich.progress.BarColumn(),
            rich.progress.TaskProgressColumn(),
            rich.progress.TimeRemainingColumn(),
            console=where,
            transient=True,
        )
        self._shown = monotonic()

    def update(self, task_id: rich.progress.TaskID, **changes: Any) -> None:
        """See :meth:`rich.progress.Progress.update`. After ``stop`` the bars are back."""
        self.start()
        super().update(task_id, **changes)
        now = monotonic()
        if not self.console.is_terminal and now > self._shown + 60:
            self._shown = now
            task = self._tasks[task_id]
            print(f"{task.description}: {task.percentage:.0f} %", file=sys.stderr)

    def stop(self) -> None:
        """Remove the bars, without the empty line of :meth:`rich.progress.Progress.stop` in a file."""
        self.live.stop()

    def count(self, what: str) -> Callable[[float, float], None]:
        """Add a bar, and return the function that moves it: (done, in all)."""
        task = self.add_task(what, total=None)
        return lambda done, total: self.update(task, completed=done, total=total)

    def stages(self) -> Callable[..., None]:
        """Add a bar for one stage after another, and return the function that moves it: (stage, done, in all)."""
        task = self.add_task("", total=None)

        def move(stage: str, done: float = 0, total: float | None = None) -> None:
            self.update(task, description=stage, completed=done, total=total or None)

        return move


def show_notes(notes: Iterable[str]) -> None:
    """Print what a user should know, a line for each note."""
    for note in notes:
        console.print(f"note: {note}", style="yellow")


def show_table(rows: Sequence[Sequence[str | Text]], **options: Any) -> None:
    """Print a table whose first row is its head. Columns of numbers are aligned to the right. In a terminal that is too
    narrow for it, each row is a list.

    Args:
        rows: texts of the cells.
        options: options of :class:`rich.table.Table`.
    """
    table = Table(**options)
    for number, name in enumerate(rows[0]):
        figures = number > 0 and all(str(row[number])[:1] in _FIGURES for row in rows[1:])
        table.add_column(name, justify="right" if figures else "left")
    for row in rows[1:]:
        table.add_row(*row)
    unlimited = console.options.update(max_width=10_000)
    if rich.measure.Measurement.get(console, unlimited, table).minimum <= console.width:
        console.print(table)
        return
    for row in rows[1:]:
        for name, cell in zip(rows[0], row, strict=True):
            console.print(f"{name}: {cell}" if name else str(cell))
        console.print()
    if options.get("caption"):
        console.print(str(options["caption"]))
