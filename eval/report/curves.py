"""Progress of trainings: how far they had come at each iteration, and their mean curves.

Steps and minutes are sums of what every iteration logged: ``speed/collect_seconds`` + ``speed/learn_seconds``, and
these times ``speed/env_steps_per_second``. Not counted are pauses between a run and its continuation, iterations that
were lost and done again, and the time before the first iteration; steps are summed over all processes. An iteration
without a log counts like the next one with a log.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import pandas as pd

from xreset.errors import RunError
from xreset.eval.report.read import Training
from xreset.eval.results import Table

X = Literal["minutes", "steps", "iterations"]
"""Horizontal axis of a learning curve."""
AXES: dict[X, tuple[str, int, str, float]] = {
    "minutes": ("minutes of training", 1, "minutes", 1.0),
    "steps": ("million environment steps", 1, "env_steps", 1e-6),
    "iterations": ("iterations of training", 0, "iteration", 1.0),
}
"""Label of an axis, digits in tables, field of :class:`~xreset.learning.clock.Lift`, and factor to the axis's unit."""
_SPEED = ["speed/collect_seconds", "speed/learn_seconds", "speed/env_steps_per_second"]


def amounts(training: Training, x: X) -> Table:
    """Return how much of ``x`` had been done after each iteration, in the unit of :data:`AXES`, with the iteration as
    index, rising.

    Raises:
        RunError: the training did not log its speed.
    """
    curves = training.curves
    if x == "iterations":
        return pd.Series(curves.index.to_numpy(float), index=curves.index)
    missing = [tag for tag in _SPEED if tag not in curves]
    if missing:
        raise RunError(
            f"{training.label} did not log {', '.join(missing)}, so {x} are not known. Choose --x iterations."
        )
    speed = curves[_SPEED].dropna()
    seconds = speed[_SPEED[0]] + speed[_SPEED[1]]
    each = seconds / 60 if x == "minutes" else seconds * speed[_SPEED[2]] * 1e-6
    return (each * np.diff(speed.index, prepend=0)).cumsum()


def line(members: Sequence[Training], tag: str, x: X) -> Table | None:
    """Return the curve of one training; or mean, minimum and maximum of several, where all of them have logged.

    Trainings without such a curve are left out; None if no training has one.

    Returns:
        Columns mean, low and high; the index is the amount of ``x``, rising.
    """
    curves = []
    for training in members:
        values = training.curves.get(tag, pd.Series()).dropna()
        if len(values):  # a training that broke down logs no number
            done = amounts(training, x)
            curves.append((np.interp(values.index, done.index, done), values))
    if not curves:
        return None
    at = max((own for own, _ in curves), key=len)
    start = max(own[0] for own, _ in curves)
    end = min(own[-1] for own, _ in curves)
    at = at[(at >= start) & (at <= end)]
    values = np.stack([np.interp(at, own, value) for own, value in curves])
    return pd.DataFrame(
        {"mean": values.mean(axis=0), "low": values.min(axis=0), "high": values.max(axis=0)},
        index=at,
    )
