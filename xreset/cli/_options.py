"""Commands as functions: what their signatures say about their options is checked before they begin, and shown."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, is_dataclass, replace
from inspect import cleandoc, signature
from itertools import pairwise
from numbers import Integral, Real
from pathlib import Path
from shutil import get_terminal_size
from textwrap import fill
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

from tyro.conf import FlagCreatePairsOff, UseAppendAction, arg
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    StructConstructorSpec,
    StructTypeInfo,
)

from xreset.errors import WrongValueError, XResetError
from xreset.files.checks import Options, Written, check_value, marks_in, marks_of
from xreset.files.storage import INVOCATION, claim

_LONGEST = 1000
"""Largest number of characters of a text or a file name, because messages repeat them."""


@dataclass(frozen=True)
class _Option:
    """An option of a command, as it was given."""

    name: str
    value: Any
    marks: list[Any]

    @property
    def flag(self) -> str:
        return f"--{self.name.replace('_', '-')}"

    @property
    def is_written(self) -> bool:
        """Whether it is a path that the command writes."""
        return _names_output(self.marks) and isinstance(self.value, Path)


def _names_output(marks: Iterable[Any]) -> bool:
    return any(isinstance(mark, Written) for mark in marks)


def checked(command: Callable[..., None]) -> Callable[..., None]:
    """Return the command with its options checked and its output files claimed while it runs."""
    hints = get_type_hints(command, include_extras=True)

    def run(*positional: Any, **named: Any) -> None:
        given = signature(command).bind(*positional, **named).arguments
        options = list(_options_of(given, hints))
        for option in options:
            _check(option)
        _check_overwriting(options)
        with ExitStack() as claims:
            for option in options:
                # the function that writes into a folder claims it; its name may have a dot as well
                path = option.value
                is_file = option.is_written and path.suffix and not path.is_dir()
                if is_file and path.parent.is_dir():
                    claims.enter_context(claim(path))
            command(*positional, **named)

    run.__doc__ = _shortened(command.__doc__ or "")
    run.__annotations__ = {**hints}
    for each in signature(command).parameters.values():
        if each.default is None or each.default == ():  # the text says what happens then
            run.__annotations__[each.name] = _without_default(hints[each.name])
        elif each.default is False:
            run.__annotations__[each.name] = _switch(hints[each.name])
    vars(run)["__signature__"] = signature(command)
    return run


def _without_default(hint: Any) -> Any:
    """Return the type of an option whose default help does not show."""
    return Annotated[hint, arg(help_behavior_hint="")]


def _switch(hint: Any) -> Any:
    """Return the type of a switch that is off by default. Help shows it without the flag that turns it off."""
    is_shown = any(word == "-h" or word.startswith("--help") for word in INVOCATION)
    return Annotated[_without_default(hint), FlagCreatePairsOff] if is_shown else hint


def refuse_empty(words: Iterable[str]) -> None:
    """Refuse, with ``XResetError``, an empty argument, which would be the current folder as a path, and every
    address as a host."""
    option = "An argument"
    for word in words:
        flag, equals, value = word.partition("=")
        is_flag = flag.startswith("--")
        if not word or (is_flag and equals and not value):
            name = flag or option
            raise XResetError(f"{name} is empty. Is a variable of the shell not set?")
        option = flag if is_flag else "An argument"


def refuse_unclear(command: Callable[..., None], words: Sequence[str]) -> None:
    """Refuse, with ``XResetError``, an option that takes several values or names an output, and is given again, because
    only the last one would count; and an option of several values that has none, because it would count as omitted."""
    flags = Counter(
        word.partition("=")[0].replace("_", "-") for word in words if word.startswith("--")
    )
    again = [flag for flag, count in flags.items() if count > 1]
    followed = pairwise([*words, "--"])
    bare = [flag for flag, following in followed if following.startswith("--")]
    for name, hint in get_type_hints(command, include_extras=True).items():
        flag = f"--{name.replace('_', '-')}"
        if flag in again and _names_output(marks_in(hint)):
            raise XResetError(
                f"{flag} is given more than once. Give the command once for each file."
            )
        for flag in _flags_of_lists(f"--{name}", hint):
            if flag in bare and not flag.startswith("--config."):  # there, none is a value
                raise XResetError(f"{flag} has no value. Give one or several, or omit it.")
            if flag in again:
                raise XResetError(
                    f"{flag} is given more than once. Give all of its values together: {flag} A B"
                )


def _flags_of_lists(name: str, hint: Any) -> Iterator[str]:
    """Yield the options of an argument that take any number of values at once."""
    kind = get_origin(hint)
    if UseAppendAction in marks_in(hint):
        return
    if kind in (Union, UnionType):
        for part in get_args(hint):
            yield from _flags_of_lists(name, part)
    elif kind is Annotated:
        yield from _flags_of_lists(name, get_args(hint)[0])
    elif is_dataclass(hint):
        prefix = "--" if isinstance(hint, type) and issubclass(hint, Options) else f"{name}."
        for field, each in get_type_hints(hint, include_extras=True).items():
            yield from _flags_of_lists(prefix + field, each)
    elif kind is dict or (kind is tuple and ... in get_args(hint)):
        yield name.replace("_", "-")


def description(command: Callable[..., None]) -> str:
    """Return what a command does."""
    return fitted(cleandoc(command.__doc__ or "").partition("\nArgs:\n")[0].strip())


def fitted(text: str) -> str:
    """Return paragraphs in lines that end where the terminal ends."""
    width = get_terminal_size().columns
    # tyro joins lines, except to one that begins with a space
    lines = [
        fill(" ".join(each.split()), width, subsequent_indent=" ") for each in text.split("\n\n")
    ]
    return "\n\n".join(lines)


def _shortened(docstring: str) -> str:
    """Return the first sentence of a docstring, for lists of commands, and its arguments, each in one line."""
    text, _, arguments = cleandoc(docstring).partition("\nArgs:\n")
    first = " ".join(text.partition("\n\n")[0].split())
    entries = re.sub(r"\n {5,}", " ", arguments)
    return f"{first}\n\nArgs:\n{entries}" if entries else first


RULES = ConstructorRegistry()
"""How options are read and shown, where it is not as tyro does: ``PATH`` in place of ``{None}|PATH``."""


_ASKED: list[StructTypeInfo] = []
"""Groups of options that tyro's own rule is describing."""


@RULES.struct_rule
def _group(info: StructTypeInfo) -> StructConstructorSpec | None:
    """Describe the options of a dataclass as tyro does, each in one line."""
    if not is_dataclass(info.type) or any(info is asked for asked in _ASKED):
        return None
    _ASKED.append(info)
    spec = ConstructorRegistry.get_struct_spec(info)
    _ASKED.pop()
    if not isinstance(spec, StructConstructorSpec):
        return None
    fields = []
    for field in spec.fields:
        text = field.helptext() if callable(field.helptext) else field.helptext
        kind = field.type
        if field.default is False:
            kind = _switch(kind)
        elif field.default in ((), {}):
            kind = _without_default(kind)
        fields.append(replace(field, type=kind, helptext=" ".join(text.split()) if text else None))

    def make(**values: Any) -> Any:
        try:
            return spec.instantiate(**values)
        except WrongValueError as error:
            text = str(error)
            for name in values:  # an attribute, which the option's name resembles
                text = re.sub(rf"\b{name}\b", name.replace("_", "-"), text)
            raise WrongValueError(text) from error

    return replace(spec, fields=tuple(fields), instantiate=make)


@RULES.primitive_rule
def _number(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Read numbers as tyro does, and say in plain words what is none."""
    kind = info.type
    if kind not in (int, float):
        return None
    expected = "a whole number" if kind is int else "a number"

    def read(words: list[str]) -> Any:
        try:
            return kind(words[0])
        except ValueError:
            raise ValueError(f"found {words[0]!r}, expected {expected}") from None

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=kind.__name__.upper(),
        instance_from_str=read,
        is_instance=lambda value: isinstance(value, Integral if kind is int else Real),
        str_from_instance=lambda value: [str(value)],
    )


@RULES.primitive_rule
def _path(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Read what may be a text or a path as a path."""
    if {*get_args(info.type)} - {NoneType} != {str, Path}:
        return None
    kind = Path | None if NoneType in get_args(info.type) else Path
    spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(kind, info.markers))
    return spec if isinstance(spec, PrimitiveConstructorSpec) else None


@RULES.primitive_rule
def _optional(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    parts = get_args(info.type)
    if info.type_origin not in (Union, UnionType) or len(parts) != 2 or parts[1] is not NoneType:
        return None
    spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(parts[0], info.markers))
    # a range, of two numbers, that a recipe states may be set to None
    if not isinstance(spec, PrimitiveConstructorSpec) or spec.nargs not in (1, 3):
        return None
    return replace(
        spec,
        instance_from_str=lambda text: None if text == ["None"] else spec.instance_from_str(text),
        is_instance=lambda value: value is None or spec.is_instance(value),
        str_from_instance=lambda value: (
            ["None"] if value is None else spec.str_from_instance(value)
        ),
    )


@RULES.primitive_rule
def _terms(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Show a table of terms, which flags of single terms have changed already (:mod:`xreset.cli._terms`)."""
    if not isinstance(info.type, type) or not issubclass(info.type, dict):
        return None

    def read(words: list[str]) -> Any:
        raise ValueError(f"found {' '.join(words)!r}, expected .NAME.PARAMETER VALUE")

    def shown(table: Mapping[str, Mapping[str, Any]]) -> list[str]:
        words = []
        for name, term in table.items():
            words += [f"{name}.{key}={value}" for key, value in term.items()] or [name]
        return words

    return PrimitiveConstructorSpec(
        nargs="*",
        metavar=".NAME.PARAMETER VALUE",
        instance_from_str=read,
        is_instance=lambda value: isinstance(value, dict),
        str_from_instance=shown,
    )


def _options_of(given: Mapping[str, Any], hints: Mapping[str, Any]) -> Iterator[_Option]:
    """Yield the options of a command; those of a group of options one by one."""
    for name, value in given.items():
        if isinstance(value, Options):
            for field, marks in marks_of(type(value)).items():
                yield _Option(field, getattr(value, field), marks)
        else:
            yield _Option(name, value, marks_in(hints[name]))


def _check(option: _Option) -> None:
    """Refuse a value that is against the rules of the option's type."""
    check_value(option.flag, option.value, option.marks)
    for text in option.value if isinstance(option.value, tuple) else (option.value,):
        if isinstance(text, str | Path) and len(str(text)) > _LONGEST:
            raise XResetError(
                f"{option.flag} has {len(str(text))} characters, expected at most {_LONGEST}."
            )
    if isinstance(option.value, float) and not math.isfinite(option.value):
        raise XResetError(f"{option.flag} is {option.value}, expected a finite number.")


def _check_overwriting(options: list[_Option]) -> None:
    """Refuse an output file that is another file of the command."""
    for option in options:
        if not option.is_written or option.value.is_dir():
            continue
        for other in options:
            several = isinstance(other.value, list | tuple)
            files = other.value if several else [other.value]
            paths = [file.resolve() for file in files if isinstance(file, Path)]
            # what is not there is a name, such as that of a policy
            is_file = other.is_written or option.value.exists()
            if other is not option and is_file and option.value.resolve() in paths:
                use = f"is {other.flag} as well" if other.is_written else "the command reads"
                raise XResetError(
                    f"{option.flag} is {option.value}, which {use}. Nothing was overwritten; choose another file."
                )
