"""Draw results and learning curves, for the page of a report and the picture of a comparison."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from xreset.eval.plots import COLORS, INK, picture, svg
from xreset.eval.report.curves import AXES, X, line
from xreset.eval.report.groups import Groups
from xreset.eval.results import Table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

REPORT_CURVES = ("episode/return", "task/grasped", "task/success")
"""Curves of a report's page."""
TITLES = {
    "task/success": "at the goal",
    "task/success_from_home": "at the goal, from home",
    "task/grasped": "thumb and a finger press",
    "task/grasped_from_home": "thumb and a finger press, from home",
    "episode/return": "episode return",
    "episode/length": "episode length [control steps]",
}
"""Title of a curve's panel; other curves have their TensorBoard name."""
_STYLES = ("-", (0, (5, 2)), (0, (1, 1.5)), (0, (5, 2, 1, 2)))
"""Line styles; the next one begins when the colors repeat: at the ninth training, the seventeenth, and so on."""
_WIDTH = 10.0
"""Width of a comparison's picture [inches]."""
_PANEL = 2.9
"""Height of a row of panels [inches]."""


def color(index: int) -> str:
    """Return the color of an engine or a training."""
    return COLORS[index % len(COLORS)]


def draw_bars(ax: Axes, mean: Table, low: Table, high: Table) -> None:
    """Draw a group of bars for each row of a table, with a bar for each column, in percent; NaN gives no bar.

    Args:
        ax: axes to draw in.
        mean: heights of the bars, in [0, 1].
        low: lower ends of the intervals.
        high: their upper ends.
    """
    width = min(0.84, 0.28 * len(mean.columns))  # groups are 1 apart
    each = width / len(mean.columns)
    for i, column in enumerate(mean):
        at = np.arange(len(mean)) + each * (i + 0.5) - width / 2
        value = mean[column].to_numpy(float)
        error = 100 * np.maximum([value - low[column], high[column] - value], 0)
        look: dict[str, Any] = {"color": color(i), "label": f" {column}", "ecolor": INK}
        ax.bar(at, 100 * value, width=0.9 * each, yerr=error, capsize=2, linewidth=0.8, **look)
    ax.set_xticks(range(len(mean)), list(mean.index))


def draw_training(curves: Table) -> str:
    """Return the drawing of a report's learning curves as SVG; empty if there are none of :data:`REPORT_CURVES`.

    Args:
        curves: :func:`xreset.eval.report.read.read_curves`.
    """
    tags = [tag for tag in REPORT_CURVES if tag in curves]

    def draw(figure: Figure) -> None:
        for ax, tag in zip(figure.subplots(1, len(tags), squeeze=False)[0], tags, strict=True):
            own = curves[[tag]].dropna().set_axis(["mean"], axis="columns")
            lines = {"": own.assign(low=own["mean"], high=own["mean"])}
            draw_lines(ax, tag, lines, "iterations", [""])

    return svg(draw, (10.6, 2.7), "curves") if tags else ""


def draw_lines(ax: Axes, tag: str, lines: Mapping[str, Table], x: X, order: Sequence[str]) -> None:
    """Draw one line for each group, with a band from ``low`` to ``high`` where they differ. Curves of the task are
    shares, and are drawn in percent.

    Args:
        ax: axes to draw in.
        tag: name of the curve.
        lines: label -> :func:`xreset.eval.report.curves.line`.
        x: kind of the horizontal axis.
        order: labels of all groups: the position decides the color.
    """
    percent = tag.startswith("task/")
    for label, curve in lines.items():
        index = order.index(label)
        values = curve * (100 if percent else 1)
        at = curve.index
        if (curve["high"] > curve["low"]).any():
            ax.fill_between(
                at, values["low"], values["high"], color=color(index), linewidth=0, alpha=0.2
            )
        # Above the axis, because many curves stay at zero.
        look: dict[str, Any] = {"marker": "o" if len(at) < 10 else "", "markersize": 4, "zorder": 3}
        ax.plot(
            at, values["mean"], color=color(index), linestyle=_style(index), linewidth=1.5, **look
        )
    _finish_panel(ax, TITLES.get(tag, tag), percent)
    ax.set_xlabel(AXES[x][0])
    ax.set_xlim(left=0)
    if percent:
        ax.set_ylim(bottom=0)


def _finish_panel(ax: Axes, title: str, percent: bool) -> None:
    ax.set_title(title, fontsize="medium", loc="left")
    ax.grid(axis="y", color=INK, alpha=0.12)
    if percent:
        ax.yaxis.set_major_formatter(lambda value, _: f"{value:g} %")


# Comparisons ----------------------------------------------------------------------------------------------------------


def draw_scores(ax: Axes, found: Table, order: Sequence[str]) -> None:
    """Draw task progress with its 95 % interval: for each engine, a bar for every group, in the color of its curve.

    Args:
        ax: axes to draw in.
        found: :func:`xreset.eval.report.groups.scores`.
        order: labels of all groups: the position decides the color.
    """
    own = found[found["metric"] == "task_progress"].pivot(index="engine", columns="group")
    values = (own[name].reindex(columns=order) for name in ("mean", "low", "high"))
    draw_bars(ax, *values)
    ax.set_ylim(0, 104)
    ax.set_yticks(range(0, 101, 25))
    _finish_panel(ax, "task progress from home, 95 % interval", percent=True)


def write_picture(path: Path, groups: Groups, tags: Sequence[str], found: Table, x: X) -> None:
    """Write the picture of a comparison.

    Args:
        path: PNG to write.
        groups: the groups, each with a color of its own.
        tags: curves that at least one training has, one panel each; may be empty if ``found`` is not.
        found: :func:`xreset.eval.report.groups.scores`; may be empty if ``tags`` is not.
        x: horizontal axis of the curves.
    """
    from matplotlib.lines import Line2D

    order = list(groups)
    rows = ceil(len(tags) / 2)
    heights = [_PANEL * rows] if tags else []
    if not found.empty:
        heights.append(_PANEL)
    size = (_WIDTH, sum(heights) + 0.1 + 0.25 * ceil(len(order) / 3))
    with picture(path, size) as figure:
        parts = figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
        if tags:
            panels = parts[0].subplots(rows, min(len(tags), 2), squeeze=False).flat
            for ax in panels[len(tags) :]:
                ax.set_axis_off()
            for ax, tag in zip(panels, tags, strict=False):
                lines = {label: line(members, tag, x) for label, members in groups.items()}
                known = {label: curve for label, curve in lines.items() if curve is not None}
                draw_lines(ax, tag, known, x, order)
        if not found.empty:
            draw_scores(parts[-1].subplots(), found, order)
        handles = []
        for i, label in enumerate(order):
            look = {"color": color(i), "linestyle": _style(i)}
            # matplotlib leaves out labels that begin with an underscore
            handles.append(Line2D([], [], linewidth=2.5, label=f" {label}", **look))
        figure.legend(handles=handles, loc="outside upper center", ncols=3, frameon=False)


def _style(index: int) -> Any:
    """Return the line style of a training."""
    return _STYLES[index // len(COLORS) % len(_STYLES)]
