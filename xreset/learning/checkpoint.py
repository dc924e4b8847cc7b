"""Files of a training's state. They are read as tensors and plain values only, so that reading runs no code."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from itertools import chain, starmap
from math import inf
from pathlib import Path
from typing import Annotated, Any

import torch

from xreset.checks import NotNegative, Rule, from_dict
from xreset.errors import FileFormatError, RunError
from xreset.files import atomic_write
from xreset.text import shown


def _are_tensors(values: Any) -> bool:
    if not isinstance(values, dict):
        return False
    return all(isinstance(value, torch.Tensor) and bool(value.isfinite().all()) for value in values.values())


def _is_setting(name: str, value: Any) -> bool:
    """Return whether an optimizer can have such a setting. torch takes any, and fails in the next step."""
    if name == "params":
        return isinstance(value, list) and all(type(index) is int for index in value)
    if name == "betas":
        return isinstance(value, tuple | list) and len(value) == 2 and all(0 <= beta < 1 for beta in value)
    if name in ("lr", "eps", "weight_decay"):
        return not isinstance(value, bool) and 0 <= float(value) < inf
    return value is None or isinstance(value, bool)


def _is_optimizer(values: dict[str, Any]) -> bool:
    try:
        settings = chain.from_iterable(group.items() for group in values["param_groups"])
        return all(map(_are_tensors, values["state"].values())) and all(starmap(_is_setting, settings))
    except (KeyError, TypeError, ValueError, AttributeError, RuntimeError):
        return False


_Networks = Annotated[dict[str, Any], Rule("tensors of finite numbers", _are_tensors)]


@dataclass(frozen=True, kw_only=True)
class Checkpoint:
    """State of a training."""

    actor_state_dict: _Networks
    critic_state_dict: _Networks
    optimizer_state_dict: Annotated[dict[str, Any], Rule("the state and settings of an optimizer", _is_optimizer)]
    iteration: NotNegative[int]
    """Iterations done."""
    env_steps: NotNegative[int]
    """Control steps of all worlds of all processes."""
    elapsed: NotNegative[float]
    """Time of all iterations [s]."""
    learning_rate: NotNegative[float]


def write_checkpoint(path: Path, content: Checkpoint) -> None:
    """Write a file that :func:`read_checkpoint` reads; it appears whole or not at all."""
    buffer = io.BytesIO()
    torch.save(vars(content), buffer)
    with atomic_write(path) as file:
        file.write(buffer.getbuffer())


def read_checkpoint(path: Path, device: str | torch.device = "cpu") -> Checkpoint:
    """Read a checkpoint.

    Raises:
        FileFormatError: the file is damaged or not a checkpoint.
    """
    try:
        content = torch.load(path, map_location=device, weights_only=True)
    except torch.OutOfMemoryError:
        raise
    except Exception as error:  # torch's own message advises to load without care
        raise FileFormatError(
            f"{path} cannot be read as a checkpoint: it is damaged, or holds more than tensors and plain values. "
            "Move it away to continue from the one before. Do not use it elsewhere if you do not know where it is from."
        ) from error
    if isinstance(content, dict):  # earlier versions wrote more
        content = {f.name: content[f.name] for f in fields(Checkpoint) if f.name in content}
    return from_dict(Checkpoint, content, str(path))


@contextmanager
def must_fit(path: Path) -> Iterator[None]:
    """Turn the errors of loading a checkpoint's content into one ``RunError``."""
    try:
        yield
    except torch.OutOfMemoryError:
        raise
    except Exception as error:
        reason = shown(str(error).partition("\n")[0] or type(error).__name__)
        raise RunError(
            f"{path} does not fit this run ({reason}). Was it written by another run, or another version of xreset?"
        ) from error


def check_moments(optimizer: torch.optim.Optimizer) -> None:
    """Raise ``ValueError`` if the optimizer has loaded moments of another shape than its parameters: torch would notice
    in the next step."""
    for parameter, moments in optimizer.state.items():
        for name, value in moments.items():
            if value.shape not in ((), parameter.shape):
                raise ValueError(f"{name} has shape {tuple(value.shape)}, expected {tuple(parameter.shape)}")
