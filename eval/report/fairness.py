"""Find what makes a comparison unfair or its figures doubtful: sentences for the reader."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from xreset.eval.report.groups import Group, members_of
from xreset.eval.report.read import Training, conditions, differences
from xreset.eval.results import Table
from xreset.text import short_name

_PLAYED_TASK = ("task.termination.", "task.reset.spawn_", "task.reset.home_noise", "task.timestep")
"""Fields of a training's task that its evaluation keeps (:func:`xreset.task.config.evaluation_task`) and that make it
easier or harder."""
_UNFAIR = "These results are not comparable: "


def notes(trainings: Sequence[Training]) -> tuple[str, ...]:
    """Return everything besides the policy in which evaluations differ; empty if all were evaluated alike."""
    evaluated = [t for t in trainings if t.results]
    found = []
    for training in evaluated:
        found += [f"{training.label}: {note}" for note in differences(tuple(training.results.values()))]
        if training.episodes["published_success"].isna().any():
            found.append(
                f"{training.label}: the published success is missing, because an earlier version evaluated it. "
                "Evaluate it again."
            )
    table = _condition_table(evaluated)
    if table.empty:
        return tuple(found)
    first = table.groupby("run", sort=False).first()  # differences within a training are found above

    def compare(what: str, column: str, advice: str = "") -> None:
        if first[column].nunique() > 1:
            found.append(f"{_UNFAIR}not the same {what} ({_listing(table, column)}).{advice}")

    if first["sequences"].nunique() == 1:
        if table["demonstrations"].nunique() > 1:
            found.append(
                f"The files of demonstrations differ ({_listing(table, 'demonstrations')}), their sequences have the "
                "same names. That is so if one was made from the other, such as retargeted trajectories for ik; "
                "otherwise the results are not comparable."
            )
    else:
        what = "objects" if first["objects"].nunique() > 1 else "demonstrations"
        compare(what, what)
    compare("robot", "robot")
    folders = set(table["object meshes"]) - {"stand-ins"}
    compare("object meshes", "object meshes", " Two folders may hold the same meshes." if len(folders) > 1 else "")
    compare("number of episodes", "number of episodes")
    compare("seed of the evaluation", "seed")
    for engine, own in table.groupby("engine"):
        if own["version"].nunique() > 1:
            found.append(f"{_UNFAIR}not the same version of {engine} ({_listing(own, 'version')}).")
    return (*found, *_task_notes(evaluated))


def _condition_table(trainings: Sequence[Training]) -> Table:
    """Return one row for each training and engine: how the training was evaluated there."""
    rows = []
    for training in trainings:
        names = training.episodes[["sequence_name", "object"]].drop_duplicates()
        played = {
            "run": training.label,
            "sequences": "\n".join(sorted(names["object"] + "/" + names["sequence_name"])),
            "objects": ", ".join(sorted(map(short_name, names["object"].unique()))),
        }
        for engine, result in training.results.items():
            rows.append(played | conditions(result) | {"engine": engine, "version": result.backend_version})
    return pd.DataFrame(rows)


def _task_notes(trainings: Sequence[Training]) -> list[str]:
    """Return a sentence for each field of the task in which the policies' own evaluation tasks differ."""
    rows = []
    for training in trainings:
        for name, fact in training.facts.items():
            if name.startswith(_PLAYED_TASK):
                rows.append({"field": name, "run": training.label, "value": str(fact.value), "text": fact.text})
    if not rows:
        return []
    found = []
    table: Table = pd.DataFrame(rows)
    for field, own in table.groupby("field"):
        if own["value"].nunique() > 1:
            found.append(f"{_UNFAIR}each policy plays its own task, whose {field} differs ({_listing(own, 'text')}).")
    return found


def begun(trainings: Sequence[Training]) -> tuple[str, ...]:
    """Return a sentence for each training that began with the networks of another: its curves are not all of its
    learning."""
    found = []
    for training in trainings:
        weights = training.facts.get("weights")
        if weights is not None and weights.value is not None:
            found.append(
                f"{training.label} began with the networks of another training ({weights.text}): "
                "its minutes and steps are not all that its policy took."
            )
    return tuple(found)


def health(found: Table) -> tuple[str, ...]:
    """Return a sentence for each score (:func:`xreset.eval.report.groups.scores`) with episodes in which the engine
    broke down."""
    sentences = []
    faults = {"nonfinite": "stopped being finite", "overflow": "dropped contacts"}
    for row in found.to_dict("records"):
        for fault, what in faults.items():
            if row[fault]:
                sentences.append(
                    f"{row[fault]} of {row['episodes']} episodes of {row['group']} in {row['engine']} {what}: "
                    "that figure means little."
                )
    return tuple(sentences)


def missing(groups: Sequence[Group], tags: Sequence[str]) -> tuple[str, ...]:
    """Return what some of the trainings lack."""
    members = members_of(groups)
    with_curves = [m for m in members if m.scalars]
    evaluated = [m for m in members if m.results]
    lacking = {
        "No learning curves": [m for m in members if not m.scalars],
        "No evaluation results": [m for m in members if not m.results],
        "No run.json, so its configuration is not known": [m for m in members if not m.facts],
        "No lift.json, so the first success from home is not known": [m for m in with_curves if m.lift is None],
    }
    for tag in tags:
        lacking[f"No curve {tag}"] = [m for m in with_curves if tag not in m.scalars]
    for engine in sorted(set().union(*(m.results for m in members))):
        lacking[f"Not evaluated in {engine}"] = [m for m in evaluated if engine not in m.results]
    sentences = []
    for what, without in lacking.items():
        if without:
            labels = ", ".join(m.label for m in without)
            sentences.append(f"{what}: {labels}.")
    return tuple(sentences)


def _listing(table: Table, column: str) -> str:
    """Return ``value: who has it; ...``; a training with one value in all of its engines is named without the
    engines."""
    parts = []
    for value, rows in table.groupby(column, sort=False):
        whole = []
        single = []
        for label, own in rows.groupby("run", sort=False):
            if len(own) == (table["run"] == label).sum():
                whole.append(label)
            else:
                single += [f"{label} in {engine}" for engine in own["engine"]]
        parts.append(f"{value}: {', '.join([*whole, *single])}")
    return "; ".join(parts)
