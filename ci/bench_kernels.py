"""kernels: where the time of a physics step of mujoco-warp goes, in the worlds of a training. Needs --resets.

The worlds begin in states of the bank, and random actions move the robots for a second. Then each stage is a graph of its own: free motion,
which a step computes next to the collisions, has its own share here; collisions are on two streams, as in a step. The kernels, on a GPU
only, run one after the other without a graph, so some microseconds of each are its launch. Counts are those of the last step, the mean and
in brackets the largest of all worlds; the room is what the engine has for them.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp
from benchlib import Options, seconds_of, trained_env
from rich.console import Console
from rich.table import Table

from xreset.backends import mujoco_warp_step
from xreset.learning.config import TrainConfig
from xreset.resets.inputs import load_inputs

NUM_ENVS = 4096
_PLAYED = 30
"""Control steps of a second before anything is measured."""
_NOISE = 0.3
"""Standard deviation of the actions."""
_STEPS = 16
"""Physics steps that are measured."""
_KERNELS = 12
"""Kernels that the table has."""

Stages = dict[str, Callable[[], None]]


def run(options: Options, console: Console) -> None:
    extra = options.extra
    if extra["resets"] is None:
        console.print("kernels: left out. Give --resets.")
        return
    inputs = load_inputs(extra["resets"], robot=options.robot, meshes=extra["meshes"])  # pyright: ignore[reportArgumentType]
    task = TrainConfig().task
    task = replace(task, reset=replace(task.reset, demo_probability=1.0))
    with trained_env(inputs, task, options) as env:
        generator = torch.Generator(env.device).manual_seed(0)
        for _ in range(_PLAYED):
            shape = (env.num_envs, env.num_actions)
            env.step(_NOISE * torch.randn(shape, device=env.device, generator=generator))
        backend: Any = env.backend
        wp.synchronize_device(backend._warp_device)
        with wp.ScopedStream(wp.Stream() if backend._warp_device.is_cuda else None):
            _print_stages(backend, console)
            if backend._warp_device.is_cuda:
                _print_kernels(backend, console)
        _print_counts(backend, console)


def _stages(backend: Any, aside: wp.Stream | None = None) -> Stages:
    """Return the stages of a step, in an order in which they can run one after the other.

    Args:
        backend: the worlds.
        aside: stream for one kind of the collisions.
    """
    m = backend._model
    d = backend._data

    def make_rows() -> None:
        mjw.make_constraint(m, d)
        mujoco_warp_step.keep_contacts(d)

    def solve() -> None:
        with mujoco_warp_step.more_blocks():
            mjw.solve(m, d)

    return {
        "kinematics": partial(mjw.fwd_kinematics, m, d),
        "free motion": partial(mujoco_warp_step.smooth_dynamics, m, d),
        "collisions": partial(mujoco_warp_step.contacts, m, d, aside),
        "rows of constraints": make_rows,
        "solver": solve,
        "integration": partial(mjw.implicit, m, d),
    }


def _print_stages(backend: Any, console: Console) -> None:
    launches = {}
    aside = wp.Stream() if backend._warp_device.is_cuda else None
    for name, stage in _stages(backend, aside).items():
        with wp.ScopedCapture(device=backend._warp_device) as capture:
            stage()
        graph: Any = capture.graph
        launches[name] = partial(wp.capture_launch, graph)
    times = defaultdict(list)
    for _ in range(_STEPS):
        for name, launch in launches.items():
            times[name].append(seconds_of(launch, str(backend.device)))
    found = {name: 1e6 * float(np.median(values)) for name, values in times.items()}
    _print_shares("stage", found, console)


def _print_kernels(backend: Any, console: Console) -> None:
    stages = _stages(backend)
    wp.timing_begin(cuda_filter=wp.TIMING_KERNEL)
    for _ in range(_STEPS):
        for stage in stages.values():
            stage()
    found: dict[str, float] = defaultdict(float)
    for result in wp.timing_end():
        name = result.name.removeprefix("forward kernel ").replace("__locals__", " ")
        found[name] += 1e3 * result.elapsed / _STEPS
    longest = sorted(found, key=lambda name: -found[name])
    shown = {name: found.pop(name) for name in longest[:_KERNELS]}
    _print_shares("kernel", {**shown, f"{len(found)} others": sum(found.values())}, console)


def _print_shares(what: str, found: dict[str, float], console: Console) -> None:
    """Print microseconds of a step by name, and each one's share."""
    total = sum(found.values())
    table = Table(what, "us of a step", "share")
    for name, time in found.items():
        table.add_row(name, f"{time:,.0f}", f"{time / total:.0%}")
    table.add_row("all", f"{total:,.0f}", "")
    console.print(table)


def _print_counts(backend: Any, console: Console) -> None:
    d = backend._data
    worlds = backend.num_worlds
    contacts = int(d.nacon.numpy()[0])
    by_world = np.bincount(d.contact.worldid.numpy()[:contacts], minlength=worlds)
    table = Table("", "in a world", "room")
    for name, counts, room in (
        ("contacts", by_world, d.naconmax / worlds),
        ("rows of constraints", d.nefc.numpy(), d.njmax),
        ("iterations of the solver", d.solver_niter.numpy(), backend._model.opt.iterations),
    ):
        table.add_row(name, f"{counts.mean():.1f} ({counts.max()})", f"{room:,.0f}")
    console.print(table)
