"""What several commands do alike."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console

from xreset.cli import INVOCATION
from xreset.cli._terminal import Progress
from xreset.plugins import backend_names, backend_status


@contextmanager
def engine_bars(console: Console, names: Sequence[str]) -> Iterator[Callable[[str, int, int], None]]:
    """One bar for each engine; gives the function that moves them: (engine, steps done, steps in all)."""
    with Progress(console) as bar:
        counts = {name: bar.count(name) for name in names}
        yield lambda name, done, total: counts[name](done, total)


def usable_engines(console: Console) -> list[str]:
    """Names of the engines that can be used here; says why others cannot."""
    statuses = [backend_status(name) for name in backend_names()]
    for status in statuses:
        if status.reason is not None:
            console.print(f"left out {status.name}: {status.reason}")
    return [status.name for status in statuses if status.reason is None]


def this_command() -> str:
    """What to type to get the same numbers: with the names of files and folders but not where they lie, and without ``--json FILE``."""
    words = list(INVOCATION)
    if "--json" in words:
        del words[(i := words.index("--json")) : i + 2]
    return shlex.join(["xreset", *(Path(word).name if Path(word).exists() else word for word in words)])
