"""Numbers of a configuration that make no sense are refused when it is made, not met as NaN some minutes later: rules at the field."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, is_dataclass
from functools import cache
from math import inf, isfinite
from types import UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np


@dataclass(frozen=True)
class Rule:
    """What a field's value must be like: metadata of its annotation."""

    expected: str
    holds: Callable[[Any], bool]


T = TypeVar("T")
Positive = Annotated[T, Rule("a number above 0", lambda x: 0 < x <= inf)]
"""Infinity will do, where it means that there is no limit: else ``Positive[Finite[float]]``."""
NotNegative = Annotated[T, Rule("a finite number, 0 or more", lambda x: 0 <= x < inf)]
Finite = Annotated[T, Rule("a finite number", isfinite)]
Share = Annotated[T, Rule("a number from 0 to 1", lambda x: 0 <= x <= 1)]
Range = Annotated[
    tuple[float, float], Rule("two finite numbers, 0 or more, the lower one first", lambda x: 0 <= x[0] <= x[1] < inf)
]

Text = Annotated[str, Rule("a text", lambda text: bool(text.strip()) and text.isprintable())]
Number = Annotated[float, Rule("a finite number, and no huge one", lambda x: abs(x) <= 1e9)]
"""Of a robot's description: stiffnesses reach 1e5, everything else far less."""


@dataclass(frozen=True)
class Only:
    """What another field must be for a field to mean anything: metadata of its annotation."""

    field: str
    choice: str


def without_effect(settings: Any, defaults: Any, path: tuple[str, ...] = ()) -> list[str]:
    """What was changed from the defaults and means nothing beside the other settings; a sentence for each field, nested ones with it.

    Args:
        defaults: another of its kind.
        path: names of the fields that lead to it.
    """
    sentences = []
    for name, marks in _marks(type(settings)).items():
        value, default = getattr(settings, name), getattr(defaults, name)
        if is_dataclass(value) and type(value) is type(default):
            sentences += without_effect(value, default, (*path, name))
        for rule in (mark for mark in marks if isinstance(mark, Only)):
            if value != default and (found := getattr(settings, rule.field)) != rule.choice:
                where = ".".join((*path, name))
                sentences.append(
                    f"{where} is {value}, which means something where {rule.field} is {rule.choice}; it is {found}"
                )
    return sentences


class Checked:
    """Base of dataclasses whose fields' annotations hold rules, as in ``width: Positive[float] = 0.1``. None meets every rule.

    Making one raises ``ValueError``, which says of all fields that break a rule what they are and what was expected. NaN is never in range.
    """

    def __post_init__(self) -> None:
        wrong = [
            f"{name} is {value}, expected {rule.expected}"
            for name, marks in _marks(type(self)).items()
            if (value := getattr(self, name)) is not None
            for rule in marks
            if isinstance(rule, Rule) and not rule.holds(value)
        ]
        if wrong:
            raise ValueError("; ".join(wrong))


@cache
def _marks(cls: type) -> dict[str, list[Rule | Only]]:
    """What the annotation of each field says besides its type."""
    return {name: _marks_in(hint) for name, hint in get_type_hints(cls, include_extras=True).items()}


def _marks_in(hint: Any) -> list[Rule | Only]:
    inside = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    return [mark for part in inside for mark in getattr(part, "__metadata__", ()) if isinstance(mark, Rule | Only)]


def is_rigid(T: np.ndarray) -> bool:
    """Whether a matrix [4, 4] is a rotation and a translation: right-handed, without scale, to three digits as people write them."""
    R = T[:3, :3]
    straight = (
        np.isfinite(T).all() and np.allclose(R @ R.T, np.eye(3), atol=2e-3) and np.array_equal(T[3], (0, 0, 0, 1))
    )
    return bool(straight and np.linalg.det(R) > 0)


class Options:
    """Base of dataclasses whose fields are options of a command, shown and checked as if they were its own."""
