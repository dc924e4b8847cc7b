"""Settings that change during a run."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Any, ClassVar

import numpy as np

from xreset.checks import Checked, Rule

Points = tuple[tuple[float, float], ...]
"""Pairs of a share of the run, from 0 to 1, and the value there; straight lines between them. Empty: no schedule."""


def is_schedule(points: Points) -> bool:
    """Whether the shares rise from 0 or more to 1 or less, and all values lie between 0 and 1."""
    shares = [share for share, _ in points]
    rising = all(earlier < later for earlier, later in pairwise(shares))
    return rising and all(0 <= share <= 1 and 0 <= value <= 1 for share, value in points)


ShareSchedule = Annotated[
    Points,
    Rule(
        "pairs of a share of the run and a value, all from 0 to 1, each share greater than the one before", is_schedule
    ),
]


@dataclass(frozen=True, kw_only=True)
class ScheduleConfig(Checked):
    """Settings that change during a run.

    A schedule is a list of points: a share of the run and the setting's value there, such as ``0 0.9 1 0.25``. Values
    between two points lie on a straight line. The share of the run counts iterations, or minutes if the run is limited
    to some and more of them have passed.
    """

    REMOVED: ClassVar[dict[str, Any]] = {"demo_probability": []}

    teacher: ShareSchedule = ()
    """Share of the worlds in which the teacher acts during a distillation. Empty: none."""
    success_position: ShareSchedule = ()
    """Replaces ``task.reward.success_position`` [m], such as ``0 0.05 1 0.01``: what counts as success becomes
    stricter. Evaluations keep their own limits."""
    faults: ShareSchedule = ()
    """Factor on the faults of a real loop, such as ``0 0 0.5 1``: all delays, lost actions, errors and losses of the
    tracker (not its interval), and the probability of pushes of ``task.randomization``. An episode keeps the delays,
    the biases and the probabilities that it began with."""


def value_at(points: Points, progress: float) -> float:
    """Return the value of a schedule at a share of the run."""
    shares, values = zip(*points, strict=True)
    return float(np.interp(progress, shares, values))
