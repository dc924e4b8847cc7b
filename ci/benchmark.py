"""Speed on the machine at hand: raw physics, the backend, the environment and training, side by side in one run.

usage: benchmark.py [--robot R] [--backend B ...] [--num-envs N] [--device cpu|cuda] [--seconds S] [--train-iterations K]

All rates are control steps per second of all worlds together, each the median over many short bursts. Raw runs on one core, backend on all:
the share per core means something only while nothing else runs on the machine.

raw       the engine's own step function alone, on one core: of a CPU engine the time within that call while one world of the backend runs
          in this process, of mujoco-warp its physics kernels for all worlds (on a GPU: the captured graph)
backend   Backend.step with all worlds, readings included; beside it the share of raw that each core in use reaches. The difference is what
          the engine cannot do itself (PyBullet: drives; SAPIEN: friction forces), the readings and the way between processes
env       ManipulationEnv.step with actions at zero: actions, physics, observations, reward, resets; beside it the share of backend
train     the whole PPO iteration with the paper's model; beside it the share of env
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import numpy as np
import torch
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from xreset import robots
from xreset.backends import backend_names, backend_status, make_backend
from xreset.backends.base import Backend
from xreset.backends.pool import PoolBackend, _usable_cores, initial_state
from xreset.backends.registry import backend_class
from xreset.env import ManipulationEnv, make_scene
from xreset.eval.evaluate import load_motion
from xreset.objects import load_objects
from xreset.task.config import TaskConfig
from xreset.task.resets import ResetDistribution


def rate(step: Callable[[], object], seconds: float, device: str) -> float:
    """Calls per second: the median over bursts of five calls, after two bursts of warm-up."""

    def burst() -> float:
        start = time.perf_counter()
        for _ in range(5):
            step()
        if device.startswith("cuda"):
            torch.cuda.synchronize()
        return time.perf_counter() - start

    burst(), burst()
    end, bursts = time.perf_counter() + seconds, []
    while not bursts or time.perf_counter() < end:
        bursts.append(burst())
    return 5 / float(np.median(bursts))


def raw_rate(backend: Backend, seconds: float, device: str) -> float:
    """Control steps per second of the engine alone: all worlds of mujoco-warp, one world of a CPU engine."""
    if not isinstance(backend, PoolBackend):
        with backend._on_stream():
            return rate(lambda: [backend._run("step") for _ in range(backend.scene.substeps)], seconds, device) * backend.num_worlds
    world = backend.world_class(backend.scene, 0)
    try:
        world.set_state({name: np.array(value, dtype=np.float64) for name, value in initial_state(backend.scene, 0).items()})
        return _rate_within(*_step_function(backend.name, world), lambda: world.step(backend.scene.substeps), seconds)
    finally:
        world.close()


def _step_function(name: str, world) -> tuple[object, str]:
    """Where the function is that advances the engine; of an engine that is not known here, the world's own step."""
    if name == "mujoco":
        import mujoco

        return mujoco, "mj_step"
    if name == "pybullet":
        return world._p, "stepSimulation"
    if name == "sapien":
        return type(world._system), "step"
    return world, "step"


def _rate_within(owner: object, name: str, step: Callable[[], object], seconds: float) -> float:
    """As :func:`rate`, counting only the time that ``step`` spends within ``owner.name``."""
    inner, spent = getattr(owner, name), 0.0

    def timed(*arguments, **keywords) -> None:
        nonlocal spent
        start = time.perf_counter()
        inner(*arguments, **keywords)
        spent += time.perf_counter() - start

    bursts, end = [], time.perf_counter() + seconds
    with mock.patch.object(owner, name, timed):
        while len(bursts) < 3 or time.perf_counter() < end:
            spent = 0.0
            for _ in range(5):
                step()
            bursts.append(spent)
    return 5 / float(np.median(bursts[2:]))


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
    cores = min(_usable_cores(), options.num_envs) if pooled else 1
    kwargs = {"workers": cores} if pooled else {"device": device}
    with make_backend(name, scene, options.num_envs, **kwargs) as backend:
        worlds = options.num_envs
        raw = raw_rate(backend, options.seconds, device)
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
    parser.add_argument("--backend", action="append", help="engine; again for more (default: all)")
    parser.add_argument("--num-envs", type=int, default=8)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--seconds", type=float, default=3.0, help="per measurement")
    parser.add_argument("--train-iterations", type=int, default=0, help="PPO iterations to time (0: none)")
    options = parser.parse_args()
    names = options.backend or backend_names()
    console = Console(width=160)
    imports = [_seconds([sys.executable, "-m", "xreset", "--help"]) for _ in range(3)]
    console.print(f"xreset --help: {np.median(imports):.2f} s")
    columns = ["engine", "device", "raw", "backend", "env (of backend)"] + ["train (of env)"] * bool(options.train_iterations)
    table = Table(*columns, title=f"control steps per second, {options.robot}, {options.num_envs} worlds, {_usable_cores()} cores")
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            reason = backend_status(name).reason
            if reason is None:
                table.add_row(*measure(name, options, Path(folder)))
            else:
                console.print(f"{name}: left out. {escape(reason)}")
    console.print(table)


def _seconds(command: list[str]) -> float:
    start = time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - start


if __name__ == "__main__":
    main()
