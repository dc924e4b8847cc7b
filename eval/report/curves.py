"""Learning curves: the amount of training at each iteration, and the mean curves of several trainings.

The seconds of an iteration are its logged ``speed/collect_seconds`` + ``speed/learn_seconds``, and its steps are these
seconds times ``speed/env_steps_per_second``, over all processes. Pauses before a run is continued, iterations that were
lost and repeated, and the time before the first iteration do not count. An iteration without a log counts like the
next one with a log.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from xreset.errors import RunError
from xreset.eval.report import X
from xreset.eval.report.read import Training
from xreset.eval.results import Table

AXES: dict[X, tuple[str, int, str, float]] = {
    "minutes": ("minutes of training", 1, "minutes", 1.0),
    "steps": ("million environment steps", 1, "env_steps", 1e-6),
    "iterations": ("iterations of training", 0, "iteration", 1.0),
}
"""Label of an axis, digits in tables, field of :class:`~xreset.learning.clock.Lift`, and factor to the axis's unit."""
_SPEED = ["speed/collect_seconds", "speed/learn_seconds", "speed/env_steps_per_second"]


def amounts(training: Training, x: X) -> Table:
    """Return the amount of ``x`` after each iteration, in the unit of :data:`AXES`; the index is the iteration, rising.

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
    """Return the curve of one training; or mean, minimum and maximum of several, in the range that all have logged.

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
