"""The experiment: a policy in engine A, in A with one property of B at a time, with all of them at once, and in B.

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
from xreset.eval.engines.measure import Measured, measure
from xreset.eval.engines.perturb import Alteration, altered_engine, contact_dial, no_contact_dial
from xreset.eval.engines.properties import PROPERTIES
from xreset.eval.rollout import Episode, roll_out
from xreset.eval.stats import bootstrap_ci95
from xreset.eval.trial import Engine, Trial
from xreset.policy import Policy

SCHEMA = "xreset-attribution/1"

Kind = Literal["as it is", "towards", "at most", "all", "what if", "other"]


@dataclass(frozen=True, kw_only=True)
class Row:
    """One run of the policy."""

    kind: Kind
    """A as it is; with one property changed towards B; with one changed farther than that, for want of a finer dial; with all
    of the former; with a change of a usual size; B as it is."""
    name: str
    """Property, or engine."""
    alteration: Alteration
    episodes: tuple[Episode, ...]

    def score(self, name: str = "task_progress") -> np.ndarray:
        """[E] one number per episode."""
        return np.array([float(getattr(e, name)) for e in self.episodes])

    @property
    def sequences(self) -> np.ndarray:
        """[E] demonstration of each episode."""
        return np.array([e.sequence for e in self.episodes])


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
    """Property that was not tried -> why."""

    def difference(self, row: Row, score: str = "task_progress") -> tuple[float, tuple[float, float]]:
        """How much a run differs from A as it is: mean over the episodes, and its 95 % interval (whole demonstrations are drawn)."""
        d = row.score(score) - self.rows[0].score(score)
        return float(d.mean()), bootstrap_ci95(d, row.sequences)

    def matters(self, row: Row) -> bool:
        """Whether the interval of the difference leaves out zero."""
        _, (low, high) = self.difference(row)
        return low > 0 or high < 0

    def share(self, row: Row) -> float:
        """Which share of the difference between A and B a run brings about; NaN where A and B do not differ for sure."""
        whole, _ = self.difference(self.rows[-1])
        return self.difference(row)[0] / whole if self.matters(self.rows[-1]) else math.nan

    def costs(self) -> Row | None:
        """The property that, changed towards B, brings about most of the difference, of those that matter; None if there is none.

        One whose cost is but a bound is named only where no other matters.
        """
        if not self.matters(self.rows[-1]):
            return None
        found = [
            row for row in self.rows if row.kind in ("towards", "at most") and self.matters(row) and self.share(row) > 0
        ]
        return max(found, key=lambda row: (row.kind == "towards", self.share(row)), default=None)

    def as_dict(self) -> dict[str, Any]:
        """JSON-able content."""

        def row(r: Row) -> dict[str, Any]:
            d, interval = self.difference(r)
            share = self.share(r)
            low, high = bootstrap_ci95(r.score(), r.sequences)
            return {
                "kind": r.kind,
                "name": r.name,
                "alteration": asdict(r.alteration),
                "task_progress": {"mean": _round(r.score().mean()), "ci95": [_round(low), _round(high)]},
                "approach_rate": _round(r.score("approach").mean()),
                "grasp_rate": _round(r.score("grasp").mean()),
                "reorient_rate": _round(r.score("reorient").mean()),
                "reorientation_progress": _round(r.score("reorientation_progress").mean()),
                "difference": {"mean": _round(d), "ci95": [_round(x) for x in interval]},
                "share_of_gap": None if math.isnan(share) else _round(share),
                "health": {
                    name: sum(getattr(e, name) for e in r.episodes)
                    for name in ("nonfinite", "overflow", "out_of_bounds")
                },
            }

        found = self.costs()
        return {
            "schema": SCHEMA,
            "a": self.a,
            "b": self.b,
            "episodes": len(self.rows[0].episodes),
            "properties": [
                {
                    "name": p.name,
                    "unit": p.unit,
                    "a": _number(p.value(self.measured_a) * p.scale),
                    "b": _number(p.value(self.measured_b) * p.scale),
                }
                for p in PROPERTIES
            ],
            "rows": [row(r) for r in self.rows],
            "skipped": [{"name": name, "reason": reason} for name, reason in self.skipped.items()],
            "costs_most": None if found is None else found.name,
        }


def attribute(
    policy: Callable[[], Policy],
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
        policy: makes the policy, a fresh one for each run.
        a: engine that is changed.
        b: engine towards which it is.
        trial: what is played; the first object's mass and inertia are measured.
        episodes: per demonstration.
        sequences: indices of the demonstrations to play; None: all.
        only: names of the properties to try; empty: all.
        what_if: also try the properties in which A and B do not differ, with changes of a usual size.
        progress: called with (name of the run, control steps done, control steps in all).

    Raises:
        XResetError: there is no such property, or an engine cannot be measured.
    """
    known = [p.name for p in PROPERTIES]
    if unknown := sorted(set(only) - set(known)):
        raise XResetError(f"there is no property {', '.join(unknown)}; there are {', '.join(known)}.")
    scene = trial.nominal_scene
    progress(f"measuring {a.name}", 0, 0)
    measured_a = measure(a, scene)
    progress(f"measuring {b.name}", 0, 0)
    measured_b = measure(b, scene)

    def run(kind: Kind, name: str, engine: Engine, alteration: Alteration) -> Row:
        label = name if kind in ("as it is", "other") else f"{a.name}, {kind} {name}"
        altered = altered_engine(engine, alteration)
        rollouts = roll_out(
            policy(), altered, trial, repetitions=episodes, only=sequences, progress=partial(progress, label)
        )
        return Row(kind=kind, name=name, alteration=alteration, episodes=rollouts.episodes)

    rows, everything, changed = [run("as it is", a.name, a, Alteration())], Alteration(), 0
    skipped: dict[str, str] = {}
    for p in PROPERTIES:
        if only and p.name not in only:
            skipped[p.name] = "not asked for"
            continue
        change = p.change(measured_a, measured_b, a.name, scene)
        if isinstance(change, Alteration):
            rows.append(run("at most" if p.at_most else "towards", p.name, a, change))
            if not p.at_most:
                everything, changed = everything.and_(change), changed + 1
            continue
        skipped[p.name] = change
        for usual in p.what_if if what_if else ():
            if usual.contact_time != 1.0 and contact_dial(a.name) is None:
                skipped[f"{p.name}, what if"] = no_contact_dial(a.name)
            else:
                rows.append(run("what if", p.name, a, usual))
    if changed > 1:
        rows.append(run("all", f"all {changed} at once", a, _allowed(everything, a)))
    rows.append(run("other", b.name, b, Alteration()))
    return Attribution(
        a=a.name, b=b.name, measured_a=measured_a, measured_b=measured_b, rows=tuple(rows), skipped=skipped
    )


def _allowed(alteration: Alteration, engine: Engine) -> Alteration:
    """Changes that each fit may together ask for stiffer contacts than the engine allows: then as stiff as it does."""
    dial = contact_dial(engine.name)
    return alteration if dial is None else replace(alteration, contact_time=max(alteration.contact_time, dial.smallest))


def _round(value: float) -> float:
    return round(float(value), 6)


def _number(value: float) -> float | None:
    return float(f"{value:.6g}") if math.isfinite(value) else None
