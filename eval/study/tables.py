"""A study's tables: the results of its runs in each engine, next to the paper's figures."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from typing import Literal

import pandas as pd

from xreset.eval.metrics import METRICS
from xreset.eval.report.fairness import uneven
from xreset.eval.report.groups import COUNTED, counted, estimate
from xreset.eval.report.read import Training, read_training
from xreset.eval.results import has_results
from xreset.eval.stats import Table
from xreset.eval.study.file import TableSpec
from xreset.eval.study.paper import ALL, PaperTable, paper_tables
from xreset.eval.study.plan import Plan
from xreset.eval.table import Rows, estimate_text
from xreset.files.checks import frozen
from xreset.files.text import short_name


@frozen
class FilledTable:
    """A table of the study with its figures."""

    title: str
    unit: Literal["%", "cm", "episodes"]
    """Unit of the figures."""
    engines: dict[str, Rows]
    """Engine -> rows of text; ``-`` where a run was not evaluated."""
    trainings: dict[str, list[Training]]
    """Run of the study -> its evaluated trainings."""
    episodes: dict[str, Table]
    """Run of the study -> all episodes. Trainings of one seed have the same name, also if each trained one object."""

    def counts(self, engine: str) -> str:
        """Return the numbers of episodes, demonstrations and seeds of each run in an engine, as text."""
        texts = []
        for name, every in self.episodes.items():
            own = every[every["engine"] == engine] if len(every) else every
            if len(own):
                texts.append(f"{name} {counted(own)}")
        return f"{COUNTED.capitalize()}: {', '.join(texts)}."


def fill(plan: Plan, table: TableSpec) -> FilledTable:
    """Fill a table with what has been evaluated so far.

    Raises:
        FileFormatError: a result is damaged.
    """
    objects = {name: plan.played.get((name, table.evaluation), set()) for name in table.runs}
    layout, names = _layout(table, sorted(set().union(*objects.values())))
    rows = [name for name in layout.values if name in names[layout.rows]]
    columns = [name for name in layout.names if name in names[layout.columns]]
    fixed = {"object": layout.object, "metric": layout.metric}
    stated = layout.figures() if table.paper else {}
    run_of = {method: name for name, method in table.runs.items()}
    trainings = {name: trainings_of(plan, name, table.evaluation) for name in table.runs}
    episodes = {
        name: _episodes(found, plan.study.runs[name].alone) for name, found in trainings.items()
    }

    def cell(engine: str, row: str, column: str) -> str:
        """Return the estimate with its interval, and the paper's figure."""
        key = fixed | {layout.rows: row, layout.columns: column}
        run = run_of[key["method"]]
        wanted = objects[run] if key["object"] == ALL else {key["object"]}
        values = estimate(_episodes_with(episodes[run], engine, wanted), key["metric"])
        theirs = (key["method"], key["object"], key["metric"])
        if key["object"] == ALL and wanted != layout.objects:
            theirs = ("", "", "")  # the paper's mean is over other objects
        return estimate_text(key["metric"], *values) + stated.get(theirs, "")

    engines = {}
    unit = METRICS[layout.metric].unit
    for engine in sorted(set().union(*(t.results for t in chain(*trainings.values())))):
        lines = [(unit, *(_shown(layout.columns, column) for column in columns))]
        for row in rows:
            cells = [cell(engine, row, column) for column in columns]
            lines.append((_shown(layout.rows, row), *cells))
        if rows and columns:  # empty if no planned run plays the objects of the results
            engines[engine] = lines
    return FilledTable(
        title=table.title or layout.title,
        unit=unit,
        engines=engines,
        trainings=trainings,
        episodes=episodes,
    )


def _layout(table: TableSpec, known: list[str]) -> tuple[PaperTable, dict[str, list[str]]]:
    """Return the layout of a table, the paper's or its own, and for each axis the names that the study has.

    Args:
        known: objects that are played.
    """
    names = {
        "method": list(table.runs.values()),
        "metric": list(METRICS),
        "object": [*known, ALL] if table.paper or len(known) > 1 else known,
    }
    if table.paper:
        return paper_tables()[table.paper], names
    layout = PaperTable(
        title=METRICS[table.metric].title,
        rows="object",
        columns="method",
        names=tuple(names["method"]),
        values=dict.fromkeys(names["object"], ()),
        metric=table.metric,
    )
    return layout, names


def trainings_of(plan: Plan, group: str, evaluation: str) -> list[Training]:
    """Return the evaluated trainings of a run of the study."""
    found = []
    for run in plan.runs:
        folder = run.folder / evaluation
        if run.group == group and has_results(folder):
            found.append(read_training(run.folder, run.label, folder))
    return found


def _episodes(trainings: Sequence[Training], alone: bool) -> Table:
    """Join the episodes of trainings, without those in an engine in which the trainings were evaluated differently: a
    study that has changed may have evaluated some of them again. If each object was trained alone, demonstrations get
    new numbers over all objects."""
    every: Table = pd.concat([pd.DataFrame(), *(t.episodes for t in trainings)], ignore_index=True)
    if not len(every):
        return every
    if alone:
        every["sequence"] = every.groupby(["object", "sequence_name"]).ngroup()
    engines = every["engine"].unique()
    return every[every["engine"].isin([e for e in engines if _is_even(trainings, alone, e)])]


def _is_even(trainings: Sequence[Training], alone: bool, engine: str) -> bool:
    """Whether the trainings were evaluated alike in an engine; those of each object if it was trained alone."""
    compared = defaultdict(list)
    for training in trainings:
        if engine in training.results:
            objects = frozenset(training.episodes["object"]) if alone else None
            results = {engine: training.results[engine]}
            compared[objects].append(replace(training, results=results))
    return not any(map(uneven, compared.values()))


def _episodes_with(episodes: Table, engine: str, objects: set[str]) -> Table:
    """Return the episodes of the given objects in an engine.

    Seeds that miss one of the objects are left out, because a mean over some of the objects is not comparable.
    """
    if episodes.empty:
        return episodes
    own = episodes[(episodes["engine"] == engine) & episodes["object"].isin(list(objects))]
    return own.groupby("run", sort=False).filter(lambda seed: set(seed["object"]) == objects)


def _shown(axis: str, name: str) -> str:
    if axis == "object":
        return "all of them" if name == ALL else short_name(name)
    if axis == "metric":
        return METRICS[name].title
    return name
