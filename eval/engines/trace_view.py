"""A comparison of replays for a terminal."""

from __future__ import annotations

import math
from collections.abc import Iterator

from rich.table import Table
from rich.text import Text

from xreset.eval.engines.replay import (
    PERTURBATION,
    THRESHOLDS,
    Divergence,
    EngineTrace,
    TraceResult,
)

_SHOWN = {
    "joints": ("mrad", 1e3),
    "object position": ("mm", 1e3),
    "object orientation": ("deg", math.degrees(1.0)),
    "contacts": ("fingers", 1.0),
    "contact force": ("N", 1.0),
}
"""Unit in which a quantity reads best, and the factor to it."""


def shown(quantity: str, value: float) -> str:
    """Return a difference in the unit in which it reads best, with two digits and without an exponent."""
    unit, scale = _SHOWN[quantity]
    return f"{float(f'{value * scale:.2g}'):g} {unit}"


def rich_table(result: TraceResult) -> Table:
    """One column for each engine and one for the reference's noise; a row for each quantity."""
    reference = result.reference.engine.name
    title = f"{result.actions.label}\n{result.actions.robot.name}: when, where and by how much engines diverge"
    table = Table("", title=f"{title} from {reference}", title_justify="left", show_lines=True)
    for e in result.engines:
        table.add_column(f"{e.engine.name} {e.engine.version}")
    table.add_column(f"{reference}, {len(result.noise)} starts moved by {PERTURBATION:.0e}")
    table.add_row("object lifted by", *map(_height, (*result.engines, result.reference)))
    for i, noise in enumerate(result.worst_noise):
        cells = []
        for e in result.engines:
            found = e.divergences[i] if e.divergences else None
            cells.append(_cell(found, result.within_noise(found)) if found else "-")
        quantity = f"{noise.quantity}\n(from {shown(noise.quantity, THRESHOLDS[noise.quantity])})"
        table.add_row(quantity, *cells, _cell(noise, False))
    return table


def _cell(found: Divergence, noise: bool) -> Text:
    lines = ["never"]
    if found.time is not None:
        lines = [f"{found.time:.3f} s"]
        if noise:
            lines.append("within noise")
    if found.where:
        lines.append(found.where)
    lines += [
        f"end {shown(found.quantity, found.end)}",
        f"most {shown(found.quantity, found.largest)}",
    ]
    return Text("\n".join(lines), "dim" if noise and found.time is not None else "")


def _height(engine: EngineTrace) -> str:
    return "not finite" if engine.lifted is None else f"{1e3 * engine.lifted:.0f} mm"


def sentences(result: TraceResult) -> Iterator[str]:
    """Yield one sentence for each engine: where it diverges first."""
    same = result.reference.engine.name
    for traced in result.engines:
        name = traced.engine.name
        beyond = [d for d in traced.divergences if d.time and not result.within_noise(d)]
        if traced.steps < len(result.actions.joint_target):
            end = traced.steps * result.actions.scene.control_dt
            yield f"{name} is no longer finite after {end:.3f} s, where the comparison ends."
        elif not beyond:
            yield f"{name} stays with {same}: within the thresholds, or as near as {same} stays to itself."
        else:
            first = min(beyond, key=lambda d: d.time or 0.0)
            where = f": {first.where}" if first.where else ""
            yield f"{name} diverges first in {first.quantity} at {first.time:.3f} s{where}."
