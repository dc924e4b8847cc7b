"""Group runs that differ only in their seed, and score each group in each engine."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from math import nan
from os.path import commonprefix

import pandas as pd

from xreset.eval.metrics import METRICS
from xreset.eval.report.fairness import uneven
from xreset.eval.report.read import Training, by_engine
from xreset.eval.stats import Table, ci95, crossed, difference, difference_p, holm, mean

Groups = dict[str, Sequence[Training]]
"""Label -> one training, or several that differ only in their seed. A group is a line of the picture."""


def grouped(trainings: Sequence[Training]) -> tuple[Groups, list[str]]:
    """Group trainings of the same configuration that have different seeds and were evaluated alike.

    Returns:
        The groups, in the order of their first trainings, and sentences about trainings of the same configuration that
        are not grouped, and about one that was evaluated differently in its engines.
    """
    alike: dict[object, list[Training]] = {}
    for training in trainings:
        shared = [fact for fact in training.facts.items() if fact[0] not in ("seed", "iterations")]
        alike.setdefault(tuple(shared) or training.label, []).append(training)
    found: list[Sequence[Training]] = []
    notes = []
    for members in alike.values():
        reasons = uneven(members)
        seeds = {m.facts.get("seed") for m in members}
        if len(seeds) < len(members):
            reasons = ["Some have the same seed, too."]
        if len(members) == 1:
            found.append(members)
            notes += reasons
        elif reasons:
            found += [[member] for member in members]
            names = ", ".join(m.label for m in members)
            notes.append(f"{names} have the same configuration and are not grouped. {reasons[0]}")
        else:
            found.append(members)
    groups = {_label(members): members for members in found}
    if len(groups) < len(found):  # shortened names may be equal
        groups = {_whole_label(members): members for members in found}
    return groups, notes


def _whole_label(members: Sequence[Training]) -> str:
    return " + ".join(member.label for member in members)


def _label(members: Sequence[Training]) -> str:
    """Return the common part of the names, without the seed: ``soup`` for ``soup-seed0`` and ``soup-seed1``."""
    labels = [member.label for member in members]
    if len(labels) == 1:
        return labels[0]
    common = commonprefix(labels)  # noqa: RUF071 (of texts, not of paths)
    if any(label[len(common) :][:1].isdigit() for label in labels):
        common = common.rstrip("0123456789")
    return re.sub(r"[-_. ]+(seed|s)?[-_. ]*$", "", common) or _whole_label(members)


COLUMNS = ("group", "engine", "object", "metric", "mean", "low", "high")
EVERY = "all"
"""Name that stands for all objects in tables of scores."""


def scores(groups: Groups) -> Table:
    """Return a row for each group, engine, object and metric of :data:`~xreset.eval.metrics.METRICS`. Faults have only
    the row of all objects.

    Columns: group (its label), engine, object (or ``all``), metric, and mean, low and high (:func:`estimate`), which
    are NaN where an earlier version did not measure the metric.
    """
    rows = []
    for label, members in groups.items():
        for engine, every in by_engine(members):
            for name in (EVERY, *sorted(every["object"].unique())):
                own = every if name == EVERY else every[every["object"] == name]
                for metric, how in METRICS.items():
                    if name == EVERY or how.unit != "episodes":
                        rows.append((label, engine, name, metric, *estimate(own, metric)))
    return pd.DataFrame(rows, columns=COLUMNS)


COUNTED = "episodes / demonstrations / seeds"
"""Name of the numbers that :func:`counted` returns."""


def counted(episodes: Table) -> str:
    """Return the numbers of :data:`COUNTED` in the episodes of one engine, such as ``24 / 6 / 2``."""
    return f"{len(episodes)} / {episodes['sequence'].nunique()} / {episodes['run'].nunique()}"


def estimate(episodes: Table, metric: str) -> tuple[float, float, float]:
    """Return the mean of a metric over all episodes of trainings that were evaluated on the same demonstrations, and
    the lower and upper end of its 95 % interval; NaN without episodes.

    The interval is a bootstrap over demonstrations, as in ``xreset eval``, and for several trainings over trainings,
    too (:func:`xreset.eval.stats.ci95`).
    """
    if episodes.empty:
        return nan, nan, nan
    return mean(episodes, metric), *ci95(episodes, metric)


def differences(groups: Groups) -> Table:
    """Return a row for each group after the first, engine and metric, where both were evaluated alike: by how much the
    group's mean is above the first group's. Columns as of :func:`scores`; the metric is named ``METRIC minus FIRST``.
    """
    first = next(iter(groups), None)
    rows = []
    for label, engine, reference, own in _compared(groups):
        for metric in METRICS:
            values = difference(reference, own, metric)
            rows.append((label, engine, EVERY, f"{metric} minus {first}", *values))
    return pd.DataFrame(rows, columns=COLUMNS)


def certain_differences(groups: Groups) -> set[tuple[str, str]]:
    """Return the groups and engines with a task progress that differs from the first group's at the 5 % level, after
    Holm's correction for all that are compared."""
    compared = list(_compared(groups))
    p_values = []
    for _, _, *tables in compared:
        one, other = (crossed(table, "task_progress") for table in tables)
        p_values.append(difference_p(one, other))
    found = set()
    for (label, engine, *_), is_certain in zip(compared, holm(p_values), strict=True):
        if is_certain:
            found.add((label, engine))
    return found


def _compared(groups: Groups) -> Iterator[tuple[str, str, Table, Table]]:
    """Yield each group after the first, each engine in which both were evaluated alike, and the first group's and the
    group's episodes there."""
    if not groups:
        return
    first, *others = groups
    reference = dict(by_engine(groups[first]))
    for label in others:
        if uneven([*groups[first], *groups[label]]):
            continue
        for engine, own in by_engine(groups[label]):
            if engine in reference:
                yield label, engine, reference[engine], own
