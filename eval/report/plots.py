"""The report's plots, drawn with matplotlib: as SVG that takes the page's text colour, and as one picture."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from xreset.errors import XResetError
from xreset.eval.results import EvalResult
from xreset.files import atomic_write

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from xreset.eval.report.clips import Clip
    from xreset.eval.report.data import Curve

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8a6d3b", "#666666")
"""Colour of each engine, in their order: Okabe and Ito's palette, told apart with colour-blind eyes and on light and dark ground."""
STAGES = (("approach_rate", "approach"), ("grasp_rate", "grasp"), ("reorient_rate", "reorient"))
INK = "#010203"
"""Text colour; in an SVG it is replaced by ``currentColor``."""

Summaries = Sequence[EvalResult]


def short_name(name: str) -> str:
    """``005_tomato_soup_can`` -> ``tomato soup can``."""
    return re.sub(r"^\d+_", "", name).replace("_", " ")


def object_progress(summary: EvalResult) -> dict[str, float]:
    """Object -> mean task progress over its episodes in one engine."""
    sums: dict[str, list[float]] = {}
    for row in summary.per_demo:
        total = sums.setdefault(row.object, [0.0, 0.0])
        total[0] += row.task_progress * row.episodes
        total[1] += row.episodes
    return {name: total / count for name, (total, count) in sorted(sums.items())}


# Axes --------------------------------------------------------------------------------------------------------------------------------


def draw_progress(ax: Axes, summaries: Summaries) -> None:
    """Task progress of each engine with its 95 % interval."""
    for i, s in enumerate(summaries):
        mean, (low, high) = s.task_progress.mean, s.task_progress.ci95
        ax.barh(i, 100 * mean, color=COLORS[i % len(COLORS)], height=0.62)
        ax.errorbar(100 * mean, i, xerr=[[100 * max(mean - low, 0)], [100 * max(high - mean, 0)]], color=INK, capsize=3, linewidth=1.2)
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
        bars = ax.bar(at, [100 * getattr(s, key) for key, _ in STAGES], width=0.9 * width, color=COLORS[i % len(COLORS)], label=s.backend)
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
        ax.scatter(*zip(*rows, strict=True), s=34, color=COLORS[i % len(COLORS)], label=s.backend, zorder=3, clip_on=False)
    ax.set_yticks(range(len(names)), [short_name(name) for name in names])
    ax.set_ylim(len(names) - 0.5, -0.5)
    percent_axis(ax, "x")
    ax.set_xlabel("task progress")


def draw_curve(ax: Axes, curve: Curve) -> None:
    """One learning curve."""
    percent = curve.label.startswith("worlds")
    ax.plot(curve.iteration, curve.value * (100 if percent else 1), color=COLORS[0], linewidth=1.6, marker="o" * (len(curve.value) < 10))
    curve_axes(ax, curve.label, "iteration", percent=percent)


def curve_axes(ax: Axes, title: str, x: str, *, percent: bool) -> None:
    """Title, horizontal axis and grid of learning curves; ``percent``: the values are percentages, so that zero is worth seeing."""
    ax.set_title(title, fontsize="medium", loc="left")
    ax.set_xlabel(x)
    ax.grid(axis="y", color=INK, alpha=0.12)
    if percent:
        ax.yaxis.set_major_formatter(lambda value, _: f"{value:g} %")
        ax.set_ylim(bottom=0)


# Figures -----------------------------------------------------------------------------------------------------------------------------


def svg(draw: Callable[[Figure], None], size: tuple[float, float], *, salt: str) -> str:
    """An ``<svg>`` element that scales with the page and takes its text colour.

    Args:
        draw: fills the figure.
        size: width and height [inches].
        salt: keeps its identifiers apart from those of other figures on the page; the same salt and drawing give the same text.
    """
    with figure_style({"svg.hashsalt": salt, "svg.fonttype": "none"}) as figure_class:
        figure = figure_class(figsize=size, layout="constrained")
        draw(figure)
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :].replace(INK, "currentColor")
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    used = set(re.findall(r"#([\w.-]+)", text))
    text = re.sub(r' id="([\w.-]+)"', lambda m: m[0] if m[1] in used else "", text)
    return re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", text, count=1), count=1).strip()


def figure_progress(summaries: Summaries, salt: str) -> str:
    """SVG of :func:`draw_progress`."""
    return svg(lambda f: draw_progress(f.subplots(), summaries), (5.2, 0.9 + 0.42 * len(summaries)), salt=salt)


def figure_stages(summaries: Summaries, salt: str) -> str:
    """SVG of :func:`draw_stages`."""

    def draw(figure: Figure) -> None:
        ax = figure.subplots()
        draw_stages(ax, summaries)
        figure.legend(loc="outside upper center", ncols=4, frameon=False, fontsize="small")

    return svg(draw, (5.2, 3.0), salt=salt)


def figure_objects(summaries: Summaries, salt: str) -> str:
    """SVG of :func:`draw_objects`."""
    number = len({row.object for s in summaries for row in s.per_demo})

    def draw(figure: Figure) -> None:
        ax = figure.subplots()
        draw_objects(ax, summaries)
        figure.legend(loc="outside upper center", ncols=4, frameon=False, fontsize="small")

    return svg(draw, (10.6, 1.3 + 0.36 * number), salt=salt)


def figure_curves(curves: Sequence[Curve], salt: str) -> str:
    """SVG of all learning curves, side by side."""

    def draw(figure: Figure) -> None:
        for ax, curve in zip(figure.subplots(1, len(curves), squeeze=False)[0], curves, strict=True):
            draw_curve(ax, curve)

    return svg(draw, (10.6, 2.7), salt=salt)


def write_overview(path: Path, title: str, summaries: Summaries, clips: Sequence[Clip], caption: str) -> None:
    """One picture: task progress and stages of every engine, and two frames of each clip, from the middle and the end."""
    columns = max(len(clips), 2)
    width = max(2.9 * columns, 9.0)
    picture_height = 2 * width / columns * 0.75 + 0.45 if clips else 0.0
    plot_height = 1.6 + 0.36 * len(summaries)
    with figure_style({"font.size": 10}) as figure_class:
        figure = figure_class(figsize=(width, plot_height + picture_height + 0.4), layout="constrained", facecolor="white")
        figure.suptitle(title, fontsize="large", fontweight="bold")
        heights = (plot_height, picture_height) if clips else (plot_height,)
        parts = figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
        if clips:
            pictures = parts[1]
            grid = pictures.subplots(2, len(clips), squeeze=False)
            for (middle, end), clip in zip(grid.T, clips, strict=True):
                middle.imshow(clip.frames[len(clip.frames) // 2])
                end.imshow(clip.frames[-1])
                middle.set_title(clip.engine, fontsize="medium", color=COLORS[_index(summaries, clip.engine)], fontweight="bold")
            for ax in grid.flat:
                ax.set_axis_off()
            pictures.supxlabel(caption, fontsize="small")
        left, right = parts[0].subplots(1, 2)
        draw_progress(left, summaries)
        draw_stages(right, summaries)
        write_png(path, figure)


def write_png(path: Path, figure: Figure) -> None:
    """Write a figure as PNG; within its :func:`figure_style`, which holds while it is drawn."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=120)
    with atomic_write(path) as file:
        file.write(buffer.getbuffer())


def _index(summaries: Summaries, engine: str) -> int:
    return [s.backend for s in summaries].index(engine) % len(COLORS)


def percent_axis(ax: Axes, which: str) -> None:
    """Make an axis, ``x`` or ``y``, go from 0 to 100 percent, with lines across."""
    axis = ax.xaxis if which == "x" else ax.yaxis
    (ax.set_xlim if which == "x" else ax.set_ylim)(0, 104)
    axis.set_ticks(range(0, 101, 25))
    axis.set_major_formatter(lambda value, _: f"{value:.0f} %")
    ax.grid(axis="x" if which == "x" else "y", color=INK, alpha=0.12)


@contextmanager
def figure_style(style: dict[str, Any]) -> Iterator[type[Figure]]:
    """matplotlib's ``Figure`` class within the style of the project's plots; no window, no global state."""
    try:
        import matplotlib
        from matplotlib.figure import Figure
    except ImportError as error:
        raise XResetError(f"matplotlib cannot be imported ({error}). Install it with: pip install 'xreset[eval]'") from error
    base = {
        "font.family": "sans-serif",
        "font.sans-serif": ["DejaVu Sans"],
        "font.size": 10.5,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.axisbelow": True,
    }
    base |= dict.fromkeys(("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color"), INK)
    with matplotlib.rc_context(base | style):  # pyright: ignore[reportArgumentType]
        yield Figure
