"""A study's tables: what its runs reach, by engine, beside the paper's figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from xreset.eval.plots import COLORS, INK, percent_axis, picture
from xreset.eval.report.groups import Group, Scores, estimate, scores
from xreset.eval.report.read import Training, read_training
from xreset.eval.rollout import Episode
from xreset.eval.study.file import Table
from xreset.eval.study.paper import ALL, METRICS, PaperTable, paper_tables
from xreset.eval.study.plan import Plan
from xreset.eval.table import Rows
from xreset.objects.catalogue import canonical_name
from xreset.text import short_name


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A figure, in [0, 1]."""

    mean: float | None
    """None: not evaluated."""
    ci95: tuple[float, float]
    """Over demonstrations, and with several seeds over these, too (:func:`xreset.eval.stats.crossed_bootstrap_ci95`)."""
    seeds: int
    paper: float | None
    """What the paper reports, percent."""
    paper_error: float | None = None
    """Its standard error, percent."""


@dataclass(frozen=True, kw_only=True)
class Made:
    """A table, filled."""

    title: str
    rows: tuple[str, ...]
    """As shown; like ``columns``."""
    columns: tuple[str, ...]
    cells: dict[str, tuple[tuple[Cell, ...], ...]]
    """Engine -> row -> column."""
    members: dict[str, tuple[Training, ...]]
    """Run of the study -> its seeds."""
    paper: bool
    """Whether it has figures of the paper."""


def fill(plan: Plan, table: Table) -> Made:
    """Fill a table with what has been evaluated so far.

    Raises:
        FileFormatError: a result is damaged.
    """
    members = {name: seeds_of(plan, name, table.evaluation) for name in table.runs}
    paper = paper_tables()[table.paper] if table.paper else None
    axes = _axes(plan, table, paper)
    engines = sorted({engine for trainings in members.values() for t in trainings for engine in t.episodes})
    run_of = {shown: name for name, shown in table.runs.items()}

    def cell(engine: str, key: Mapping[str, str]) -> Cell:
        expected = set(objects_of(plan, run_of[key["method"]], table)) if key["object"] == ALL else {key["object"]}
        found = [
            chosen for t in members[run_of[key["method"]]] if (chosen := _of(t.episodes.get(engine, ()), expected))
        ]
        mean, ci95 = estimate(found, key["metric"]) if found else (None, (0.0, 0.0))
        figure = paper.figure(key["method"], key["object"], key["metric"]) if paper else None
        return Cell(mean=mean, ci95=ci95, seeds=len(found), paper=figure, paper_error=_paper_error(paper, key))

    (row_axis, row_names), (column_axis, column_names), fixed = axes
    return Made(
        title=table.title or (paper.title if paper else METRICS[table.metric]),
        rows=tuple(_shown(row_axis, name) for name in row_names),
        columns=tuple(_shown(column_axis, name) for name in column_names),
        cells={
            engine: tuple(
                tuple(cell(engine, fixed | {row_axis: row, column_axis: column}) for column in column_names)
                for row in row_names
            )
            for engine in engines
        },
        members=members,
        paper=paper is not None,
    )


def seeds_of(plan: Plan, group: str, evaluation: str) -> tuple[Training, ...]:
    """The evaluated trainings of a run of the study; those of one seed, for each object alone, are taken as one."""
    found: dict[int, list[Training]] = {}
    for run in plan.runs:
        folder = run.folder / evaluation
        if run.group == group and folder.is_dir() and any(folder.glob("*.episodes.json")):
            found.setdefault(run.seed, []).append(read_training(run.name, run.folder, folder))
    return tuple(_joined(f"{group}-seed{seed}", parts) for seed, parts in found.items())


def _joined(label: str, parts: Sequence[Training]) -> Training:
    """One training of several, whose demonstrations are numbered through."""
    if len(parts) == 1:
        return parts[0]
    names = sorted({(e.object, e.sequence_name) for t in parts for episodes in t.episodes.values() for e in episodes})
    number = {name: i for i, name in enumerate(names)}
    engines = sorted({engine for t in parts for engine in t.episodes})
    episodes = {
        engine: tuple(
            replace(e, sequence=number[e.object, e.sequence_name]) for t in parts for e in t.episodes.get(engine, ())
        )
        for engine in engines
    }
    summaries = {}
    for engine in engines:
        mine = [t.summaries[engine] for t in parts if engine in t.summaries]
        demos = "+".join(sorted({s.inputs.get("demos", "")[:12] for s in mine}))
        summaries[engine] = replace(mine[0], policy=label, episodes=len(episodes[engine]), inputs={"demos": demos})
    return Training(
        label=label, folder=parts[0].folder, facts=parts[0].facts, scalars={}, summaries=summaries, episodes=episodes
    )


def _of(episodes: Sequence[Episode], objects: set[str]) -> list[Episode]:
    """Those with the objects; none if one of these is missing, for the mean over some is not that over all."""
    chosen = [e for e in episodes if e.object in objects]
    return chosen if {e.object for e in chosen} == objects else []


def objects_of(plan: Plan, group: str, table: Table) -> tuple[str, ...]:
    """The objects that a run of the study is to be evaluated with."""
    steps = (step for name, step in plan.steps.items() if name.startswith(f"{table.evaluation} "))
    return tuple(sorted({o for s in steps if s.run.group == group for o in (s.subset.objects or s.run.objects)}))  # pyright: ignore[reportAttributeAccessIssue]


def _axes(
    plan: Plan, table: Table, paper: PaperTable | None
) -> tuple[tuple[str, list[str]], tuple[str, list[str]], dict[str, str]]:
    """Rows, columns, and what is the same in all cells."""
    there = sorted({o for name in table.runs for o in objects_of(plan, name, table)})
    methods, metrics = list(table.runs.values()), list(METRICS)
    if paper is not None:
        names: dict[str, list[str]] = {"method": methods, "metric": metrics, "object": [*there, ALL]}
        listed: dict[str, list[str]] = {paper.rows: list(paper.values), paper.columns: list(paper.names)}
        rows, columns = ((axis, [name for name in of if name in names[axis]]) for axis, of in listed.items())
        return rows, columns, {"object": paper.object or ALL, "metric": paper.metric or "task_progress"}
    things = [canonical_name(table.object, there)] if table.object else [*there, ALL] if there[1:] else there
    if table.rows == "run":
        return ("method", methods), ("object", things), {"metric": table.metric}
    return ("object", things), ("method", methods), {"metric": table.metric}


def _paper_error(paper: PaperTable | None, key: Mapping[str, str]) -> float | None:
    if (
        paper is None
        or key[paper.rows] not in paper.standard_error
        or paper.figure(key["method"], key["object"], key["metric"]) is None
    ):
        return None
    return paper.standard_error[key[paper.rows]][paper.names.index(key[paper.columns])]


def _shown(axis: str, name: str) -> str:
    if axis == "object":
        return "all of them" if name == ALL else short_name(name)
    return METRICS[name] if axis == "metric" else name


def as_rows(made: Made, engine: str) -> Rows:
    """One engine's table."""
    body = [(name, *map(cell_text, cells)) for name, cells in zip(made.rows, made.cells[engine], strict=True)]
    return Rows(head=("%", *made.columns), body=tuple(body))


def cell_text(cell: Cell) -> str:
    """``93.2 (88-98), paper 90.8 ± 1.5``."""
    ours = "-" if cell.mean is None else f"{100 * cell.mean:.1f} ({100 * cell.ci95[0]:.0f}-{100 * cell.ci95[1]:.0f})"
    if cell.paper is None:
        return ours
    return f"{ours}, paper {cell.paper:.1f}" + (
        f" \N{PLUS-MINUS SIGN} {cell.paper_error:.1f}" if cell.paper_error is not None else ""
    )


def draw(path: Path, made: Made) -> None:
    """Bars with intervals, a panel for each engine; the paper's figures are black lines across them."""
    engines = list(made.cells)
    size = (max(7.0, 1.1 * len(made.rows) + 2), 2.6 * len(engines) + 0.4)
    with picture(path, size, text_parse_math=False) as figure:
        for ax, engine in zip(figure.subplots(len(engines), 1, squeeze=False)[:, 0], engines, strict=True):
            width = 0.8 / len(made.columns)
            for j, column in enumerate(made.columns):
                color = COLORS[j % len(COLORS)]
                for i, cells in enumerate(made.cells[engine]):
                    cell, at = cells[j], i + width * (j + 0.5) - 0.4
                    if cell.mean is not None:
                        error = 100 * np.maximum([[cell.mean - cell.ci95[0]], [cell.ci95[1] - cell.mean]], 0)
                        ax.bar(at, 100 * cell.mean, width=0.9 * width, color=color)
                        ax.errorbar(at, 100 * cell.mean, yerr=error, fmt="none", ecolor=INK, capsize=2, linewidth=0.8)
                    if cell.paper is not None:
                        ax.plot([at - 0.45 * width, at + 0.45 * width], [cell.paper] * 2, color="black", linewidth=2)
                ax.bar(0, 0, color=color, label=" " + column)
            ax.set_xticks(range(len(made.rows)), made.rows, fontsize="small")
            percent_axis(ax, "y")
            ax.set_ylim(0, 105)
            ax.set_title(engine, fontsize="medium", loc="left")
        if made.paper:
            ax.plot([], [], color="black", linewidth=2, label=" the paper")
        handles, labels = ax.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=min(len(labels), 5), frameon=False)


def versions(made: Made, engine: str) -> str:
    """Those that a table's runs were evaluated in."""
    return ", ".join(
        sorted(
            {t.summaries[engine].backend_version for ts in made.members.values() for t in ts if engine in t.summaries}
        )
    )


def broken(made: Made) -> Scores:
    """Scores of the runs, which tell of episodes in which an engine broke down."""
    return scores([Group(label=name, members=members) for name, members in made.members.items() if members])
