"""env: control steps per second of an engine, the environment on it, and training, all worlds together.

backend   Backend.step with all worlds, readings included; a CPU engine runs on all cores
env       ManipulationEnv.step with actions at zero: actions, physics, observations, reward, resets; beside it the share of backend
train     the whole PPO iteration with the paper's model (--train-iterations); beside it the share of env
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import torch
from benchlib import OBJECT, Options, engines, rate
from rich.console import Console
from rich.table import Table

from xreset import robots
from xreset.backends import make_backend
from xreset.env import ManipulationEnv, make_scene
from xreset.objects import load_objects
from xreset.resets.bank import ResetBank
from xreset.spec import RobotSpec
from xreset.task.config import TaskConfig
from xreset.task.resets import ResetDistribution


def add_arguments(group: argparse._ArgumentGroup) -> None:
    group.add_argument("--train-iterations", type=int, default=0, help="PPO iterations to time (0: none)")


def run(options: Options, console: Console) -> None:
    iterations = int(options.extra["train_iterations"])
    robot, task = robots.load(options.robot), TaskConfig()
    scene = make_scene(robot, tuple(load_objects([OBJECT], None)), task)
    columns = ["engine", "device", "backend", "env (of backend)"] + ["train (of env)"] * bool(iterations)
    table = Table(*columns, title=f"env: control steps per second, {options.robot}, {options.num_envs} worlds")
    with tempfile.TemporaryDirectory() as folder:
        bank = _motion(robot, Path(folder))
        for name, device in engines(options, console):
            with make_backend(name, scene, options.num_envs, device=device) as backend:
                wrapped = rate(backend.step, options.seconds, device) * options.num_envs
                env = ManipulationEnv(backend, task, ResetDistribution(bank, robot, bank.object_names, task.reset, backend.device))
                action = torch.zeros(options.num_envs, env.num_actions, device=backend.device)
                stepped = rate(lambda env=env, action=action: env.step(action), options.seconds, device) * options.num_envs
                row = [name, device, f"{wrapped:,.0f}", f"{stepped:,.0f} ({stepped / wrapped:.2f})"]
                if iterations:
                    row.append(_training(env, iterations, Path(folder) / name, stepped))
                table.add_row(*row)
    console.print(table)


def _motion(robot: RobotSpec, folder: Path) -> ResetBank:
    """Starts and goals of one synthetic demonstration."""
    from xreset.demos.archive import write_demos
    from xreset.demos.synth import synthesize
    from xreset.eval.evaluate import load_motion

    file = folder / "demos.npz"
    write_demos(file, synthesize([OBJECT], 1, seed=0))
    return load_motion(file, robot, None, trajectories=False)[0]


def _training(env: ManipulationEnv, iterations: int, folder: Path, stepped: float) -> str:
    from xreset.learning.config import TrainConfig
    from xreset.learning.runner import TrainingRunner

    runner = TrainingRunner(env, TrainConfig(iterations=iterations), folder)
    runner.learn(1)
    runner.elapsed, before = 0.0, runner.env_steps
    runner.learn(1 + iterations)
    trained = (runner.env_steps - before) / runner.elapsed
    return f"{trained:,.0f} ({trained / stepped:.2f})"
