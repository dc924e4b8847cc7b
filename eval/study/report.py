"""A study's page: its tables beside the paper's figures, what makes them unfair, and what is still missing."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from xreset.eval.pages import render
from xreset.eval.report import fairness
from xreset.eval.report.make import compare
from xreset.eval.study.paper import paper_training
from xreset.eval.study.plan import EvalStep, Plan, Run, TrainStep
from xreset.eval.study.tables import Made, as_rows, broken, draw, fill, versions
from xreset.eval.table import Rows
from xreset.files import write_whole
from xreset.learning.clock import Lift, read_lift
from xreset.text import short_name

_ALIKE = 0.05
"""Trainings whose lengths differ by less are of equal length."""


@dataclass(frozen=True, kw_only=True)
class Page:
    """What was written."""

    path: Path
    tables: tuple[Made, ...]
    notes: tuple[str, ...]
    """What makes the figures incomparable, doubtful or incomplete."""
    runs: Rows


def write_page(plan: Plan, out: Path) -> Page:
    """Write ``study.md``, its pictures, and comparisons of the trainings of each object."""
    amounts = {run.name: run.trained() for run in plan.runs if run.config is not None}
    tables = tuple(fill(plan, table) for table in plan.study.tables)
    notes = tuple(
        dict.fromkeys([*_incomplete(plan), *(note for made in tables for note in _unfair(plan, made, amounts))])
    )
    made = Page(path=out / "study.md", tables=tables, notes=notes, runs=_runs(plan, amounts))
    for i, table in enumerate(tables, 1):
        if table.cells:
            draw(out / f"table-{i}.png", table)
    text = render(
        "study.md.j2", plan=plan, compared=_compare(plan, out), as_rows=as_rows, versions=versions, **vars(made)
    )
    write_whole(made.path, text)
    return made


def _incomplete(plan: Plan) -> Iterator[str]:
    """What the study asks for and does not have yet."""
    undone = [
        step.name
        for step in plan.steps.values()
        if not isinstance(step, TrainStep) and step.kind == "eval" and not step.done()
    ]
    for run in plan.runs:
        if run.config is not None and not plan.steps[f"train {run.name}"].done():
            yield f"The training {run.name} is not finished: {_extent(run, run.trained())}."
    if undone:
        yield f"Not evaluated yet: {', '.join(undone)}."
    for engine, reason in plan.unavailable.items():
        yield f"Not evaluated in {engine} on this machine: {reason.splitlines()[0]}"


def _unfair(plan: Plan, made: Made, amounts: dict[str, Lift]) -> Iterator[str]:
    """What makes a table's figures incomparable, with one another and with the paper's."""
    trainings = [t for members in made.members.values() for t in members]
    if not trainings:
        return
    yield from (f"{made.title}: {note}" for note in (*fairness.notes(trainings), *fairness.health(broken(made))))
    lengths: dict[str, float] = {}
    for name in made.members:
        mine = [run for run in plan.runs if run.group == name and run.name in amounts]
        yield from (
            f"{run.name} began with the networks of {run.weights.name}, whose training counts, too."
            for run in mine
            if run.weights
        )
        if found := [amounts[run.name].env_steps * 1e-6 for run in mine if amounts[run.name].env_steps]:
            lengths[name] = sum(found) / len(found)
            if max(found) > (1 + _ALIKE) * min(found):
                yield f"{made.title}: trainings of {name} are not of equal length ({min(found):.3g} to {max(found):.3g} million steps)."
    if lengths and max(lengths.values()) > (1 + _ALIKE) * min(lengths.values()):
        listing = ", ".join(f"{name} {steps:.3g}" for name, steps in lengths.items())
        yield f"{made.title}: not of equal length (million environment steps of a training: {listing})."
    single = [name for name, members in made.members.items() if name in lengths and len(members) == 1]
    if single:
        yield f"{made.title}: one seed only of {', '.join(single)}; its interval knows of demonstrations alone, so differences may be luck."
    counts = {len(members) for name, members in made.members.items() if name in lengths and members}
    if len(counts) > 1:
        yield f"{made.title}: not the same number of seeds ({', '.join(f'{n} {len(m)}' for n, m in made.members.items() if n in lengths)})."
    if made.paper:
        yield f"{made.title}: the paper's policies took {paper_training()}; ours as listed under Runs."


def _runs(plan: Plan, amounts: dict[str, Lift]) -> Rows:
    head = (
        "run",
        "objects",
        "seed",
        "worlds",
        "minutes",
        "million steps",
        "iterations",
        "from home 10 % after",
        "evaluated",
    )
    body = []
    for run in plan.runs:
        done = sorted({f.stem.removesuffix(".episodes") for f in run.folder.glob("eval*/*.episodes.json")})
        objects = ", ".join(map(short_name, run.objects)) if len(run.objects) < 4 else str(len(run.objects))
        if run.config is None:
            body.append((run.name, objects, "-", "-", "-", "-", "-", "-", ", ".join(done) or "-"))
            continue
        now, spec = amounts[run.name], run.runs
        lift = next((p for p in read_lift(run.folder).passed if p.share == 0.1), None)
        asked = "" if spec.minutes is None else f" of {spec.minutes:g}"
        amount = (
            f"{now.minutes:.1f}{asked}",
            f"{now.env_steps / 1e6:.3g}",
            f"{now.iteration} of {run.config.iterations}",
        )
        lifted = f"{lift.minutes:.1f} min" if lift else "-"
        body.append(
            (
                run.name,
                objects,
                str(run.seed),
                f"{spec.gpus} x {spec.num_envs}",
                *amount,
                lifted,
                ", ".join(done) or "-",
            )
        )
    return Rows(head=head, body=tuple(body))


def _extent(run: Run, now: Lift) -> str:
    assert run.config is not None
    if not now.iteration:
        return "not begun"
    minutes = "" if run.runs.minutes is None else f", {now.minutes:.1f} of {run.runs.minutes:g} minutes"
    return f"{now.iteration} of {run.config.iterations} iterations{minutes}"


def _compare(plan: Plan, out: Path) -> list[str]:
    """Comparisons of the trainings that have the same objects, a folder each."""
    by_objects: dict[tuple[str, ...], list[Run]] = {}
    for run in plan.runs:
        if run.config is not None and (
            any(run.folder.glob("events.out.tfevents.*")) or any(run.folder.glob("eval/*.episodes.json"))
        ):
            by_objects.setdefault(run.objects, []).append(run)
    names = []
    for objects, runs in by_objects.items():
        names.append(f"compare-{short_name(objects[0], '_') if len(objects) == 1 else f'{len(objects)}-objects'}")
        compare([f"{run.group}-seed{run.seed}={run.folder}" for run in runs], out / names[-1])
    return names


def plan_rows(plan: Plan, steps: Sequence[str]) -> Rows:
    """What ``--dry-run`` prints: every step, whether it is done, and what it waits for."""
    body = []
    for name in steps:
        step = plan.steps[name]
        if step.done():
            state = "done"
        elif isinstance(step, TrainStep):
            state = _extent(step.run, step.run.trained())
        else:
            state = f"in {', '.join(step.missing())}" if isinstance(step, EvalStep) else "to do"
        body.append(
            (
                name,
                state,
                f"{step.gpus} GPU" if step.gpus else "CPU",
                ", ".join(n for n in step.needs if not plan.steps[n].done()),
            )
        )
    return Rows(head=("step", "state", "on", "after"), body=tuple(body))
