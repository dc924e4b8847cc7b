"""The stress card as a picture: task progress against each property, a line for each engine."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from xreset.eval.plots import COLORS, picture
from xreset.eval.stress import COSTLY, Stress


def write_plot(path: Path, found: Sequence[Stress], title: str) -> None:
    """Write the picture as PNG."""
    names = list(dict.fromkeys(curve.property for stress in found for curve in stress.curves))
    columns = min(4, len(names))
    rows = math.ceil(len(names) / columns)
    with picture(path, (max(2.9 * columns, 5.0), 0.8 + 2.3 * rows), dpi=110, font_size=9) as figure:
        axes = figure.subplots(rows, columns, squeeze=False, sharey=True)
        for ax, name in zip(axes.flat, names, strict=False):
            for stress, color in zip(found, COLORS, strict=False):
                for curve in (c for c in stress.curves if c.property == name):
                    x = [p.value for p in curve.points]
                    band = ([100 * (stress.task_progress + p.difference_ci95[i]) for p in curve.points] for i in (0, 1))
                    ax.fill_between(x, *band, color=color, alpha=0.15, linewidth=0)
                    ax.plot(x, [100 * p.task_progress for p in curve.points], color=color, marker="o", markersize=3, label=stress.backend)
                    ax.axvline(curve.nominal, color="grey", linewidth=0.7, linestyle=":")
                    ax.set_xlabel(curve.unit if curve.unit != "x" else "factor")
            ax.set_title(name)
            ax.set_ylim(0, 100)
        for ax in list(axes.flat)[len(names) :]:
            ax.set_visible(False)
        for stress, color in zip(found, COLORS, strict=False):
            for ax in list(axes.flat)[: len(names)]:
                ax.axhline(100 * (stress.task_progress - COSTLY), color=color, linewidth=0.7, linestyle="--")
        axes[0, 0].legend(loc="lower left", fontsize=8)
        for row in axes:
            row[0].set_ylabel("task progress [%]")
        figure.suptitle(
            f"{title}\n(shaded: difference to the nominal value, 95 %; dashed: ten points less)", fontsize="medium", fontweight="bold"
        )
