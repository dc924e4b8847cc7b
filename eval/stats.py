"""Confidence intervals of evaluation results."""

from __future__ import annotations

import numpy as np


def bootstrap_ci95(values: np.ndarray, groups: np.ndarray | None = None, *, draws: int = 2000, seed: int = 0) -> tuple[float, float]:
    """95 % percentile bootstrap interval of the mean.

    Args:
        values: [E] one value per episode.
        groups: [E] demonstration of each episode. Episodes of one demonstration resemble one another, so whole demonstrations are drawn
            (cluster bootstrap); with a single one, or None, episodes are drawn.
        draws: resamples.
        seed: of the resampling: the same values give the same interval.
    """
    values = np.asarray(values, dtype=float)
    if len(values) < 2:
        return float(values.mean()), float(values.mean())
    rng = np.random.default_rng(seed)
    if groups is None or len(np.unique(groups)) < 2:
        means = values[rng.integers(len(values), size=(draws, len(values)))].mean(axis=1)
    else:
        _, number = np.unique(groups, return_inverse=True)
        sums, counts = np.bincount(number, values), np.bincount(number)
        picks = rng.integers(len(sums), size=(draws, len(sums)))
        means = sums[picks].sum(axis=1) / counts[picks].sum(axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    return float(low), float(high)
