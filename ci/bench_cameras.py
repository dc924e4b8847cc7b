"""cameras: depth images per second, and the share of cameras in a control step.

rays      the kernel alone, one camera in front of the table, the robot at home
images    the same with errors, as the policy gets them
env       ManipulationEnv.step with actions at zero, without cameras and with one that takes an image every second step; the share is what
          the camera adds, of the step with it
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import torch
from bench_env import motion
from benchlib import OBJECT, Options, engines, env_rate, rate
from rich.console import Console
from rich.table import Table

from xreset import robots
from xreset.cameras.config import FRONT, VisionConfig
from xreset.cameras.sensor import Cameras
from xreset.env.manipulation import make_env, make_scene
from xreset.objects.catalogue import load_objects
from xreset.physics import State
from xreset.task.config import TaskConfig


def add_arguments(group) -> None:
    group.add_argument(
        "--pixels", type=int, default=64, help="width and height of an image (default: 64)"
    )


def run(options: Options, console: Console) -> None:
    robot = robots.load(options.robot)
    objects = tuple(load_objects([OBJECT], None))
    pixels = options.extra["pixels"]
    worlds = options.num_envs
    task = TaskConfig()
    seeing = replace(task, vision=VisionConfig(cameras=(FRONT,), width=pixels, height=pixels))
    columns = [
        "engine",
        "device",
        "rays [1/s]",
        "images [1/s]",
        "env without [1/s]",
        "env with [1/s]",
        "share",
    ]
    table = Table(
        *columns, title=f"cameras: {options.robot}, {worlds} worlds, {pixels} x {pixels} pixels"
    )
    with tempfile.TemporaryDirectory() as folder:
        bank = motion(robot, Path(folder))
        for name, device in engines(options, console):
            rays, images = (
                worlds * each
                for each in _images(seeing, robot, objects, worlds, device, options.seconds)
            )
            steps = []
            for variant in (task, seeing):
                with make_env(
                    robot, objects, bank, variant, engine=name, num_envs=worlds, device=device
                ) as env:
                    steps.append(env_rate(env, options.seconds))
            cells = [f"{value:,.0f}" for value in (rays, images, *steps)]
            table.add_row(name, device, *cells, f"{1 - steps[1] / steps[0]:.0%}")
    console.print(table)


def _images(
    task: TaskConfig, robot, objects, worlds: int, device: str, seconds: float
) -> tuple[float, float]:
    """Times per second that all worlds take their images: rays alone, and with errors."""
    scene = make_scene(robot, objects, task)
    index = torch.zeros(worlds, dtype=torch.long, device=device)
    cameras = Cameras(scene, index, task.vision)
    state = State.initial(scene, index).to(torch.device(device))
    everywhere = torch.ones(worlds, dtype=torch.bool, device=device)
    generator = torch.Generator(device)

    def take() -> None:
        cameras.aim(state, state.object_pos, state.object_quat, everywhere)
        cameras.cast()
        cameras.observe(generator)

    take()
    return rate(cameras.cast, seconds, device), rate(take, seconds, device)
