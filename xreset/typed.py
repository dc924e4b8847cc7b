"""Frozen dataclasses to JSON and back, strictly: an unknown entry is an error, never ignored, and so is a missing one without default."""

from __future__ import annotations

import types
import typing
from dataclasses import MISSING, fields, is_dataclass
from difflib import get_close_matches
from typing import Any, TypeVar

from xreset.checks import Checked, Rule
from xreset.errors import FileFormatError
from xreset.text import shown

T = TypeVar("T")


def from_dict(cls: type[T], data: Any, where: str = "configuration") -> T:
    """Build a dataclass from nested dictionaries as :func:`dataclasses.asdict` and JSON make them.

    What is missing takes its default, so that files stay readable when a field is added: its default must be what was done before.
    A class may list the fields that it no longer has, with the values that mean what is done now: ``REMOVED: ClassVar[dict[str, Any]]``.
    Entries with these values are ignored.

    Raises:
        FileFormatError: names every entry that is unknown, missing, of the wrong type or out of range.
    """
    value, problems = parsed(cls, data, where)
    if value is None:
        raise FileFormatError("\n".join(problems))
    return value


def parsed(cls: type[T], data: Any, where: str) -> tuple[T | None, list[str]]:
    """The dataclass, and nothing; or None, and all that is wrong, a sentence each. Rules of fields (:mod:`xreset.checks`) are looked at."""
    problems: list[str] = []
    value = _record(cls, data, where, problems)
    return (None if problems else value), problems


def _record(cls: type, data: Any, where: str, problems: list[str]) -> Any:
    if not isinstance(data, dict):
        problems.append(f"{where} is {shown(data)}, expected an object with the entries of {cls.__name__}.")
        return None
    before = len(problems)
    removed = getattr(cls, "REMOVED", {})
    for name in sorted(data.keys() & removed.keys()):
        if data[name] != removed[name]:
            problems.append(
                f"{where}.{name} is {shown(data[name])}. This option was removed; only {removed[name]!r} can be read. "
                "Use an earlier version of xreset."
            )
    data = {name: value for name, value in data.items() if name not in removed}
    hints = typing.get_type_hints(cls, include_extras=not issubclass(cls, Checked))  # which looks at its rules itself
    needed = {f.name: f.default is MISSING and f.default_factory is MISSING for f in fields(cls)}
    unknown, missing = (
        sorted(set(data) - set(needed)),
        sorted(name for name in needed if needed[name] and name not in data),
    )
    if unknown or missing:
        named = [
            f"{name} ({guess[0]}?)" if (guess := get_close_matches(str(name), list(needed), cutoff=0.75)) else str(name)
            for name in unknown
        ]
        found = [f"unknown: {', '.join(named)}"] * bool(unknown) + [f"missing: {', '.join(missing)}"] * bool(missing)
        problems.append(
            f"{where} does not fit {cls.__name__} ({'; '.join(found)}). Was it written by another version of xreset?"
        )
    values = {
        name: _value(hints[name], value, f"{where}.{name}", problems) for name, value in data.items() if name in needed
    }
    if len(problems) > before:
        return None
    try:
        return cls(**values)
    except ValueError as error:
        problems.append(f"{where}: {error}.")


_LARGEST = 2**63 - 1


def _value(hint: Any, value: Any, where: str, problems: list[str]) -> Any:
    def wrong(expected: str) -> None:
        problems.append(f"{where} is {shown(value)}, expected {expected}.")

    if is_dataclass(hint):
        return _record(typing.cast(type, hint), value, where, problems)
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        before, made = len(problems), _value(args[0], value, where, problems)
        for rule in args[1:]:
            if len(problems) == before and isinstance(rule, Rule) and made is not None and not rule.holds(made):
                wrong(rule.expected)
        return made
    if origin in (typing.Union, types.UnionType):
        return None if value is None else _value(next(a for a in args if a is not type(None)), value, where, problems)
    if origin is tuple:
        if not isinstance(value, list | tuple):
            return wrong("a list")
        kinds = [args[0]] * len(value) if len(args) == 2 and args[1] is Ellipsis else list(args)
        if len(kinds) != len(value):
            return problems.append(f"{where} has {len(value)} entries, expected {len(kinds)}.")
        return tuple(
            _value(kind, item, f"{where}[{i}]", problems)
            for i, (kind, item) in enumerate(zip(kinds, value, strict=True))
        )
    if hint is Any:
        return value
    if origin is dict:
        if not isinstance(value, dict):
            return wrong("an object")
        return {name: _value(args[1], item, f"{where}.{name}", problems) for name, item in value.items()}
    if origin is typing.Literal:
        return value if value in args else wrong(f"one of {', '.join(map(repr, args))}")
    fits = isinstance(value, (int, float) if hint is float else hint) and not (
        hint in (int, float) and isinstance(value, bool)
    )
    if not fits or (isinstance(value, int) and not -_LARGEST <= value <= _LARGEST):
        return wrong(hint.__name__)
    return float(value) if hint is float else value
