"""How surely and how soon trainings learn to lift: the share of runs whose success from home has passed a threshold by then.

A run that ended before it passed is watched until it ended, and says nothing of later (the product-limit estimate of Kaplan and Meier,
J. Am. Stat. Assoc. 53, 1958). Where no run ended early, the share is that of all runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from xreset.errors import RunError
from xreset.eval.report.groups import Group
from xreset.eval.report.progress import Line, X, amounts
from xreset.eval.report.read import Training
from xreset.eval.stats import wilson_ci95
from xreset.learning.clock import SHARES, Lift, Passing

CURVE = "task/success_from_home"
"""What the lift clock reads; from it the passings of runs without ``lift.json`` are taken."""
_FIELDS: dict[X, str] = {"minutes": "minutes", "steps": "env_steps", "iterations": "iteration"}
"""Horizontal axis -> field of :class:`xreset.learning.clock.Lift`."""


class Fate(NamedTuple):
    """What became of one run."""

    at: float
    """When it passed, or how far it came without: minutes, environment steps or iterations."""
    passed: bool
    end: float
    """How far it came."""


def lift_of(training: Training) -> Lift | None:
    """When a training passed which share: from its ``lift.json``, or from its learning curves; None if it has neither."""
    if training.lift is not None or CURVE not in training.scalars:
        return training.lift
    curve = training.scalars[CURVE]

    def until(x: X) -> np.ndarray:
        try:
            iteration, amount = amounts(training, x)
        except RunError:
            return np.full(len(curve.iteration), np.nan)
        return np.interp(curve.iteration, iteration, amount)

    minutes, steps = until("minutes"), np.nan_to_num(until("steps"))
    passed = []
    for share in SHARES:
        if (curve.value >= share).any():
            i = int(np.argmax(curve.value >= share))
            passed.append(
                Passing(
                    share=share, iteration=int(curve.iteration[i]), env_steps=round(steps[i]), minutes=float(minutes[i])
                )
            )
    return Lift(
        passed=tuple(passed), iteration=int(curve.iteration[-1]), env_steps=round(steps[-1]), minutes=float(minutes[-1]),
        success_from_home=float(curve.value[-1]),
    )  # fmt: skip


def fates(members: Sequence[Training], share: float, x: X) -> list[Fate]:
    """Of every training for which it is known, in their order."""
    found = []
    for lift in filter(None, map(lift_of, members)):
        passing = next((p for p in lift.passed if p.share == share), None)
        at, end = (float(getattr(source, _FIELDS[x])) for source in (passing or lift, lift))
        if end > 0:  # NaN and 0 where a training did not log its speed
            found.append(Fate(at, passing is not None, max(at, end)))
    return found


def share_of_runs(found: Sequence[Fate]) -> Line:
    """The share of runs that have passed, as steps: ``mean`` holds from each ``x`` to the next, from 0 to where the last run was watched.

    ``low`` and ``high`` are Wilson's 95 % interval of that share of as many runs as are known: those that have passed, and those that are
    still watched.
    """
    at, passed = np.array([fate.at for fate in found]), np.array([fate.passed for fate in found])
    times, left = np.unique(np.concatenate(([0.0], at))), 1.0
    rows = []
    for t in times:
        left *= 1.0 - (passed & (at == t)).sum() / max((at >= t).sum(), 1)
        known = int(((passed & (at <= t)) | (at >= t)).sum())
        rows.append((1.0 - left, *wilson_ci95((1.0 - left) * known, known)))
    end = max(fate.end for fate in found)
    if end > times[-1]:  # runs that went on after they had passed: nothing changes any more
        times, rows = np.append(times, end), [*rows, rows[-1]]
    mean, low, high = np.array(rows).T
    return Line(x=times, mean=mean, low=low, high=high)


def notes(groups: Sequence[Group]) -> tuple[str, ...]:
    """What a reader must know before believing the shares; nothing if no training tells when it lifted."""
    known = {m.label: lift_of(m) for group in groups for m in group.members if m.facts or m.scalars}
    if not any(known.values()):
        return ()
    found = []
    if derived := [m.label for g in groups for m in g.members if m.lift is None and known.get(m.label)]:
        found.append(f"No lift.json, so when they lifted is taken from the learning curves: {', '.join(derived)}.")
    if unknown := [label for label, lift in known.items() if lift is None]:
        found.append(
            f"When they lifted is not known, for they have neither lift.json nor the curve {CURVE}: {', '.join(unknown)}."
        )
    if single := [g.label for g in groups if len(g.members) == 1 and known.get(g.members[0].label)]:
        found.append(f"One run only, which says little about how surely another seed lifts: {', '.join(single)}.")
    return tuple(found)
