"""The partings for a terminal and as a picture: differences over time, and which fingers touch in each engine."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.table import Table
from rich.text import Text

from xreset.eval.engines.divergence import Differences, Parting, first_of, runs
from xreset.eval.engines.replay import EngineTrace, TraceResult
from xreset.eval.plots import COLORS, picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_UNITS = {"rad": ("mrad", 1e3), "m": ("mm", 1e3), "N": ("N", 1.0), "fingers": ("fingers", 1.0)}
_NOISE = "#999999"


def shown(parting: Parting, value: float) -> str:
    """Return a difference in the unit in which it is read best, with two digits and without an exponent."""
    unit, scale = _UNITS[parting.unit]
    if parting.quantity == "object orientation":
        unit = "deg"
        scale = math.degrees(1.0)
    return f"{float(f'{value * scale:.2g}'):g} {unit}"


def rich_table(result: TraceResult) -> Table:
    """One column for each engine and one for the reference's noise; a row for each quantity."""
    reference = result.reference
    part = f"{result.actions.robot.name}: when, where and by how much engines part from {reference.name}"
    table = Table(title=f"{result.actions.label}\n{part}", title_justify="left", show_lines=True)
    table.add_column("")
    for e in result.engines:
        table.add_column(f"{e.name} {e.engine.version}")
    table.add_column(f"{reference.name}, {len(result.noise_differences)} starts moved by {result.perturbation:.0e}")
    table.add_row("object lifted by", *(_height(e.lifted) for e in result.engines), _height(reference.lifted))
    for i, noise in enumerate(result.noise):
        cells = []
        for e in result.engines:
            if e.partings:
                cells.append(_cell(result, e.partings[i], dim=result.within_noise(e.partings[i])))
            else:
                cells.append("-")
        quantity = f"{noise.quantity}\n(from {shown(noise, noise.threshold)})"
        table.add_row(quantity, *cells, _cell(result, noise, dim=False))
    return table


def sentences(result: TraceResult) -> Iterator[str]:
    """Yield one sentence for each engine: where it parts first."""
    for engine in result.engines:
        yield _sentence(result, engine)


def _sentence(result: TraceResult, engine: EngineTrace) -> str:
    time = engine.differences.time
    if len(time) < len(result.actions.joint_target):
        end = time[-1] if len(time) else 0.0
        return f"{engine.name} is no longer finite after {end:.3f} s, where the comparison ends."
    first = first_of([p for p in engine.partings if not result.within_noise(p)])
    if first is None:
        same = result.reference.name
        return f"{engine.name} stays with {same}: within the thresholds, or as near as {same} stays to itself."
    phase = result.actions.phase_at(first.time or 0.0)
    during = f" (during {phase!r})" if phase else ""
    where = f": {first.where}" if first.where else ""
    return f"{engine.name} parts first in {first.quantity} at {first.time:.3f} s{during}{where}."


def _cell(result: TraceResult, p: Parting, *, dim: bool) -> Text:
    lines = []
    if p.time is None:
        lines.append("never")
    else:
        phase = result.actions.phase_at(p.time)
        lines.append(f"{p.time:.3f} s, {phase}" if phase else f"{p.time:.3f} s")
        if p.where:
            lines.append(p.where)
    lines.append(f"end {shown(p, p.end)}")
    other = f" ({p.largest_where})" if p.largest_where and p.largest_where != p.where else ""
    lines.append(f"most {shown(p, p.largest)} at {p.largest_time:.2f} s{other}")
    if dim and p.time is not None:
        return Text("\n".join([*lines, "within noise"]), "dim")
    return Text("\n".join(lines))


def _height(metres: float) -> str:
    return f"{1e3 * metres:.0f} mm" if math.isfinite(metres) else "not finite"


def write_plot(path: Path, result: TraceResult) -> None:
    """Write the plot as PNG.

    Four rows of differences on logarithmic axes, with the thresholds (dashed) and the reference's distance to itself
    from perturbed starts (grey); then, for each engine, when each finger touches the object.
    """
    t = result.thresholds
    rows = (
        ("joint that differs most [mrad, mm]", lambda d: 1e3 * d.joint.max(axis=1), 1e3 * t.joint),
        ("object position [mm]", lambda d: 1e3 * d.position, 1e3 * t.position),
        ("object orientation [deg]", lambda d: np.degrees(d.angle), math.degrees(t.angle)),
        ("contact force [N]", lambda d: d.force.max(axis=1), t.force),
    )
    fingers = result.actions.robot.fingertip_names
    engines = (result.reference, *result.engines)
    heights = [1.7] * len(rows) + [0.35 + 0.13 * len(fingers) * len(engines)]
    with picture(path, (10, sum(heights) + 0.9), dpi=110, font_size=9) as figure:
        figure.suptitle(f"{result.actions.label}: distance to {result.reference.name}", fontweight="bold")
        axes = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights)
        for ax, (title, value, threshold) in zip(axes, rows, strict=False):
            _draw_differences(ax, result, value, threshold)
            ax.set_title(title, loc="left", fontsize="medium")
        _draw_touches(axes[-1], engines, fingers)
        axes[-1].set_xlabel("time [s]")
        for name, start in result.actions.phases:
            for ax in axes:
                ax.axvline(start, color="black", alpha=0.15, linewidth=0.8)
            top = axes[0].get_xaxis_transform()
            axes[0].annotate(name, (start, 1), xycoords=top, xytext=(2, -2), textcoords="offset points", va="top")
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=5, frameon=False)


def _draw_differences(ax: Axes, result: TraceResult, value, threshold: float) -> None:
    floor = 1e-4 * threshold

    def draw(d: Differences, **style) -> None:
        ax.plot(d.time, np.maximum(value(d), floor), **style)

    label = f"{result.reference.name}, start moved by {result.perturbation:.0e}"
    for d in result.noise_differences:
        draw(d, color=_NOISE, linewidth=0.7, label=label)
        label = None
    for i, engine in enumerate(result.engines, start=1):
        draw(engine.differences, color=COLORS[i % len(COLORS)], linewidth=1.3, label=engine.name)
    ax.axhline(threshold, color="black", linestyle="--", linewidth=0.8, label="threshold")
    ax.set_yscale("log")
    ax.set_ylim(bottom=floor)
    ax.grid(axis="y", alpha=0.2)


def _draw_touches(ax: Axes, engines: tuple[EngineTrace, ...], fingers: tuple[str, ...]) -> None:
    count = len(engines)
    for finger in range(len(fingers)):
        ax.axhline(finger * count - 0.5, color="black", alpha=0.15, linewidth=0.8)
        for k, engine in enumerate(engines):
            d = engine.differences
            dt = float(d.time[0])
            spans = [(start * dt, (stop - start) * dt) for start, stop in runs(d.touch[:, finger])]
            ax.broken_barh(spans, (finger * count + k - 0.4, 0.8), color=COLORS[k % len(COLORS)])
    ax.set_yticks([i * count + (count - 1) / 2 for i in range(len(fingers))], list(fingers))
    ax.set_ylim(len(fingers) * count - 0.5, -0.5)
    names = ", ".join(engine.name for engine in engines)
    ax.set_title(f"which fingers touch the object (in each, from above: {names})", loc="left", fontsize="medium")
