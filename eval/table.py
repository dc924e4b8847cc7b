"""Tables: for a terminal, and as Markdown like the tables of ``docs/results.md``."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from math import isnan
from typing import TYPE_CHECKING

import rich.console
from rich.table import Table

from xreset.eval.stats import Interval, mean_of_known

if TYPE_CHECKING:
    from xreset.eval.results import DemoResult, EvalResult


Rows = Sequence[Sequence[str]]
"""A table of text; the first row is its head."""


def escape(text: str) -> str:
    """Return text that Markdown shows unchanged, in one line."""
    for special in "\\|*_<>`[]":
        text = text.replace(special, f"\\{special}")
    return " ".join(text.split())


def cell(text: str) -> str:
    """Return Markdown for a cell of a table, in one line."""
    return " ".join(text.replace("|", "\\|").split())


def markdown(rows: Rows) -> str:
    """Return a table in Markdown."""
    lines = ""
    for cells in (rows[0], ["---"] * len(rows[0]), *rows[1:]):
        lines += "| " + " | ".join(map(escape, cells)) + " |\n"
    return lines


METRICS = {
    "task_progress": "task progress",
    "approach": "approach",
    "grasp": "grasp",
    "reorient": "reorient",
    "reorient_once": "at the goal at any time",
    "reorientation_progress": "reorientation progress",
    "published_success": "published success",
    "least_distance": "published distance [cm]",
}
"""Column of the table of episodes -> its name in tables. Shares are shown in percent, and 100 times metres are cm."""
VERSIONS = (
    "Published success and distance (mean of 64 surface points, least over the episode) are the published paper's. "
    "The others are its draft's."
)
"""Note under every table: the version of the paper that each metric is from."""
OPEN_LOOP = (
    "Task progress of ik near 33 % means that the hand gets to the object and does not grasp it. It does not rank "
    "hands: `xreset robots judge` does."
)
"""Note under tables with the baseline ``ik``: how to read its task progress."""


def caption(policies: Iterable[str]) -> str:
    """Return the notes under a table of these policies."""
    return f"{VERSIONS} {OPEN_LOOP}" if "ik" in policies else VERSIONS


def success_text(share: float | None) -> str:
    """Return the published success as text; None: an earlier version did not measure it."""
    return "missing" if share is None else f"{share:.1%}"


def estimate_text(metric: str, mean: float, low: float, high: float) -> str:
    """Return an estimate and its interval as percent, such as ``93.2 (88-98)``, or cm, such as ``0.6 (0.5-0.8)``; ``-``
    if it is not known."""
    if isnan(mean):
        return "-"
    digits = 1 if metric == "least_distance" else 0
    return f"{100 * mean:.1f} ({100 * low:.{digits}f}-{100 * high:.{digits}f})"


@dataclass(frozen=True)
class Figure:
    """A number of an evaluation: a row of the terminal's table, a column of the report's table."""

    text: Callable[[EvalResult], str]
    interval: Callable[[EvalResult], Interval | None] | None = None
    """95 % interval, in [0, 1]; None where the figure was not measured."""
    fault: bool = False
    """Whether every number but 0 is a fault."""


FIGURES = {
    "task progress": Figure(
        lambda s: f"{s.task_progress.mean:.1%}",
        interval=lambda s: s.task_progress.ci95,
    ),
    "approach": Figure(lambda s: f"{s.approach_rate:.0%}"),
    "grasp": Figure(lambda s: f"{s.grasp_rate:.0%}"),
    "reorient": Figure(lambda s: f"{s.reorient_rate:.0%}"),
    "reorientation progress": Figure(lambda s: f"{s.reorientation_progress:.1%}"),
    "published success": Figure(
        lambda s: success_text(s.published_success_rate),
        interval=lambda s: s.published_success_ci95,
    ),
    "published distance": Figure(
        lambda s: "missing" if s.least_distance is None else f"{100 * s.least_distance:.1f} cm"
    ),
    "not finite": Figure(lambda s: str(s.health.nonfinite), fault=True),
    "overflow": Figure(lambda s: str(s.health.overflow), fault=True),
    "left the scene": Figure(lambda s: str(s.health.out_of_bounds)),
    "control steps/s": Figure(lambda s: f"{s.control_steps_per_second:,.0f}"),
}
"""Numbers that tables show of every engine, by name."""


def result_rows(summaries: Sequence[EvalResult]) -> list[tuple[str, ...]]:
    """Return one row of text for each figure: its name, then its value in each engine."""
    rows = [("version", *(s.engine_version for s in summaries))]
    lengths = [_length_text(s) for s in summaries]
    if len(set(lengths)) > 1:
        rows.append(("episode length", *lengths))
    for name, figure in FIGURES.items():
        rows.append((name, *map(figure.text, summaries)))
        if figure.interval is not None:
            rows.append(("  95 % interval", *(_interval(figure.interval(s)) for s in summaries)))
        if name == "task progress":
            rows += _unseen_rows(summaries, lambda d: d.task_progress)
        if name == "published success" and summaries[0].published_success_rate is not None:
            rows += _unseen_rows(summaries, lambda d: d.published_success_rate)
    return rows


def _length_text(summary: EvalResult) -> str:
    """Return the length of the episodes as text; an earlier version did not record it."""
    return "missing" if summary.episode_seconds is None else f"{summary.episode_seconds:g} s"


def _interval(interval: Interval | None) -> str:
    return "-" if interval is None else f"{100 * interval[0]:.0f}-{100 * interval[1]:.0f}%"


def _unseen_rows(
    summaries: Sequence[EvalResult], metric: Callable[[DemoResult], float | None]
) -> list[tuple[str, ...]]:
    """Return a metric of trained and of unseen objects; nothing if all objects are of one kind."""
    unseen = summaries[0].unseen
    trained = [name for name in summaries[0].objects if name not in unseen]
    rows = []
    if trained and unseen:
        for label, objects in (("  trained objects", trained), ("  unseen objects", unseen)):
            cells = []
            for s in summaries:
                values = [metric(d) for d in s.per_demo if d.object in objects]
                cells.append(success_text(mean_of_known(values)))
            rows.append((label, *cells))
    return rows


def results_table(summaries: Sequence[EvalResult]) -> Table:
    """Return the table of an evaluation: one column for each engine; four engines fit into 80 characters."""
    first = summaries[0]
    length = ""
    if first.episode_seconds is not None and len({s.episode_seconds for s in summaries}) == 1:
        length = f" of {_length_text(first)}"
    counts = (
        f"episodes: {first.episodes}{length}, demonstrations: {len(first.per_demo)}, "
        f"seed: {first.seed}"
    )
    table = Table(
        "",
        title=f"{first.policy} on {first.robot}\n{counts}",
        min_width=len(counts) + 1,
        title_justify="left",
        caption=caption([first.policy]),
        caption_justify="left",
    )
    table.columns[0].no_wrap = True
    for s in summaries:
        table.add_column(s.engine, justify="right", no_wrap=True)
    for row in result_rows(summaries):
        table.add_row(
            *row, style="bold" if row[0] in ("task progress", "published success") else None
        )
    return table


def table_text(summaries: Sequence[EvalResult]) -> str:
    """Return :func:`results_table` as plain text."""
    if not summaries:
        return "no results"
    console = rich.console.Console(width=100, color_system=None)
    with console.capture() as captured:
        console.print(results_table(summaries))
    return captured.get()
