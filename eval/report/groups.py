"""Group trainings that differ in their seed only, and score each group in each engine."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from os.path import commonprefix
from typing import Any

import pandas as pd

from xreset.eval.report.fairness import uneven
from xreset.eval.report.read import Training
from xreset.eval.results import Table, mean
from xreset.eval.stats import crossed_bootstrap_ci95
from xreset.eval.table import METRICS


@dataclass(frozen=True, kw_only=True)
class Group:
    """One line of the picture and one row of the table."""

    label: str
    members: tuple[Training, ...]
    """One training, or several that differ in their seed only."""


def grouped(trainings: Sequence[Training]) -> tuple[tuple[Group, ...], tuple[str, ...]]:
    """Group trainings of the same configuration that have different seeds and were evaluated alike.

    Returns:
        The groups, in the order of their first trainings, and sentences about trainings of the same configuration that
        are not grouped.
    """
    alike: dict[object, list[Training]] = {}
    for training in trainings:
        shared = [fact for fact in training.facts.items() if fact[0] not in ("seed", "iterations")]
        alike.setdefault(tuple(shared) or training.label, []).append(training)
    groups = []
    notes = []
    for members in alike.values():
        names = [m.label for m in members]
        reasons = uneven(members)
        seeds = {m.facts.get("seed") for m in members}
        if len(seeds) < len(members):
            reasons = ["Some have the same seed, too."]
        if reasons:
            groups += singles(members)
            notes.append(f"{', '.join(names)} have the same configuration and are not grouped. {reasons[0]}")
        else:
            groups.append(Group(label=_label(names), members=tuple(members)))
    if len({group.label for group in groups}) < len(groups):  # shortened names may be equal
        groups = [replace(group, label=" + ".join(m.label for m in group.members)) for group in groups]  # noqa: XR002
    return tuple(groups), tuple(notes)


def members_of(groups: Iterable[Group]) -> list[Training]:
    """Return the trainings of all groups."""
    members = []
    for group in groups:
        members += group.members
    return members


def singles(trainings: Sequence[Training]) -> tuple[Group, ...]:
    """Return a group for each training."""
    return tuple(Group(label=training.label, members=(training,)) for training in trainings)


def _label(labels: Sequence[str]) -> str:
    """Return what the names have in common: ``soup-seed0`` and ``soup-seed1`` are ``soup``."""
    if len(labels) == 1:
        return labels[0]
    common = commonprefix(labels)  # noqa: RUF071 (of texts, not of paths)
    if any(label[len(common) :][:1].isdigit() for label in labels):
        common = common.rstrip("0123456789")
    return re.sub(r"[-_. ]+(seed|s)?[-_. ]*$", "", common) or " + ".join(labels)


def scores(groups: Iterable[Group]) -> Table:
    """Return a row for each group, engine and metric of :data:`~xreset.eval.table.METRICS`: group (its label), engine,
    metric, mean, low and high (:func:`estimate`); NaN where an earlier version did not measure the metric."""
    rows = []
    for group in groups:
        for engine, own in by_engine(group.members):
            for metric in METRICS:
                value, (low, high) = estimate(own, metric)
                rows.append((group.label, engine, metric, value, low, high))
    return pd.DataFrame(rows, columns=["group", "engine", "metric", "mean", "low", "high"])


def by_engine(members: Iterable[Training]) -> Sequence[tuple[Any, Table]]:
    """Return every engine in which trainings were evaluated, with the episodes of all of them there."""
    evaluated = [member.episodes for member in members if member.results]
    return list(pd.concat(evaluated).groupby("engine")) if evaluated else []


def estimate(episodes: Table, metric: str) -> tuple[float, tuple[float, float]]:
    """Return the mean of a metric over all episodes of several trainings on the same demonstrations, and its 95 %
    interval.

    The interval is a bootstrap over demonstrations, as in ``xreset eval``, and for several trainings over trainings,
    too (:func:`xreset.eval.stats.crossed_bootstrap_ci95`).
    """
    values = episodes[metric].to_numpy(float)
    runs = pd.factorize(episodes["run"])[0]
    return mean(episodes, metric), crossed_bootstrap_ci95(values, runs, episodes["sequence"].to_numpy())
