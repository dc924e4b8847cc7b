"""Tables of results for a terminal, and text that all tables share."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import isnan
from typing import TYPE_CHECKING

import rich.console
from rich.table import Table

from xreset.eval.metrics import METRICS

if TYPE_CHECKING:
    from xreset.eval.results import EvalResult


Rows = Sequence[Sequence[str]]
"""A table of text; the first row is its head."""


VERSIONS = (
    "Published success and distance (mean of 64 surface points, least over the episode) are metrics of the published "
    "paper, the others of its draft."
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


def estimate_text(metric: str, mean: float, low: float, high: float) -> str:
    """Return an estimate and its interval as percent, such as ``93.2 (88-98)``, or cm, such as ``0.6 (0.5-0.8)``; ``-``
    if it is not known."""
    if isnan(mean):
        return "-"
    digits = 1 if METRICS[metric].unit == "cm" else 0
    return f"{100 * mean:.1f} ({100 * low:.{digits}f}-{100 * high:.{digits}f})"


def points_text(difference: float, low: float, high: float) -> str:
    """Return a difference of shares and its interval in points, such as ``+5.2 (+1.0 to +9.3)``."""
    return f"{100 * difference:+.1f} ({100 * low:+.1f} to {100 * high:+.1f})"


def result_rows(results: Sequence[EvalResult]) -> list[tuple[str, ...]]:
    """Return one row of text for each metric: its name, then its value in each engine."""
    rows = [("version", *(r.engine_version for r in results))]
    lengths = [length_text(r) for r in results]
    if len(set(lengths)) > 1:
        rows.append(("episode length", *lengths))
    for name, metric in METRICS.items():
        cells = [metric.text(r.mean(name), len(r.nominal)) for r in results]
        rows.append((metric.title, *cells))
        if metric.headline and any(cell != "missing" for cell in cells):
            rows.append(("  95 % interval", *(_interval(r, name) for r in results)))
            rows += _unseen_rows(results, name)
    speeds = [f"{r.control_steps_per_second:,.0f}" for r in results]
    return [*rows, ("control steps/s", *speeds)]


def length_text(result: EvalResult) -> str:
    """Return the length of the episodes as text; an earlier version did not record it."""
    return "missing" if result.episode_seconds is None else f"{result.episode_seconds:g} s"


def _interval(result: EvalResult, name: str) -> str:
    low, high = result.ci95(name)
    return "-" if isnan(low) else METRICS[name].interval_text(low, high)


def _unseen_rows(results: Sequence[EvalResult], name: str) -> list[tuple[str, ...]]:
    """Return a metric of trained and of unseen objects; nothing if all objects are of one kind."""
    unseen = results[0].unseen
    trained = [each for each in results[0].objects if each not in unseen]
    rows = []
    if trained and unseen:
        for label, objects in (("  trained objects", trained), ("  unseen objects", unseen)):
            cells = []
            for result in results:
                own = result.nominal[result.nominal["object"].isin(objects)]
                cells.append(METRICS[name].text(float(own[name].mean()), len(own)))
            rows.append((label, *cells))
    return rows


def results_table(results: Sequence[EvalResult]) -> Table:
    """Return the table of an evaluation: one column for each engine; four engines fit into 80 characters."""
    first = results[0]
    length = ""
    if first.episode_seconds is not None and len({r.episode_seconds for r in results}) == 1:
        length = f" of {length_text(first)}"
    counts = (
        f"episodes: {len(first.nominal)}{length}, demonstrations: {first.nominal['sequence'].nunique()}, "
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
    headlines = [metric.title for metric in METRICS.values() if metric.headline]
    for result in results:
        table.add_column(result.engine, justify="right", no_wrap=True)
    for row in result_rows(results):
        table.add_row(*row, style="bold" if row[0] in headlines else None)
    return table


def table_text(results: Sequence[EvalResult]) -> str:
    """Return :func:`results_table` as plain text."""
    if not results:
        return "no results"
    console = rich.console.Console(width=100, color_system=None)
    with console.capture() as captured:
        console.print(results_table(results))
    return captured.get()
