"""Evaluation results of one training, or of several that differ in their seed only, in one engine."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from xreset.eval.report.groups import Group
from xreset.eval.rollout import Episode
from xreset.eval.stats import crossed_bootstrap_ci95


@dataclass(frozen=True, kw_only=True)
class Score:
    """Means over all episodes of all trainings of a group, in [0, 1]; rounded as ``xreset eval`` does, so that both show the same."""

    task_progress: float
    ci95: tuple[float, float]
    """Of the mean task progress. Of one training: whole demonstrations are drawn (:func:`xreset.eval.stats.bootstrap_ci95`), as
    ``xreset eval`` does; of several: trainings and demonstrations (:func:`xreset.eval.stats.crossed_bootstrap_ci95`)."""
    approach: float
    grasp: float
    reorient: float
    reorient_once: float
    """At the goal at any time."""
    reorientation_progress: float
    each: dict[str, float]
    """Label of every training that was evaluated in this engine -> its mean task progress."""
    nonfinite: int
    """Episodes in which a number was not finite."""
    overflow: int
    """Episodes in which the engine dropped contacts."""
    episodes: int


def score(group: Group, engine: str) -> Score | None:
    """What the group reaches in an engine; None if none of it was evaluated there."""
    evaluated = [m for m in group.members if engine in m.episodes]
    if not evaluated:
        return None
    episodes = [e for m in evaluated for e in m.episodes[engine]]
    task_progress, ci95 = estimate([m.episodes[engine] for m in evaluated], "task_progress")

    def mean(name: str) -> float:
        return round(float(np.mean([getattr(e, name) for e in episodes])), 6)

    return Score(
        task_progress=task_progress,
        ci95=ci95,
        approach=mean("approach"),
        grasp=mean("grasp"),
        reorient=mean("reorient"),
        reorient_once=mean("reorient_once"),
        reorientation_progress=mean("reorientation_progress"),
        each={m.label: float(np.mean([e.task_progress for e in m.episodes[engine]])) for m in evaluated},
        nonfinite=sum(e.nonfinite for e in episodes),
        overflow=sum(e.overflow for e in episodes),
        episodes=len(episodes),
    )


def estimate(episodes: Sequence[Sequence[Episode]], metric: str) -> tuple[float, tuple[float, float]]:
    """Mean of a metric over all episodes of several trainings, and its 95 % interval as in :class:`Score`.

    Args:
        episodes: of each training, on the same demonstrations.
        metric: field of an episode.
    """
    every = [e for own in episodes for e in own]
    values = np.array([float(getattr(e, metric)) for e in every])
    runs = np.repeat(np.arange(len(episodes)), [len(own) for own in episodes])
    return round(float(values.mean()), 6), crossed_bootstrap_ci95(values, runs, np.array([e.sequence for e in every]))


Scores = Mapping[str, Mapping[str, Score]]
"""Label of every group that was evaluated -> engine -> score."""


def scores(groups: Iterable[Group]) -> Scores:
    """What every group reaches in every engine, engines in order of name."""
    found = {}
    for group in groups:
        engines = sorted({engine for m in group.members for engine in m.episodes})
        if engines:
            found[group.label] = {engine: s for engine in engines if (s := score(group, engine)) is not None}
    return found


def engines_of(found: Scores) -> tuple[str, ...]:
    """Every engine in which anything was evaluated, in order of name."""
    return tuple(sorted({engine for row in found.values() for engine in row}))
