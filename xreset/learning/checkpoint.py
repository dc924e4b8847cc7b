"""Files of a training's state. They are read as tensors and plain values only, so that reading runs no code."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from xreset.errors import RunError
from xreset.files import atomic_write
from xreset.text import shown

_KINDS: dict[str, type | tuple[type, ...]] = {
    "actor_state_dict": dict,
    "critic_state_dict": dict,
    "optimizer_state_dict": dict,
    "iteration": int,
    "env_steps": int,
    "elapsed": (int, float),
    "learning_rate": (int, float),
}
"""Entries of a checkpoint."""


def write_checkpoint(path: Path, content: dict[str, Any]) -> None:
    """Write a file that :func:`read_checkpoint` reads; it appears whole or not at all."""
    buffer = io.BytesIO()
    torch.save(content, buffer)
    with atomic_write(path) as file:
        file.write(buffer.getbuffer())


def read_checkpoint(path: Path, device: str | torch.device = "cpu") -> dict[str, Any]:
    """Read a checkpoint.

    Raises:
        RunError: the file is damaged or not a checkpoint.
    """
    try:
        content = torch.load(path, map_location=device, weights_only=True)
    except torch.OutOfMemoryError:
        raise
    except Exception as error:  # torch's own message advises to load without care
        raise RunError(
            f"{path} cannot be read as a checkpoint: it is damaged, or holds more than tensors and plain values. "
            "Move it away to continue from the one before. Do not use it elsewhere if you do not know where it is from."
        ) from error
    for key, kind in _KINDS.items():
        value = content.get(key) if isinstance(content, dict) else None
        is_number = isinstance(value, int | float)
        if not isinstance(value, kind) or isinstance(value, bool) or (is_number and not 0 <= value < math.inf):
            raise RunError(f"{path} is not a checkpoint of xreset: its {key} is {shown(value)}.")
    return {key: content[key] for key in _KINDS}


@contextmanager
def must_fit(path: Path) -> Iterator[None]:
    """Turn the errors of loading a checkpoint's content into one ``RunError``."""
    try:
        yield
    except torch.OutOfMemoryError:
        raise
    except (KeyError, IndexError, TypeError, AttributeError, ValueError, RuntimeError) as error:
        reason = shown(str(error).splitlines()[0] if str(error) else type(error).__name__)
        raise RunError(
            f"{path} does not fit this run ({reason}). Was it written by another run, or another version of xreset?"
        ) from error
