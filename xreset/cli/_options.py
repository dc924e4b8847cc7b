"""What every command's options must be like, by their names: checked before work begins, so that no traceback comes after it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial, wraps
from inspect import signature
from pathlib import Path
from typing import Any

from xreset.checks import Options
from xreset.errors import XResetError
from xreset.files import claim

_COUNTS = {
    "num_envs", "iterations", "episodes", "states", "grasps", "per_object", "max_per_object", "max_demos", "perturbed", "per_gpu", "most",
    "processes",
}  # fmt: skip
"""At least 1."""
_INDICES = {"seed", "episode", "repetition", "sequence", "frame", "port"}
"""At least 0."""
_WRITTEN = ("out", "png", "mp4", "picture", "json")
"""Files or folders that a command writes."""
_IN_PLACE = {"policy"}
"""What a command may replace by what it makes of it."""
_LARGEST = 2**32 - 1
"""The largest seed that all of numpy, torch and the engines take; more worlds or episodes no machine holds."""


def checked(command: Callable[..., None]) -> Callable[..., None]:
    """The command, which now refuses impossible options, and keeps to itself what it writes while it runs."""
    if isinstance(command, partial):
        return partial(checked(command.func), **command.keywords)

    @wraps(command)
    def run(*positional: Any, **named: Any) -> None:
        options = _flat(signature(command).bind(*positional, **named).arguments)
        _check(options)
        with _claimed(options):
            command(*positional, **named)

    return run


def _flat(options: dict[str, Any]) -> dict[str, Any]:
    together = [name for name, value in options.items() if isinstance(value, Options)]
    own = {name: value for name, value in options.items() if name not in together}
    return own | {name: value for group in together for name, value in vars(options[group]).items()}


def _check(options: dict[str, Any]) -> None:
    for name, value in options.items():
        flag = f"--{name.replace('_', '-')}"
        if isinstance(value, bool) or value is None:
            continue
        low = 1 if name in _COUNTS else 0 if name in _INDICES else None
        if low is not None and not low <= value <= _LARGEST:
            raise XResetError(f"{flag} is {value}, expected a whole number from {low} to {_LARGEST}.")
        if isinstance(value, float) and math.isnan(value):
            raise XResetError(f"{flag} is not a number.")
        if name == "device" and isinstance(value, str):
            check_device(value)
    _check_overwriting(options)


def check_device(device: str) -> None:
    """Refuse what is no device, and a GPU that is not there."""
    kind, _, number = device.partition(":")
    if kind not in ("cpu", "cuda") or not (number.isdecimal() or (not number and ":" not in device)):
        raise XResetError(f"there is no device {device!r}; expected cpu, cuda or one of several GPUs, such as cuda:1.")
    if kind == "cuda":
        import torch

        count = torch.cuda.device_count()
        if int(number or 0) >= count:
            found = f"{count} of them" if count else "none that torch can use"
            raise XResetError(
                f"--device is {device}, but of GPUs there is {found}. Check the driver with nvidia-smi, or use --device cpu."
            )


def _check_overwriting(options: dict[str, Any]) -> None:
    given = {name: value for name, value in options.items() if isinstance(value, Path)}
    for name in _WRITTEN:
        if name not in given or given[name].is_dir():
            continue
        for other, path in given.items():
            if other not in (name, *_IN_PLACE) and path.resolve() == given[name].resolve():
                raise XResetError(
                    f"--{name} is {path}, which is given as {other.replace('_', ' ')} too. Nothing was overwritten; choose another file."
                )


@contextmanager
def _claimed(options: dict[str, Any]) -> Iterator[None]:
    with ExitStack() as claims:
        for name in _WRITTEN:
            path = options.get(name)
            if (
                isinstance(path, Path) and path.suffix and path.parent.is_dir()
            ):  # a folder is claimed by what writes into it
                claims.enter_context(claim(path))
        yield
