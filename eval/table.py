"""The result matrix: engines side by side."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.table import Table

COLUMNS = (
    "engine",
    "version",
    "task progress [95 %]",
    "approach",
    "grasp",
    "reorient",
    "reorientation progress",
    "not finite",
    "overflow",
    "steps/s",
)


def rows(summaries: Sequence[dict[str, Any]]) -> list[tuple[str, ...]]:
    """One row of text per engine, in the order of :data:`COLUMNS`."""
    out = []
    for s in summaries:
        progress, health = s["task_progress"], s["health"]
        low, high = progress["ci95"]
        out.append(
            (
                s["backend"],
                s["backend_version"],
                f"{progress['mean']:.1%} [{low:.1%}, {high:.1%}]",
                f"{s['approach_rate']:.0%}",
                f"{s['grasp_rate']:.0%}",
                f"{s['reorient_rate']:.0%}",
                f"{s['reorientation_progress']:.1%}",
                str(health["nonfinite"]),
                str(health["overflow"]),
                f"{s['control_steps_per_second']:,.0f}",
            )
        )
    return out


def rich_table(summaries: Sequence[dict[str, Any]]) -> Table:
    """The matrix for a terminal."""
    from rich.table import Table

    first = summaries[0]
    count = f"{first['episodes']} episodes of {len(first['per_demo'])} demonstrations"
    title = f"{first['policy']} on {first['robot']}: {count}, seed {first['seed']}"
    table = Table(*COLUMNS, title=title)
    for row in rows(summaries):
        table.add_row(*row)
    return table
