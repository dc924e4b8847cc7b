"""Tables: for a terminal, and as Markdown like that of ``docs/results.md``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from rich.table import Table
from rich.text import Text

from xreset.eval.results import EvalResult


@dataclass(frozen=True, kw_only=True)
class Rows:
    """A table of text."""

    title: str = ""
    head: tuple[str, ...]
    body: tuple[tuple[str, ...], ...]


def escape(text: str) -> str:
    """Text that Markdown shows as it is, in one line."""
    for special in "\\|*_<>`[]":
        text = text.replace(special, f"\\{special}")
    return " ".join(text.split())


def markdown(rows: Rows, escape: Callable[[str], str] = escape) -> str:
    """As a table in Markdown."""
    lines = [rows.head, ("---",) * len(rows.head), *rows.body]
    return "\n".join("| " + " | ".join(escape(cell) for cell in line) + " |" for line in lines) + "\n"


def rich_table(rows: Rows) -> Table:
    """For a terminal. If two columns describe a row, they become one, so that four engines fit into 80 characters."""
    grouped = not any(rows.head[:2])
    table = Table(title=rows.title, title_justify="left")
    for i, name in enumerate(rows.head[grouped:]):
        table.add_column(_cell(name), justify="right" if i else "left", overflow="fold")
    for line in rows.body:
        if grouped and line[0]:
            table.add_section()
            table.add_row(_cell(line[0]), style="bold")
        table.add_row(*map(_cell, line[grouped:]))
    return table


def _cell(text: str) -> Text:
    """As it is, without markup; a number stays beside its unit, and three shares on one line."""
    return Text(text.replace(" / ", "/").replace(" %", "\N{NO-BREAK SPACE}%"))


@dataclass(frozen=True)
class Figure:
    """A figure of an evaluation: a row of the terminal's table, a column of the report's."""

    text: Callable[[EvalResult], str]
    share: Callable[[EvalResult], float] | None = None
    """Drawn behind it, in [0, 1]."""
    interval: Callable[[EvalResult], tuple[float, float]] | None = None
    """95 %, in [0, 1]."""
    fault: bool = False
    """Whether all but 0 is bad."""


FIGURES = {
    "task progress": Figure(
        lambda s: f"{s.task_progress.mean:.1%}",
        share=lambda s: s.task_progress.mean,
        interval=lambda s: s.task_progress.ci95,
    ),
    "approach": Figure(lambda s: f"{s.approach_rate:.0%}"),
    "grasp": Figure(lambda s: f"{s.grasp_rate:.0%}"),
    "reorient": Figure(lambda s: f"{s.reorient_rate:.0%}"),
    "reorientation progress": Figure(
        lambda s: f"{s.reorientation_progress:.1%}", share=lambda s: s.reorientation_progress
    ),
    "not finite": Figure(lambda s: str(s.health.nonfinite), fault=True),
    "overflow": Figure(lambda s: str(s.health.overflow), fault=True),
    "left the scene": Figure(lambda s: str(s.health.out_of_bounds)),
    "control steps/s": Figure(lambda s: f"{s.control_steps_per_second:,.0f}"),
}
"""What is shown of every engine, by name."""


def result_rows(summaries: Sequence[EvalResult]) -> list[tuple[str, ...]]:
    """One row of text per figure: its name, then its value in each engine."""
    found, first = [("version", *(s.backend_version for s in summaries))], summaries[0]
    for name, figure in FIGURES.items():
        found.append((name, *map(figure.text, summaries)))
        if (interval := figure.interval) is not None:
            found.append(
                ("  95 % interval", *("{:.0f}-{:.0f}%".format(*(100 * x for x in interval(s))) for s in summaries))
            )
    known = [name for name in first.objects if name not in first.unseen]
    parts = {"  trained objects": known, "  unseen objects": first.unseen} if known and first.unseen else {}
    for place, (part, objects) in enumerate(parts.items(), 3):
        means = [np.mean([d.task_progress for d in s.per_demo if d.object in objects]) for s in summaries]
        found.insert(place, (part, *(f"{value:.1%}" for value in means)))
    return found


def results_table(summaries: Sequence[EvalResult]) -> Table:
    """An evaluation: one column per engine; four of them fit into 80 characters."""
    first = summaries[0]
    title = f"{first.policy} on {first.robot}\n{first.episodes} episodes of {len(first.per_demo)} demonstrations, seed {first.seed}"
    table = Table("", title=title, title_justify="left")
    table.columns[0].no_wrap = True
    for s in summaries:
        table.add_column(s.backend, justify="right", no_wrap=True)
    for row in result_rows(summaries):
        table.add_row(*row, style="bold" if row[0] == "task progress" else None)
    return table
