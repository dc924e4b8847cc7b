"""The attribution as a picture: task progress of every run, with its interval, between A and B."""

from __future__ import annotations

import io
from pathlib import Path

from xreset.eval.engines.attribution import Attribution
from xreset.eval.engines.tables import amount, label
from xreset.eval.report.plots import COLORS, figure_style
from xreset.eval.stats import bootstrap_ci95
from xreset.files import atomic_write

_COLOR = {"as it is": COLORS[0], "towards": COLORS[4], "at most": COLORS[5], "all": COLORS[2], "what if": COLORS[7], "other": COLORS[1]}


def write_plot(path: Path, found: Attribution, title: str) -> None:
    """Write the plot as PNG."""
    with figure_style({"font.size": 10}) as figure_class:
        figure = figure_class(figsize=(8, 1.3 + 0.36 * len(found.rows)), layout="constrained", facecolor="white")
        ax = figure.subplots()
        for y, row in enumerate(found.rows):
            mean = 100 * row.score().mean()
            low, high = (100 * x for x in bootstrap_ci95(row.score(), row.sequences))
            ax.barh(y, mean, color=_COLOR[row.kind], height=0.62)
            ax.errorbar(mean, y, xerr=[[max(mean - low, 0)], [max(high - mean, 0)]], color="black", capsize=3, linewidth=1.2)
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
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=120)
    with atomic_write(path) as file:
        file.write(buffer.getbuffer())
