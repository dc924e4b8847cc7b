"""The attribution for a terminal, and as a picture: task progress of every run, with its interval, between A and B."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

from rich.table import Table

from xreset.eval.engines.attribution import Attribution, Row
from xreset.eval.engines.measure import Measured
from xreset.eval.engines.properties import PROPERTIES, Property
from xreset.eval.plots import COLORS, picture
from xreset.eval.stats import bootstrap_ci95

_BY_NAME = {p.name: p for p in PROPERTIES}


def rich_table(found: Attribution, title: str) -> Table:
    """One row per run: what was changed, the score, and how much that differs from A as it is. Bold: the interval leaves out zero."""
    table = Table(title=title, title_justify="left")
    table.add_column("")
    for name in ("value", "task progress", "grasp", "reorient", f"against {found.a}", "of gap"):
        table.add_column(name, justify="right")
    for row in found.rows:
        low, high = bootstrap_ci95(row.score(), row.sequences)
        d, (least, most) = found.difference(row)
        share, first = found.share(row), row.kind == "as it is"
        table.add_row(
            label(row),
            _change(row, found),
            f"{row.score().mean():.1%}\n{100 * low:.0f}-{100 * high:.0f}",
            f"{row.score('grasp').mean():.0%}",
            f"{row.score('reorient').mean():.0%}",
            "" if first else f"{100 * d:+.1f}\n{100 * least:+.1f} to {100 * most:+.1f}",
            "" if first or math.isnan(share) else f"{share:.0%}",
            style="bold" if found.matters(row) and not first else None,
        )
    return table


def not_tried(found: Attribution) -> Iterator[str]:
    """A line for each property that was not changed towards B: its value in both, and why not."""
    for name, reason in found.skipped.items():
        p = _BY_NAME.get(name)
        values = (
            ""
            if p is None
            else f" ({_value(p, found.measured_a)} in {found.a}, {_value(p, found.measured_b)} in {found.b})"
        )
        yield f"not tried: {name}{values}: {reason}"


def verdict(found: Attribution) -> str:
    """The result in a sentence or two."""
    gap, (low, high) = found.difference(found.rows[-1])
    episodes = len(found.rows[0].episodes)
    size = f"{100 * gap:+.1f} points of task progress ({100 * low:+.1f} to {100 * high:+.1f})"
    if not found.matters(found.rows[-1]):
        return (
            f"{found.b} and {found.a} do not differ for sure: {size} over {episodes} episodes. "
            "There is nothing to attribute; more episodes would tell smaller differences."
        )
    row = found.costs()
    if row is None:
        return (
            f"{found.b} differs from {found.a} by {size}, and none of the properties that could be changed explains it."
        )
    best = f"{row.name!r} alone brings about {found.share(row):.0%} of it"
    if row.kind == "at most":
        best = f"{row.name!r} may bring about {found.share(row):.0%} of it, at most ({_BY_NAME[row.name].at_most})"
    together = next((r for r in found.rows if r.kind == "all"), None)
    rest = "" if together is None else f", {together.name} {found.share(together):.0%}"
    return f"{found.b} differs from {found.a} by {size}; {best}{rest}."


def label(row: Row) -> str:
    """Name of a run."""
    return f"{row.name} ({row.kind})" if row.kind in ("what if", "at most") else row.name


def amount(row: Row) -> str:
    """By how much a run's physics was changed."""
    changed = {name: value for name, value in vars(row.alteration).items() if value != (0 if name == "delay" else 1.0)}
    return ", ".join(
        f"{value:+d} control step" if name == "delay" else f"x {value:g}" if value else "none"
        for name, value in changed.items()
    )


def _value(p: Property, measured: Measured) -> str:
    value = p.value(measured) * p.scale
    return f"{value:.3g} {p.unit}".rstrip() if math.isfinite(value) else "unknown"


def _change(row: Row, found: Attribution) -> str:
    """A's value and B's; or by how much the property was changed, for want of a difference."""
    p = _BY_NAME.get(row.name)
    if p is None:
        return ""
    if row.kind in ("towards", "at most"):
        return f"{p.value(found.measured_a) * p.scale:.3g} -> {_value(p, found.measured_b)}"
    return amount(row)


_COLOR = {
    "as it is": COLORS[0],
    "towards": COLORS[4],
    "at most": COLORS[5],
    "all": COLORS[2],
    "what if": COLORS[7],
    "other": COLORS[1],
}


def write_plot(path: Path, found: Attribution, title: str) -> None:
    """Write the plot as PNG."""
    with picture(path, (8, 1.3 + 0.36 * len(found.rows)), font_size=10) as figure:
        ax = figure.subplots()
        for y, row in enumerate(found.rows):
            mean = 100 * row.score().mean()
            low, high = (100 * x for x in bootstrap_ci95(row.score(), row.sequences))
            ax.barh(y, mean, color=_COLOR[row.kind], height=0.62)
            ax.errorbar(
                mean, y, xerr=[[max(mean - low, 0)], [max(high - mean, 0)]], color="black", capsize=3, linewidth=1.2
            )
            d, _ = found.difference(row)
            text = f"{mean:.0f} %" if row.kind == "as it is" else f"{mean:.0f} % ({100 * d:+.1f})"
            ax.text(high + 1.5, y, text, va="center", fontweight="bold" if found.matters(row) else "normal")
        labels = [f"{label(row)}, {amount(row)}" if row.kind == "what if" else label(row) for row in found.rows]
        ax.set_yticks(range(len(labels)), labels)
        ax.invert_yaxis()
        for row in (found.rows[0], found.rows[-1]):
            ax.axvline(100 * row.score().mean(), color=_COLOR[row.kind], linestyle="--", linewidth=0.9)
        ax.set_xlim(0, 118)
        ax.set_xlabel("task progress [%], 95 % interval")
        figure.suptitle(title, fontweight="bold", fontsize="medium")
