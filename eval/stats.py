"""Means of the metrics of episodes, their differences, and confidence intervals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from xreset.eval.metrics import METRICS

if TYPE_CHECKING:
    Table = Any  # pandas' own types do not tell the rows of a table from one of its columns
else:
    Table = pd.DataFrame

Interval = tuple[float, float]
"""Lower and upper end of a 95 % interval."""
DRAWS = 2000
"""Resamples of a bootstrap."""
_Z = 1.959963984540054
"""Half width of a 95 % interval of the normal distribution, in standard deviations."""


def mean(episodes: Table, metric: str) -> float:
    """Return the mean of one metric over episodes, rounded to six digits; NaN if it was not measured in all of them."""
    return round(float(episodes[metric].to_numpy(float).mean()), 6)


def ci95(episodes: Table, metric: str) -> Interval:
    """Return the 95 % interval of the mean over demonstrations; and over trainings, if the table is of several
    (:func:`share_ci95`)."""
    interval = share_ci95 if METRICS[metric].unit == "%" else crossed_bootstrap_ci95
    return interval(*crossed(episodes, metric))


def difference(one: Table, other: Table, metric: str) -> tuple[float, float, float]:
    """Return the mean of a metric in ``other`` minus that in ``one``, and the lower and upper end of its 95 % interval
    (:func:`difference_ci95`). Both have episodes on the same demonstrations."""
    interval = difference_ci95(crossed(one, metric), crossed(other, metric))
    return mean(other, metric) - mean(one, metric), *interval


def crossed(episodes: Table, metric: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the metric, the index of the training and the demonstration of each episode, [E] each."""
    runs = np.zeros(len(episodes), int)
    if "run" in episodes:
        runs = pd.factorize(episodes["run"])[0]
    return episodes[metric].to_numpy(float), runs, episodes["sequence"].to_numpy()


def share_ci95(values: np.ndarray, runs: np.ndarray, groups: np.ndarray) -> Interval:
    """Return a 95 % interval of the mean of values in [0, 1]: :func:`crossed_bootstrap_ci95`, which is a point where
    all groups have the same mean. Wilson's interval for as many trials as there are groups takes its place there, so
    that four successes of four do not look certain.
    """
    low, high = crossed_bootstrap_ci95(values, runs, groups)
    if high - low > 1e-9 or not 0 <= low <= high <= 1:
        return low, high
    count = _independent(values, groups)
    share = min((low + high) / 2, 1.0)
    shrunk = 1 + _Z**2 / count
    center = (share + _Z**2 / (2 * count)) / shrunk
    half = _Z / shrunk * np.sqrt(share * (1 - share) / count + _Z**2 / (4 * count**2))
    return max(0.0, float(center - half)), min(1.0, float(center + half))


def _independent(values: np.ndarray, groups: np.ndarray) -> int:
    """Return the number of demonstrations; that of episodes with a single one."""
    count = len(np.unique(groups))
    return count if count > 1 else len(values)


def bootstrap_ci95(values: np.ndarray, groups: np.ndarray) -> Interval:
    """Return the 95 % percentile bootstrap interval of the mean. The same values give the same interval.

    Args:
        values: [E] one value per episode.
        groups: [E] demonstration of each episode. Episodes of one demonstration resemble one another, so whole
            demonstrations are drawn (cluster bootstrap); with a single one, episodes are drawn.
    """
    values = np.asarray(values, dtype=float)
    if len(values) < 2:
        return float(values.mean()), float(values.mean())
    rng = np.random.default_rng(0)
    if len(np.unique(groups)) < 2:
        groups = np.arange(len(values))
    _, number = np.unique(groups, return_inverse=True)
    sums = np.bincount(number, values)
    counts = np.bincount(number)
    picks = rng.integers(len(sums), size=(DRAWS, len(sums)))
    return _interval(sums[picks].sum(axis=1) / counts[picks].sum(axis=1))


def crossed_bootstrap_ci95(values: np.ndarray, runs: np.ndarray, groups: np.ndarray) -> Interval:
    """Return the 95 % percentile bootstrap interval of the mean over trainings that were evaluated on the same
    demonstrations.

    Trainings and demonstrations are drawn with replacement, independently of each other. The weight of an episode is
    the number of draws of its training times the number of draws of its demonstration (the "pigeonhole bootstrap" of
    Owen, Annals of Applied Statistics 1, 2007). The interval thus covers other training seeds and other demonstrations.
    It is too narrow for few trainings: the spread between n trainings appears smaller by sqrt((n - 1) / n), 0.71 for
    two and 0.82 for three. For a single training it is :func:`bootstrap_ci95`, which does not cover other seeds.

    Args:
        values: [E] one value per episode.
        runs: [E] training of each episode.
        groups: [E] demonstration of each episode; every training has episodes of every one.

    Raises:
        ValueError: a training has no episode of some demonstration.
    """
    if len(np.unique(runs)) == 1:
        return bootstrap_ci95(values, groups)
    rng = np.random.default_rng(0)
    return _interval(_means((values, runs, groups), rng, rng))


def difference_ci95(one: Sequence[np.ndarray], other: Sequence[np.ndarray]) -> Interval:
    """Return the 95 % interval of the mean of ``other`` minus the mean of ``one``.

    Both are crossed bootstraps, with the same draws of demonstrations and different draws of trainings. With one
    training and one demonstration, episodes are drawn instead.

    Args:
        one: values, runs and groups, as of :func:`crossed_bootstrap_ci95`.
        other: the same of trainings that were evaluated on the same demonstrations.
    """
    return _interval(_mean_differences(one, other))


def difference_p(one: Sequence[np.ndarray], other: Sequence[np.ndarray]) -> float:
    """Return the two-sided p value of equal means: twice the share of the draws of :func:`difference_ci95` on the
    smaller side of zero, where one more draw counts as a tie. It is at least 0.001, and at least :func:`least_p`."""
    differences = _mean_differences(one, other)
    fewer = min((differences <= 0).sum(), (differences >= 0).sum())
    return min(1.0, max(2 * float(fewer + 1) / (DRAWS + 1), least_p(one[0], one[2])))


def least_p(values: np.ndarray, groups: np.ndarray) -> float:
    """Return the least p value that values [E] of n demonstrations [E] can show: 2^(1 - n), the chance that all of them
    differ in the same direction."""
    return 2.0 ** (1 - _independent(values, groups))


def holm(p_values: Sequence[float]) -> list[bool]:
    """Return which of several differences are certain, if the chance that any of them is claimed wrongly may be 5 %
    (Holm, Scandinavian Journal of Statistics 6, 1979).

    Of m p values, the smallest is compared with 0.05 / m, the next one with 0.05 / (m - 1), and so on up to the first
    that is too large.
    """
    certain = [False] * len(p_values)
    for place, index in enumerate(np.argsort(p_values, kind="stable")):
        if p_values[index] > 0.05 / (len(p_values) - place):
            break
        certain[index] = True
    return certain


def _mean_differences(one: Sequence[np.ndarray], other: Sequence[np.ndarray]) -> np.ndarray:
    """Return the differences of the means in each draw [DRAWS]."""
    rng = np.random.default_rng(0)
    first = _means(one, rng, np.random.default_rng(1))
    second = _means(other, rng, np.random.default_rng(1))
    return second - first


def _means(
    crossed: Sequence[np.ndarray],
    run_rng: np.random.Generator,
    group_rng: np.random.Generator,
) -> np.ndarray:
    """Return the mean of the values in each draw of runs and groups [DRAWS]. With one run and one group, episodes are
    drawn instead."""
    values, runs, groups = crossed
    run_names, run = np.unique(runs, return_inverse=True)
    group_names, group = np.unique(groups, return_inverse=True)
    if len(run_names) == len(group_names) == 1:
        group_names = group = np.arange(len(values))
    sums, counts = np.zeros((2, len(run_names), len(group_names)))
    np.add.at(sums, (run, group), values)
    np.add.at(counts, (run, group), 1)
    if (counts == 0).any():
        raise ValueError("every training needs episodes of every demonstration")
    run_times = _times_drawn(run_rng, len(run_names))
    group_times = _times_drawn(group_rng, len(group_names))
    means = ((run_times @ sums) * group_times).sum(axis=1)
    return means / ((run_times @ counts) * group_times).sum(axis=1)


def _times_drawn(rng: np.random.Generator, count: int) -> np.ndarray:
    """[DRAWS, count] how often each of some items is drawn, in draws of as many items with replacement."""
    return rng.multinomial(count, np.full(count, 1 / count), size=DRAWS)


def _interval(means: np.ndarray) -> Interval:
    low, high = np.percentile(means, [2.5, 97.5])
    return float(low), float(high)
