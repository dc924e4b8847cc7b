"""The partings for a terminal: quantities by engine."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

from xreset.eval.engines.divergence import Parting, first_of
from xreset.eval.engines.replay import EngineTrace, TraceResult

if TYPE_CHECKING:
    from rich.table import Table
    from rich.text import Text

_SHOWN = {"rad": ("mrad", 1e3), "m": ("mm", 1e3), "N": ("N", 1.0), "fingers": ("fingers", 1.0)}


def shown(parting: Parting, value: float) -> str:
    """A difference in the unit in which it is read best."""
    unit, scale = ("deg", math.degrees(1.0)) if parting.quantity == "object orientation" else _SHOWN[parting.unit]
    return f"{float(f'{value * scale:.2g}'):g} {unit}"  # two digits, without an exponent


def rich_table(result: TraceResult) -> Table:
    """One column per engine and one for the reference's own noise; per quantity when and where it parts, and by how much."""
    from rich.table import Table

    reference = result.reference
    title = f"{result.actions.label}\n{result.actions.robot.name}: when, where and by how much engines part from {reference.name}"
    table = Table(title=title, title_justify="left", show_lines=True)
    table.add_column("")
    for engine in result.engines:
        table.add_column(f"{engine.name} {engine.version}")
    table.add_column(f"{reference.name}, {len(result.noise_differences)} starts moved by {result.perturbation:.0e}")
    table.add_row("object lifted by", *(_height(e.lifted) for e in result.engines), _height(reference.lifted))
    for i, noise in enumerate(result.noise):
        cells = [_cell(result, e.partings[i], dim=result.within_noise(e.partings[i])) if e.partings else "-" for e in result.engines]
        table.add_row(f"{noise.quantity}\n(from {shown(noise, noise.threshold)})", *cells, _cell(result, noise, dim=False))
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
    from rich.text import Text

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
