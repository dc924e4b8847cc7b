"""How far a training has come at each iteration, in iterations, environment steps or minutes; and the mean curve of several trainings.

Steps and minutes are sums of what every iteration logged: ``speed/collect_seconds`` + ``speed/learn_seconds``, and that times
``speed/env_steps_per_second``. So pauses between a run and its continuation do not count, nor iterations that were lost and done again,
nor the start-up before the first; steps are those of all processes. An iteration that was not logged counts as the next one that was.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from xreset.errors import RunError
from xreset.eval.report.read import Training

X = Literal["minutes", "steps", "iterations"]
"""What the horizontal axis of a learning curve may be."""
_SECONDS = ("speed/collect_seconds", "speed/learn_seconds")
_STEPS_PER_SECOND = "speed/env_steps_per_second"


@dataclass(frozen=True, kw_only=True)
class Line:
    """A learning curve of one training, or of several at once."""

    x: np.ndarray
    """[T] rising"""
    mean: np.ndarray
    """[T]"""
    low: np.ndarray
    """[T] the lowest training; that of a single one is its mean."""
    high: np.ndarray
    """[T] the highest."""


def amounts(training: Training, x: X) -> tuple[np.ndarray, np.ndarray]:
    """How much of ``x`` had been done after each iteration.

    Returns:
        Iterations [T] rising, and amounts [T]: iterations, environment steps, or minutes.

    Raises:
        RunError: the training did not log its speed.
    """
    if x == "iterations":
        iteration = np.unique(np.concatenate([curve.iteration for curve in training.scalars.values()]))
        return iteration, iteration.astype(float)
    missing = [tag for tag in (*_SECONDS, _STEPS_PER_SECOND) if tag not in training.scalars]
    if missing:
        raise RunError(
            f"{training.label} did not log {', '.join(missing)}, so {x} are not known. Choose --x iterations."
        )
    iteration = training.scalars[_SECONDS[0]].iteration
    seconds = sum(_at(training, tag, iteration) for tag in _SECONDS)
    each = seconds / 60 if x == "minutes" else seconds * _at(training, _STEPS_PER_SECOND, iteration)
    return iteration, np.cumsum(each * np.diff(iteration, prepend=0))


def processes(training: Training) -> int | None:
    """With how many processes it was trained, each with worlds of its own; None if that is not known."""
    try:
        iteration, steps = amounts(training, "steps")
        per_process = training.facts["num_envs"].value * training.facts["ppo.horizon"].value
    except (RunError, KeyError):
        return None
    return round(float(steps[-1]) / (float(iteration[-1]) * per_process))


def line(members: Sequence[Training], tag: str, x: X) -> Line | None:
    """The curve of one training; or mean, minimum and maximum of several, where all of them have it, straight between logged points.

    Those that have no such curve are left out; None if all have none.
    """
    found = []
    for training in members:
        if tag in training.scalars:
            curve, (iteration, amount) = training.scalars[tag], amounts(training, x)
            found.append((np.interp(curve.iteration, iteration, amount), curve.value))
    if not found:
        return None
    start, end = max(at[0] for at, _ in found), min(at[-1] for at, _ in found)
    at = max((at for at, _ in found), key=len)
    at = at[(at >= start) & (at <= end)] if len(found) > 1 else at
    values = np.stack([np.interp(at, own, value) for own, value in found])
    return Line(x=at, mean=values.mean(axis=0), low=values.min(axis=0), high=values.max(axis=0))


def _at(training: Training, tag: str, iteration: np.ndarray) -> np.ndarray:
    curve = training.scalars[tag]
    return np.interp(iteration, curve.iteration, curve.value)
