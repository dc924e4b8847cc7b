"""The partings as a picture: differences to the reference over time, and which fingers touch in each engine."""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from xreset.eval.engines.divergence import Differences
from xreset.eval.engines.replay import TraceResult
from xreset.eval.report.plots import COLORS, figure_style
from xreset.files import atomic_write

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_NOISE = "#999999"


def write_plot(path: Path, result: TraceResult) -> None:
    """Write the plot as PNG.

    Four rows of differences on logarithmic axes, with the thresholds (dashed) and the reference's distance to itself from perturbed starts
    (grey); then, for each engine, when each finger touches the object.
    """
    t = result.thresholds
    rows = (
        ("joint that differs most [mrad, mm]", lambda d: 1e3 * d.joint.max(axis=1), 1e3 * t.joint),
        ("object position [mm]", lambda d: 1e3 * d.position, 1e3 * t.position),
        ("object orientation [deg]", lambda d: np.degrees(d.angle), math.degrees(t.angle)),
        ("contact force [N]", lambda d: d.force.max(axis=1), t.force),
    )
    fingers = result.actions.robot.fingertip_names
    engines = [result.reference, *result.engines]
    heights = [1.7] * len(rows) + [0.35 + 0.13 * len(fingers) * len(engines)]
    with figure_style({"font.size": 9}) as figure_class:
        figure = figure_class(figsize=(10, sum(heights) + 0.9), layout="constrained", facecolor="white")
        figure.suptitle(f"{result.actions.label}: distance to {result.reference.name}", fontweight="bold")
        axes = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights)
        for ax, (title, value, threshold) in zip(axes, rows, strict=False):
            _draw_differences(ax, result, value, threshold)
            ax.set_title(title, loc="left", fontsize="medium")
        _draw_touches(axes[-1], [(e.name, e.differences) for e in engines], fingers)
        axes[-1].set_xlabel("time [s]")
        for ax in axes:
            for name, start in result.actions.phases:
                ax.axvline(start, color="black", alpha=0.15, linewidth=0.8)
                if ax is axes[0]:
                    ax.annotate(name, (start, 1), xycoords=("data", "axes fraction"), xytext=(2, -2), textcoords="offset points", va="top")
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=5, frameon=False)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=110)
    with atomic_write(path) as file:
        file.write(buffer.getbuffer())


def _draw_differences(ax: Axes, result: TraceResult, value, threshold: float) -> None:
    floor = 1e-4 * threshold

    def draw(d: Differences, **style) -> None:
        ax.plot(d.time, np.maximum(value(d), floor), **style)

    for i, d in enumerate(result.noise_differences):
        draw(d, color=_NOISE, linewidth=0.7, label=f"{result.reference.name}, start moved by {result.perturbation:.0e}" if i == 0 else None)
    for i, engine in enumerate(result.engines, start=1):
        draw(engine.differences, color=COLORS[i % len(COLORS)], linewidth=1.3, label=engine.name)
    ax.axhline(threshold, color="black", linestyle="--", linewidth=0.8, label="threshold")
    ax.set_yscale("log")
    ax.set_ylim(bottom=floor)
    ax.grid(axis="y", alpha=0.2)


def _draw_touches(ax: Axes, engines: list[tuple[str, Differences]], fingers: tuple[str, ...]) -> None:
    rows = [(finger, name, k) for finger in range(len(fingers)) for k, (name, _) in enumerate(engines)]
    for y, (finger, _, k) in enumerate(rows):
        d = engines[k][1]
        flags = d.touch[:, finger]
        edges = np.flatnonzero(np.diff(np.concatenate(([0], flags.astype(np.int8), [0])))).reshape(-1, 2)
        dt = float(d.time[0])
        ax.broken_barh([(start * dt, (stop - start) * dt) for start, stop in edges], (y - 0.4, 0.8), color=COLORS[k % len(COLORS)])
        if k == 0:
            ax.axhline(y - 0.5, color="black", alpha=0.15, linewidth=0.8)
    middle = (len(engines) - 1) / 2
    ax.set_yticks([i * len(engines) + middle for i in range(len(fingers))], list(fingers))
    ax.set_ylim(len(rows) - 0.5, -0.5)
    ax.set_title(
        f"which fingers touch the object (in each, from above: {', '.join(name for name, _ in engines)})", loc="left", fontsize="medium"
    )
