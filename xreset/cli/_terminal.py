"""What the commands print with. Names come from files, so text is shown as it is: square brackets are no markup here."""

from __future__ import annotations

import os
import sys
from typing import Any

import rich.console
import rich.progress


class Console(rich.console.Console):
    """A console without markup; style whole texts instead. A file or a pipe, which has no width of its own, gets 160 columns."""

    def __init__(self, **options: Any) -> None:
        known = sys.stdout.isatty() or os.environ.get("COLUMNS")
        options.setdefault("width", None if known else 160)
        super().__init__(markup=False, emoji=False, **options)


class Progress(rich.progress.Progress):
    """Bars whose descriptions are no markup; they vanish at the end."""

    def __init__(self, console: rich.console.Console) -> None:
        super().__init__(
            rich.progress.TextColumn("{task.description}", style="progress.description", markup=False),
            rich.progress.BarColumn(),
            rich.progress.TaskProgressColumn(),
            rich.progress.TimeRemainingColumn(),
            console=console,
            transient=True,
        )
