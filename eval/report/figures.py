"""Figures of results and trainings: of a report's page, its picture, and the picture of a comparison."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from xreset.eval.plots import COLORS, INK, percent_axis, picture, svg
from xreset.eval.report.clips import Clip
from xreset.eval.report.groups import Group, Scores, engines_of
from xreset.eval.report.lifting import Fate, fates, share_of_runs
from xreset.eval.report.progress import Line, X, line
from xreset.eval.report.read import Curve
from xreset.eval.results import EvalResult
from xreset.learning.clock import SHARES
from xreset.text import short_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STAGES = (("approach_rate", "approach"), ("grasp_rate", "grasp"), ("reorient_rate", "reorient"))
Summaries = Sequence[EvalResult]
TITLES = {
    "task/success": "at the goal",
    "task/success_from_home": "at the goal, from home",
    "task/grasped": "thumb and a finger press",
    "task/grasped_from_home": "thumb and a finger press, from home",
    "episode/return": "episode return",
    "episode/length": "episode length [control steps]",
}
"""Title of a curve's panel; others have their TensorBoard name."""
AXES: dict[X, str] = {
    "minutes": "minutes of training",
    "steps": "million environment steps",
    "iterations": "iterations",
}
"""Label of the horizontal axis."""
_STYLES = ("-", (0, (5, 2)), (0, (1, 1.5)), (0, (5, 2, 1, 2)))
_HATCHES = ("", "///", "...", "xxx")
"""Lines and bars of the ninth to sixteenth training, and so on, which have the colours of the first ones."""
_WIDTH = 10.0
"""[inches]"""
_MAX_NUMBERS = 24
"""Bars up to which their numbers find room above them."""


def object_progress(summary: EvalResult) -> dict[str, float]:
    """Object -> mean task progress over its episodes in one engine."""
    sums: dict[str, list[float]] = {}
    for row in summary.per_demo:
        total = sums.setdefault(row.object, [0.0, 0.0])
        total[0] += row.task_progress * row.episodes
        total[1] += row.episodes
    return {name: total / count for name, (total, count) in sorted(sums.items())}


def draw_progress(ax: Axes, summaries: Summaries) -> None:
    """Task progress of each engine with its 95 % interval."""
    for i, s in enumerate(summaries):
        mean, (low, high) = s.task_progress.mean, s.task_progress.ci95
        ax.barh(i, 100 * mean, color=COLORS[i % len(COLORS)], height=0.62)
        ax.errorbar(
            100 * mean,
            i,
            xerr=[[100 * max(mean - low, 0)], [100 * max(high - mean, 0)]],
            color=INK,
            capsize=3,
            linewidth=1.2,
        )
        ax.text(100 * high + 2, i, f"{mean:.0%}", va="center")
    ax.set_yticks(range(len(summaries)), [s.backend for s in summaries])
    ax.invert_yaxis()
    percent_axis(ax, "x")
    ax.set_xlim(0, 112)
    ax.set_xlabel("task progress, 95 % interval")


def draw_stages(ax: Axes, summaries: Summaries) -> None:
    """Share of episodes that reach each stage, per engine."""
    width = 0.8 / len(summaries)
    for i, s in enumerate(summaries):
        at = np.arange(len(STAGES)) - 0.4 + width * (i + 0.5)
        bars = ax.bar(
            at,
            [100 * getattr(s, key) for key, _ in STAGES],
            width=0.9 * width,
            color=COLORS[i % len(COLORS)],
            label=s.backend,
        )
        ax.bar_label(bars, fmt="%.0f", fontsize="small", padding=1)
    ax.set_xticks(range(len(STAGES)), [label for _, label in STAGES])
    percent_axis(ax, "y")
    ax.set_ylabel("episodes")


def draw_objects(ax: Axes, summaries: Summaries) -> None:
    """Task progress per object and engine: a dot each, so that engines which agree lie on one another."""
    names = sorted({row.object for s in summaries for row in s.per_demo})
    for i, s in enumerate(summaries):
        found = object_progress(s)
        offset = 0.5 * ((i + 0.5) / len(summaries) - 0.5)
        rows = [(100 * found[name], j + offset) for j, name in enumerate(names) if name in found]
        ax.scatter(
            *zip(*rows, strict=True), s=34, color=COLORS[i % len(COLORS)], label=s.backend, zorder=3, clip_on=False
        )
    ax.set_yticks(range(len(names)), [short_name(name) for name in names])
    ax.set_ylim(len(names) - 0.5, -0.5)
    percent_axis(ax, "x")
    ax.set_xlabel("task progress")


def draw_curve(ax: Axes, curve: Curve) -> None:
    """One learning curve."""
    percent = curve.label.startswith("worlds")
    ax.plot(
        curve.iteration,
        curve.value * (100 if percent else 1),
        color=COLORS[0],
        linewidth=1.6,
        marker="o" * (len(curve.value) < 10),
    )
    curve_axes(ax, curve.label, "iteration", percent=percent)


def curve_axes(ax: Axes, title: str, x: str, *, percent: bool) -> None:
    """Title, horizontal axis and grid of learning curves; ``percent``: the values are percentages, so that zero is worth seeing."""
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
    """One line for each group, with a band from ``low`` to ``high`` where they differ.

    Args:
        lines: label -> curve, in units of ``x``.
        x: what the horizontal axis is.
        order: labels of all groups: the position decides the colour.
        percent: whether the values are shares.
        of: what they are shares of.
        steps: values hold from each ``x`` to the next.
    """
    for label, curve in lines.items():
        color, style = _look(order.index(label))
        at, scale = curve.x / (1e6 if x == "steps" else 1), 100 if percent else 1
        if (curve.high > curve.low).any():
            alpha, step = (0.12, "post") if steps else (0.2, None)
            ax.fill_between(at, scale * curve.low, scale * curve.high, step=step, color=color, alpha=alpha, linewidth=0)
        drawn: dict[str, Any] = (
            {"drawstyle": "steps-post"} if steps else {"marker": "o" * (len(at) < 10), "markersize": 4}
        )
        # over the axis, for many curves stay at zero
        ax.plot(at, scale * curve.mean, color=color, linestyle=_STYLES[style], linewidth=1.5, zorder=3, **drawn)
    curve_axes(ax, title, AXES[x], percent=percent)
    ax.set_ylabel(of)
    ax.set_xlim(left=0)


def draw_scores(ax: Axes, found: Scores, order: Sequence[str]) -> None:
    """Task progress with its 95 % interval: engines side by side, in each a bar for every group, in the colour of its curve."""
    engines = engines_of(found)
    width = min(0.84 / len(found), 0.28)
    for i, (label, row) in enumerate(found.items()):
        color, style = _look(order.index(label))
        at = np.array([engines.index(e) for e in row]) + width * (i + 0.5 - len(found) / 2)
        mean, low, high = 100 * np.array([(s.task_progress, *s.ci95) for s in row.values()]).T
        ax.bar(at, mean, width=0.9 * width, color=color, hatch=_HATCHES[style], edgecolor="white", linewidth=0)
        error = np.maximum([mean - low, high - mean], 0)
        ax.errorbar(
            at, mean, yerr=error, fmt="none", ecolor=INK, capsize=min(3.0, 60 * width / len(engines)), linewidth=1.0
        )
        if len(engines) * len(found) <= _MAX_NUMBERS:
            for place, value, top in zip(at, mean, high, strict=True):
                ax.text(place, max(top, value) + 1.5, f"{value:.0f}", ha="center", va="bottom", fontsize="small")
    ax.set_xticks(range(len(engines)), engines)
    ax.tick_params(axis="x", length=0)
    ax.set_xlim(-0.5, len(engines) - 0.5)
    percent_axis(ax, "y")
    ax.set_ylim(0, 109)
    ax.set_title("task progress from home, 95 % interval", fontsize="medium", loc="left")


# Figures ---------------------------------------------------------------------------------------------------------------------------------


def figure_progress(summaries: Summaries) -> str:
    """SVG of :func:`draw_progress`."""
    return svg(lambda f: draw_progress(f.subplots(), summaries), (5.2, 0.9 + 0.42 * len(summaries)), "progress")


def figure_stages(summaries: Summaries) -> str:
    """SVG of :func:`draw_stages`."""
    return svg(lambda f: _with_legend(f, draw_stages, summaries), (5.2, 3.0), "stages")


def figure_objects(summaries: Summaries) -> str:
    """SVG of :func:`draw_objects`."""
    number = len({row.object for s in summaries for row in s.per_demo})
    return svg(lambda f: _with_legend(f, draw_objects, summaries), (10.6, 1.3 + 0.36 * number), "objects")


def _with_legend(figure: Figure, draw: Callable[[Axes, Summaries], None], summaries: Summaries) -> None:
    draw(figure.subplots(), summaries)
    figure.legend(loc="outside upper center", ncols=4, frameon=False, fontsize="small")


def figure_curves(curves: Sequence[Curve]) -> str:
    """SVG of all learning curves, side by side."""

    def draw(figure: Figure) -> None:
        for ax, curve in zip(figure.subplots(1, len(curves), squeeze=False)[0], curves, strict=True):
            draw_curve(ax, curve)

    return svg(draw, (10.6, 2.7), "curves")


def write_overview(path: Path, title: str, summaries: Summaries, clips: Sequence[Clip], caption: str) -> None:
    """One picture: task progress and stages of every engine, and two frames of each clip, from the middle and the end."""
    columns = max(len(clips), 2)
    width = max(2.9 * columns, 9.0)
    heights = [1.6 + 0.36 * len(summaries)] + [2 * width / columns * 0.75 + 0.45] * bool(clips)
    with picture(path, (width, sum(heights) + 0.4), font_size=10) as figure:
        figure.suptitle(title, fontsize="large", fontweight="bold")
        parts = figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
        if clips:
            engines = [s.backend for s in summaries]
            grid = parts[1].subplots(2, len(clips), squeeze=False)
            for (middle, end), clip in zip(grid.T, clips, strict=True):
                middle.imshow(clip.frames[len(clip.frames) // 2])
                end.imshow(clip.frames[-1])
                color = COLORS[engines.index(clip.engine) % len(COLORS)]
                middle.set_title(clip.engine, fontsize="medium", color=color, fontweight="bold")
            for ax in grid.flat:
                ax.set_axis_off()
            parts[1].supxlabel(caption, fontsize="small")
        left, right = parts[0].subplots(1, 2)
        draw_progress(left, summaries)
        draw_stages(right, summaries)


def write_picture(path: Path, groups: Sequence[Group], tags: Sequence[str], found: Scores, x: X) -> None:
    """The picture of a comparison.

    Args:
        tags: curves that at least one of them has, one panel each; may be empty if ``found`` is not.
        found: scores; may be empty if ``tags`` is not.
    """
    order = [group.label for group in groups]
    across = 3 if len(tags) % 3 == 0 else min(len(tags), 2)
    rows = len(tags) and -(-len(tags) // across)
    lifted = {s: {g.label: _share_of_runs(known) for g in groups if (known := fates(g.members, s, x))} for s in SHARES}
    lifted = {s: lines for s, lines in lifted.items() if lines}
    heights = [2.9 * rows] * bool(rows) + [2.9] * bool(lifted) + [2.9] * bool(found)
    lines_of_legend = -(-len(order) // max(1, int(_WIDTH / (0.8 + 0.1 * max(map(len, order))))))
    size = (_WIDTH, sum(heights) + 0.1 + 0.25 * lines_of_legend)
    with picture(path, size, text_parse_math=False, hatch_linewidth=0.8) as figure:
        parts = iter(figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0])
        if tags:
            grid = next(parts).subplots(rows, across, squeeze=False)
            for ax, tag in zip(grid.flat, tags, strict=False):
                lines = {g.label: curve for g in groups if (curve := line(g.members, tag, x)) is not None}
                share = tag.startswith("task/")
                draw_lines(ax, lines, TITLES.get(tag, tag), x, order, percent=share, of="worlds" if share else "")
            for ax in grid.flat[len(tags) :]:
                ax.set_axis_off()
        if lifted:
            panels = next(parts).subplots(1, len(lifted), squeeze=False)[0]
            for ax, (s, lines) in zip(panels, lifted.items(), strict=True):
                draw_lines(
                    ax, lines, f"runs past {100 * s:g} % from home", x, order, percent=True, of="runs", steps=True
                )
                ax.set_ylim(-2, 102)
        if found:
            draw_scores(next(parts).subplots(), found, order)
        _legend(figure, groups, -(-len(order) // lines_of_legend))


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
