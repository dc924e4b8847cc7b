"""Speed on the machine at hand: raw physics, the backend, the environment and training, side by side in one run.

usage: benchmark.py [--robot R] [--backend B ...] [--num-envs N] [--device cpu|cuda] [--seconds S] [--train-iterations K]

raw       the engine's own loop on the model that the backend built, in this process, one world (GPU: the captured graph, all worlds)
backend   Backend.step with all worlds, per core in use
env       ManipulationEnv.step: actions, physics, observations, reward, resets
train     the whole PPO iteration with the paper's model
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from xreset import robots
from xreset.backends import backend_names, backend_status, make_backend
from xreset.backends.pool import PoolBackend
from xreset.backends.registry import backend_class
from xreset.env import ManipulationEnv, make_scene
from xreset.eval.evaluate import load_motion
from xreset.objects import load_objects
from xreset.task.config import TaskConfig
from xreset.task.resets import ResetDistribution


def rate(step: Callable[[], object], seconds: float, device: str) -> float:
    """Calls per second, after two calls of warm-up."""

    def wait() -> None:
        if device.startswith("cuda"):
            torch.cuda.synchronize()

    for _ in range(2):
        step()
    wait()
    start, count = time.perf_counter(), 0
    while time.perf_counter() - start < seconds:
        for _ in range(5):
            step()
        wait()
        count += 5
    return count / (time.perf_counter() - start)


def raw_loop(backend) -> tuple[Callable[[], object], int]:
    """One control step of the engine alone, and how many worlds it advances."""
    substeps = backend.scene.substeps
    if backend.name == "mujoco-warp":
        return lambda: [backend._run("step") for _ in range(substeps)], backend.num_worlds
    world = backend.world_class(backend.scene, 0)
    if backend.name == "mujoco":
        import mujoco

        return lambda: mujoco.mj_step(world._model, world._data, substeps), 1
    return lambda: world.step(substeps), 1


def demonstrations(robot, folder: Path):
    """Starts and goals of one synthetic soup-can demonstration."""
    from xreset.demos.archive import write_demos
    from xreset.demos.synth import synthesize

    file = folder / "demos.npz"
    write_demos(file, synthesize(["005_tomato_soup_can"], 1, seed=0))
    return load_motion(file, robot, None, trajectories=False)[0]


def measure(name: str, options: argparse.Namespace, folder: Path) -> list[str]:
    """One row of the table for an engine."""
    device = options.device if "cuda" in backend_status(name).device else "cpu"
    robot = robots.load(options.robot)
    objects = tuple(load_objects(["005_tomato_soup_can"], None))
    task = TaskConfig()
    scene = make_scene(robot, objects, task)
    pooled = issubclass(backend_class(name), PoolBackend)
    cores = min(len(os.sched_getaffinity(0)), options.num_envs) if pooled else 1
    kwargs = {"workers": cores} if pooled else {"device": device}
    with make_backend(name, scene, options.num_envs, **kwargs) as backend:
        worlds = options.num_envs
        raw_step, raw_worlds = raw_loop(backend)
        raw = rate(raw_step, options.seconds, device) * raw_worlds
        wrapped = rate(backend.step, options.seconds, device) * worlds
        bank = demonstrations(robot, folder)
        env = ManipulationEnv(backend, task, ResetDistribution(bank, robot, bank.object_names, task.reset, backend.device))
        action = torch.zeros(worlds, env.num_actions, device=backend.device)
        stepped = rate(lambda: env.step(action), options.seconds, device) * worlds
        row = [
            name,
            device,
            f"{raw:,.0f}",
            f"{wrapped:,.0f} ({wrapped / raw / cores:.2f} per core)",
            f"{stepped:,.0f} ({stepped / wrapped:.2f})",
        ]
        if options.train_iterations:
            row.append(_training(env, options.train_iterations, folder, stepped))
        return row


def _training(env: ManipulationEnv, iterations: int, folder: Path, stepped: float) -> str:
    from xreset.learning.config import TrainConfig
    from xreset.learning.runner import TrainingRunner

    runner = TrainingRunner(env, TrainConfig(iterations=iterations), folder / "run")
    runner.learn(1)
    runner.elapsed, before = 0.0, runner.env_steps
    runner.learn(1 + iterations)
    trained = (runner.env_steps - before) / runner.elapsed
    return f"{trained:,.0f} ({trained / stepped:.2f})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robot", default="ur7e-sharpa")
    parser.add_argument("--backend", action="append", help="engine; again for more (default: all that work here)")
    parser.add_argument("--num-envs", type=int, default=8)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--seconds", type=float, default=3.0, help="per measurement")
    parser.add_argument("--train-iterations", type=int, default=0, help="PPO iterations to time (0: none)")
    options = parser.parse_args()
    names = options.backend or [name for name in backend_names() if backend_status(name).reason is None]
    console = Console(width=160)
    imports = [_seconds([sys.executable, "-m", "xreset", "--help"]) for _ in range(3)]
    console.print(f"xreset --help: {np.median(imports):.2f} s")
    columns = ["engine", "device", "raw", "backend", "env (of backend)"] + ["train (of env)"] * bool(options.train_iterations)
    table = Table(*columns, title=f"control steps per second, {options.robot}, {options.num_envs} worlds")
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            table.add_row(*measure(name, options, Path(folder)))
    console.print(table)


def _seconds(command: list[str]) -> float:
    start = time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - start


if __name__ == "__main__":
    main()
