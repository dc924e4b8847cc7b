"""Files of a training's state. They are read as tensors and plain values only, so that reading runs no code."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import field, fields
from pathlib import Path
from typing import Annotated, Any

import torch

from xreset.errors import FileFormatError, RunError
from xreset.files.checks import NonNegativeFloat, NonNegativeInt, Rule, from_dict, frozen
from xreset.files.storage import atomic_write, must_exist
from xreset.files.text import shown
from xreset.policy.shipped import whole


def _are_tensors(values: Any) -> bool:
    if not isinstance(values, dict):
        return False
    return all(map(_is_finite, values.values()))


def _is_finite(value: Any) -> bool:
    """Return whether a value is a tensor of finite numbers, all of which are stored.

    One stored number may stand for any number of them, and testing these would fill the memory.
    """
    if not isinstance(value, torch.Tensor):
        return False
    is_stored = value.numel() * value.element_size() <= value.untyped_storage().nbytes()
    return is_stored and bool(value.isfinite().all())


def _is_optimizer(values: dict[str, Any]) -> bool:
    moments = values.get("state")
    return isinstance(moments, dict) and all(map(_are_tensors, moments.values()))


_Networks = Annotated[dict[str, Any], Rule("tensors of finite numbers", _are_tensors)]


@frozen
class Checkpoint:
    """State of a training."""

    actor_state_dict: _Networks
    critic_state_dict: _Networks = field(default_factory=dict)
    """Empty in a distillation, which has none."""
    optimizer_state_dict: Annotated[
        dict[str, Any], Rule("the state of an optimizer", _is_optimizer)
    ]
    iteration: NonNegativeInt
    """Iterations done."""
    env_steps: NonNegativeInt
    """Control steps of all worlds of all processes."""
    elapsed: NonNegativeFloat
    """Time of all iterations [s]."""
    learning_rate: NonNegativeFloat
    average_state_dict: _Networks = field(default_factory=dict)
    """Running mean of the actor's state; empty: the training takes none (``ppo.average``)."""
    resets_state_dict: _Networks = field(default_factory=dict)
    """``success_rate`` of the reset distribution; empty: an earlier version did not write it."""

    @property
    def policy_state_dict(self) -> dict[str, Any]:
        """State of the policy that is exported."""
        return self.average_state_dict or self.actor_state_dict


def write_checkpoint(path: Path, content: Checkpoint) -> None:
    """Write a file that :func:`read_checkpoint` reads; it appears whole or not at all."""
    buffer = io.BytesIO()
    torch.save(vars(content), buffer)
    with atomic_write(path) as file:
        file.write(buffer.getbuffer())


def read_checkpoint(path: Path, device: str | torch.device = "cpu") -> Checkpoint:
    """Read a checkpoint.

    Raises:
        FileFormatError: there is no such file, or it is damaged or not a checkpoint.
    """
    must_exist(path, "checkpoint")
    try:
        content = torch.load(io.BytesIO(whole(path)), map_location=device, weights_only=True)
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


def load_moments(optimizer: torch.optim.Optimizer, moments: dict[int, Any]) -> None:
    """Give an optimizer the moments of a checkpoint; its settings stay.

    Raises:
        ValueError: moments have another shape than their parameters; torch would notice in the next step.
    """
    optimizer.load_state_dict(optimizer.state_dict() | {"state": moments})
    for parameter, loaded in optimizer.state.items():
        for name, value in loaded.items():
            if value.shape not in ((), parameter.shape):
                raise ValueError(
                    f"{name} has shape {tuple(value.shape)}, expected {tuple(parameter.shape)}"
                )
