"""The comparison as a picture: learning curves, and below them task progress in every engine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from xreset.eval.report.groups import Group
from xreset.eval.report.lifting import Fate, fates, share_of_runs
from xreset.eval.report.plots import COLORS, INK, curve_axes, figure_style, percent_axis, write_png
from xreset.eval.report.progress import Line, X, line
from xreset.eval.report.score import Scores, engines_of
from xreset.learning.clock import SHARES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TITLES = {
    "task/success": "at the goal",
    "task/success_from_home": "at the goal, from home",
    "task/grasped": "thumb and a finger press",
    "task/grasped_from_home": "thumb and a finger press, from home",
    "episode/return": "episode return",
    "episode/length": "episode length [control steps]",
}
"""Title of a curve's panel; others have their TensorBoard name."""
AXES: dict[X, str] = {"minutes": "minutes of training", "steps": "million environment steps", "iterations": "iterations"}
"""Label of the horizontal axis."""
_STYLES = ("-", (0, (5, 2)), (0, (1, 1.5)), (0, (5, 2, 1, 2)))
_HATCHES = ("", "///", "...", "xxx")
"""Lines and bars of the ninth to sixteenth training, and so on, which have the colours of the first ones."""
_WIDTH = 10.0
"""[inches]"""
_MAX_NUMBERS = 24
"""Bars up to which their numbers find room above them."""


def draw_lines(ax: Axes, lines: Mapping[str, Line], tag: str, x: X, order: Sequence[str]) -> None:
    """One learning curve of every group: its line, and where it is several trainings the band from the lowest to the highest.

    Args:
        ax: axes.
        lines: label -> curve, in units of ``x``.
        tag: TensorBoard's name of the curve; those of ``task/`` are shares, and shown as percentages.
        x: what the horizontal axis is.
        order: labels of all groups: the position decides the colour.
    """
    percent = tag.startswith("task/")
    for label, curve in lines.items():
        color, style = _look(order.index(label))
        at, scale = curve.x / (1e6 if x == "steps" else 1), 100 if percent else 1
        if (curve.high > curve.low).any():
            ax.fill_between(at, scale * curve.low, scale * curve.high, color=color, alpha=0.2, linewidth=0)
        marker = "o" * (len(at) < 10)  # over the axis, for many curves stay at zero
        ax.plot(at, scale * curve.mean, color=color, linestyle=_STYLES[style], linewidth=1.5, marker=marker, markersize=4, zorder=3)
    curve_axes(ax, TITLES.get(tag, tag), AXES[x], percent=percent)
    if percent:
        ax.set_ylabel("worlds")
    ax.set_xlim(left=0)


def draw_scores(ax: Axes, found: Scores, order: Sequence[str]) -> None:
    """Task progress with its 95 % interval: engines side by side, in each a bar for every group, in the colour of its curve."""
    engines = engines_of(found)
    width = min(0.84 / len(found), 0.28)
    for i, (label, row) in enumerate(found.items()):
        color, style = _look(order.index(label))
        at = np.array([engines.index(e) for e in row]) + width * (i + 0.5 - len(found) / 2)
        mean, low, high = (100 * np.array([get(s) for s in row.values()]) for get in _PARTS)
        ax.bar(at, mean, width=0.9 * width, color=color, hatch=_HATCHES[style], edgecolor="white", linewidth=0)
        error = np.maximum([mean - low, high - mean], 0)
        ax.errorbar(at, mean, yerr=error, fmt="none", ecolor=INK, capsize=min(3.0, 60 * width / len(engines)), linewidth=1.0)
        if len(engines) * len(found) <= _MAX_NUMBERS:
            for place, value, top in zip(at, mean, high, strict=True):
                ax.text(place, max(top, value) + 1.5, f"{value:.0f}", ha="center", va="bottom", fontsize="small")
    ax.set_xticks(range(len(engines)), engines)
    ax.tick_params(axis="x", length=0)
    ax.set_xlim(-0.5, len(engines) - 0.5)
    percent_axis(ax, "y")
    ax.set_ylim(0, 109)
    ax.set_title("task progress from home, 95 % interval", fontsize="medium", loc="left")


def draw_lifted(ax: Axes, lines: Mapping[str, Line], share: float, x: X, order: Sequence[str]) -> None:
    """The share of each group's runs that have passed a share of success from home, in steps; ``low`` to ``high`` as a band."""
    for label, curve in lines.items():
        color, style = _look(order.index(label))
        at = curve.x / (1e6 if x == "steps" else 1)
        if (curve.high > curve.low).any():
            ax.fill_between(at, 100 * curve.low, 100 * curve.high, step="post", color=color, alpha=0.12, linewidth=0)
        ax.step(at, 100 * curve.mean, where="post", color=color, linestyle=_STYLES[style], linewidth=1.5, zorder=3)
    curve_axes(ax, f"runs past {100 * share:g} % from home", AXES[x], percent=True)
    ax.set_ylabel("runs")
    ax.set_xlim(left=0)
    ax.set_ylim(-2, 102)


def write_picture(path: Path, groups: Sequence[Group], tags: Sequence[str], found: Scores, x: X) -> None:
    """Write the picture.

    Args:
        path: PNG file.
        groups: all that are compared.
        tags: curves that at least one of them has, one panel each; may be empty if ``found`` is not.
        found: scores; may be empty if ``tags`` is not.
        x: horizontal axis of the curves.
    """
    order = [group.label for group in groups]
    across = 3 if len(tags) % 3 == 0 else min(len(tags), 2)
    rows = len(tags) and -(-len(tags) // across)
    lifted = {s: {g.label: _share_of_runs(known) for g in groups if (known := fates(g.members, s, x))} for s in SHARES}
    lifted = {s: lines for s, lines in lifted.items() if lines}
    heights = [2.9 * rows] * bool(rows) + [2.9] * bool(lifted) + [2.9] * bool(found)
    lines_of_legend = -(-len(order) // max(1, int(_WIDTH / (0.8 + 0.1 * max(map(len, order))))))
    with figure_style({"text.parse_math": False, "hatch.linewidth": 0.8}) as figure_class:
        figure = figure_class(figsize=(_WIDTH, sum(heights) + 0.1 + 0.25 * lines_of_legend), layout="constrained", facecolor="white")
        parts = iter(figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0])
        if tags:
            grid = next(parts).subplots(rows, across, squeeze=False)
            for ax, tag in zip(grid.flat, tags, strict=False):
                lines = {g.label: curve for g in groups if (curve := line(g.members, tag, x)) is not None}
                draw_lines(ax, lines, tag, x, order)
            for ax in grid.flat[len(tags) :]:
                ax.set_axis_off()
        if lifted:
            panels = next(parts).subplots(1, len(lifted), squeeze=False)[0]
            for ax, (s, lines) in zip(panels, lifted.items(), strict=True):
                draw_lifted(ax, lines, s, x, order)
        if found:
            draw_scores(next(parts).subplots(), found, order)
        _legend(figure, groups, -(-len(order) // lines_of_legend))
        write_png(path, figure)


_PARTS = (lambda s: s.task_progress, lambda s: s.ci95[0], lambda s: s.ci95[1])


def _share_of_runs(known: Sequence[Fate]) -> Line:
    """As steps; without a band for a single run, of which it would hide everything else."""
    line = share_of_runs(known)
    return line if len(known) > 1 else replace(line, low=line.mean, high=line.mean)


def _look(index: int) -> tuple[str, int]:
    return COLORS[index % len(COLORS)], index // len(COLORS) % len(_STYLES)


def _legend(figure: Figure, groups: Sequence[Group], columns: int) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles = []
    for i, group in enumerate(groups):
        color, style = _look(i)
        seeds = f" ({len(group.members)} seeds)" if len(group.members) > 1 else ""
        label = " " + group.label + seeds  # matplotlib leaves out labels that begin with an underscore
        if any(m.scalars for m in group.members):
            handles.append(Line2D([], [], color=color, linestyle=_STYLES[style], linewidth=2.5, label=label))
        else:
            handles.append(Patch(facecolor=color, hatch=_HATCHES[style], edgecolor="white", linewidth=0, label=label))
    figure.legend(handles=handles, loc="outside upper center", ncols=columns, frameon=False)
