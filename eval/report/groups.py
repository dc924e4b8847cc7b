"""Trainings that differ in their seed only, taken together, and what they reach in each engine."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, takewhile

import numpy as np

from xreset.eval.report.progress import processes
from xreset.eval.report.read import ASPECTS, Training
from xreset.eval.rollout import Episode
from xreset.eval.stats import crossed_bootstrap_ci95


@dataclass(frozen=True, kw_only=True)
class Group:
    """One line of the picture and one row of the table."""

    label: str
    members: tuple[Training, ...]
    """One training, or several that differ in their seed only."""


def grouped(trainings: Sequence[Training]) -> tuple[tuple[Group, ...], tuple[str, ...]]:
    """Take together what differs in the seed only: the same configuration, each with a seed of its own, and evaluated alike.

    Returns:
        The groups, in the order of their first trainings, and sentences about trainings that have the same configuration and yet are not
        taken together.
    """
    alike: list[list[Training]] = []
    for training in trainings:
        key = _configuration(training)
        found = next((group for group in alike if key and _configuration(group[0]) == key), None)
        if found is None:
            alike.append([training])
        else:
            found.append(training)
    groups, notes = [], []
    for members in alike:
        if len(members) == 1 or (reason := _apart(members)) is None:
            groups.append(Group(label=_label([m.label for m in members]), members=tuple(members)))
        else:
            groups += singles(members)
            notes.append(
                f"{', '.join(m.label for m in members)} have the same configuration and are not taken together: {reason}."
            )
    labels = [group.label for group in groups]
    if len(set(labels)) < len(labels):  # names that were shortened to the same
        groups = [Group(label=" + ".join(m.label for m in group.members), members=group.members) for group in groups]
    return tuple(groups), tuple(notes)


def singles(trainings: Sequence[Training]) -> tuple[Group, ...]:
    """Every training for itself."""
    return tuple(Group(label=training.label, members=(training,)) for training in trainings)


def _configuration(training: Training) -> dict[str, object]:
    """All facts but the seed, and how long it was to go on: a run stops when it is stopped, and how far it came is said of each."""
    return {name: fact.value for name, fact in training.facts.items() if name not in ("seed", "iterations")}


def _apart(members: Sequence[Training]) -> str | None:
    """Why trainings of one configuration are not repetitions of one another; None if they are."""
    for a, b in combinations(members, 2):
        if a.facts["seed"].value == b.facts["seed"].value:
            return f"{a.label} and {b.label} have the same seed, too"
        if len({processes(t) for t in (a, b)} - {None}) > 1:
            return f"{a.label} was trained with {processes(a)} processes and {b.label} with {processes(b)}"
        for engine in a.summaries.keys() & b.summaries.keys():
            for aspect, get in ASPECTS.items():
                if not aspect.startswith("policy") and get(a.summaries[engine]) != get(b.summaries[engine]):
                    return f"in the evaluations of {a.label} and {b.label} in {engine} the {aspect} differs"
            if _played(a, engine) != _played(b, engine):
                return f"{a.label} and {b.label} were evaluated with different episodes in {engine}"
            if a.summaries[engine].backend_version != b.summaries[engine].backend_version:
                return f"{a.label} and {b.label} were evaluated in different versions of {engine}"
    return None


def _played(training: Training, engine: str) -> set[tuple[int, int]]:
    return {(e.sequence, e.repetition) for e in training.episodes[engine]}


def _label(labels: Sequence[str]) -> str:
    """What the names have in common: ``soup-seed0`` and ``soup-seed1`` are ``soup``."""
    if len(labels) == 1:
        return labels[0]
    common = "".join(
        letters[0] for letters in takewhile(lambda letters: len(set(letters)) == 1, zip(*labels, strict=False))
    )
    if any(label[len(common) :][:1].isdigit() for label in labels):
        common = common.rstrip("0123456789")
    return re.sub(r"[-_. ]+(seed|s)?[-_. ]*$", "", common) or " + ".join(labels)


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

    stages = ("approach", "grasp", "reorient", "reorient_once", "reorientation_progress")
    return Score(
        task_progress=task_progress,
        ci95=ci95,
        **{name: round(float(np.mean([getattr(e, name) for e in episodes])), 6) for name in stages},
        each={m.label: float(np.mean([e.task_progress for e in m.episodes[engine]])) for m in evaluated},
        nonfinite=sum(e.nonfinite for e in episodes),
        overflow=sum(e.overflow for e in episodes),
        episodes=len(episodes),
    )


def estimate(episodes: Sequence[Sequence[Episode]], metric: str) -> tuple[float, tuple[float, float]]:
    """Mean of a metric over all episodes of several trainings, and its 95 % interval as in :class:`Score`.

    Args:
        episodes: of each training, on the same demonstrations.
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
