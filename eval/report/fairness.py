"""Find what makes a comparison unfair or its figures doubtful: sentences for the reader."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import pandas as pd

from xreset.eval.results import Table
from xreset.text import short_name

if TYPE_CHECKING:
    from xreset.eval.report.read import Training

POLICY_CONDITIONS = ("policy", "policy file")
"""Conditions in which the engines of one policy must agree."""
_CONDITIONS = ("objects", "robot", "object meshes", "number of episodes", "seed of the evaluation")
_PLAYED_TASK = ("task.termination.", "task.reset.spawn_", "task.reset.home_noise", "task.timestep")
"""Fields of a training's task that its evaluation keeps (:func:`xreset.task.config.evaluation_task`) and that make it
easier or harder."""
_SAME_NAMES = " Their sequences have the same names: if one was made from the other, as for ik, they are comparable."


def uneven(trainings: Sequence[Training], further: Sequence[str] = ()) -> list[str]:
    """Return a sentence for each condition besides the policy in which evaluations differ; none if all were evaluated
    alike.

    Args:
        further: further conditions to compare, of :data:`POLICY_CONDITIONS`.
    """
    table = _condition_table(trainings)
    if table.empty:
        return []
    tasks = sorted(name for name in table if name.startswith(_PLAYED_TASK))
    found = []
    for name in (*_CONDITIONS, *tasks, *further):
        found += _difference(table, name, name)
    if table["objects"].nunique() == 1:
        same_names = table["sequences"].nunique() == 1
        found += _difference(table, "demonstrations", "demonstrations", _SAME_NAMES if same_names else "")
    for engine, own in table.groupby("engine"):
        found += _difference(own, "version", f"version of {engine}")
    return found


def _condition_table(trainings: Sequence[Training]) -> Table:
    """Return one row for each training and engine: how the training was evaluated there."""
    rows = []
    for training in trainings:
        for engine, result in training.results.items():
            episodes = training.episodes[training.episodes["engine"] == engine]
            row = {
                "run": training.label,
                "engine": engine,
                "version": result.backend_version,
                "policy": result.policy,
                "policy file": result.inputs.get("policy", "")[:12],
                "robot": result.robot,
                "objects": ", ".join(sorted(map(short_name, episodes["object"].unique()))),
                "object meshes": result.objects_folder or "stand-ins",
                "demonstrations": result.inputs.get("demos", "")[:12],
                "sequences": tuple(sorted(set(episodes["object"] + "/" + episodes["sequence_name"]))),
                "number of episodes": result.episodes,
                "seed of the evaluation": result.seed,
            }
            rows.append(row | {name: text for name, text in training.facts.items() if name.startswith(_PLAYED_TASK)})
    return pd.DataFrame(rows)


def _difference(table: Table, column: str, what: str, advice: str = "") -> list[str]:
    """Return a sentence if a condition differs: which value in which evaluation. A training with one value in all of
    its engines is named without the engines."""
    if table[column].nunique() < 2:
        return []
    parts = []
    for value, rows in table.groupby(column, sort=False):
        names = []
        for label, own in rows.groupby("run", sort=False):
            everywhere = len(own) == (table["run"] == label).sum()
            names += [label] if everywhere else [f"{label} in {engine}" for engine in own["engine"]]
        parts.append(f"{value}: {', '.join(names)}")
    return [f"These results are not comparable: not the same {what} ({'; '.join(parts)}).{advice}"]


def begun(trainings: Sequence[Training]) -> list[str]:
    """Return a sentence for each training that began with the networks of another: its curves are not all of its
    learning."""
    found = []
    for training in trainings:
        weights = training.facts.get("weights", "new")
        if weights != "new":
            found.append(
                f"{training.label} began with the networks of another training ({weights}): "
                "its minutes and steps are not all that its policy took."
            )
    return found


def health(found: Table) -> list[str]:
    """Return a sentence for each score (:func:`xreset.eval.report.groups.scores`) with episodes in which the engine
    broke down or dropped contacts."""
    sentences = []
    for row in found.to_dict("records"):
        if row["nonfinite"] or row["overflow"]:
            sentences.append(
                f"Of {row['episodes']} episodes of {row['group']} in {row['engine']}, {row['nonfinite']} stopped being "
                f"finite and {row['overflow']} dropped contacts: that figure means little."
            )
    return sentences


def missing(trainings: Sequence[Training], tags: Sequence[str]) -> list[str]:
    """Return what some of the trainings lack."""
    with_curves = [t for t in trainings if len(t.curves)]
    evaluated = [t for t in trainings if t.results]
    lacking = {
        "No learning curves": [t for t in trainings if t.curves.empty],
        "No evaluation results": [t for t in trainings if not t.results],
        "No run.json, so its configuration is not known": [t for t in trainings if not t.facts],
        "No lift.json, so the first success from home is not known": [t for t in with_curves if t.lift is None],
        "No published success, which an earlier version did not measure": [
            t for t in evaluated if t.episodes["published_success"].isna().any()
        ],
    }
    for tag in tags:
        lacking[f"No curve {tag}"] = [t for t in with_curves if tag not in t.curves]
    for engine in sorted(set().union(*(t.results for t in trainings))):
        lacking[f"Not evaluated in {engine}"] = [t for t in evaluated if engine not in t.results]
    sentences = []
    for what, without in lacking.items():
        if without:
            sentences.append(f"{what}: {', '.join(t.label for t in without)}.")
    return sentences
