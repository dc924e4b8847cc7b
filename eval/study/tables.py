"""A study's tables: what its runs reach, by engine, next to the paper's figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain, product
from math import nan
from pathlib import Path
from typing import Any

import pandas as pd

from xreset.eval.plots import picture
from xreset.eval.report.figures import draw_bars
from xreset.eval.report.groups import COUNTED, counted, estimate
from xreset.eval.report.read import Training, read_training
from xreset.eval.results import Table
from xreset.eval.study.file import TableSpec
from xreset.eval.study.paper import ALL, PaperTable, paper_tables
from xreset.eval.study.plan import Plan
from xreset.eval.table import METRICS, Rows, estimate_text
from xreset.objects.catalogue import canonical_name
from xreset.text import short_name

Axis = tuple[str, list[str]]
"""What the rows or columns are (method, object or metric), and their names."""


@dataclass(frozen=True, kw_only=True)
class FilledTable:
    """A table of the study with its figures."""

    title: str
    cells: Table
    """One row for each figure: engine, row and column (names as they are shown), mean, low and high (95 % interval;
    shares, or m; NaN if it was not evaluated or measured), the paper's figure (percent), text."""
    trainings: dict[str, list[Training]]
    """Run of the study -> its evaluated trainings."""
    episodes: dict[str, Table]
    """Run of the study -> all episodes; a seed has one name, also where it trained each object alone."""
    paper: bool
    """Whether it has figures of the paper."""
    unit: str
    """Unit of the cells, where their column does not state one."""

    @property
    def engines(self) -> list[str]:
        """Engines in which anything was evaluated."""
        return list(self.cells["engine"].unique())

    def wide(self, engine: str) -> Table:
        """Return the cells of one engine: rows by columns, for each kind of value."""
        own = self.cells[self.cells["engine"] == engine].drop(columns="engine")
        return own.set_index(["row", "column"]).unstack(sort=False)

    def as_rows(self, engine: str) -> Rows:
        """Return the table of one engine."""
        text = self.wide(engine)["text"]
        return [(self.unit, *text.columns), *text.itertuples(name=None)]

    def counts(self, engine: str) -> str:
        """Return how much of each run was evaluated in an engine."""
        texts = []
        for name, every in self.episodes.items():
            own = every[every["engine"] == engine] if len(every) else every
            if len(own):
                texts.append(f"{name} {counted(own)}")
        return f"{COUNTED.capitalize()}: {', '.join(texts)}."

    def versions(self, engine: str) -> str:
        """Return the engine's versions in which the runs were evaluated."""
        evaluated = [
            t.results[engine] for t in chain(*self.trainings.values()) if engine in t.results
        ]
        return ", ".join(sorted({result.backend_version for result in evaluated}))


def fill(plan: Plan, table: TableSpec) -> FilledTable:
    """Fill a table with what has been evaluated so far.

    Raises:
        FileFormatError: a result is damaged.
    """
    trainings = {name: trainings_of(plan, name, table.evaluation) for name in table.runs}
    episodes = {
        name: _episodes(found, plan.study.runs[name].alone) for name, found in trainings.items()
    }
    paper = paper_tables()[table.paper] if table.paper else None
    stated = paper.figures() if paper else {}
    (row_axis, rows), (column_axis, columns), fixed = _axes(plan, table, paper)
    run_of = {shown: name for name, shown in table.runs.items()}
    engines = sorted(set().union(*(t.results for t in chain(*trainings.values()))))
    cells = []
    for engine, row, column in product(engines, rows, columns):
        key = fixed | {row_axis: row, column_axis: column}
        run = run_of[key["method"]]
        objects = {key["object"]} if key["object"] != ALL else set(objects_of(plan, run, table))
        own = _episodes_with(episodes[run], engine, objects)
        cell: dict[str, Any] = {
            "engine": engine,
            "row": _shown(row_axis, row),
            "column": _shown(column_axis, column),
        }
        mean, (low, high) = estimate(own, key["metric"]) if len(own) else (nan, (nan, nan))
        figure = stated.get((key["method"], key["object"], key["metric"]))
        text = estimate_text(key["metric"], mean, low, high)
        if figure is not None:
            text += f", paper {figure[0]:.1f}"
            if figure[1] is not None:
                text += f" \N{PLUS-MINUS SIGN} {figure[1]:.1f}"
        cell |= {
            "mean": mean,
            "low": low,
            "high": high,
            "paper": figure[0] if figure else nan,
            "text": text,
        }
        cells.append(cell)
    names = ["engine", "row", "column", "mean", "low", "high", "paper", "text"]
    return FilledTable(
        title=table.title or (paper.title if paper else METRICS[table.metric]),
        cells=pd.DataFrame(cells, columns=names),
        trainings=trainings,
        episodes=episodes,
        paper=paper is not None,
        unit="cm" if fixed.get("metric") == "least_distance" else "%",
    )


def trainings_of(plan: Plan, group: str, evaluation: str) -> list[Training]:
    """Return the evaluated trainings of a run of the study. Those of one seed, one for each object alone, have one
    label."""
    found = []
    for run in plan.runs:
        folder = run.folder / evaluation
        if run.group == group and any(folder.glob("*.episodes.json")):
            label = f"{group}-seed{run.seed}" if run.runs.alone else run.name
            found.append(read_training(label, run.folder, folder))
    return found


def _episodes(trainings: Sequence[Training], alone: bool) -> Table:
    """Join the episodes of trainings. Where objects were trained alone, the demonstrations of all of them are numbered
    together."""
    every: Table = pd.concat([pd.DataFrame(), *(t.episodes for t in trainings)], ignore_index=True)
    if alone and len(every):
        every["sequence"] = every.groupby(["object", "sequence_name"]).ngroup()
    return every


def _episodes_with(episodes: Table, engine: str, objects: set[str]) -> Table:
    """Return the episodes of the given objects in an engine.

    Seeds that miss one of the objects are left out, because a mean over some of the objects is not comparable.
    """
    if episodes.empty:
        return episodes
    own = episodes[(episodes["engine"] == engine) & episodes["object"].isin(list(objects))]
    return own.groupby("run", sort=False).filter(lambda seed: set(seed["object"]) == objects)


def objects_of(plan: Plan, group: str, table: TableSpec) -> tuple[str, ...]:
    """Return the objects with which a run of the study is evaluated."""
    objects = set()
    for step in plan.steps.values():
        if (
            step.run is not None
            and step.run.group == group
            and step.name.startswith(f"{table.evaluation} ")
        ):
            objects.update(step.objects)
    return tuple(sorted(objects))


def _axes(
    plan: Plan, table: TableSpec, paper: PaperTable | None
) -> tuple[Axis, Axis, dict[str, str]]:
    """Return rows, columns, and what is the same in all cells."""
    known = sorted(set().union(*(objects_of(plan, run, table) for run in table.runs)))
    methods = list(table.runs.values())
    if paper is not None:
        names = {"method": methods, "metric": list(METRICS), "object": [*known, ALL]}
        rows = [name for name in paper.values if name in names[paper.rows]]
        columns = [name for name in paper.names if name in names[paper.columns]]
        fixed = {"object": paper.object, "metric": paper.metric}
        return (paper.rows, rows), (paper.columns, columns), fixed
    one = canonical_name(table.object, known) if table.object else None
    if table.rows == "metric":
        return ("metric", list(METRICS)), ("method", methods), {"object": one or ALL}
    objects = [one] if one else [*known, ALL] if len(known) > 1 else known
    fixed = {"metric": table.metric}
    if table.rows == "run":
        return ("method", methods), ("object", objects), fixed
    return ("object", objects), ("method", methods), fixed


def _shown(axis: str, name: str) -> str:
    if axis == "metric":
        return METRICS[name]
    if axis == "method":
        return name
    return "all of them" if name == ALL else short_name(name)


def draw(path: Path, table: FilledTable) -> None:
    """Draw bars with intervals, a panel for each engine; the paper's figures are black lines across them."""
    engines = table.engines
    size = (max(7.0, 1.1 * table.cells["row"].nunique() + 2), 2.6 * len(engines) + 0.4)
    with picture(path, size, text_parse_math=False) as figure:
        panels = figure.subplots(len(engines), 1, squeeze=False)[:, 0]
        for ax, engine in zip(panels, engines, strict=True):
            wide = table.wide(engine)
            draw_bars(ax, wide["mean"], wide["low"], wide["high"])
            for bar, value in zip(ax.patches, wide["paper"].to_numpy().T.ravel(), strict=True):
                ax.hlines(
                    value, bar.get_x(), bar.get_x() + bar.get_width(), color="black", linewidth=2
                )
            ax.set_ylabel(table.unit)
            if table.unit == "%":
                ax.set_ylim(0, 104)
            ax.set_title(engine, fontsize="medium", loc="left")
        if table.paper:
            panels[-1].plot([], [], color="black", linewidth=2, label=" the paper")
        handles, labels = panels[-1].get_legend_handles_labels()
        figure.legend(
            handles, labels, loc="outside upper center", ncols=min(len(labels), 5), frameon=False
        )
