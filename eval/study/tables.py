"""A study's tables: what its runs reach, by engine, next to the paper's figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np
import pandas as pd

from xreset.eval.plots import INK, percent_axis, picture
from xreset.eval.report.figures import color
from xreset.eval.report.groups import Group, Scores, estimate, scores
from xreset.eval.report.read import Training, read_training
from xreset.eval.results import Table, measured
from xreset.eval.study.file import TableSpec
from xreset.eval.study.paper import ALL, METRICS, PaperTable, paper_tables
from xreset.eval.study.plan import Plan
from xreset.eval.table import Rows
from xreset.objects.catalogue import canonical_name
from xreset.text import short_name

Axis = tuple[str, list[str]]
"""What the rows or columns are (method, object or metric), and their names."""


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A figure: a share, or a distance [m]."""

    mean: float | None
    """None: not evaluated, or not measured by an earlier version."""
    ci95: tuple[float, float]
    """95 % interval, as :func:`~xreset.eval.report.groups.estimate` gives it."""
    paper: float | None
    """The paper's figure, percent."""
    paper_error: float | None = None
    """Standard error of the paper's figure, percent."""

    @property
    def text(self) -> str:
        """``93.2 (88-98), paper 90.8 ± 1.5``."""
        text = "-"
        if self.mean is not None:
            text = f"{100 * self.mean:.1f} ({100 * self.ci95[0]:.0f}-{100 * self.ci95[1]:.0f})"
        if self.paper is not None:
            text += f", paper {self.paper:.1f}"
        if self.paper_error is not None:
            text += f" \N{PLUS-MINUS SIGN} {self.paper_error:.1f}"
        return text


@dataclass(frozen=True, kw_only=True)
class FilledTable:
    """A table of the study with its figures."""

    title: str
    rows: tuple[str, ...]
    """Names of the rows, as they are shown."""
    columns: tuple[str, ...]
    """Names of the columns, as they are shown."""
    cells: dict[str, list[list[Cell]]]
    """Engine -> row -> column."""
    members: dict[str, tuple[Training, ...]]
    """Run of the study -> its seeds."""
    paper: bool
    """Whether it has figures of the paper."""
    unit: str = "%"
    """Unit of the cells, where their column does not state one."""

    @property
    def trainings(self) -> list[Training]:
        """All seeds of all runs."""
        return list(chain(*self.members.values()))

    def as_rows(self, engine: str) -> Rows:
        """Return the table of one engine."""
        body = []
        for name, cells in zip(self.rows, self.cells[engine], strict=True):
            body.append((name, *(cell.text for cell in cells)))
        return Rows(head=(self.unit, *self.columns), body=tuple(body))

    def versions(self, engine: str) -> str:
        """Return the engine's versions in which the runs were evaluated."""
        return ", ".join(sorted({t.results[engine].backend_version for t in self.trainings if engine in t.results}))

    def scores(self) -> Scores:
        """Return the scores of the runs, which count the episodes in which an engine broke down."""
        return scores(Group(label=name, members=members) for name, members in self.members.items())


def fill(plan: Plan, table: TableSpec) -> FilledTable:
    """Fill a table with what has been evaluated so far.

    Raises:
        FileFormatError: a result is damaged.
    """
    members = {name: seeds_of(plan, name, table.evaluation) for name in table.runs}
    paper = paper_tables()[table.paper] if table.paper else None
    (row_axis, row_names), (column_axis, column_names), fixed = _axes(plan, table, paper)
    run_of = {shown: name for name, shown in table.runs.items()}

    def cell(engine: str, key: Mapping[str, str]) -> Cell:
        run = run_of[key["method"]]
        objects = {key["object"]}
        if key["object"] == ALL:
            objects = set(objects_of(plan, run, table))
        mean = None
        ci95 = (0.0, 0.0)
        episodes = _episodes_with(members[run], engine, objects)
        if len(episodes) and measured(episodes, key["metric"]) is not None:
            mean, ci95 = estimate(episodes, key["metric"])
        figure, error = paper.figure(key["method"], key["object"], key["metric"]) if paper else (None, None)
        return Cell(mean=mean, ci95=ci95, paper=figure, paper_error=error)

    engines = set().union(*(t.results for t in chain(*members.values())))
    cells: dict[str, list[list[Cell]]] = {}
    for engine in sorted(engines):
        cells[engine] = []
        for row in row_names:
            keys = [fixed | {row_axis: row, column_axis: column} for column in column_names]
            cells[engine].append([cell(engine, key) for key in keys])
    return FilledTable(
        title=table.title or (paper.title if paper else METRICS[table.metric]),
        rows=tuple(_shown(row_axis, name) for name in row_names),
        columns=tuple(_shown(column_axis, name) for name in column_names),
        cells=cells,
        members=members,
        paper=paper is not None,
        unit="cm" if fixed.get("metric") == "least_distance" else "%",
    )


def seeds_of(plan: Plan, group: str, evaluation: str) -> tuple[Training, ...]:
    """Return the evaluated trainings of a run of the study. Trainings of one seed, one for each object alone, are
    joined."""
    by_seed: dict[int, list[Training]] = {}
    for run in plan.runs:
        folder = run.folder / evaluation
        if run.group == group and any(folder.glob("*.episodes.json")):
            by_seed.setdefault(run.seed, []).append(read_training(run.name, run.folder, folder))
    return tuple(_joined(f"{group}-seed{seed}", parts) for seed, parts in by_seed.items())


def _joined(label: str, parts: Sequence[Training]) -> Training:
    """Join trainings to one, and number their demonstrations consecutively."""
    if len(parts) == 1:
        return parts[0]
    episodes: Table = pd.concat([t.episodes for t in parts], ignore_index=True)
    numbers = episodes.groupby(["object", "sequence_name"]).ngroup()
    episodes = episodes.assign(run=label, sequence=numbers)
    results = {}
    for engine, own in episodes.groupby("engine"):
        mine = [t.results[str(engine)] for t in parts if engine in t.results]
        demos = "+".join(sorted({s.inputs.get("demos", "")[:12] for s in mine}))
        results[str(engine)] = replace(mine[0], policy=label, episodes=len(own), inputs={"demos": demos})
    return replace(parts[0], label=label, scalars={}, results=results, episodes=episodes, lift=None)


def _episodes_with(members: Sequence[Training], engine: str, objects: set[str]) -> Table:
    """Return the episodes of the given objects in an engine.

    Seeds that miss one of the objects are left out, because a mean over some of the objects is not comparable.
    """
    tables = []
    for member in members:
        own = member.episodes
        own = own[(own["engine"] == engine) & own["object"].isin(list(objects))]
        if set(own["object"]) == objects:
            tables.append(own)
    return pd.concat(tables) if tables else pd.DataFrame()


def objects_of(plan: Plan, group: str, table: TableSpec) -> tuple[str, ...]:
    """Return the objects with which a run of the study is evaluated."""
    objects = set()
    for step in plan.steps.values():
        if step.run is not None and step.run.group == group and step.name.startswith(f"{table.evaluation} "):
            objects.update(step.objects)
    return tuple(sorted(objects))


def _axes(plan: Plan, table: TableSpec, paper: PaperTable | None) -> tuple[Axis, Axis, dict[str, str]]:
    """Return rows, columns, and what is the same in all cells."""
    known = sorted(set().union(*(objects_of(plan, run, table) for run in table.runs)))
    methods = list(table.runs.values())
    if paper is not None:
        names = {"method": methods, "metric": list(METRICS), "object": [*known, ALL]}
        rows = [name for name in paper.values if name in names[paper.rows]]
        columns = [name for name in paper.names if name in names[paper.columns]]
        fixed = {"object": paper.object or ALL, "metric": paper.metric or "task_progress"}
        return (paper.rows, rows), (paper.columns, columns), fixed
    if table.rows == "metric":
        fixed = {"object": canonical_name(table.object, known) if table.object else ALL}
        return ("metric", list(METRICS)), ("method", methods), fixed
    objects = known
    if table.object:
        objects = [canonical_name(table.object, known)]
    elif len(known) > 1:
        objects = [*known, ALL]
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
    size = (max(7.0, 1.1 * len(table.rows) + 2), 2.6 * len(table.cells) + 0.4)
    width = 0.8 / len(table.columns)
    with picture(path, size, text_parse_math=False) as figure:
        panels = figure.subplots(len(table.cells), 1, squeeze=False)[:, 0]
        for ax, (engine, rows) in zip(panels, table.cells.items(), strict=True):
            for j, column in enumerate(table.columns):
                ax.bar(0, 0, color=color(j), label=" " + column)
            for i, cells in enumerate(rows):
                for j, cell in enumerate(cells):
                    at = i + width * (j + 0.5) - 0.4
                    if cell.mean is not None:
                        low, high = cell.ci95
                        error = 100 * np.maximum([[cell.mean - low], [high - cell.mean]], 0)
                        ax.bar(at, 100 * cell.mean, width=0.9 * width, color=color(j))
                        ax.errorbar(at, 100 * cell.mean, yerr=error, fmt="none", ecolor=INK, capsize=2, linewidth=0.8)
                    if cell.paper is not None:
                        ends = [at - 0.45 * width, at + 0.45 * width]
                        ax.plot(ends, [cell.paper] * 2, color="black", linewidth=2)
            ax.set_xticks(range(len(table.rows)), table.rows, fontsize="small")
            if table.unit == "%":
                percent_axis(ax, "y")
                ax.set_ylim(0, 105)
            else:
                ax.set_ylabel(table.unit)
            ax.set_title(engine, fontsize="medium", loc="left")
        last = panels[-1]
        if table.paper:
            last.plot([], [], color="black", linewidth=2, label=" the paper")
        handles, labels = last.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=min(len(labels), 5), frameon=False)
