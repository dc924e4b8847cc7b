"""Write a study's page: tables next to the paper's figures, and notes on unfair comparisons and missing results."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import pandas as pd

from xreset.eval.pages import render
from xreset.eval.report import fairness
from xreset.eval.report.curves import AXES
from xreset.eval.report.make import compare
from xreset.eval.report.tables import lifted
from xreset.eval.study.file import TableSpec
from xreset.eval.study.paper import TRAINING
from xreset.eval.study.plan import Plan
from xreset.eval.study.tables import FilledTable, draw, fill
from xreset.eval.table import caption
from xreset.files.storage import write_whole
from xreset.files.text import short_name
from xreset.learning.clock import Lift, read_lift

_ALIKE = 0.05
"""Trainings whose lengths differ by a smaller share are of equal length."""


def write_page(plan: Plan, out: Path) -> tuple[Path, list[str]]:
    """Write ``study.md``, its tables as pictures and CSV, and comparisons of the trainings of each object.

    Returns:
        The page, and its notes: what makes figures incomparable, doubtful or incomplete.
    """
    tables = [fill(plan, table) for table in plan.study.tables]
    metrics: list[TableSpec] = []
    for table in plan.study.tables:
        title = f"Every metric, {table.evaluation}"
        spec = TableSpec(runs=table.runs, title=title, evaluation=table.evaluation, rows="metric")
        if spec not in metrics:
            metrics.append(spec)
    notes = dict.fromkeys(_incomplete(plan))
    for i, table in enumerate(tables, 1):
        if table.engines:
            notes |= dict.fromkeys(f"{table.title}: {note}" for note in _unfair(plan, table))
            draw(out / f"table-{i}.png", table)
            every = pd.concat(
                {e: t.stack("column", future_stack=True) for e, t in table.engines.items()}
            )
            write_whole(
                out / f"table-{i}.csv", every.to_csv(index_label=["engine", "row", "column"])
            )
    content = render(
        "study.md.j2",
        plan=plan,
        tables=tables,
        metrics=[fill(plan, spec) for spec in metrics],
        notes=notes,
        compared=_compare(plan, out),
        lifted={
            label: lifted(_clocks(plan), x) for x, (label, *_) in AXES.items() if x != "iterations"
        },
        versions=caption(run.spec.policy or "" for run in plan.runs),
    )
    write_whole(out / "study.md", content)
    return out / "study.md", list(notes)


def _incomplete(plan: Plan) -> Iterator[str]:
    """Yield what the study asks for and does not have yet."""
    unevaluated = []
    for step in plan.steps.values():
        left = "" if step.kind == "data" else step.left()
        if left and step.kind == "train":
            yield f"The training {step.folder.name} is not finished: {left}."
        elif left:
            unevaluated.append(step.name)
    if unevaluated:
        yield f"Not evaluated yet: {', '.join(unevaluated)}."
    for engine, reason in plan.unavailable.items():
        yield f"Not evaluated in {engine} on this machine: {reason.splitlines()[0]}"


def _unfair(plan: Plan, table: FilledTable) -> Iterator[str]:
    """Yield why a table's figures are not comparable, with one another or with the paper's."""
    by_objects = defaultdict(list)
    for training in chain(*table.trainings.values()):
        by_objects[frozenset(training.episodes["object"])].append(training)
    for trainings in by_objects.values():
        yield from fairness.uneven(trainings)
        yield from fairness.begun(trainings)
    single = []
    for name, episodes in table.episodes.items():
        if len(episodes):
            yield from fairness.health(name, episodes.groupby("engine"))
            if plan.study.runs[name].policy is None and episodes["run"].nunique() == 1:
                single.append(name)
    if single:
        yield (
            f"one seed only of {', '.join(single)}; the interval covers demonstrations alone, so differences may be "
            "chance."
        )
    lengths = {}
    for run in plan.runs:
        steps = read_lift(run.folder).env_steps
        if run.group in table.trainings and steps:
            lengths[run.folder.name] = steps * 1e-6
    if lengths and max(lengths.values()) > (1 + _ALIKE) * min(lengths.values()):
        listing = ", ".join(f"{name} {steps:.3g}" for name, steps in lengths.items())
        yield f"not of equal length (million environment steps: {listing})."
    if table.paper:
        yield f"the paper's policies took {TRAINING}; ours as in the comparisons below."


def _clocks(plan: Plan) -> dict[str, list[Lift]]:
    """Return the lift clocks of each run's trainings; where a run trains objects alone, also those of each object."""
    clocks: defaultdict[str, list[Lift]] = defaultdict(list)
    for run in plan.runs:
        if run.config is not None:
            labels = [run.group]
            if run.spec.alone:
                labels.append(f"{run.group}: {short_name(run.objects[0])}")
            for label in labels:
                clocks[label].append(read_lift(run.folder))
    return clocks


def _compare(plan: Plan, out: Path) -> list[str]:
    """Compare the trainings of the same objects, one folder for each set of objects; return the folders' names."""
    by_objects = defaultdict(list)
    for run in plan.runs:
        has_curves = any(run.folder.glob("events.out.tfevents.*"))
        if run.config is not None and (has_curves or any(run.folder.glob("eval/*.episodes.json"))):
            by_objects[run.objects].append(f"{run.label}={run.folder}")
    names = []
    for objects, runs in by_objects.items():
        what = short_name(objects[0], "_") if len(objects) == 1 else f"{len(objects)}-objects"
        names.append(f"compare-{what}")
        compare(runs, out / names[-1])
    return names
