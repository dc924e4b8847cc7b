"""The attribution for a terminal: task progress of every run, with its interval, between A and B."""

from __future__ import annotations

import math
from collections.abc import Iterator

from rich.table import Table

from xreset.eval.engines.attribution import Attribution
from xreset.eval.sensitivity import COMPARED
from xreset.eval.table import success_text


def rich_table(found: Attribution, title: str) -> Table:
    """One row for each run: change, score, and difference to A as it is. Bold: the interval leaves out zero."""
    table = Table("", title=title, title_justify="left")
    names = (
        "value",
        "task progress",
        "grasp",
        "reorient",
        "published success",
        f"against {found.a}",
        "of gap",
    )
    for name in names:
        table.add_column(name, justify="right")
    for row in found.rows:
        effect = row.effect
        low, high = effect.ci95
        least, most = effect.difference_ci95
        share = found.share(row)
        first = row is found.rows[0]
        table.add_row(
            row.name,
            " -> ".join(_values(row.name, found)) if row.kind == "towards" else "",
            f"{effect.task_progress:.1%}\n{100 * low:.0f}-{100 * high:.0f}",
            f"{row.mean('grasp'):.0%}",
            f"{row.mean('reorient'):.0%}",
            success_text(effect.published_success),
            ""
            if first
            else f"{100 * effect.difference:+.1f}\n{100 * least:+.1f} to {100 * most:+.1f}",
            "" if first or math.isnan(share) else f"{share:.0%}",
            style="bold" if effect.is_certain else None,
        )
    return table


def not_tried(found: Attribution) -> Iterator[str]:
    """Yield a line for each property that was not changed towards B: its value in both engines, and the reason."""
    for name, reason in found.skipped.items():
        a, b = _values(name, found)
        yield f"not tried: {name} ({a} in {found.a}, {b} in {found.b}): {reason}"


def verdict(found: Attribution) -> str:
    """Return the result in a sentence or two."""
    low, high = found.gap.difference_ci95
    size = f"{100 * found.gap.difference:+.1f} points of task progress ({100 * low:+.1f} to {100 * high:+.1f})"
    if not found.gap.is_certain:
        return (
            f"{found.b} and {found.a} do not differ for sure: {size} over {len(found.rows[0].episodes)} episodes. "
            "There is nothing to attribute. More episodes would show smaller differences."
        )
    row = found.costs()
    if row is None:
        return (
            f"{found.b} differs from {found.a} by {size}, and none of the properties that could be changed explains "
            "it."
        )
    best = f"{row.name!r} alone brings about {found.share(row):.0%} of it"
    for together in found.rows:
        if together.kind == "all":
            best += f", {together.name} {found.share(together):.0%}"
    return f"{found.b} differs from {found.a} by {size}; {best}."


def _values(name: str, found: Attribution) -> list[str]:
    """Return what was measured in A and in B."""
    prop = COMPARED[name]
    values = [getattr(measured, prop.measured) for measured in (found.measured_a, found.measured_b)]
    return [prop.shown(value) if math.isfinite(value) else "unknown" for value in values]
