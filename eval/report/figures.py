"""Figures of results and trainings: of a report's page, and the picture of a comparison."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from xreset.eval.plots import COLORS, INK, percent_axis, picture, svg
from xreset.eval.report.curves import X, line
from xreset.eval.report.groups import Group
from xreset.eval.results import Table
from xreset.text import short_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CURVES = {
    "episode/return": "episode return",
    "task/grasped": "worlds with a grasp",
    "task/success": "worlds at the goal",
}
"""Curves of a report's page -> their titles."""
TITLES = {
    "task/success": "at the goal",
    "task/success_from_home": "at the goal, from home",
    "task/grasped": "thumb and a finger press",
    "task/grasped_from_home": "thumb and a finger press, from home",
    "episode/return": "episode return",
    "episode/length": "episode length [control steps]",
}
"""Title of a curve's panel in a comparison; other curves have their TensorBoard name."""
AXES: dict[X, str] = {
    "minutes": "minutes of training",
    "steps": "million environment steps",
    "iterations": "iterations",
}
"""Label of the horizontal axis."""
_STYLES = ("-", (0, (5, 2)), (0, (1, 1.5)), (0, (5, 2, 1, 2)))
"""The line changes where the colors begin again: with the ninth training, the seventeenth, and so on."""
_WIDTH = 10.0
"""[inches]"""
_PANEL = 2.9
"""Height of a row of panels [inches]."""
_MAX_NUMBERS = 24
"""Bars up to which their numbers have space above them."""


def color(index: int) -> str:
    """Return the color of an engine or a training."""
    return COLORS[index % len(COLORS)]


def draw_bars(ax: Axes, mean: Table, low: Table, high: Table, *, numbers: bool = False) -> None:
    """Draw a group of bars for each row of a table and in it a bar for each column, in percent; NaN gives no bar.

    Args:
        low: lower ends of intervals; ``high``: their upper ends.
        numbers: whether numbers stand above the bars.
    """
    width = min(0.84, 0.28 * len(mean.columns))  # groups are 1 apart
    each = width / len(mean.columns)
    for i, column in enumerate(mean):
        at = np.arange(len(mean)) + each * (i + 0.5) - width / 2
        value = mean[column].to_numpy(float)
        error = 100 * np.maximum([value - low[column], high[column] - value], 0)
        look: dict[str, Any] = {"color": color(i), "label": f" {column}", "ecolor": INK}
        bars = ax.bar(at, 100 * value, width=0.9 * each, yerr=error, capsize=2, linewidth=0.8, **look)
        if numbers:
            ax.bar_label(bars, fmt="%.0f", fontsize="small", padding=2)
    ax.set_xticks(range(len(mean)), list(mean.index))


# Results of one policy ------------------------------------------------------------------------------------------------


def object_progress(episodes: Table) -> Table:
    """Return the mean task progress of each object (rows) in each engine (columns)."""
    return episodes.pivot_table(index="object", columns="engine", values="task_progress")


def draw_objects(ax: Axes, progress: Table) -> None:
    """Draw a dot for each object and engine."""
    count = len(progress.columns)
    for i, engine in enumerate(progress):
        rows = np.arange(len(progress)) + 0.5 * ((i + 0.5) / count - 0.5)
        ax.scatter(100 * progress[engine], rows, s=34, color=color(i), label=engine, zorder=3, clip_on=False)
    ax.set_yticks(range(len(progress)), list(map(short_name, progress.index)))
    ax.set_ylim(len(progress) - 0.5, -0.5)
    percent_axis(ax, "x")
    ax.set_xlabel("task progress")


def charts(progress: Table, curves: Table) -> dict[str, str]:
    """Return the drawings of a report's page as SVG: objects and learning curves, if there are any.

    Args:
        progress: :func:`object_progress`.
        curves: :func:`xreset.eval.report.read.read_curves`.
    """
    tags = [tag for tag in CURVES if tag in curves]

    def draw_progress(figure: Figure) -> None:
        draw_objects(figure.subplots(), progress)
        figure.legend(loc="outside upper center", ncols=4, frameon=False, fontsize="small")

    def draw_curves(figure: Figure) -> None:
        for ax, tag in zip(figure.subplots(1, len(tags), squeeze=False)[0], tags, strict=True):
            own = curves[[tag]].dropna().set_axis(["mean"], axis="columns")
            lines = {"": own.assign(low=own["mean"], high=own["mean"])}
            draw_lines(ax, lines, CURVES[tag], "iterations", [""], percent=tag.startswith("task/"))

    drawn = {}
    if len(progress) > 1:
        drawn["objects"] = svg(draw_progress, (10.6, 1.3 + 0.36 * len(progress)), "objects")
    if tags:
        drawn["curves"] = svg(draw_curves, (10.6, 2.7), "curves")
    return drawn


# Comparisons ----------------------------------------------------------------------------------------------------------


def draw_lines(ax: Axes, lines: Mapping[str, Table], title: str, x: X, order: Sequence[str], *, percent: bool) -> None:
    """Draw one line for each group, with a band from ``low`` to ``high`` where they differ.

    Args:
        lines: label -> :func:`xreset.eval.report.curves.line`.
        x: kind of the horizontal axis.
        order: labels of all groups: the position decides the color.
        percent: whether the values are shares.
    """
    for label, curve in lines.items():
        index = order.index(label)
        values = curve * (100 if percent else 1)
        at = curve.index / (1e6 if x == "steps" else 1)
        if (curve["high"] > curve["low"]).any():
            ax.fill_between(at, values["low"], values["high"], color=color(index), linewidth=0, alpha=0.2)
        # Above the axis, because many curves stay at zero.
        look: dict[str, Any] = {"marker": "o" if len(at) < 10 else "", "markersize": 4, "zorder": 3}
        ax.plot(at, values["mean"], color=color(index), linestyle=_style(index), linewidth=1.5, **look)
    ax.set_title(title, fontsize="medium", loc="left")
    ax.set_xlabel(AXES[x])
    ax.set_xlim(left=0)
    ax.grid(axis="y", color=INK, alpha=0.12)
    if percent:
        ax.yaxis.set_major_formatter(lambda value, _: f"{value:g} %")
        ax.set_ylim(bottom=0)


def draw_scores(ax: Axes, found: Table, order: Sequence[str]) -> None:
    """Draw task progress with its 95 % interval: engines side by side, in each a bar for every group, in the color of
    its curve."""
    low = found["task_progress_ci95"].str[0]
    high = found["task_progress_ci95"].str[1]
    ends = found.assign(low=low, high=high).pivot(index="engine", columns="group")
    values = (ends[name].reindex(columns=order) for name in ("task_progress", "low", "high"))
    draw_bars(ax, *values, numbers=len(found) <= _MAX_NUMBERS)
    percent_axis(ax, "y")
    ax.set_ylim(0, 109)
    ax.set_title("task progress from home, 95 % interval", fontsize="medium", loc="left")


def write_picture(path: Path, groups: Sequence[Group], tags: Sequence[str], found: Table, x: X) -> None:
    """Write the picture of a comparison.

    Args:
        tags: curves that at least one training has, one panel each; may be empty if ``found`` is not.
        found: :func:`xreset.eval.report.groups.scores`; may be empty if ``tags`` is not.
    """
    from matplotlib.lines import Line2D

    order = [group.label for group in groups]
    across = min(len(tags), 2)
    heights = []
    if tags:
        heights.append(_PANEL * -(-len(tags) // across))
    if not found.empty:
        heights.append(_PANEL)
    legend_rows = -(-len(order) // 3)
    size = (_WIDTH, sum(heights) + 0.1 + 0.25 * legend_rows)
    with picture(path, size, text_parse_math=False) as figure:
        parts = figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
        if tags:
            panels = parts[0].subplots(-(-len(tags) // across), across, squeeze=False).flat
            for ax in panels[len(tags) :]:
                ax.set_axis_off()
            for ax, tag in zip(panels, tags, strict=False):
                lines = {g.label: line(g.members, tag, x) for g in groups}
                known = {label: curve for label, curve in lines.items() if curve is not None}
                draw_lines(ax, known, TITLES.get(tag, tag), x, order, percent=tag.startswith("task/"))
        if not found.empty:
            draw_scores(parts[-1].subplots(), found, order)
        handles = []
        for i, label in enumerate(order):  # matplotlib leaves out labels that begin with an underscore
            handles.append(Line2D([], [], color=color(i), linestyle=_style(i), linewidth=2.5, label=f" {label}"))
        figure.legend(handles=handles, loc="outside upper center", ncols=3, frameon=False)


def _style(index: int) -> Any:
    """Return the line of a training."""
    return _STYLES[index // len(COLORS) % len(_STYLES)]
