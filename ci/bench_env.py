"""env: control steps per second of an engine and of the environment on it, all worlds together.

backend   Backend.step with all worlds, readings included; a CPU engine runs on all cores
env       ManipulationEnv.step with actions at zero: actions, physics, observations, reward, resets; next to it the share of backend
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from benchlib import OBJECT, Options, engines, env_rate, rate
from rich.console import Console
from rich.table import Table

from xreset import robots
from xreset.demos.archive import write_demos
from xreset.demos.verbs import synthesize
from xreset.env.manipulation import ManipulationEnv, make_scene
from xreset.objects.catalogue import load_objects
from xreset.physics.plugins import make_backend
from xreset.resets.bank import ResetBank
from xreset.resets.distribution import ResetDistribution
from xreset.resets.inputs import load_inputs
from xreset.spec import RobotSpec
from xreset.task.config import TaskConfig


def run(options: Options, console: Console) -> None:
    robot = robots.load(options.robot)
    task = TaskConfig()
    scene = make_scene(robot, tuple(load_objects([OBJECT], None)), task)
    columns = ["engine", "device", "backend", "env (of backend)"]
    table = Table(
        *columns, title=f"env: control steps per second, {options.robot}, {options.num_envs} worlds"
    )
    with tempfile.TemporaryDirectory() as folder:
        bank = motion(robot, Path(folder))
        for name, device in engines(options, console):
            with make_backend(name, scene, options.num_envs, device=device) as backend:
                wrapped = rate(backend.step, options.seconds, device) * options.num_envs
                env = ManipulationEnv(
                    backend,
                    task,
                    ResetDistribution(bank, robot, bank.object_names, task.reset, backend.device),
                )
                stepped = env_rate(env, options.seconds)
                table.add_row(
                    name, device, f"{wrapped:,.0f}", f"{stepped:,.0f} ({stepped / wrapped:.2f})"
                )
    console.print(table)


def motion(robot: RobotSpec, folder: Path) -> ResetBank:
    """Starts and goals of one synthetic demonstration."""
    file = folder / "demos.npz"
    write_demos(file, synthesize([OBJECT], 1, seed=0))
    return load_inputs(file, robot=robot).bank
