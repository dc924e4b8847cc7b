"""A training of half a minute on one core: the conformance suite's gripper learns to take a brick between its jaws and to lift it.

Everything is as in real trainings but small: environment, resets from a bank, PPO on sequences, curves.
"""

import tempfile
from contextlib import redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import torch

from tests import toy_grasp
from xreset.env.manipulation import ManipulationEnv, make_scene
from xreset.eval.report.read import read_curves
from xreset.learning.config import ModelConfig, PpoConfig, TrainConfig
from xreset.learning.runner import TrainingRunner
from xreset.resets.distribution import ResetDistribution
from xreset.task.config import (
    ActionConfig,
    ObservationConfig,
    RandomizationConfig,
    ResetConfig,
    RewardConfig,
    TaskConfig,
    TerminationConfig,
)
from xreset.task.default import TASK

WORLDS = 64
LAST = 10
"""Iterations at the end over which a training is judged."""
CONFIG = TrainConfig(
    task=TaskConfig(
        timestep=1 / 120,
        substeps=2,
        action=ActionConfig(arm_step=0.01),
        observation=ObservationConfig(
            cloud_points=8, perception={"cloud": {"frames": 1, "noise": 0.002, "scale": 1.0}}
        ),
        reward=RewardConfig(
            terms=RewardConfig().terms
            | {"reach_near": {"function": "best_reach", "weight": 1.0, "width": 0.05}}
        ),
        termination=TerminationConfig(episode_seconds=1.0),
        reset=ResetConfig(demo_probability=1.0),
        distance_points=32,
    ),
    model=ModelConfig(pointnet=(8, 8), lstm=32, mlp=(64,), initial_std=0.5),
    ppo=PpoConfig(mini_epochs=4, minibatch_size=512, desired_kl=0.05, entropy=0.0),
    iterations=60,
    save_interval=1000,
)
RECIPE = replace(
    CONFIG,
    task=replace(
        TASK,
        randomization=RandomizationConfig(),
        action=replace(TASK.action, arm_step=0.02),
        observation=replace(TASK.observation, cloud_points=8),
        termination=CONFIG.task.termination,
        reset=CONFIG.task.reset,
        distance_points=32,
    ),
)
"""The same training in the default task without random properties: control at 30 Hz, paired points, its actions and rewards."""


def shares(mean):
    """Return the shares of all worlds' control steps with both fingers on the brick, and with the brick at the goal.

    Args:
        mean: name of a curve -> its mean.
    """
    return {name: float(mean(f"task/{name}")) for name in ("grasped", "success")}


def bank():
    """States in which the brick hangs between the jaws, which are told to close."""
    robot = toy_grasp.robot()
    closing = robot.home.copy()
    closing[robot.joint_names.index("jaw_a_slide")] = toy_grasp.CLOSED
    return toy_grasp.grasps(joint_target=np.tile(closing, (6, 1)).astype(np.float32))


def random_policy(seed, backend):
    """What uniform actions do in one episode."""
    env = environment(seed, backend)
    generator = torch.Generator().manual_seed(seed)
    logs = []
    for _ in range(env.max_episode_length):
        share = torch.rand(env.num_envs, env.num_actions, generator=generator)
        *_, extras = env.step(2.0 * share - 1.0)
        logs.append(extras["log"])
    return shares(lambda name: np.mean([log[name] for log in logs]))


def trained(seed, backend, config=CONFIG):
    """What a training does in its last iterations in the backend's worlds of :func:`scene`, and its steps in all worlds."""
    torch.manual_seed(seed)
    with tempfile.TemporaryDirectory() as folder, redirect_stdout(StringIO()):
        runner = TrainingRunner(environment(seed, backend, config.task), config, Path(folder))
        runner.learn(config.iterations)
        curves = read_curves(Path(folder))
    return shares(lambda name: curves[name].iloc[-LAST:].mean()), runner.env_steps


def scene(task=CONFIG.task):
    """Gripper and brick."""
    return make_scene(toy_grasp.robot(), (toy_grasp.brick(),), task)


def environment(seed, backend, task=CONFIG.task):
    """A task in the backend's worlds."""
    resets = ResetDistribution(
        bank(), toy_grasp.robot(), (toy_grasp.brick().name,), task.reset, backend.device
    )
    return ManipulationEnv(backend, task, resets, seed=seed)
