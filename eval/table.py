"""The result matrix for a terminal: engines side by side."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from xreset.eval.results import EvalResult

if TYPE_CHECKING:
    from rich.table import Table


def rows(summaries: Sequence[EvalResult]) -> list[tuple[str, ...]]:
    """One row of text per quantity: its name, then its value in each engine."""

    def health(name: str) -> list[str]:
        return [str(getattr(s.health, name)) for s in summaries]

    def rate(name: str) -> list[str]:
        return [f"{getattr(s, name):.0%}" for s in summaries]

    def over(part: str, objects: Sequence[str]) -> tuple[str, ...]:
        means = [[d.task_progress for d in s.per_demo if d.object in objects] for s in summaries]
        return (part, *(f"{sum(values) / len(values):.1%}" for values in means))

    intervals, first = [s.task_progress.ci95 for s in summaries], summaries[0]
    known = [name for name in first.objects if name not in first.unseen]
    parts = [over("  trained objects", known), over("  unseen objects", first.unseen)] if known and first.unseen else []
    return [
        ("version", *(s.backend_version for s in summaries)),
        ("task progress", *(f"{s.task_progress.mean:.1%}" for s in summaries)),
        ("  95 % interval", *(f"{100 * low:.0f}-{100 * high:.0f}%" for low, high in intervals)),
        *parts,
        ("approach", *rate("approach_rate")),
        ("grasp", *rate("grasp_rate")),
        ("reorient", *rate("reorient_rate")),
        ("reorientation progress", *(f"{s.reorientation_progress:.1%}" for s in summaries)),
        ("not finite", *health("nonfinite")),
        ("overflow", *health("overflow")),
        ("left the scene", *health("out_of_bounds")),
        ("control steps/s", *(f"{s.control_steps_per_second:,.0f}" for s in summaries)),
    ]


def rich_table(summaries: Sequence[EvalResult]) -> Table:
    """The matrix: one column per engine; four of them fit into 80 characters."""
    from rich.table import Table

    first = summaries[0]
    count = f"{first.episodes} episodes of {len(first.per_demo)} demonstrations"
    table = Table(title=f"{first.policy} on {first.robot}\n{count}, seed {first.seed}", title_justify="left")
    table.add_column("", no_wrap=True)
    for s in summaries:
        table.add_column(s.backend, justify="right", no_wrap=True)
    for row in rows(summaries):
        table.add_row(*row, style="bold" if row[0] == "task progress" else None)
    return table
