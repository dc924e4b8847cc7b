"""Frozen dataclasses to JSON and back, strictly: an unknown entry is an error, never ignored, and so is a missing one without default."""

from __future__ import annotations

import types
import typing
from dataclasses import MISSING, fields, is_dataclass
from difflib import get_close_matches
from typing import Any, TypeVar

from xreset.errors import FileFormatError
from xreset.text import shown

T = TypeVar("T")


def from_dict(cls: type[T], data: Any, where: str = "configuration") -> T:
    """Build a dataclass from nested dictionaries as :func:`dataclasses.asdict` and JSON make them.

    What is missing takes its default, so that files stay readable when a field is added: its default must be what was done before.

    Raises:
        FileFormatError: names the entry that is unknown, missing, of the wrong type or out of range.
    """
    if not isinstance(data, dict):
        raise FileFormatError(f"{where} is {shown(data)}, expected an object with the entries of {cls.__name__}.")
    hints = typing.get_type_hints(cls)
    needed = {f.name: f.default is MISSING and f.default_factory is MISSING for f in fields(cls)}  # pyright: ignore[reportArgumentType]
    unknown, missing = sorted(set(data) - set(needed)), sorted(name for name in needed if needed[name] and name not in data)
    if unknown or missing:
        named = [
            f"{name} ({guess[0]}?)" if (guess := get_close_matches(str(name), list(needed), cutoff=0.75)) else str(name) for name in unknown
        ]
        problems = [f"unknown: {', '.join(named)}"] * bool(unknown) + [f"missing: {', '.join(missing)}"] * bool(missing)
        raise FileFormatError(f"{where} does not fit {cls.__name__} ({'; '.join(problems)}). Was it written by another version of xreset?")
    values = {name: _value(hints[name], value, f"{where}.{name}") for name, value in data.items()}
    try:
        return cls(**values)
    except ValueError as error:
        raise FileFormatError(f"{where}: {error}.") from error


_LARGEST = 2**63 - 1


def _value(hint: Any, value: Any, where: str) -> Any:
    if is_dataclass(hint):
        return from_dict(typing.cast(type, hint), value, where)
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return None if value is None else _value(next(a for a in args if a is not type(None)), value, where)
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise FileFormatError(f"{where} is {shown(value)}, expected a list.")
        kinds = [args[0]] * len(value) if len(args) == 2 and args[1] is Ellipsis else list(args)
        if len(kinds) != len(value):
            raise FileFormatError(f"{where} has {len(value)} entries, expected {len(kinds)}.")
        return tuple(_value(kind, item, f"{where}[{i}]") for i, (kind, item) in enumerate(zip(kinds, value, strict=True)))
    if hint is Any:
        return value
    if origin is dict:
        if not isinstance(value, dict):
            raise FileFormatError(f"{where} is {shown(value)}, expected an object.")
        return {name: _value(args[1], item, f"{where}.{name}") for name, item in value.items()}
    if origin is typing.Literal:
        if value not in args:
            raise FileFormatError(f"{where} is {shown(value)}, expected one of {', '.join(map(repr, args))}.")
        return value
    fits = isinstance(value, (int, float) if hint is float else hint) and not (hint in (int, float) and isinstance(value, bool))
    if not fits or (isinstance(value, int) and not -_LARGEST <= value <= _LARGEST):
        raise FileFormatError(f"{where} is {shown(value)}, expected {hint.__name__}.")
    return float(value) if hint is float else value
