"""training: environment steps per second of a training on mujoco-warp, and where its time goes.

raw       the captured graph of the engine's own step, as many times as a control step has physics steps, timed inside the steps of env: how
          long a step takes depends on what the worlds are doing, so it is timed in the same worlds at the same moments; next to it the
          rate that the same graph reaches in worlds left to themselves, their targets constant
env       ManipulationEnv.step with random actions, resets from home and bank included; next to it the share of raw
rollout   env and the policy, the value and the storage
update    the rest of a PPO iteration: all epochs over the rollout
train     whole iterations; next to it how many seconds of physics they simulate in a second
The worlds start from a bank of retargeted synthetic demonstrations, or from --resets. --recipe and --precision as in training.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from benchlib import OBJECT, Options, rate, run_time, seconds_of, trained_env
from rich.console import Console
from rich.table import Table

from xreset.env.manipulation import ManipulationEnv
from xreset.learning.config import TrainConfig
from xreset.learning.recipes import starting_config
from xreset.learning.runner import TrainingRunner
from xreset.physics.plugins import backend_status
from xreset.resets.inputs import load_inputs


def add_arguments(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--resets",
        type=Path,
        help="reset bank (default: one of a synthetic soup-can demonstration)",
    )
    group.add_argument("--meshes", type=Path, help="folder of real meshes")
    group.add_argument("--recipe", default="paper", help="as in training")
    group.add_argument("--precision", default="bfloat16", choices=["float32", "tf32", "bfloat16"])
    group.add_argument("--iterations", type=int, default=5, help="PPO iterations to time")


def run(options: Options, console: Console) -> None:
    reason = backend_status("mujoco-warp").reason
    if reason is not None:
        console.print(f"training: left out. {reason}")
        return
    with tempfile.TemporaryDirectory() as folder:
        resets = options.extra["resets"] or _synthetic_bank(options.robot, Path(folder))
        inputs = load_inputs(resets, robot=options.robot, meshes=options.extra["meshes"])
        config = starting_config(options.extra["recipe"])
        config = replace(config, ppo=replace(config.ppo, precision=options.extra["precision"]))
        with trained_env(inputs, config.task, options) as env:
            console.print(_measure(env, config, options, Path(folder)))


def _measure(env: ManipulationEnv, config: TrainConfig, options: Options, folder: Path) -> Table:
    n = env.num_envs
    device = options.device
    env.episode_length_buf = torch.randint_like(env.episode_length_buf, high=env.max_episode_length)

    def act() -> torch.Tensor:
        return 2.0 * torch.rand(n, env.num_actions, device=env.device) - 1.0

    for _ in range(20):
        env.step(act())
    raw, stepped = _physics_and_env(env, act, options)
    backend = env.backend
    with backend._on_stream():
        still = rate(
            lambda: [backend._run("step") for _ in range(backend.scene.substeps)],
            options.seconds,
            device,
        )
    env.reset()
    runner = TrainingRunner(env, config, folder / "run")
    runner.learn(2)
    alg = runner.alg
    horizon = config.ppo.horizon
    obs = env.get_observations()

    def roll_out() -> None:
        nonlocal obs
        alg.storage.clear()
        with torch.no_grad():
            for _ in range(horizon):
                obs, reward, done, extras = env.step(alg.act(obs))
                alg.process_env_step(obs, reward, done, extras)
            alg.compute_returns(obs)

    collect = []
    learn = []
    for _ in range(options.extra["iterations"]):
        collect.append(seconds_of(roll_out, device))
        learn.append(seconds_of(alg.update, device))
    runner.elapsed = 0.0
    before = runner.env_steps
    runner.learn(runner.iteration + options.extra["iterations"])
    trained = (runner.env_steps - before) / runner.elapsed
    rolled, updated = (horizon / sorted(times)[len(times) // 2] for times in (collect, learn))

    table = Table(
        "",
        "env steps/s",
        "ms per control step",
        "",
        title=f"training: {n} worlds, {options.robot}, {options.extra['recipe']}, {config.ppo.precision}",
    )
    simulated = trained * backend.scene.control_dt
    faults = f"{int(env.nonfinite_count)} not finite, {int(env.overflow_count)} overflows"
    note = {
        "raw": f"{still * n:,.0f} with constant targets",
        "env": f"{stepped / raw:.2f} of raw",
        "train": f"{simulated:,.0f} simulated seconds per second; {faults}",
    }
    steps = {"raw": raw, "env": stepped, "rollout": rolled, "update": updated, "train": trained / n}
    for name, per_second in steps.items():
        table.add_row(name, f"{per_second * n:,.0f}", f"{1e3 / per_second:.2f}", note.get(name, ""))
    return table


def _physics_and_env(
    env: ManipulationEnv, act: Callable[[], torch.Tensor], options: Options
) -> tuple[float, float]:
    """Control steps per second of the engine's own steps, and of the environment's steps that they are part of."""
    backend = env.backend
    run = env.backend._run
    marks = []

    def mark() -> None:
        if env.device.type == "cuda":
            event = torch.cuda.Event(enable_timing=True)
            event.record()
            marks.append(event)
        else:
            marks.append(time.perf_counter())

    def watched(name: str) -> None:
        """Marks the first and the last of a control step's physics steps."""
        steps = counts[name] = counts.get(name, 0) + 1
        if name == "step" and steps % backend.scene.substeps == 1 % backend.scene.substeps:
            mark()
        run(name)
        if name == "step" and steps % backend.scene.substeps == 0:
            mark()

    counts: dict[str, int] = {}
    backend._run = watched
    try:
        stepped = rate(lambda: env.step(act()), options.seconds, options.device)
    finally:
        del backend._run
    ends = zip(marks[::2], marks[1::2], strict=True)
    seconds = [
        start.elapsed_time(end) / 1e3 if env.device.type == "cuda" else end - start
        for start, end in ends
    ]
    return 1 / float(np.median(seconds)), stepped


def _synthetic_bank(robot: str, folder: Path) -> Path:
    """A bank made of one synthetic demonstration, by the commands that a user would type."""
    demos, moved, bank = (folder / name for name in ("demos.npz", "retargeted.npz", "resets.npz"))
    for command in (
        ["demos", "synth", "--objects", OBJECT, "--per-object", "1", "--out", demos],
        ["retarget", demos, "--robot", robot, "--out", moved],
        ["resets", moved, "--engine", "mujoco", "--out", bank],
    ):
        run_time([sys.executable, "-m", "xreset", *map(str, command)])
    return bank
