"""Typed dataclasses: rules for the values of their fields, and strict reading from JSON and TOML.

A rule is part of a field's annotation, as in ``width: PositiveFloat = 0.1``. A number that makes no sense is refused
when a configuration is made, instead of turning into NaN some minutes later.
"""

from __future__ import annotations

import os
import re
import types
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import MISSING, dataclass, fields, is_dataclass, make_dataclass
from difflib import get_close_matches
from functools import cache, wraps
from inspect import Parameter, signature
from math import inf, isfinite
from numbers import Integral
from pathlib import Path
from types import SimpleNamespace
from typing import (
    Annotated,
    Any,
    Literal,
    ParamSpec,
    TypeVar,
    Union,
    cast,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np

from xreset import __version__
from xreset.errors import FileFormatError, WrongValueError, XResetError
from xreset.files.legacy import REMOVED
from xreset.files.text import Brief, shown

P = ParamSpec("P")
T = TypeVar("T")


@dataclass_transform(frozen_default=True, kw_only_default=True)
def frozen(cls: type[T]) -> type[T]:
    """Make a data class whose objects do not change, and whose fields are named where one is made."""
    return dataclass(frozen=True, kw_only=True, repr=not issubclass(cls, Brief))(cls)


@dataclass(frozen=True)
class Rule:
    """What the value of a field must be like, in its annotation. None obeys every rule."""

    expected: str
    holds: Callable[[Any], bool]


def _is_whole(value: Any) -> bool:
    return isinstance(value, Integral)


@dataclass(frozen=True)
class Check:
    """A function that refuses wrong values with ``XResetError``, in the annotation of an argument."""

    refuse: Callable[[Any], Any]


@dataclass(frozen=True)
class Written:
    """Marks the path of a file or folder that a function writes, in its annotation."""


@dataclass(frozen=True)
class Option:
    """Name of an argument as an option of the command, in its annotation, if it is another. None: the command has no
    such option."""

    name: str | None


def _check_place(path: str | Path) -> None:
    """Refuse, with ``XResetError``, an output for which there can be no folder: results would be lost at the end."""
    place = Path(path).absolute()
    folder = next(each for each in (place, *place.parents) if os.path.exists(each))
    if folder == place and not os.path.isdir(place):  # a file, which is replaced
        folder = place.parent
    if not os.path.isdir(folder):
        raise XResetError(
            f"cannot write {path}: {folder} is a file, expected a folder. Choose another place."
        )
    if not os.access(folder, os.W_OK):
        raise XResetError(
            f"cannot write {path}: the folder {folder} is read-only. Choose another place."
        )


def _ends_in(*suffixes: str) -> Rule:
    """Return the rule for the name of a file whose suffix decides what is written."""
    expected = f"a name that ends in {' or '.join(suffixes)}"
    return Rule(expected, lambda path: Path(path).suffix.lower() in suffixes)


Output = Annotated[str | Path, Written(), Check(_check_place)]
"""File or folder that a function writes."""
OutputFile = Annotated[Output, Rule("a file, not a folder", lambda path: not os.path.isdir(path))]
Json = Annotated[OutputFile, _ends_in(".json")]
JsonOrPage = Annotated[OutputFile, _ends_in(".json", ".md")]
Mp4 = Annotated[OutputFile, _ends_in(".mp4")]
Onnx = Annotated[OutputFile, _ends_in(".onnx")]
Png = Annotated[OutputFile, _ends_in(".png")]
PngOrMp4 = Annotated[OutputFile, _ends_in(".png", ".mp4")]
Positive = Annotated[T, Rule("a number above 0 and finite", lambda x: 0 < x < inf)]
"""JSON, and so a run's configuration, has no infinity."""
NotNegative = Annotated[T, Rule("a number from 0 to 1e15", lambda x: 0 <= x <= 1e15)]
"""No time, number of steps or distance is larger: such a number in a file is damage."""
PositiveFloat = Positive[float]
Length = Annotated[float, Rule("a number from 1e-5 to 1e5", lambda x: 1e-5 <= x <= 1e5)]
"""A length [m] that others are divided by: its square is finite, too."""
PositiveInt = Annotated[
    int, Rule("a whole number above 0", lambda x: _is_whole(x) and 0 < x <= 1e15)
]
NonNegativeFloat = NotNegative[float]
NonNegativeInt = Annotated[
    int, Rule("a whole number from 0 to 1e15", lambda x: _is_whole(x) and 0 <= x <= 1e15)
]
FiniteFloat = Annotated[float, Rule("a finite number", isfinite)]
Share = Annotated[float, Rule("a number from 0 to 1", lambda x: 0 <= x <= 1)]
Range = Annotated[
    tuple[float, float],
    Rule("two finite numbers, 0 or more, the lower one first", lambda x: 0 <= x[0] <= x[1] < inf),
]
LARGEST_SEED = 2**32 - 1
"""numpy, torch and the engines take seeds up to this one."""
Seed = Annotated[
    int,
    Rule(
        f"a whole number from 0 to {LARGEST_SEED}",
        lambda x: _is_whole(x) and 0 <= x <= LARGEST_SEED,
    ),
]
Port = Annotated[int, Rule("a whole number from 0 to 65535", lambda x: 0 <= x <= 65535)]
Text = Annotated[str, Rule("a text", lambda text: bool(text.strip()) and text.isprintable())]
Number = Annotated[float, Rule("a finite number of at most 1e9", lambda x: abs(x) <= 1e9)]
"""A number of a robot's description: stiffnesses reach 1e5, everything else is far smaller."""


class Checked:
    """Base of dataclasses whose fields are checked: making one with a value that breaks its field's rule, or is of
    another type, raises ``WrongValueError``, which names every such field."""

    def __post_init__(self) -> None:
        wrong = []
        for name, hint in _hints_of(type(self)).items():
            value = _plain(getattr(self, name))
            object.__setattr__(self, name, value)
            marks = marks_of(type(self))[name]
            broken = _broken_rules(marks, value)
            expected = [rule.expected for rule in broken]
            if not broken and not _is_of(hint, value):
                expected = [mark.expected for mark in marks if isinstance(mark, Rule)]
                expected = expected or [_described(hint)]
            wrong += [f"{name} is {shown(value)}, expected {each}" for each in expected]
        if wrong:
            raise WrongValueError("; ".join(wrong))


def _plain(value: Any) -> Any:
    """Return a value as it comes back from a file: a number of Python, not of numpy, and a tuple, not a list."""
    if isinstance(value, np.generic):
        return value.item()
    return tuple(value) if isinstance(value, list) else value


class Options:
    """Base of dataclasses whose fields are options of a command, shown and checked as if they were its own."""


@cache
def marks_of(cls: type) -> dict[str, list[Any]]:
    """Field name -> what its annotation holds in addition to the type."""
    hints = get_type_hints(cls, include_extras=True)
    return {name: marks_in(hint) for name, hint in hints.items()}


def marks_in(hint: Any) -> list[Any]:
    """Return what an annotation holds in addition to the type."""
    marks = []
    for part in get_args(hint) if _is_union(hint) else (hint,):
        marks += getattr(part, "__metadata__", ())
    return marks


@cache
def _hints_of(cls: type) -> dict[str, Any]:
    """Field name -> type."""
    hints = get_type_hints(cls)
    return {f.name: hints[f.name] for f in fields(cast(Any, cls))}


def _described(hint: Any) -> str:
    """Return what messages call a type."""
    if hint in _NAMES:
        return _NAMES[hint]
    if get_origin(hint) is Literal:
        return f"one of {', '.join(map(repr, get_args(hint)))}"
    if _is_union(hint):
        return " or ".join(map(_described, get_args(hint)))
    if get_origin(hint) is tuple:
        return f"several of: {_described(get_args(hint)[0])}"
    return (get_origin(hint) or hint).__name__


_NAMES = {
    bool: "True or False",
    int: "a whole number",
    float: "a number",
    str: "a text",
    types.NoneType: "None",
}


def _broken_rules(marks: Iterable[Any], value: Any) -> list[Rule]:
    if value is None:
        return []
    return [mark for mark in marks if isinstance(mark, Rule) and not _holds(mark, value)]


def _holds(rule: Rule, value: Any) -> bool:
    try:
        return bool(rule.holds(value))
    except (TypeError, ValueError, IndexError, OverflowError):  # or an integer of 400 digits
        return False


def _is_union(hint: Any) -> bool:
    return get_origin(hint) in (Union, types.UnionType)


def first_repeated(values: Sequence[Any]) -> int | None:
    """Return the index of the first value that equals an earlier one; None: each is given once."""
    return next((i for i, value in enumerate(values) if value in values[:i]), None)


def is_rigid(T: np.ndarray) -> bool:
    """Return whether a matrix [4, 4] is a rotation and a translation: right-handed, without scale, to three digits as
    people write them."""
    R = T[:3, :3]
    is_orthogonal = np.isfinite(T).all() and np.allclose(R @ R.T, np.eye(3), atol=2e-3)
    return bool(is_orthogonal and np.array_equal(T[3], (0, 0, 0, 1)) and np.linalg.det(R) > 0)


def check_value(name: str, value: Any, marks: Iterable[Any]) -> None:
    """Refuse, with ``XResetError``, an argument that breaks a rule of its annotation. None breaks none.

    Args:
        name: name of the argument in messages.
        value: its value.
        marks: what its annotation holds in addition to the type: :func:`marks_in`.
    """
    for rule in _broken_rules(marks, value):
        raise WrongValueError(f"{name} is {shown(value)}, expected {rule.expected}.")
    for mark in marks:
        if isinstance(mark, Check) and value is not None:
            mark.refuse(value)


def obeys_rules(function: Callable[P, T]) -> Callable[P, T]:
    """Return a function that raises ``WrongValueError`` if an argument breaks a rule of its annotation."""

    @wraps(function)
    def call(*positional: P.args, **named: P.kwargs) -> T:
        declared = signature(function)
        try:
            given = declared.bind(*positional, **named).arguments
        except TypeError as error:
            names = ", ".join(name for name in declared.parameters if name != "self")
            raise TypeError(f"{function.__qualname__}() {error}; it takes {names}") from None
        for name, value in given.items():
            check_value(name, value, marks_in(_hint_of(function, name)))
        return function(*positional, **named)

    return call


def _hint_of(function: Callable[..., Any], name: str) -> Any:
    """Return the type of an argument; Any if there is none (``self``), or only type checkers know it."""
    with suppress(KeyError, NameError):
        one = SimpleNamespace(__annotations__={name: function.__annotations__[name]})
        known = getattr(function, "__globals__", None)
        return get_type_hints(one, globalns=known, include_extras=True)[name]
    return Any


def _is_of(hint: Any, value: Any) -> bool:
    """Return whether a value and the items of a tuple are of a type."""
    if _is_union(hint):
        return any(_is_of(part, value) for part in get_args(hint))
    kind = get_origin(hint) or hint
    if kind is Any:
        return True
    if kind is Literal:
        return value in get_args(hint)
    if kind is tuple:
        if not isinstance(value, tuple):
            return False
        kinds = _item_kinds(hint, len(value))
        return len(kinds) == len(value) and all(map(_is_of, kinds, value))
    if kind in (int, float) and isinstance(value, bool):
        return False
    if kind is float:
        return isinstance(value, int | float)
    return isinstance(value, dict if issubclass(kind, dict) else kind)


def _item_kinds(hint: Any, count: int) -> tuple[Any, ...]:
    """Return the types of the items of a tuple; ``count`` of them if it may have any number."""
    kinds = get_args(hint)
    return kinds[:1] * count if kinds[-1] is Ellipsis else kinds


# Reading from JSON and TOML -------------------------------------------------------------------------------------------

_LARGEST = 2**63 - 1
_MOST_NAMED = 20
"""Number of problems, or of unknown entries, that a message names."""


def merged(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Return ``base`` with nested changes.

    A change ``false`` removes a table. A table that names another ``function`` replaces the former one.
    """
    result = dict(base)
    for name, value in changes.items():
        before = base.get(name)
        result[name] = value
        if not isinstance(before, dict):
            continue
        if value is False:
            del result[name]
        elif isinstance(value, dict) and _is_same_function(name, before, value):
            result[name] = merged(before, value)
    return result


def _is_same_function(name: str, before: dict[str, Any], value: dict[str, Any]) -> bool:
    named = value.get("function")
    return named is None or named == before.get("function", name)


def from_dict(cls: type[T], data: Any, where: str = "configuration", version: Any = None) -> T:
    """Build a dataclass from nested dictionaries, as :func:`dataclasses.asdict` and JSON make them.

    A missing entry takes its default, so files stay readable when a field is added: its default must be what was done
    before. Entries that :data:`xreset.files.legacy.REMOVED` lists are ignored if they have the value that is listed. A
    class may list the earlier names of fields: ``RENAMED: ClassVar[dict[str, str]]``, earlier name -> present name.
    ``EARLIER`` is a dataclass of the fields of earlier versions; its method ``entries`` returns what they are called
    today.

    Args:
        cls: the dataclass.
        data: nested dictionaries.
        where: name of the data in messages.
        version: the version of xreset that wrote the data, if they state it.

    Raises:
        FileFormatError: names every entry that is unknown, missing, of the wrong type or out of range.
    """
    value, problems = parsed(cls, data, where, version)
    if value is None:
        raise FileFormatError("\n".join(problems))
    return value


def _release(version: Any) -> list[int]:
    """Return the numbers of a version such as ``0.2.0+g1a2b3c4d5e6f``; none if it is no version."""
    release = version.partition("+")[0] if isinstance(version, str) else ""
    return [int(number) for number in re.findall(r"\d{1,9}", release)]


def parsed(cls: type[T], data: Any, where: str, version: Any = None) -> tuple[T | None, list[str]]:
    """Return the dataclass and no problem, or None and a sentence for each problem. See :func:`from_dict`."""
    problems = []
    value = _parsed_record(cls, data, where, problems)
    if not problems:
        return value, []
    problems = _shortened(problems)
    if _release(version) > _release(__version__):
        problems.append(
            f"It was written by xreset {shown(version)}, and this is xreset {__version__}. "
            "Update xreset, or make it again."
        )
    return None, problems


def renamed(cls: type, data: dict[str, Any]) -> dict[str, Any]:
    """Return the data of a dataclass with the present names of entries; see :func:`from_dict`."""
    found = dict(data)
    for earlier, name in getattr(cls, "RENAMED", {}).items():
        if earlier in found and name not in found:
            found[name] = found.pop(earlier)
    return found


def _parsed_record(cls: type, data: Any, where: str, problems: list[str]) -> Any:
    if not isinstance(data, dict):
        names = ", ".join(_shortened([f.name for f in fields(cls)]))
        problems.append(f"{where} is {shown(data)}, expected an object with the entries {names}.")
        return None
    count = len(problems)
    data = renamed(cls, data)
    removed = REMOVED.get(cls.__name__, {})
    for name in sorted(data.keys() & removed.keys()):
        kept = removed[name] if isinstance(removed[name], tuple) else (removed[name],)
        if data[name] not in kept:
            problems.append(
                f"{where}.{name} is {shown(data[name])}. This option was removed; only {kept[0]!r} can be read. "
                "Use an earlier version of xreset."
            )
    data = {name: value for name, value in data.items() if name not in removed}
    names = [f.name for f in fields(cls)]
    earlier = getattr(cls, "EARLIER", None)
    if earlier is not None and data.keys() & ({f.name for f in fields(earlier)} - set(names)):
        options = _parsed_record(earlier, data, where, problems)
        if options is None:
            return None
        data = options.entries()
    required = {
        f.name for f in fields(cls) if f.default is MISSING and f.default_factory is MISSING
    }
    missing = sorted(required - set(data))
    unknown = sorted(set(data) - set(names))
    found = []
    nearest: list[str] = []
    if unknown:
        keys = []
        for key in _shortened([str(key)[:100] for key in unknown]):
            guesses = get_close_matches(key, names, 1, 0.75)
            nearest += guesses
            keys.append(f"{key} ({guesses[0]}?)" if guesses else key)
        found.append(f"unknown: {', '.join(keys)}")
    if missing:
        found.append(f"missing: {', '.join(missing)}")
    if unknown:
        found.append(f"known: {', '.join(dict.fromkeys([*nearest, *names]))}")
    if found:
        problems.append(f"{where} has wrong entries ({'; '.join(found)}).")
    hints = get_type_hints(cls, include_extras=True)
    values = {
        name: _parsed_value(hints[name], data[name], f"{where}.{name}", problems)
        for name in data
        if name in names
    }
    if len(problems) > count:
        return None
    try:
        return cls(**values)
    except ValueError as error:
        problems.append(f"{where}: {error}.")
        return None


def parsed_arguments(
    function: Callable[..., Any], given: Any, where: str
) -> tuple[dict[str, Any], list[str]]:
    """Return arguments of a function with the types of its annotations, and a sentence for each problem.

    Args:
        function: the function; its first argument is not one of these.
        given: arguments by name, as JSON and TOML have them.
        where: name of the arguments in messages.
    """
    value, problems = parsed(_arguments_of(function), given, where)
    return vars(value) if value is not None else {}, problems


@cache
def _arguments_of(function: Callable[..., Any]) -> type:
    """Return a dataclass whose fields are the arguments of a function, without the first one."""
    _, *parameters = signature(function).parameters.values()
    described: list[Any] = []
    for parameter in parameters:
        field_type = _hint_of(function, parameter.name)
        default = () if parameter.default is Parameter.empty else (parameter.default,)
        described.append((parameter.name, field_type, *default))
    return make_dataclass(function.__name__, described, kw_only=True)


def _shortened(texts: list[str]) -> list[str]:
    """Return the first texts, and the number of the others: a file may have any number of entries."""
    others = len(texts) - _MOST_NAMED
    if others <= 0:
        return texts
    return [*texts[:_MOST_NAMED], f"and {others} more"]


def _parsed_value(hint: Any, value: Any, where: str, problems: list[str]) -> Any:
    """Convert a value to the type of a field, and append what is wrong with it to the problems."""

    def wrong(expected: str) -> None:
        problems.append(f"{where} is {shown(value)}, expected {expected}.")

    origin = get_origin(hint)
    arguments = get_args(hint)
    if is_dataclass(hint):
        return _parsed_record(cast(type, hint), value, where, problems)
    if hint is Any:
        return value
    if origin is Annotated:
        count = len(problems)
        converted = _parsed_value(arguments[0], value, where, problems)
        if len(problems) == count:
            for rule in _broken_rules(arguments[1:], converted):
                wrong(rule.expected)
        return converted
    if _is_union(hint):
        if value is None:
            return None
        kind = next(argument for argument in arguments if argument is not types.NoneType)
        return _parsed_value(kind, value, where, problems)
    if origin is tuple:
        if not isinstance(value, list | tuple):
            return wrong("a list")
        kinds = _item_kinds(hint, len(value))
        if len(kinds) != len(value):
            problems.append(f"{where} has {len(value)} entries, expected {len(kinds)}.")
            return None
        return tuple(
            _parsed_value(kind, value[i], f"{where}[{i}]", problems) for i, kind in enumerate(kinds)
        )
    if origin is dict:
        if not isinstance(value, dict):
            return wrong("an object")
        return {
            name: _parsed_value(arguments[1], item, f"{where}.{name}", problems)
            for name, item in value.items()
        }
    if origin is Literal:
        if value not in arguments:
            return wrong(_described(hint))
        return value
    if issubclass(hint, dict):
        return hint(value) if isinstance(value, dict) else wrong("an object")
    is_large = isinstance(value, int) and abs(value) > _LARGEST
    if not _is_of(hint, value) or is_large:
        return wrong(_described(hint))
    return float(value) if hint is float else value
