"""Shared by the sections of the benchmark: timing, engines, and a grasp that is held."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from rich.console import Console
from rich.markup import escape

from xreset.demos.archive import rest_on_table
from xreset.demos.verbs import synthesize
from xreset.env.manipulation import ManipulationEnv, make_env
from xreset.geometry.kinematics import Kinematics
from xreset.physics import State
from xreset.physics.plugins import backend_names, backend_status
from xreset.resets.inputs import Inputs
from xreset.retarget.verbs import retarget_demos
from xreset.spec import ObjectSpec, RobotSpec
from xreset.task.config import TaskConfig

OBJECT = "005_tomato_soup_can"

_PRESS = 8.0
"""Force of each fingertip of a grasp [N]."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of all sections; those of single sections are in ``extra``."""

    robot: str
    engines: tuple[str, ...]
    """Engines to measure, all if empty."""
    num_envs: int
    device: str
    """``cpu``, or ``cuda`` for the engines that can."""
    seconds: float
    """Time of one measurement [s]."""
    extra: Mapping[str, object]
    """Options that sections have added, by name."""


def engines(options: Options, console: Console) -> Iterator[tuple[str, str]]:
    """Yield name and device of the chosen engines that work here; print why others are left out."""
    for name in options.engines or tuple(backend_names()):
        status = backend_status(name)
        if status.reason is None:
            yield name, options.device if "cuda" in status.device else "cpu"
        else:
            console.print(f"{name}: left out. {escape(status.reason)}")


def seconds_of(action: Callable[[], object], device: str = "cpu") -> float:
    """Wall time of one call, a GPU's work included."""
    start = time.perf_counter()
    action()
    if device.startswith("cuda"):
        torch.cuda.synchronize()
    return time.perf_counter() - start


def rate(step: Callable[[], object], seconds: float, device: str) -> float:
    """Calls per second: the median over bursts of five calls, after two bursts of warm-up."""

    def burst() -> float:
        return seconds_of(lambda: [step() for _ in range(5)], device)

    burst(), burst()
    end = time.perf_counter() + seconds
    bursts = []
    while not bursts or time.perf_counter() < end:
        bursts.append(burst())
    return 5 / float(np.median(bursts))


def env_rate(env: ManipulationEnv, seconds: float) -> float:
    """Control steps of all worlds per second, with actions at zero."""
    action = torch.zeros(env.num_envs, env.num_actions, device=env.device)
    return env.num_envs * rate(lambda: env.step(action), seconds, env.device.type)


def trained_env(inputs: Inputs, task: TaskConfig, options: Options) -> ManipulationEnv:
    """The worlds of a training on mujoco-warp."""
    return make_env(
        inputs.robot,
        inputs.objects,
        inputs.bank,
        task,
        engine="mujoco-warp",
        num_envs=options.num_envs,
        device=options.device,
    )


def run_time(command: Sequence[str]) -> float:
    """Wall time of a command [s]."""
    return seconds_of(lambda: subprocess.run(command, check=True, stdout=subprocess.DEVNULL))


def held_grasp(robot: RobotSpec, objects: Sequence[ObjectSpec]) -> State:
    """Return one world ([1, ...]) in which the robot presses with its fingers on the first object in the air.

    A retargeted synthetic demonstration gives the hand's shape. With the drives' targets each fingertip presses towards the object's centre.
    """
    moved = retarget_demos(
        rest_on_table(synthesize([objects[0].name], 1, seed=0), objects), robot, objects
    )
    frame = int(
        np.flatnonzero(moved.valid & (moved.object_pos[:, 2] > moved.object_pos[0, 2] + 0.1))[0]
    )
    center = torch.as_tensor(moved.object_pos[frame], dtype=torch.float64)
    position = torch.as_tensor(moved.joint_pos[frame], dtype=torch.float64).requires_grad_()
    poses = Kinematics(robot).link_poses(position, [tip.link for tip in robot.fingertips])
    (poses[:, :3, 3] - center).norm(
        dim=-1
    ).sum().backward()  # its gradient is - J^T of a unit force on each tip towards the centre
    assert position.grad is not None
    hand = torch.tensor([joint.group == "hand" for joint in robot.joints])
    stiffness = torch.tensor([joint.drive.kp for joint in robot.joints], dtype=torch.float64)
    target = position.detach() - torch.where(hand, _PRESS * position.grad / stiffness, 0.0)
    return State.at_rest(
        position.detach()[None],
        center[None],
        torch.as_tensor(moved.object_quat_wxyz[frame])[None],
        target[None],
    )
