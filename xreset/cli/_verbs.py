"""Functions of the library as commands: the signature and the docstring are the options and the help."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import is_dataclass
from functools import reduce
from inspect import Parameter, Signature, cleandoc, signature
from operator import or_
from pathlib import Path
from time import monotonic
from types import NoneType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from tyro.conf import Positional, UseAppendAction, arg

from xreset.cli._terminal import Progress, console, show_notes
from xreset.files.checks import Option, Options, marks_in

REQUIRED = Parameter.empty
"""Default of an argument that a command must have, and a function need not."""
_TEXTS = (str, Path, bool, int, float, NoneType)
"""Types that an option can have."""


def verb(
    function: Callable[..., Any],
    show: Callable[[Any, Mapping[str, Any]], None] | None = None,
    *,
    prepare: Callable[[dict[str, Any]], None] | None = None,
    **defaults: Any,
) -> Callable[..., None]:
    """Return a function of the library as a command.

    Its first argument needs no flag, unless it is marked as an :class:`~xreset.files.checks.Option`. Of a union of
    types, those that a text can be are taken. A sequence is an option that is given again for each item. An argument
    that no text can be is left out; ``progress`` moves a bar, and ``note`` and ``say`` print a line.

    Args:
        function: the function.
        show: prints what it returns; it also gets the options, and the ``seconds`` that the call took.
        prepare: changes the arguments of the function before the call.
        defaults: other defaults of arguments, by name. A dataclass makes its fields options.
    """
    hints = get_type_hints(function, include_extras=True)
    parameters = signature(function).parameters
    names = {}  # of options -> of arguments
    options = []
    for i, each in enumerate(parameters.values()):
        marks = marks_in(hints[each.name])
        named = [mark.name for mark in marks if isinstance(mark, Option)]
        name = (named or [each.name])[0]
        if name is None:
            continue
        each = each.replace(default=defaults.get(each.name, each.default))
        option = _option(each, hints[each.name], is_positional=i == 0 and not named)
        if option is not None:
            names[name] = each.name
            options.append(option.replace(name=name))
    progress = hints.get("progress")

    def command(**given: Any) -> None:
        arguments = {}
        for name, value in given.items():
            argument = parameters[names[name]]
            if value != () or argument.default is REQUIRED:  # else the function has its own
                arguments[argument.name] = value
        if prepare is not None:
            prepare(arguments)
        if "say" in hints:
            arguments["say"] = console.print
        if "note" in hints:
            arguments["note"] = lambda text: show_notes([text])
        begun = monotonic()
        if progress is None:
            found = function(**arguments)
        else:
            with Progress() as bar:
                staged = len(get_args(progress)[0]) == 3  # with the name of the stage
                moved = bar.stages() if staged else bar.count(function.__name__.replace("_", " "))
                if "say" in hints:
                    bar.stop()  # it may show a page; a film brings the bar back
                found = function(**arguments, progress=moved)
        if show is not None:
            show(found, given | {"seconds": monotonic() - begun})

    command.__name__ = function.__name__
    command.__doc__ = _help(function.__doc__ or "", {old: new for new, old in names.items()})
    command.__annotations__ = {each.name: each.annotation for each in options}
    vars(command)["__signature__"] = Signature(options)
    return command


def _option(argument: Parameter, hint: Any, *, is_positional: bool) -> Parameter | None:
    """Return an argument as a keyword with the type of its option; None if no text can be its value."""
    kinds = list(_kinds(hint))
    items = []  # of a sequence
    for kind in kinds:
        if get_origin(kind) is Sequence:
            items += filter(_can_be_text, _kinds(get_args(kind)[0]))
    single = [kind for kind in kinds if _can_be_text(kind)]
    if argument.default is not None and len(single) > 1:
        single = [kind for kind in single if kind is not NoneType]
    marks = [mark for mark in marks_in(hint) if not isinstance(mark, Option)]
    default = argument.default
    if items:
        option: Any = tuple[reduce(or_, items), ...]
        is_stated = default not in ((), None, Parameter.empty)
        if not is_positional:
            text = f"(default: {default}; repeatable)" if is_stated else "(repeatable)"
            marks += [UseAppendAction, arg(help_behavior_hint=text)]
            default = ()
        elif not is_stated:
            marks.append(arg(help_behavior_hint=""))
            default = () if default is None else default
    elif is_dataclass(default):
        option = type(default)
        if isinstance(default, Options):
            marks.append(arg(name=""))
    elif set(single) - {NoneType}:
        option = reduce(or_, single)
    else:
        return None
    if is_positional:
        marks.append(Positional)
    for mark in marks:
        option = Annotated[option, mark]
    return argument.replace(kind=Parameter.KEYWORD_ONLY, default=default, annotation=option)


def _kinds(hint: Any) -> Iterator[Any]:
    """Yield the types of a union, without marks."""
    if get_origin(hint) is Annotated:
        yield from _kinds(get_args(hint)[0])
    elif get_origin(hint) in (Union, type(int | str)):
        for each in get_args(hint):
            yield from _kinds(each)
    else:
        yield hint


def _can_be_text(kind: Any) -> bool:
    return kind in _TEXTS or get_origin(kind) in (tuple, Literal)


def _help(docstring: str, names: Mapping[str, str]) -> str:
    """Return a docstring as a command has it: without markup, with the names of the options, in sentences.

    Args:
        docstring: docstring of a function.
        names: name of each argument -> name of its option; others are left out.
    """
    text = re.sub(r":\w+:`~?([\w.]*\.)?(\w+)`", r"\2", cleandoc(docstring)).replace("``", "`")
    about, _, rest = text.partition("\nArgs:\n")
    lines = []
    entries = rest.partition("\n\n")[0]
    for entry in re.split(r"\n    (?=\w+: )", "\n" + entries)[1:]:
        name, _, what = entry.partition(": ")
        if name in names:
            end = "" if what.endswith(".") else "."
            lines.append(f"    {names[name]}: {what[0].upper()}{what[1:]}{end}")
    return "\n".join([about, "Args:", *lines])
