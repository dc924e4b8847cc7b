"""Progress of trainings: how far they had come at each iteration, their mean curves, and when they first succeeded from
home.

Steps and minutes are sums of what every iteration logged: ``speed/collect_seconds`` + ``speed/learn_seconds``, and
these times ``speed/env_steps_per_second``. Not counted are pauses between a run and its continuation, iterations that
were lost and done again, and the time before the first iteration; steps are summed over all processes. An iteration
without a log counts like the next one with a log.

The share of runs that have passed a threshold is the product-limit estimate of Kaplan and Meier (J. Am. Stat. Assoc.
53, 1958): a run that ended before it passed counts until its end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from xreset.errors import RunError
from xreset.eval.report.read import Training
from xreset.eval.stats import wilson_ci95

X = Literal["minutes", "steps", "iterations"]
"""Horizontal axis of a learning curve."""
_SECONDS = ("speed/collect_seconds", "speed/learn_seconds")
_STEPS_PER_SECOND = "speed/env_steps_per_second"
_LIFT_FIELDS: dict[X, str] = {"minutes": "minutes", "steps": "env_steps", "iterations": "iteration"}


@dataclass(frozen=True, kw_only=True)
class Line:
    """A learning curve of one training, or of several trainings together."""

    x: np.ndarray
    """[T] rising"""
    mean: np.ndarray
    """[T]"""
    low: np.ndarray
    """[T] the lowest training; equal to the mean for a single training."""
    high: np.ndarray
    """[T] the highest training."""


def amounts(training: Training, x: X) -> tuple[np.ndarray, np.ndarray]:
    """Return how much of ``x`` had been done after each iteration.

    Returns:
        Iterations [T] rising, and amounts [T]: iterations, environment steps, or minutes.

    Raises:
        RunError: the training did not log its speed.
    """
    scalars = training.scalars
    if x == "iterations":
        iteration = np.unique(np.concatenate([curve.iteration for curve in scalars.values()]))
        return iteration, iteration.astype(float)
    missing = [tag for tag in (*_SECONDS, _STEPS_PER_SECOND) if tag not in scalars]
    if missing:
        raise RunError(
            f"{training.label} did not log {', '.join(missing)}, so {x} are not known. Choose --x iterations."
        )
    iteration = scalars[_SECONDS[0]].iteration

    def logged(tag: str) -> np.ndarray:
        return np.interp(iteration, scalars[tag].iteration, scalars[tag].value)

    seconds = sum(logged(tag) for tag in _SECONDS)
    each = seconds / 60 if x == "minutes" else seconds * logged(_STEPS_PER_SECOND)
    return iteration, np.cumsum(each * np.diff(iteration, prepend=0))


def line(members: Sequence[Training], tag: str, x: X) -> Line | None:
    """Return the curve of one training; or mean, minimum and maximum of several, where all of them have logged.

    Trainings without such a curve are left out; None if no training has one.
    """
    curves = []
    for training in members:
        if tag in training.scalars:
            curve = training.scalars[tag]
            curves.append((np.interp(curve.iteration, *amounts(training, x)), curve.value))
    if not curves:
        return None
    at = max((own for own, _ in curves), key=len)
    if len(curves) > 1:
        start = max(own[0] for own, _ in curves)
        end = min(own[-1] for own, _ in curves)
        at = at[(at >= start) & (at <= end)]
    values = np.stack([np.interp(at, own, value) for own, value in curves])
    return Line(x=at, mean=values.mean(axis=0), low=values.min(axis=0), high=values.max(axis=0))


# First success from home ----------------------------------------------------------------------------------------------


class Fate(NamedTuple):
    """Whether and when one run passed a threshold."""

    at: float
    """When the run passed, or how far it came without: minutes, environment steps or iterations."""
    passed: bool
    end: float
    """How far the run came."""


def fates(members: Sequence[Training], share: float, x: X) -> list[Fate]:
    """Return the fates of the trainings that have a lift clock, in their order."""
    field = _LIFT_FIELDS[x]
    found = []
    for training in members:
        end = float(getattr(training.lift, field, 0))
        passed = training.lift.passed if training.lift else ()
        at = [float(getattr(passing, field)) for passing in passed if passing.share == share]
        if end > 0:  # 0: no iteration is done
            found.append(Fate(at[0] if at else end, bool(at), max([end, *at])))
    return found


def share_of_runs(found: Sequence[Fate]) -> Line:
    """Return the share of runs that have passed, as steps from 0 to the end of the last run: ``mean`` holds until the
    next ``x``.

    ``low`` and ``high`` are Wilson's 95 % interval of the share. It counts the runs whose fate is known: those that
    have passed, and those that have not ended.
    """
    at = np.array([fate.at for fate in found])
    passed = np.array([fate.passed for fate in found])
    times = np.unique(np.append(at, 0.0))
    remaining = 1.0
    rows = []
    for t in times:
        remaining *= 1.0 - (passed & (at == t)).sum() / max((at >= t).sum(), 1)
        known = int(((passed & (at <= t)) | (at >= t)).sum())
        rows.append((1.0 - remaining, *wilson_ci95((1.0 - remaining) * known, known)))
    end = max(fate.end for fate in found)
    if end > times[-1]:  # the last value holds for runs that continued after they had passed
        times = np.append(times, end)
        rows.append(rows[-1])
    mean, low, high = np.array(rows).T
    return Line(x=times, mean=mean, low=low, high=high)
