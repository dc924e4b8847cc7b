"""Progress on the terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console


@contextmanager
def engine_bars(console: Console, names: Sequence[str]) -> Iterator[Callable[[str, int, int], None]]:
    """One bar for each engine; gives the function that moves them: (engine, steps done, steps in all)."""
    from xreset.cli._terminal import Progress

    with Progress(console) as bar:
        tasks = {name: bar.add_task(name, total=None) for name in names}
        yield lambda name, done, total: bar.update(tasks[name], completed=done, total=total)
