"""What makes a comparison unfair, or its figures doubtful: sentences for the reader."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from xreset.eval.report.groups import Group, Scores
from xreset.eval.report.read import ASPECTS, Training, differences
from xreset.eval.results import EvalResult
from xreset.text import short_name

_OF_EVALUATION = ("task.termination.", "task.reset.spawn_", "task.reset.home_noise", "task.timestep")
"""Fields of a training's task that its evaluation keeps (:func:`xreset.task.config.evaluation_task`) and that make it easier or harder."""


def notes(trainings: Sequence[Training]) -> tuple[str, ...]:
    """Everything in which evaluations differ that is not the policy; empty if all were evaluated alike."""
    evaluated = [t for t in trainings if t.summaries]
    found = [f"{t.label}: {note}" for t in evaluated for note in differences(tuple(t.summaries.values()))]

    def compare(what: str, get: Callable[[EvalResult], Any], advice: str = "") -> None:
        values = {(t.label, engine): get(s) for t in evaluated for engine, s in t.summaries.items()}
        first = {
            get(next(iter(t.summaries.values()))) for t in evaluated
        }  # what differs within a training has been said above
        if len(first) > 1:
            found.append(f"These results are not comparable: not the same {what} ({_listing(values)}).{advice}")

    if len({_sequences(t) for t in evaluated}) == 1:
        files = {
            (t.label, engine): ASPECTS["demonstrations"](s) for t in evaluated for engine, s in t.summaries.items()
        }
        if len(set(files.values())) > 1:
            found.append(
                f"The files of demonstrations differ ({_listing(files)}), their sequences have the same names. That is so if one was made "
                "from the other, such as retargeted trajectories for ik; otherwise the results are not comparable."
            )
    elif len({frozenset(name for _, name in _sequences(t)) for t in evaluated}) > 1:
        found.append(
            f"These results are not comparable: not the same objects ({_listing({(t.label, ''): _objects(t) for t in evaluated})})."
        )
    else:
        compare("demonstrations", ASPECTS["demonstrations"])
    compare("robot", ASPECTS["robot"])
    folders = {s.objects_folder for t in evaluated for s in t.summaries.values()} - {None}
    compare("object meshes", ASPECTS["object meshes"], " Two folders may hold the same meshes." * (len(folders) > 1))
    compare("number of episodes", ASPECTS["number of episodes"])
    compare("seed of the evaluation", ASPECTS["seed"])
    for engine in sorted({engine for t in evaluated for engine in t.summaries}):
        versions = {(t.label, ""): t.summaries[engine].backend_version for t in evaluated if engine in t.summaries}
        if len(set(versions.values())) > 1:
            found.append(f"These results are not comparable: not the same version of {engine} ({_listing(versions)}).")
    for field in sorted({name for t in evaluated for name in t.facts if name.startswith(_OF_EVALUATION)}):
        facts = {(t.label, ""): t.facts[field] for t in evaluated if field in t.facts}
        if len({fact.value for fact in facts.values()}) > 1:
            texts = {name: fact.text for name, fact in facts.items()}
            found.append(
                f"These results are not comparable: each policy plays its own task, whose {field} differs ({_listing(texts)})."
            )
    return tuple(found)


def begun(trainings: Sequence[Training]) -> tuple[str, ...]:
    """Trainings whose curves are not all of their learning."""
    return tuple(
        f"{t.label} began with the networks of another training ({fact.text}): its minutes and steps are not all that its policy took."
        for t in trainings
        if (fact := t.facts.get("weights")) is not None and fact.value is not None
    )


def health(found: Scores) -> tuple[str, ...]:
    """Episodes in which an engine broke down."""
    return tuple(
        f"{count} of {s.episodes} episodes of {label} in {engine} {what}: that figure means little."
        for label, row in found.items()
        for engine, s in row.items()
        for count, what in ((s.nonfinite, "stopped being finite"), (s.overflow, "dropped contacts"))
        if count
    )


def missing(groups: Sequence[Group], tags: Sequence[str]) -> tuple[str, ...]:
    """What some of the trainings have and others have not."""
    members = [m for group in groups for m in group.members]
    found = []
    engines = {engine for m in members for engine in m.summaries}
    for what, of in (
        ("learning curves", lambda m: bool(m.scalars)),
        ("evaluation results", lambda m: bool(m.summaries)),
        ("run.json, so its configuration is not known", lambda m: bool(m.facts)),
    ):
        if without := [m.label for m in members if not of(m)]:
            found.append(f"No {what}: {', '.join(without)}.")
    for tag in tags:
        if without := [m.label for m in members if m.scalars and tag not in m.scalars]:
            found.append(f"No curve {tag}: {', '.join(without)}.")
    for engine in sorted(engines):
        if without := [m.label for m in members if m.summaries and engine not in m.summaries]:
            found.append(f"Not evaluated in {engine}: {', '.join(without)}.")
    return tuple(found)


def _sequences(training: Training) -> frozenset[tuple[str, str]]:
    return frozenset((e.sequence_name, e.object) for episodes in training.episodes.values() for e in episodes)


def _objects(training: Training) -> str:
    return ", ".join(sorted({short_name(name) for _, name in _sequences(training)}))


def _listing(values: dict[tuple[str, str], Any]) -> str:
    """``value: who has it; ...``; a training with the same value in all of its engines is named without them."""
    owners: dict[str, list[tuple[str, str]]] = {}
    for name, value in values.items():
        owners.setdefault(str(value), []).append(name)
    parts = []
    for value, names in owners.items():
        labels = dict.fromkeys(label for label, _ in names)
        whole = [label for label in labels if all((label, e) in names for other, e in values if other == label)]
        single = [f"{label} in {engine}" for label, engine in names if label not in whole]
        parts.append(f"{value}: {', '.join([*whole, *single])}")
    return "; ".join(parts)
