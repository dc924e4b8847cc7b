"""How MuJoCo-Warp is set up: the process, the device, and what of the model differs between worlds."""

from __future__ import annotations

import hashlib
import inspect
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import fields
from functools import cache, partial
from importlib import import_module
from types import ModuleType
from typing import Any
from unittest.mock import patch

import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp
from torch import Tensor

from xreset.backends.mjcf_model import SceneModel
from xreset.backends.workers import usable_cores

_TESTED = "4.0.0"
"""Version of MuJoCo-Warp with which depths of contacts and the order of a step were tested."""
CPU_FLAGS = "-march=native"
"""Flags of the compiler for the CPU. Warp's own flags inline forty times as much: kernels take 1.5 times as long to
compile, and are no faster."""
_ANNOUNCE_AFTER = 3.0
"""Seconds after which the wait for kernels is explained. From the cache they take less."""


def correct_engine() -> None:
    """Correct the depths of contacts, before any kernel is made; warn where it is unknown whether they are wrong."""
    depth = _replacement("mujoco_warp_depth")
    if depth is not None:
        depth.correct_depths()
        return
    warnings.warn(
        f"MuJoCo-Warp {mjw.__version__} finds contacts in another way than {_TESTED}, whose depths are corrected here. "
        f"Grasps may slip. Install mujoco-warp=={_TESTED}, or test with: xreset engines check --engine mujoco-warp",
        stacklevel=3,
    )


def engine_step(device: Any) -> Callable[[Any, Any], None]:
    """Return what advances a model and data, whose kinematics are there, by one step."""
    step = _replacement("mujoco_warp_step")
    if step is None:
        warnings.warn(
            f"MuJoCo-Warp {mjw.__version__} steps in another way than {_TESTED}: objects that slide hop. Install "
            f"mujoco-warp=={_TESTED}",
            stacklevel=3,
        )
        return mjw.step
    streams = [wp.Stream(device), wp.Stream(device)] if device.is_cuda else []
    return partial(step.forked_step, streams)


def order_pairs(model: Any) -> None:
    """Order the pairs of geoms that are tested for collisions, so that tests take less time."""
    step = _replacement("mujoco_warp_step")
    if step is not None:
        step.order_pairs(model)


def _replacement(name: str) -> ModuleType | None:
    """Return a module that replaces parts of the engine; None if the engine's source is not what the module knows."""
    try:
        module = import_module(f"xreset.backends.{name}")
    except (ImportError, AttributeError):  # the engine's private modules have changed
        return None
    return module if source_digest(*module.ORIGINAL) == module.KNOWN_SOURCE else None


@cache
def source_digest(*functions: Callable) -> str:
    """Return a digest of the source of functions; it is read once, because parsing it takes 0.1 s."""
    source = "".join(inspect.getsource(function) for function in functions)
    return hashlib.sha256(source.encode()).hexdigest()[:16]


def contact_room(pieces: int) -> tuple[int, int, int]:
    """Return contacts, convex contacts and rows of constraints that a world needs for an object of n pieces.

    One piece never passed 89 rows under a trained policy. Scissors of 27 pieces reached 278: with the room for one
    piece, 0.17 % of a trained policy's world-steps overflowed (a power drill: 0.06 %), and 52,000 of 70 million in
    training; with 96, 64 and 340 it was 16 of 92 million. Room costs a little time: a step of the soup can took 1.3 %
    less with 128 rows than with 220 (H200, 4,096 worlds).
    """
    # contacts; only pieces that face a finger or the table have any
    more = min(2 * (pieces - 1), 32)
    return 64 + more, 32 + more, 220 + 4 * more


def differing_fields(models: list[Any]) -> list[str]:
    """Return the model fields that can be batched and are not the same in all models."""
    first, *others = models
    names = []
    for field in fields(mjw.Model):
        shape = getattr(field.type, "shape", ())
        if not shape or shape[0] != "*" or not hasattr(first, field.name):
            continue
        value = np.asarray(getattr(first, field.name))
        if not all(
            np.array_equal(value, np.asarray(getattr(other, field.name))) for other in others
        ):
            names.append(field.name)
    return names


def fill_batched(
    model: Any, scenes: dict[int, SceneModel], object_index: Tensor, names: list[str]
) -> None:
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
        values = []
        for scene in scenes.values():
            value = np.array(getattr(scene.model, name))
            if name == "geom_dataid":
                value[scene.parked] = -1  # no mesh in this world
            values.append(value)
        view = wp.to_torch(getattr(model, name))
        table = torch.as_tensor(np.stack(values), dtype=view.dtype, device=row.device)
        view.copy_(table.view(len(order), *view.shape[1:])[row])


def compile_kernels(device: Any, launch: Callable[[], None]) -> int:
    """Compile the kernels that a function launches, on all usable cores, and return the number of their modules.

    Warp compiles a module when one of its kernels is launched first, one module after the other: for an H100 that is
    188 s of one core. The longest module takes 36 s. So the function runs without launching anything, to find the
    modules. It runs twice: some kernels are launched in blocks of the size that Warp suggests, which it does for
    compiled kernels only.
    """
    modules = set()
    cores = usable_cores()  # each thread reads Warp's headers for itself, which takes 3 s
    flags = CPU_FLAGS if wp.get_device(device).is_cpu else wp.config.cpu_compiler_flags
    with patch.object(wp.config, "cpu_compiler_flags", flags), ThreadPoolExecutor(cores) as pool:
        compute = pool.map if cores > 1 else map
        for is_compiled in (False, True):
            found = _modules_launched(launch, is_compiled)
            list(compute(lambda each: each[0].load(device, each[1]), found))
            modules |= {module for module, _ in found}
    return len(modules)


def _modules_launched(
    launch: Callable[[], None], is_compiled: bool
) -> list[tuple[Any, int | None]]:
    """Return the modules whose kernels a function launches, with the size of their blocks, without launching any. Loops
    on the device take one round, because nothing ends them."""
    found: dict[tuple[Any, int | None], None] = {}
    this_thread = threading.get_ident()
    load = wp.Module.load

    def note(module: Any, device: Any, block_dim: int | None = None) -> Any:
        is_suggesting = is_compiled and block_dim is None
        if is_suggesting or threading.get_ident() != this_thread:
            return load(module, device, block_dim)
        found[module, block_dim] = None
        return None  # without a loaded module Warp launches nothing

    def take_one_round(_: Any, while_body: Callable[..., None], **arguments: Any) -> None:
        while_body(**arguments)

    with (
        patch.object(wp.Module, "load", note),
        patch.object(wp, "capture_while", take_one_round),
        patch.object(
            wp,
            "get_suggested_block_size",
            wp.get_suggested_block_size if is_compiled else _usual_block_size,
        ),
    ):
        launch()
    return list(found)


def _usual_block_size(kernel: Any, device: Any = None) -> tuple[int, int]:
    """Stand for Warp's function for a kernel that is not compiled yet: threads of a block, and blocks."""
    kernel.module.load(device)
    return 256, 1


@contextmanager
def announced(device: Any) -> Iterator[None]:
    """Explain a long wait for kernels to the user."""
    text = (
        f"mujoco-warp: compiling kernels for {device}, which takes minutes the first time; they are kept in "
        f"{wp.config.kernel_cache_dir} (set WARP_CACHE_PATH to choose another folder)."
    )
    timer = threading.Timer(_ANNOUNCE_AFTER, print, (text,), {"file": sys.stderr, "flush": True})
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
