"""Check the options of a command, by their names, before the command begins, and show them."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import partial, wraps
from inspect import signature
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Union, get_args

from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from xreset.errors import XResetError
from xreset.files.checks import LARGEST_SEED, LAST_PORT, Options
from xreset.files.storage import check_suffix, claim
from xreset.physics.plugins import existing_device

_COUNTS = {
    "num_envs", "iterations", "episodes", "states", "grasps", "per_object", "max_per_object", "perturbed",
    "most", "processes",
}  # fmt: skip
"""Whole numbers from 1."""
_INDICES = {"seed", "episode", "repetition", "sequence", "frame", "port"}
"""Whole numbers from 0."""
_WRITTEN = ("out", "rest", "png", "mp4", "picture", "json")
"""Files or folders that a command writes."""
_SUFFIXES = {"png": ".png", "mp4": ".mp4", "picture": ".png"}
"""How the name of a file ends that can be written in one format only."""
_IN_PLACE = {"policy"}
"""Options that may name the same file as the output."""
_LONGEST = 1000
"""Largest number of characters of a text or a file name, because messages repeat them."""


def checked(command: Callable[..., None]) -> Callable[..., None]:
    """Return the command with its options checked and its output files claimed while it runs."""
    if isinstance(command, partial):
        return partial(checked(command.func), **command.keywords)

    @wraps(command)
    def run(*positional: Any, **named: Any) -> None:
        options: dict[str, Any] = {}
        for name, value in signature(command).bind(*positional, **named).arguments.items():
            options |= vars(value) if isinstance(value, Options) else {name: value}
        _check(options)
        with ExitStack() as claims:
            for name in _WRITTEN:
                path = options.get(name)
                # the function that writes into a folder claims it; its name may have a dot as well
                if not isinstance(path, Path) or not path.suffix or path.is_dir():
                    continue
                if path.parent.is_dir():
                    claims.enter_context(claim(path))
            command(*positional, **named)

    run.__doc__ = _reflowed(command.__doc__ or "")
    return run


def _reflowed(docstring: str) -> str:
    """Return a docstring with each paragraph and each argument's text on one line, because the terminal's width decides
    where lines end."""
    lines: list[str] = []
    for line in docstring.splitlines():
        begins = not line.strip() or re.match(r"    (Args:|    \w+: )", line)
        if begins or not lines or not lines[-1].strip() or lines[-1].endswith("Args:"):
            lines.append(line)
        else:
            lines[-1] += f" {line.strip()}"
    return "\n".join(lines)


OPTIONAL = ConstructorRegistry()
"""How options that may be left out are read and shown: as ``PATH``, and not as ``{None}|PATH``."""


@OPTIONAL.primitive_rule
def _optional(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    parts = get_args(info.type)
    if info.type_origin not in (Union, UnionType) or len(parts) != 2 or parts[1] is not NoneType:
        return None
    spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(parts[0], info.markers))
    if not isinstance(spec, PrimitiveConstructorSpec) or spec.nargs != 1:
        return None
    return replace(
        spec,
        instance_from_str=lambda text: None if text == ["None"] else spec.instance_from_str(text),
        is_instance=lambda value: value is None or spec.is_instance(value),
        str_from_instance=lambda value: (
            ["None"] if value is None else spec.str_from_instance(value)
        ),
    )


def _check(options: dict[str, Any]) -> None:
    for name, value in options.items():
        flag = f"--{name.replace('_', '-')}"
        if isinstance(value, bool) or value is None:
            continue
        if name in _COUNTS or name in _INDICES:
            low = 1 if name in _COUNTS else 0
            high = LAST_PORT if name == "port" else LARGEST_SEED
            if not low <= value <= high:
                raise XResetError(
                    f"{flag} is {value}, expected a whole number from {low} to {high}."
                )
        if name in _SUFFIXES:
            check_suffix(flag, value, _SUFFIXES[name])
        for text in value if isinstance(value, tuple) else (value,):
            if isinstance(text, str | Path) and len(str(text)) > _LONGEST:
                raise XResetError(
                    f"{flag} has {len(str(text))} characters, expected at most {_LONGEST}."
                )
        if isinstance(value, float) and math.isnan(value):
            raise XResetError(f"{flag} is not a number.")
        if name == "device" and isinstance(value, str):
            existing_device(value)
    _check_overwriting(options)


def _check_overwriting(options: dict[str, Any]) -> None:
    given = {name: value for name, value in options.items() if isinstance(value, Path)}
    for name in _WRITTEN:
        if name not in given or given[name].is_dir():
            continue
        for other, path in given.items():
            if other not in (name, *_IN_PLACE) and path.resolve() == given[name].resolve():
                raise XResetError(
                    f"--{name} is {path}, which is also the {other.replace('_', ' ')}. "
                    "Nothing was overwritten; choose another file."
                )
