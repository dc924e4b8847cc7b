"""Find what makes a comparison unfair or its figures doubtful: sentences for the reader."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from xreset.eval.report.read import Training, by_engine, how_to_evaluate
from xreset.eval.stats import Table
from xreset.files.storage import file_hash
from xreset.files.text import quantity, short_name
from xreset.learning.run import CHOICE
from xreset.task.config import evaluation_task

_CONDITIONS = ("objects", "object meshes", "number of episodes", "seed of the evaluation")
_OF_ONE_TRAINING = ("robot", "policy", "policy file")
"""Conditions in which the results of one training agree. Trainings may differ in them: they are what is compared."""
_PLAYED_TASK = (
    "task.termination.", "task.reset.spawn_", "task.object_frame", "task.randomization.elastomer",
    "task.randomization.metal", "task.randomization.table",
)  # fmt: skip
"""Fields of a training's task that make its evaluation easier or harder, because the evaluation keeps them
(:func:`xreset.task.config.evaluation_task`). An evaluation may only change the length of episodes."""
_LENGTH = "task.termination.episode_seconds"


_IK = (
    "ik is a baseline without a policy: it plays the robot motion that was retargeted from the demonstration, without "
    "looking where the object is."
)


def doubts(trainings: Sequence[Training], groups: Mapping[str, Sequence[Training]]) -> list[str]:
    """Return what makes a comparison of groups of trainings unfair, and the faults of engines in several trainings."""
    found = uneven(trainings)
    if len(trainings) > 1:
        for label, members in groups.items():
            found += health(label, by_engine(members))
    return found


def remarks(trainings: Sequence[Training]) -> list[str]:
    """Return what a reader must know of each of some trainings, however they are compared."""
    found = begun(trainings)
    for training in trainings:
        found += training.notes
        if not training.results:
            found.append(f"{training.label} has no results. {how_to_evaluate(training.folder)}")
            continue
        found += _outdated(training)
        if len(trainings) == 1:
            found += expected(training)
    return found


def _outdated(training: Training) -> list[str]:
    """Return a sentence if results are of another policy than the run has, which may have gone on since."""
    folder = training.folder
    file = folder / "policy.onnx"
    if training.run is None or not file.is_file() or (folder / CHOICE).is_file():
        return []
    present = file_hash(file)
    engines = []
    for engine, result in training.results.items():
        if result.inputs.get("policy", present) != present:
            engines.append(engine)
    if not engines:
        return []
    return [
        f"The results of {training.label} in {', '.join(engines)} are of another policy than its policy.onnx. If the "
        f"training went on since, evaluate again: xreset eval {folder} --demos DEMOS"
    ]


def expected(training: Training) -> list[str]:
    """Return what a reader should expect of the results: those of a baseline, and of a training that was too short."""
    found = []
    if training.first.policy == "ik":
        found.append(_IK)
    lift = training.lift
    reached = training.episodes["reorient_once"].any()
    if lift.iteration and not lift.passed and not reached:
        length = f"{quantity(lift.iteration, 'iteration')} ({lift.minutes:.2g} min)"
        found.append(
            f"No object gets to its goal, as expected: in {length}, the training has not once brought an object to its "
            "goal from home. Most trainings need minutes on a GPU for that."
        )
    return found


def uneven(trainings: Sequence[Training]) -> list[str]:
    """Return a sentence for each condition in which the evaluations of trainings differ. For a single training, robot
    and policy are conditions, too, because all engines must have played the same ones."""
    table = _condition_table(trainings)
    if table.empty:
        return []
    tasks = sorted(name for name in table if name.startswith("task."))
    found = []
    of_one = _OF_ONE_TRAINING if len(trainings) == 1 else ()
    for name in (*_CONDITIONS, *tasks, *of_one):
        found += _difference(table, name, name)
    if table["objects"].nunique() == 1:
        found += _difference(table, "demonstrations", "demonstrations")
    for engine, own in table.groupby("engine"):
        found += _difference(own, "version", f"version of {engine}")
    return found


def _condition_table(trainings: Sequence[Training]) -> Table:
    """Return one row for each training and engine: how the training was evaluated there."""
    rows = []
    for training in trainings:
        for engine, result in training.results.items():
            episodes = training.episodes[training.episodes["engine"] == engine]
            folder = result.meshes
            row: dict[str, Any] = {
                "run": training.label,
                "engine": engine,
                "version": result.engine_version,
                "policy": result.policy,
                "policy file": result.inputs.get("policy", "")[:12],
                "robot": result.robot,
                "objects": ", ".join(sorted(map(short_name, episodes["object"].unique()))),
                # the absolute path, because a relative one may mean the same folder
                "object meshes": str(Path(folder).resolve()) if folder else "stand-ins",
                "demonstrations": result.inputs.get("demos", "")[:12],
                "number of episodes": len(result.nominal),
                "seed of the evaluation": result.seed,
            }
            row |= _played_task(training)
            if result.episode_seconds is not None:  # may differ from the training's
                row[_LENGTH] = f"{result.episode_seconds:.6g}"
            if result.object_frame is not None:  # a policy that ships has no training here
                row["task.object_frame"] = result.object_frame
            rows.append(row)
    return pd.DataFrame(rows)


def _played_task(training: Training) -> dict[str, str]:
    """Return what evaluations keep of a training's task, by name, as text. They have the mean of its range of friction,
    and a timestep of their own unless the time between actions does not allow it."""
    kept = {name: x for name, x in training.facts.items() if name.startswith(_PLAYED_TASK)}
    if training.run is not None:
        task = evaluation_task(training.run.config.task)
        kept["task.timestep"] = f"{task.timestep:.6g}"
        kept["task.randomization.friction"] = f"{sum(task.randomization.friction) / 2:.6g}"
    return kept


def _difference(table: Table, column: str, what: str) -> list[str]:
    """Return a sentence that lists the evaluations with each value of a condition; none if all have the same value.
    A training with one value in all of its engines is named without the engines."""
    if table[column].nunique() < 2:
        return []
    parts = []
    for value, rows in table.groupby(column, sort=False):
        names = []
        for label, own in rows.groupby("run", sort=False):
            everywhere = len(own) == (table["run"] == label).sum()
            names += [label] if everywhere else [f"{label} in {engine}" for engine in own["engine"]]
        parts.append(f"{value}: {', '.join(names)}")
    return [f"These results are not comparable: not the same {what} ({'; '.join(parts)})."]


def begun(trainings: Sequence[Training]) -> list[str]:
    """Return a sentence for each training that began with the networks of another, because its curves do not show all
    of its policy's learning."""
    found = []
    for training in trainings:
        weights = training.facts.get("weights", "new")
        if weights != "new":
            found.append(
                f"{training.label} began with the networks of another training ({weights}), "
                "whose minutes and steps are not counted here."
            )
    return found


def health(label: str, episodes: Iterable[tuple[Any, Table]]) -> list[str]:
    """Return a sentence for each engine in which it broke down or dropped contacts.

    Args:
        label: name of the training.
        episodes: :func:`xreset.eval.report.read.by_engine`.
    """
    sentences = []
    for engine, own in episodes:
        nonfinite = int(own["nonfinite"].sum())
        overflow = int(own["overflow"].sum())
        if nonfinite or overflow:
            sentences.append(
                f"Of {len(own)} episodes of {label} in {engine}, {nonfinite} stopped being finite and {overflow} "
                "dropped contacts: that figure means little."
            )
    return sentences
