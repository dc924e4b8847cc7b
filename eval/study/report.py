"""Write a study's page: tables next to the paper's figures, and notes on unfair comparisons and missing results."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

from xreset.eval.report import fairness
from xreset.eval.report.make import PageTable, Report, collect, write_report
from xreset.eval.report.read import Training, read_training, versions
from xreset.eval.results import has_results
from xreset.eval.study.file import TableSpec
from xreset.eval.study.paper import TRAINING
from xreset.eval.study.plan import Plan
from xreset.eval.study.tables import FilledTable, fill
from xreset.learning.clock import read_lift

_ALIKE = 0.05
"""Trainings whose lengths differ by a smaller share are of equal length."""


def write_page(plan: Plan, out: Path) -> Report:
    """Write the report of a study's runs, with the study's tables first. Its notes say what makes figures incomparable,
    doubtful or incomplete."""
    notes = list(_incomplete(plan))
    page_tables = []
    for spec in plan.study.tables:
        table = fill(plan, spec)
        if not table.engines:
            notes.append(f"{table.title}: nothing is evaluated yet.")
            continue
        notes += [f"{table.title}: {note}" for note in _unfair(plan, spec, table)]
        for engine, rows in table.engines.items():
            played = versions(chain(*table.trainings.values()), engine)
            note = f"{_note(spec, table.unit)} {table.counts(engine)}"
            title = f"{table.title}: {engine} {played}"
            page_tables.append(PageTable(title=title, rows=rows, note=note))
    report = collect(
        list(_trainings(plan)),
        title=f"Study {plan.name}: {plan.study.about}",
        notes=notes,
        page_tables=page_tables,
    )
    return write_report(report, out)


def _note(spec: TableSpec, unit: str) -> str:
    """Return what the figures of a table are."""
    text = (
        f"{'Centimetres' if unit == 'cm' else 'Percent'}, mean and in brackets the 95 % interval: a bootstrap "
        "over demonstrations and, where there are several, over seeds, too; over two or three seeds it is too narrow."
    )
    if spec.paper:
        text += " The paper's figures follow, with their standard error where it states one."
    return f"{text} All of them: the mean over all episodes, left out while an object is missing."


def _trainings(plan: Plan) -> Iterator[Training]:
    """Yield the runs that have begun to learn or were evaluated."""
    for run in plan.runs:
        has_curves = any(run.folder.glob("events.out.tfevents.*"))
        evaluations = [name for group, name in plan.played if group == run.group]
        evaluated = [run.folder / name for name in evaluations if has_results(run.folder / name)]
        if has_curves or evaluated:
            results = next(iter(evaluated), run.folder / "eval")
            yield read_training(run.folder, run.folder.name, results)


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


def _unfair(plan: Plan, spec: TableSpec, table: FilledTable) -> Iterator[str]:
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
    if spec.paper:
        yield f"the paper's policies took {TRAINING}; ours as in the table of what differs."
