"""How MuJoCo-Warp is set up: the process, the device, and what of the model differs between worlds."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields
from typing import Any

import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp
from torch import Tensor

from xreset.backends.mjcf_model import SceneModel
from xreset.errors import BackendUnavailableError

_WRONG_DEPTHS = ("4.0.0",)
"""Versions of MuJoCo-Warp that were seen to take the wrong depth of some contacts. Others are left as they are, and their private modules
unread; ``tests/test_mujoco_warp_depth.py`` says whether they need it too."""
_FORKS = ("4.0.0",)
"""Versions whose step was seen to be the one of :mod:`xreset.backends.mujoco_warp_step`. Others make it themselves."""
_PATIENCE = 3.0
"""Seconds after which the wait for kernels is explained. From the cache they take less."""


def prepare_engine() -> None:
    """Set Warp up for this process, before any kernel is made: quiet, and with right depths of contacts."""
    wp.config.log_level = (
        wp.LOG_WARNING
    )  # else a line for each of some hundred kernels; what a user needs to know is announced
    wp.init()
    if mjw.__version__ in _WRONG_DEPTHS:
        from xreset.backends.mujoco_warp_depth import correct_depths

        correct_depths()


def engine_step(device: Any) -> Callable[[Any, Any], None]:
    """What takes a model and data, whose kinematics are there, one step further."""
    if mjw.__version__ not in _FORKS:
        return mjw.step
    from xreset.backends.mujoco_warp_step import ForkedStep

    return ForkedStep(device)


def existing_device(name: str) -> str:
    """The device with its index; ``BackendUnavailableError`` if it is not there."""
    device = torch.device(name)
    if device.type == "cpu":
        return name
    if device.type != "cuda":
        raise BackendUnavailableError(
            f"the backend 'mujoco-warp' runs on devices 'cuda' and 'cpu', found {str(device)!r}."
        )
    if not torch.cuda.is_available():
        raise BackendUnavailableError(
            "no CUDA device can be used here. Use device 'cpu', or the backend 'mujoco', which is faster on CPUs."
        )
    index = torch.cuda.current_device() if device.index is None else device.index
    if index >= torch.cuda.device_count():
        raise BackendUnavailableError(
            f"there is no device 'cuda:{index}'; there are {torch.cuda.device_count()} CUDA devices."
        )
    return f"cuda:{index}"


def contact_room(pieces: int) -> tuple[int, int, int]:
    """Contacts, convex contacts and rows of constraints that a world needs room for, its object being of so many convex pieces.

    One piece never passed 89 rows under a trained policy. Scissors of 27 pieces reached 278: of the room for one piece, 0.17 % of a trained
    policy's world-steps ran out (a power drill's: 0.06 %), and 52,000 of 70 million in training; with 96, 64 and 340 it was 16 of 92
    million. Room costs a little time: a step of the soup can took 1.3 % less with 128 rows than with 220 (H200, 4,096 worlds).
    """
    more = min(2 * (pieces - 1), 32)  # contacts; only pieces that face a finger or the table have any
    return 64 + more, 32 + more, 220 + 4 * more


def differing_fields(models: list[Any]) -> list[str]:
    """Model fields that can be batched and are not the same in all models."""
    first, *others = models
    names = []
    for field in fields(mjw.Model):
        shape = getattr(field.type, "shape", ())
        if not shape or shape[0] != "*" or not hasattr(first, field.name):
            continue
        value = np.asarray(getattr(first, field.name))
        if any(not np.array_equal(value, np.asarray(getattr(other, field.name))) for other in others):
            names.append(field.name)
    return names


def fill_batched(model: Any, scenes: dict[int, SceneModel], object_index: Tensor, names: list[str]) -> None:
    """Give each world of ``model`` its object's values of the fields in which the objects differ.

    Args:
        model: batched by world.
        scenes: object -> its scene.
        object_index: [N] which object each world holds.
        names: the fields.
    """
    order = list(scenes)
    row = torch.tensor([order.index(i) for i in object_index.tolist()], device=object_index.device)
    for name in names:
        values = [np.array(getattr(scene.model, name)) for scene in scenes.values()]
        if name == "geom_dataid":
            values = [
                np.where(s.parked, -1, value) for s, value in zip(scenes.values(), values, strict=True)
            ]  # -1: no mesh in this world
        view = wp.to_torch(getattr(model, name))
        table = torch.as_tensor(np.stack(values), device=row.device).to(view.dtype).reshape(len(order), *view.shape[1:])
        view.copy_(table[row])


class TorchStream:
    """Has Warp work on torch's current stream, so that what either queues comes in the order of the program."""

    def __init__(self, device: torch.device) -> None:
        self._device, self._warp_device = device, wp.device_from_torch(device)
        self._streams: dict[int, Any] = {}

    @contextmanager
    def __call__(self) -> Iterator[None]:
        """While this lasts."""
        with wp.ScopedDevice(self._warp_device):
            if not self._warp_device.is_cuda:
                yield
                return
            stream = torch.cuda.current_stream(self._device)
            known = self._streams.get(stream.cuda_stream)
            if known is None:
                known = self._streams[stream.cuda_stream] = wp.stream_from_torch(stream)
            with wp.ScopedStream(known, sync_enter=False):
                yield


@contextmanager
def announced(device: Any) -> Iterator[None]:
    """Tell the user what takes so long, if it does."""
    text = (
        f"mujoco-warp: compiling kernels for {device}, one to three minutes the first time; they are kept in {wp.config.kernel_cache_dir}"
        " (set WARP_CACHE_PATH to choose another folder)."
    )
    timer = threading.Timer(_PATIENCE, lambda: print(text, file=sys.stderr, flush=True))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
