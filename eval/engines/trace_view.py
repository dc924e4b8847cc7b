"""The partings for a terminal, and as a picture: differences to the reference over time, and which fingers touch in each engine."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.table import Table
from rich.text import Text

from xreset.eval.engines.divergence import Differences, Parting, first_of
from xreset.eval.engines.replay import EngineTrace, TraceResult
from xreset.eval.plots import COLORS, picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SHOWN = {"rad": ("mrad", 1e3), "m": ("mm", 1e3), "N": ("N", 1.0), "fingers": ("fingers", 1.0)}


def shown(parting: Parting, value: float) -> str:
    """A difference in the unit in which it is read best."""
    unit, scale = ("deg", math.degrees(1.0)) if parting.quantity == "object orientation" else _SHOWN[parting.unit]
    return f"{float(f'{value * scale:.2g}'):g} {unit}"  # two digits, without an exponent


def rich_table(result: TraceResult) -> Table:
    """One column per engine and one for the reference's own noise; per quantity when and where it parts, and by how much."""
    reference = result.reference
    title = f"{result.actions.label}\n{result.actions.robot.name}: when, where and by how much engines part from {reference.name}"
    table = Table(title=title, title_justify="left", show_lines=True)
    table.add_column("")
    for engine in result.engines:
        table.add_column(f"{engine.name} {engine.version}")
    table.add_column(f"{reference.name}, {len(result.noise_differences)} starts moved by {result.perturbation:.0e}")
    table.add_row("object lifted by", *(_height(e.lifted) for e in result.engines), _height(reference.lifted))
    for i, noise in enumerate(result.noise):
        cells = [
            _cell(result, e.partings[i], dim=result.within_noise(e.partings[i])) if e.partings else "-"
            for e in result.engines
        ]
        table.add_row(
            f"{noise.quantity}\n(from {shown(noise, noise.threshold)})", *cells, _cell(result, noise, dim=False)
        )
    return table


def sentences(result: TraceResult) -> Iterator[str]:
    """What each engine's partings come to, a sentence each."""
    for engine in result.engines:
        yield _sentence(result, engine)


def _sentence(result: TraceResult, engine: EngineTrace) -> str:
    total = len(result.actions.joint_target)
    if len(engine.differences.time) < total:
        end = engine.differences.time[-1] if len(engine.differences.time) else 0.0
        return f"{engine.name} is no longer finite after {end:.3f} s; what is said of it ends there."
    first = first_of([p for p in engine.partings if not result.within_noise(p)])
    if first is None:
        same = result.reference.name
        return f"{engine.name} stays with {same}: within the thresholds, or as near as {same} stays to itself."
    phase = result.actions.phase_at(first.time or 0.0)
    during = f" (during {phase!r})" if phase else ""
    where = f": {first.where}" if first.where else ""
    return f"{engine.name} parts first in {first.quantity} at {first.time:.3f} s{during}{where}."


def _cell(result: TraceResult, p: Parting, *, dim: bool) -> Text:
    if p.time is None:
        first = "never"
    else:
        phase = result.actions.phase_at(p.time)
        first = f"{p.time:.3f} s" + (f", {phase}" if phase else "")
        first += f"\n{p.where}" if p.where else ""
    most = f"most {shown(p, p.largest)} at {p.largest_time:.2f} s"
    if p.largest_where and p.largest_where != p.where:
        most += f" ({p.largest_where})"
    text = f"{first}\nend {shown(p, p.end)}\n{most}"
    return Text(f"{text}\nwithin noise", "dim") if dim and p.time is not None else Text(text)


def _height(metres: float) -> str:
    return f"{1e3 * metres:.0f} mm" if math.isfinite(metres) else "not finite"


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
    with picture(path, (10, sum(heights) + 0.9), dpi=110, font_size=9) as figure:
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
                    ax.annotate(
                        name,
                        (start, 1),
                        xycoords=("data", "axes fraction"),
                        xytext=(2, -2),
                        textcoords="offset points",
                        va="top",
                    )
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=5, frameon=False)


def _draw_differences(ax: Axes, result: TraceResult, value, threshold: float) -> None:
    floor = 1e-4 * threshold

    def draw(d: Differences, **style) -> None:
        ax.plot(d.time, np.maximum(value(d), floor), **style)

    for i, d in enumerate(result.noise_differences):
        draw(
            d,
            color=_NOISE,
            linewidth=0.7,
            label=f"{result.reference.name}, start moved by {result.perturbation:.0e}" if i == 0 else None,
        )
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
        ax.broken_barh(
            [(start * dt, (stop - start) * dt) for start, stop in edges], (y - 0.4, 0.8), color=COLORS[k % len(COLORS)]
        )
        if k == 0:
            ax.axhline(y - 0.5, color="black", alpha=0.15, linewidth=0.8)
    middle = (len(engines) - 1) / 2
    ax.set_yticks([i * len(engines) + middle for i in range(len(fingers))], list(fingers))
    ax.set_ylim(len(rows) - 0.5, -0.5)
    ax.set_title(
        f"which fingers touch the object (in each, from above: {', '.join(name for name, _ in engines)})",
        loc="left",
        fontsize="medium",
    )
