"""Trainings that differ in their seed only, taken together."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, takewhile

from xreset.eval.report.data import ASPECTS
from xreset.eval.report.progress import processes
from xreset.eval.report.trainings import Training


@dataclass(frozen=True, kw_only=True)
class Group:
    """One line of the picture and one row of the table."""

    label: str
    members: tuple[Training, ...]
    """One training, or several that differ in their seed only."""


def grouped(trainings: Sequence[Training]) -> tuple[tuple[Group, ...], tuple[str, ...]]:
    """Take together what differs in the seed only: the same configuration, each with a seed of its own, and evaluated alike.

    Returns:
        The groups, in the order of their first trainings, and sentences about trainings that have the same configuration and yet are not
        taken together.
    """
    alike: list[list[Training]] = []
    for training in trainings:
        key = _configuration(training)
        found = next((group for group in alike if key and _configuration(group[0]) == key), None)
        if found is None:
            alike.append([training])
        else:
            found.append(training)
    groups, notes = [], []
    for members in alike:
        if len(members) == 1 or (reason := _apart(members)) is None:
            groups.append(Group(label=_label([m.label for m in members]), members=tuple(members)))
        else:
            groups += singles(members)
            notes.append(f"{', '.join(m.label for m in members)} have the same configuration and are not taken together: {reason}.")
    labels = [group.label for group in groups]
    if len(set(labels)) < len(labels):  # names that were shortened to the same
        groups = [Group(label=" + ".join(m.label for m in group.members), members=group.members) for group in groups]
    return tuple(groups), tuple(notes)


def singles(trainings: Sequence[Training]) -> tuple[Group, ...]:
    """Every training for itself."""
    return tuple(Group(label=training.label, members=(training,)) for training in trainings)


def _configuration(training: Training) -> dict[str, object]:
    return {name: fact.value for name, fact in training.facts.items() if name != "seed"}


def _apart(members: Sequence[Training]) -> str | None:
    """Why trainings of one configuration are not repetitions of one another; None if they are."""
    for a, b in combinations(members, 2):
        if a.facts["seed"].value == b.facts["seed"].value:
            return f"{a.label} and {b.label} have the same seed, too"
        if len({processes(t) for t in (a, b)} - {None}) > 1:
            return f"{a.label} was trained with {processes(a)} processes and {b.label} with {processes(b)}"
        for engine in a.summaries.keys() & b.summaries.keys():
            for aspect, get in ASPECTS.items():
                if not aspect.startswith("policy") and get(a.summaries[engine]) != get(b.summaries[engine]):
                    return f"in the evaluations of {a.label} and {b.label} in {engine} the {aspect} differs"
            if _played(a, engine) != _played(b, engine):
                return f"{a.label} and {b.label} were evaluated with different episodes in {engine}"
            if a.summaries[engine].backend_version != b.summaries[engine].backend_version:
                return f"{a.label} and {b.label} were evaluated in different versions of {engine}"
    return None


def _played(training: Training, engine: str) -> set[tuple[int, int]]:
    return {(e.sequence, e.repetition) for e in training.episodes[engine]}


def _label(labels: Sequence[str]) -> str:
    """What the names have in common: ``soup-seed0`` and ``soup-seed1`` are ``soup``."""
    if len(labels) == 1:
        return labels[0]
    common = "".join(letters[0] for letters in takewhile(lambda letters: len(set(letters)) == 1, zip(*labels, strict=False)))
    if any(label[len(common) :][:1].isdigit() for label in labels):
        common = common.rstrip("0123456789")
    return re.sub(r"[-_. ]+(seed|s)?[-_. ]*$", "", common) or " + ".join(labels)
