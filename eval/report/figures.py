"""Figures of results and trainings: of a report's page, its picture, and the picture of a comparison."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from xreset.eval.plots import COLORS, INK, percent_axis, picture, svg
from xreset.eval.report.clips import Clip
from xreset.eval.report.curves import Line, X, fates, line, share_of_runs
from xreset.eval.report.groups import Group
from xreset.eval.report.read import Curve
from xreset.eval.results import EvalResult, Table
from xreset.learning.clock import SHARES
from xreset.text import short_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.container import BarContainer
    from matplotlib.figure import Figure

STAGES = {"approach_rate": "approach", "grasp_rate": "grasp", "reorient_rate": "reorient"}
Results = Sequence[EvalResult]
TITLES = {
    "task/success": "at the goal",
    "task/success_from_home": "at the goal, from home",
    "task/grasped": "thumb and a finger press",
    "task/grasped_from_home": "thumb and a finger press, from home",
    "episode/return": "episode return",
    "episode/length": "episode length [control steps]",
}
"""Title of a curve's panel; other curves have their TensorBoard name."""
AXES: dict[X, str] = {
    "minutes": "minutes of training",
    "steps": "million environment steps",
    "iterations": "iterations",
}
"""Label of the horizontal axis."""
_STYLES = ("-", (0, (5, 2)), (0, (1, 1.5)), (0, (5, 2, 1, 2)))
_HATCHES = ("", "///", "...", "xxx")
"""Line and hatch change where the colors begin again: with the ninth training, the seventeenth, and so on."""
_WIDTH = 10.0
"""[inches]"""
_PANEL = 2.9
"""Height of a row of panels [inches]."""
_MAX_NUMBERS = 24
"""Bars up to which their numbers have space above them."""


def color(index: int) -> str:
    """Return the color of an engine or a training."""
    return COLORS[index % len(COLORS)]


def draw_bars(ax: Axes, mean: Table, low: Table, high: Table, *, width: float = 0.8) -> list[BarContainer]:
    """Draw a group of bars for each row of a table and in it a bar for each column, in percent; NaN gives no bar.

    Args:
        low: lower ends of intervals; ``high``: their upper ends.
        width: width of a group of bars; groups are 1 apart.

    Returns:
        The bars of each column.
    """
    each = width / len(mean.columns)
    drawn = []
    for i, column in enumerate(mean):
        at = np.arange(len(mean)) + each * (i + 0.5) - width / 2
        value = mean[column].to_numpy(float)
        error = 100 * np.maximum([value - low[column], high[column] - value], 0)
        look: dict[str, Any] = {"color": color(i), "label": f" {column}", "ecolor": INK}
        drawn.append(ax.bar(at, 100 * value, width=0.9 * each, yerr=error, capsize=2, linewidth=0.8, **look))
    ax.set_xticks(range(len(mean)), list(mean.index))
    return drawn


# Results of one policy ------------------------------------------------------------------------------------------------


def object_progress(episodes: Table) -> Table:
    """Return the mean task progress of each object (rows) in each engine (columns)."""
    return episodes.pivot_table(index="object", columns="engine", values="task_progress")


def draw_progress(ax: Axes, results: Results) -> None:
    """Draw task progress of each engine with its 95 % interval."""
    for i, s in enumerate(results):
        mean = s.task_progress.mean
        low, high = s.task_progress.ci95
        error = [[100 * max(mean - low, 0)], [100 * max(high - mean, 0)]]
        ax.barh(i, 100 * mean, color=color(i), height=0.62, xerr=error, ecolor=INK, capsize=3)
        ax.text(100 * high + 2, i, f"{mean:.0%}", va="center")
    ax.set_yticks(range(len(results)), [s.backend for s in results])
    ax.invert_yaxis()
    percent_axis(ax, "x")
    ax.set_xlim(0, 112)
    ax.set_xlabel("task progress, 95 % interval")


def draw_stages(ax: Axes, results: Results) -> None:
    """Draw the share of episodes that reach each stage, for each engine."""
    table = pd.DataFrame(map(vars, results), index=[s.backend for s in results])
    table = table[list(STAGES)].T
    table.index = pd.Index(STAGES.values())
    for bars in draw_bars(ax, table, table, table):
        ax.bar_label(bars, fmt="%.0f", fontsize="small", padding=1)
    percent_axis(ax, "y")
    ax.set_ylabel("episodes")


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


def draw_curve(ax: Axes, curve: Curve) -> None:
    """Draw one learning curve."""
    percent = curve.label.startswith("worlds")
    values = curve.value * (100 if percent else 1)
    ax.plot(curve.iteration, values, color=color(0), linewidth=1.6, marker="o" if len(values) < 10 else "")
    curve_axes(ax, curve.label, "iteration", percent=percent)


def charts(results: Results, progress: Table, curves: Sequence[Curve]) -> dict[str, str]:
    """Return the drawings of a report's page as SVG: progress, stages and, if there are any, objects and curves.

    Args:
        progress: :func:`object_progress`.
    """
    drawn = {"progress": _chart("progress", draw_progress, [results], (5.2, 0.9 + 0.42 * len(results)))}
    drawn["stages"] = _chart("stages", draw_stages, [results], (5.2, 3.0), legend=True)
    if len(progress) > 1:
        drawn["objects"] = _chart("objects", draw_objects, [progress], (10.6, 1.3 + 0.36 * len(progress)), legend=True)
    if curves:
        drawn["curves"] = _chart("curves", draw_curve, curves, (10.6, 2.7))
    return drawn


def _chart(
    name: str, draw: Callable[[Axes, Any], None], panels: Sequence[Any], size: tuple[float, float], legend: bool = False
) -> str:
    """Return panels side by side as SVG."""

    def whole(figure: Figure) -> None:
        for ax, data in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
            draw(ax, data)
        if legend:
            figure.legend(loc="outside upper center", ncols=4, frameon=False, fontsize="small")

    return svg(whole, size, name)


def write_overview(path: Path, title: str, results: Results, clips: Sequence[Clip], caption: str) -> None:
    """Write one picture: task progress and stages of every engine, and two frames of each clip, from the middle and the
    end."""
    columns = max(len(clips), 2)
    width = max(2.9 * columns, 9.0)
    heights = [1.6 + 0.36 * len(results)]
    if clips:
        heights.append(2 * width / columns * 0.75 + 0.45)
    with picture(path, (width, sum(heights) + 0.4), font_size=10) as figure:
        figure.suptitle(title, fontsize="large", fontweight="bold")
        parts = figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
        left, right = parts[0].subplots(1, 2)
        draw_progress(left, results)
        draw_stages(right, results)
        if clips:
            engines = [s.backend for s in results]
            grid = parts[1].subplots(2, len(clips), squeeze=False)
            for (middle, end), clip in zip(grid.T, clips, strict=True):
                middle.imshow(clip.frames[len(clip.frames) // 2])
                end.imshow(clip.frames[-1])
                own = color(engines.index(clip.engine))
                middle.set_title(clip.engine, fontsize="medium", color=own, fontweight="bold")
            for ax in grid.flat:
                ax.set_axis_off()
            parts[1].supxlabel(caption, fontsize="small")


# Comparisons ----------------------------------------------------------------------------------------------------------


def curve_axes(ax: Axes, title: str, x: str, *, percent: bool) -> None:
    """Set title, horizontal axis and grid of learning curves; with ``percent`` the axis of the values begins at
    zero."""
    ax.set_title(title, fontsize="medium", loc="left")
    ax.set_xlabel(x)
    ax.grid(axis="y", color=INK, alpha=0.12)
    if percent:
        ax.yaxis.set_major_formatter(lambda value, _: f"{value:g} %")
        ax.set_ylim(bottom=0)


def draw_lines(
    ax: Axes,
    lines: Mapping[str, Line],
    title: str,
    x: X,
    order: Sequence[str],
    *,
    percent: bool,
    of: str = "",
    steps: bool = False,
) -> None:
    """Draw one line for each group, with a band from ``low`` to ``high`` where they differ.

    Args:
        lines: label -> curve, in units of ``x``.
        x: kind of the horizontal axis.
        order: labels of all groups: the position decides the color.
        percent: whether the values are shares.
        of: label of the vertical axis.
        steps: values hold from each ``x`` to the next.
    """
    scale = 100 if percent else 1
    for label, curve in lines.items():
        index = order.index(label)
        at = curve.x / (1e6 if x == "steps" else 1)
        look: dict[str, Any] = {"marker": "o" if len(at) < 10 else "", "markersize": 4}
        band: dict[str, Any] = {"alpha": 0.2}
        if steps:
            look = {"drawstyle": "steps-post"}
            band = {"alpha": 0.12, "step": "post"}
        if (curve.high > curve.low).any():
            ax.fill_between(at, scale * curve.low, scale * curve.high, color=color(index), linewidth=0, **band)
        # Above the axis, because many curves stay at zero.
        look |= {"color": color(index), "linestyle": _of(_STYLES, index), "linewidth": 1.5, "zorder": 3}
        ax.plot(at, scale * curve.mean, **look)
    curve_axes(ax, title, AXES[x], percent=percent)
    ax.set_ylabel(of)
    ax.set_xlim(left=0)


def draw_scores(ax: Axes, found: Table, order: Sequence[str]) -> None:
    """Draw task progress with its 95 % interval: engines side by side, in each a bar for every group, in the color of
    its curve."""
    labels = list(found["group"].unique())
    low = found["task_progress_ci95"].str[0]
    high = found["task_progress_ci95"].str[1]
    ends = found.assign(low=low, high=high).pivot(index="engine", columns="group")
    values = (ends[name][labels] for name in ("task_progress", "low", "high"))
    for label, bars in zip(labels, draw_bars(ax, *values, width=min(0.84, 0.28 * len(labels))), strict=True):
        index = order.index(label)
        for bar in bars:
            bar.set(facecolor=color(index), hatch=_of(_HATCHES, index), edgecolor="white", linewidth=0)
        if len(found) <= _MAX_NUMBERS:
            ax.bar_label(bars, fmt="%.0f", fontsize="small", padding=2)
    ax.tick_params(axis="x", length=0)
    ax.set_xlim(-0.5, found["engine"].nunique() - 0.5)
    percent_axis(ax, "y")
    ax.set_ylim(0, 109)
    ax.set_title("task progress from home, 95 % interval", fontsize="medium", loc="left")


def write_picture(path: Path, groups: Sequence[Group], tags: Sequence[str], found: Table, x: X) -> None:
    """Write the picture of a comparison.

    Args:
        tags: curves that at least one training has, one panel each; may be empty if ``found`` is not.
        found: :func:`xreset.eval.report.groups.scores`; may be empty if ``tags`` is not.
    """
    order = [group.label for group in groups]
    across = 3 if len(tags) % 3 == 0 else min(len(tags), 2)
    rows = -(-len(tags) // across) if tags else 0
    lifted = _lifted_lines(groups, x)
    heights = [_PANEL * rows] if rows else []
    heights += [_PANEL] * (bool(lifted) + (not found.empty))
    labels_across = max(1, int(_WIDTH / (0.8 + 0.1 * max(map(len, order)))))
    legend_rows = -(-len(order) // labels_across)
    size = (_WIDTH, sum(heights) + 0.1 + 0.25 * legend_rows)
    with picture(path, size, text_parse_math=False, hatch_linewidth=0.8) as figure:
        parts = iter(figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0])
        if tags:
            panels = next(parts).subplots(rows, across, squeeze=False).flat
            for ax in panels[len(tags) :]:
                ax.set_axis_off()
            for ax, tag in zip(panels, tags, strict=False):
                lines = {g.label: line(g.members, tag, x) for g in groups}
                known = {label: curve for label, curve in lines.items() if curve is not None}
                share = tag.startswith("task/")
                draw_lines(ax, known, TITLES.get(tag, tag), x, order, percent=share, of="worlds" if share else "")
        if lifted:
            panels = next(parts).subplots(1, len(lifted), squeeze=False)[0]
            for ax, (share, lines) in zip(panels, lifted.items(), strict=True):
                title = f"runs past {100 * share:g} % from home"
                draw_lines(ax, lines, title, x, order, percent=True, of="runs", steps=True)
                ax.set_ylim(-2, 102)
        if not found.empty:
            draw_scores(next(parts).subplots(), found, order)
        handles = [_legend_handle(group, i) for i, group in enumerate(groups)]
        columns = -(-len(order) // legend_rows)
        figure.legend(handles=handles, loc="outside upper center", ncols=columns, frameon=False)


def _lifted_lines(groups: Sequence[Group], x: X) -> dict[float, dict[str, Line]]:
    """Return share of success -> label -> share of the group's runs that have passed it."""
    lifted: dict[float, dict[str, Line]] = {}
    for share in SHARES:
        for group in groups:
            known = fates(group.members, share, x)
            if known:
                curve = share_of_runs(known)
                if len(known) == 1:  # its band would hide everything else
                    curve = replace(curve, low=curve.mean, high=curve.mean)
                lifted.setdefault(share, {})[group.label] = curve
    return lifted


def _of(choices: Sequence[Any], index: int) -> Any:
    """Return the style of a training, which changes where the colors begin again."""
    return choices[index // len(COLORS) % len(choices)]


def _legend_handle(group: Group, index: int) -> Any:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    label = " " + group.label  # matplotlib leaves out labels that begin with an underscore
    if len(group.members) > 1:
        label += f" ({len(group.members)} seeds)"
    if any(m.scalars for m in group.members):
        return Line2D([], [], color=color(index), linestyle=_of(_STYLES, index), linewidth=2.5, label=label)
    return Patch(facecolor=color(index), hatch=_of(_HATCHES, index), edgecolor="white", linewidth=0, label=label)
