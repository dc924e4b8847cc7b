"""The attribution for a terminal, and as a picture: task progress of every run, with its interval, between A and B."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

from rich.table import Table

from xreset.eval.engines.alteration import Alteration
from xreset.eval.engines.attribution import Attribution, Row
from xreset.eval.engines.measure import Measured
from xreset.eval.plots import COLORS, picture
from xreset.eval.sensitivity import COMPARED
from xreset.eval.table import success_text


def rich_table(found: Attribution, title: str) -> Table:
    """One row for each run: change, score, and difference to A as it is. Bold: the interval leaves out zero."""
    table = Table(title=title, title_justify="left")
    table.add_column("")
    names = ("value", "task progress", "grasp", "reorient", "published success", f"against {found.a}", "of gap")
    for name in names:
        table.add_column(name, justify="right")
    for row in found.rows:
        effect = row.effect
        low, high = effect.ci95
        least, most = effect.difference_ci95
        share = found.share(row)
        first = row is found.rows[0]
        table.add_row(
            label(row),
            _change(row, found),
            f"{effect.task_progress:.1%}\n{100 * low:.0f}-{100 * high:.0f}",
            f"{row.mean('grasp'):.0%}",
            f"{row.mean('reorient'):.0%}",
            success_text(effect.published_success),
            "" if first else f"{100 * effect.difference:+.1f}\n{100 * least:+.1f} to {100 * most:+.1f}",
            "" if first or math.isnan(share) else f"{share:.0%}",
            style="bold" if effect.is_certain else None,
        )
    return table


def not_tried(found: Attribution) -> Iterator[str]:
    """Yield a line for each property that was not changed towards B: its value in both engines, and the reason."""
    for name, reason in found.skipped.items():
        values = ""
        if name in COMPARED:
            a = _value(name, found.measured_a)
            b = _value(name, found.measured_b)
            values = f" ({a} in {found.a}, {b} in {found.b})"
        yield f"not tried: {name}{values}: {reason}"


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
            f"{found.b} differs from {found.a} by {size}, and none of the properties that could be changed explains it."
        )
    best = f"{row.name!r} alone brings about {found.share(row):.0%} of it"
    if row.kind == "at most":
        reason = COMPARED[row.name].at_most
        best = f"{row.name!r} may bring about {found.share(row):.0%} of it, at most ({reason})"
    for together in found.rows:
        if together.kind == "all":
            best += f", {together.name} {found.share(together):.0%}"
    return f"{found.b} differs from {found.a} by {size}; {best}."


def label(row: Row) -> str:
    """Return the name of a run."""
    return f"{row.name} ({row.kind})" if row.kind in ("what if", "at most") else row.name


def amount(row: Row) -> str:
    """Return by how much a run's physics was changed."""
    texts = []
    nominal = vars(Alteration())
    for name, value in vars(row.alteration).items():
        if value == nominal[name]:
            continue
        if name == "delay":
            texts.append(f"{value:+d} control step")
        else:
            texts.append(f"x {value:g}" if value else "none")
    return ", ".join(texts)


def _value(name: str, measured: Measured) -> str:
    compared = COMPARED[name]
    value = getattr(measured, compared.measured) * compared.scale
    return f"{value:.3g} {compared.shown_unit}".rstrip() if math.isfinite(value) else "unknown"


def _change(row: Row, found: Attribution) -> str:
    """A's value and B's; of a what-if, the size of the change."""
    if row.kind in ("towards", "at most"):
        compared = COMPARED[row.name]
        before = getattr(found.measured_a, compared.measured) * compared.scale
        return f"{before:.3g} -> {_value(row.name, found.measured_b)}"
    return amount(row) if row.kind == "what if" else ""


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
        labels = []
        for y, row in enumerate(found.rows):
            mean = 100 * row.effect.task_progress
            low, high = (100 * x for x in row.effect.ci95)
            error = [[max(mean - low, 0)], [max(high - mean, 0)]]
            ax.barh(y, mean, color=_COLOR[row.kind], height=0.62)
            ax.errorbar(mean, y, xerr=error, color="black", capsize=3, linewidth=1.2)
            text = f"{mean:.0f} %"
            if row.kind != "as it is":
                text += f" ({100 * row.effect.difference:+.1f})"
            ax.text(high + 1.5, y, text, va="center", fontweight="bold" if row.effect.is_certain else "normal")
            labels.append(f"{label(row)}, {amount(row)}" if row.kind == "what if" else label(row))
            if row in (found.rows[0], found.rows[-1]):
                ax.axvline(mean, color=_COLOR[row.kind], linestyle="--", linewidth=0.9)
        ax.set_yticks(range(len(labels)), labels)
        ax.invert_yaxis()
        ax.set_xlim(0, 118)
        ax.set_xlabel("task progress [%], 95 % interval")
        figure.suptitle(title, fontweight="bold", fontsize="medium")
