"""The tables of a report."""

from __future__ import annotations

from math import isnan

from xreset.eval.metrics import METRICS
from xreset.eval.report.curves import AXES, amounts
from xreset.eval.report.groups import EVERY, Groups, by_engine, certain_differences, counted
from xreset.eval.report.read import Training, versions
from xreset.eval.stats import Table
from xreset.eval.table import Rows, points_text
from xreset.files.checks import frozen


@frozen
class Cell:
    """One number of the table of results."""

    text: str
    within: str
    """Its 95 % interval; empty: none."""
    share: float | None
    """Length of a bar; None: no bar."""
    bad: bool


@frozen
class Row:
    """A group in one engine."""

    label: str
    engine: str
    version: str
    trained: bool
    """Whether it was trained in this engine."""
    counts: str
    """:func:`xreset.eval.report.groups.counted`"""
    cells: tuple[Cell, ...]
    """A number for each of :data:`xreset.eval.metrics.METRICS`."""
    difference: str
    """Points of task progress above the first group; empty: not comparable."""
    certain: bool
    """Whether that is a difference (:func:`xreset.eval.report.groups.certain_differences`)."""


def results(groups: Groups, scores: Table) -> list[Row]:
    """Return a row for each group and engine.

    Args:
        groups: the groups.
        scores: :func:`xreset.eval.report.groups.scores` and :func:`~xreset.eval.report.groups.differences`.
    """
    rows = []
    above = f"task_progress minus {next(iter(groups), None)}"
    every = scores[scores["object"] == EVERY].set_index(["group", "engine", "metric"])
    figures = every[["mean", "low", "high"]]
    certain = certain_differences(groups)
    for label, members in groups.items():
        for engine, episodes in by_engine(members):
            cells = []
            for name, metric in METRICS.items():
                mean, low, high = figures.loc[(label, engine, name)]
                text = metric.text(mean, len(episodes))
                within = "" if isnan(low) else metric.interval_text(low, high)
                cells.append(
                    Cell(
                        text=text,
                        within=within if metric.unit != "episodes" else "",
                        share=mean if metric.headline and not isnan(mean) else None,
                        bad=metric.fault and mean > 0,
                    )
                )
            difference = ""
            if (label, engine, above) in figures.index:
                difference = points_text(*figures.loc[(label, engine, above)])
            row = Row(
                label=label,
                engine=engine,
                version=versions(members, engine),
                trained=any(m.run is not None and m.run.engine == engine for m in members),
                counts=counted(episodes),
                cells=tuple(cells),
                difference=difference,
                certain=(label, engine) in certain,
            )
            rows.append(row)
    return rows


def different(groups: Groups) -> Rows:
    """Return a table of the fields in which trainings differ, with a column for each group, and their lengths.

    Baselines, which have no configuration, have no column.
    """
    facts: dict[str, list[dict[str, str]]] = {}
    names: dict[str, None] = {}
    for label, members in groups.items():
        if members[0].facts or len(members[0].curves):
            facts[label] = [member.facts | _lengths(member) for member in members]
            for known in facts[label]:
                names |= dict.fromkeys(known)
    lengths = [label for label, _ in AXES.values()]
    rows = [["", *facts]]
    for name in names:
        cells = []
        described = set()
        for columns in facts.values():
            texts = dict.fromkeys(known.get(name, "-") for known in columns)
            cells.append("; ".join(texts))
            if "seed" in columns[0]:
                described.update(texts)
        if len(described) > 1 or name in lengths:
            rows.append([name, *cells])
    return rows


def _lengths(member: Training) -> dict[str, str]:
    """Return the length of a training on each of :data:`AXES`, as text, where it was logged."""
    lengths = {}
    if not len(member.curves):
        return lengths
    for x, (label, digits) in AXES.items():
        done = amounts(member, x)
        if done is not None:
            lengths[label] = f"{done.iloc[-1]:,.{digits}f}"
    return lengths
