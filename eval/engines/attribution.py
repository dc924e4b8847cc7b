"""The experiment: a policy in engine A, in A with one property of B at a time, with all of these at once, and in B.

Every run plays the same episodes from the same starts, so runs are compared episode by episode.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from xreset.errors import XResetError
from xreset.eval.engines.alteration import (
    SOFTEST,
    Alteration,
    altered_engine,
    change_towards,
    has_contact_dial,
    no_contact_dial,
)
from xreset.eval.engines.measure import Measured, measure
from xreset.eval.policy_spec import PolicySpec
from xreset.eval.rollout import Episode, roll_out
from xreset.eval.sensitivity import COMPARED, Effect
from xreset.eval.trial import Engine, Trial

SCHEMA = "xreset-attribution/1"

Kind = Literal["as it is", "towards", "at most", "all", "what if", "other"]


@dataclass(frozen=True, kw_only=True)
class Row:
    """One run of the policy."""

    kind: Kind
    """``as it is``: A. ``towards``: one property changed to B's value. ``at most``: one property changed farther than
    that, because there is no finer dial. ``all``: all properties of kind ``towards``. ``what if``: a change of a usual
    size. ``other``: B.
    """
    name: str
    """Property, or engine."""
    alteration: Alteration
    episodes: tuple[Episode, ...]
    effect: Effect
    """Against A as it is."""

    def mean(self, metric: str) -> float:
        """Mean of one metric over the episodes."""
        return float(np.mean([float(getattr(e, metric)) for e in self.episodes]))


@dataclass(frozen=True, kw_only=True)
class Attribution:
    """The outcome of :func:`attribute`."""

    a: str
    b: str
    measured_a: Measured
    measured_b: Measured
    rows: tuple[Row, ...]
    """The first is A as it is, the last B."""
    skipped: dict[str, str]
    """Property that was not tried -> reason."""

    @property
    def gap(self) -> Effect:
        """The difference between B and A."""
        return self.rows[-1].effect

    def share(self, row: Row) -> float:
        """Return the share of the gap that a run brings about; NaN where A and B do not differ for sure."""
        return row.effect.difference / self.gap.difference if self.gap.is_certain else math.nan

    def costs(self) -> Row | None:
        """Return the property that brings about most of the gap when it is changed to B's value; None if none does for
        sure.

        A property whose cost is only a bound is named only where no other matters.
        """
        if not self.gap.is_certain:
            return None
        found = []
        for row in self.rows:
            if row.kind in ("towards", "at most") and row.effect.is_certain and self.share(row) > 0:
                found.append(row)
        return max(found, key=lambda row: (row.kind == "towards", self.share(row)), default=None)

    def as_dict(self) -> dict[str, Any]:
        """Return JSON-able content."""
        properties = []
        for name, compared in COMPARED.items():
            values = [getattr(m, compared.measured) * compared.scale for m in (self.measured_a, self.measured_b)]
            a, b = [float(f"{value:.6g}") if math.isfinite(value) else None for value in values]
            properties.append({"name": name, "unit": compared.shown_unit, "a": a, "b": b})
        costly = self.costs()
        return {
            "schema": SCHEMA,
            "a": self.a,
            "b": self.b,
            "episodes": len(self.rows[0].episodes),
            "properties": properties,
            "rows": [self._row(row) for row in self.rows],
            "skipped": [{"name": name, "reason": reason} for name, reason in self.skipped.items()],
            "costs_most": None if costly is None else costly.name,
        }

    def _row(self, row: Row) -> dict[str, Any]:
        share = self.share(row)
        effect = row.effect
        return {
            "kind": row.kind,
            "name": row.name,
            "alteration": asdict(row.alteration),
            "task_progress": _interval(effect.task_progress, effect.ci95),
            "approach_rate": round(row.mean("approach"), 6),
            "grasp_rate": round(row.mean("grasp"), 6),
            "reorient_rate": round(row.mean("reorient"), 6),
            "reorientation_progress": round(row.mean("reorientation_progress"), 6),
            "published_success_rate": row.effect.published_success,
            "difference": _interval(effect.difference, effect.difference_ci95),
            "share_of_gap": None if math.isnan(share) else round(share, 6),
            "health": {
                "nonfinite": sum(e.nonfinite for e in row.episodes),
                "overflow": sum(e.overflow for e in row.episodes),
                "out_of_bounds": sum(e.out_of_bounds for e in row.episodes),
            },
        }


def _interval(mean: float, ci95: tuple[float, float]) -> dict[str, Any]:
    return {"mean": round(mean, 6), "ci95": [round(x, 6) for x in ci95]}


def attribute(
    policy: PolicySpec,
    a: Engine,
    b: Engine,
    trial: Trial,
    *,
    episodes: int,
    sequences: np.ndarray | None = None,
    only: Sequence[str] = (),
    what_if: bool = False,
    progress: Callable[[str, int, int], None] = lambda run, done, total: None,
) -> Attribution:
    """Measure both engines, and play the policy in A, in A changed towards B, and in B.

    Args:
        policy: what plays.
        a: engine that is changed.
        b: engine towards which A is changed.
        trial: what is played; the mass and inertia of its first object are measured.
        episodes: episodes of each demonstration.
        sequences: indices of the demonstrations to play; None: all.
        only: names of the properties to try; empty: all.
        what_if: also try the properties in which A and B do not differ, with changes of a usual size.
        progress: called with (name of the run, control steps done, control steps in all).

    Raises:
        XResetError: a property is unknown, an engine cannot be measured, or the seed chose this checkpoint.
    """
    policy.check_seed(trial.seed)
    if unknown := sorted(set(only) - set(COMPARED)):
        raise XResetError(f"Unknown property {', '.join(unknown)}. Choose from: {', '.join(COMPARED)}.")
    scene = trial.nominal_scene
    progress(f"measuring {a.name}", 0, 0)
    measured_a = measure(a, scene)
    progress(f"measuring {b.name}", 0, 0)
    measured_b = measure(b, scene)
    rows: list[Row] = []

    def run(kind: Kind, name: str, engine: Engine, alteration: Alteration) -> None:
        label = name if kind in ("as it is", "other") else f"{a.name}, {kind} {name}"
        altered = altered_engine(engine, alteration)
        player = policy.start(trial.motion)
        played = roll_out(
            player, altered, trial, repetitions=episodes, only=sequences, progress=partial(progress, label)
        ).episodes
        nominal = rows[0].episodes if rows else played
        effect = Effect.of(played, nominal)
        rows.append(Row(kind=kind, name=name, alteration=alteration, episodes=played, effect=effect))

    run("as it is", a.name, a, Alteration())
    everything = Alteration()
    changed = 0
    skipped: dict[str, str] = {}
    for name, compared in COMPARED.items():
        if only and name not in only:
            skipped[name] = "not asked for"
            continue
        change = change_towards(name, measured_a, measured_b, a.name, scene)
        if isinstance(change, Alteration):
            run("at most" if compared.at_most else "towards", name, a, change)
            if not compared.at_most:
                everything = everything.and_(change)
                changed += 1
            continue
        skipped[name] = change
        for usual in compared.what_if if what_if else ():
            if compared.altered == "contact_time" and not has_contact_dial(a.name):
                skipped[f"{name}, what if"] = no_contact_dial(a.name)
            else:
                run("what if", name, a, Alteration(**{compared.altered: usual}))  # pyright: ignore[reportArgumentType]
    if changed > 1:
        if has_contact_dial(
            a.name
        ):  # changes that each fit may together ask for stiffer contacts than the engine allows
            everything = replace(everything, contact_time=max(everything.contact_time, SOFTEST))
        run("all", f"all {changed} at once", a, everything)
    run("other", b.name, b, Alteration())
    return Attribution(
        a=a.name, b=b.name, measured_a=measured_a, measured_b=measured_b, rows=tuple(rows), skipped=skipped
    )
