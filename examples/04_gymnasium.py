"""The environment as Gymnasium's VectorEnv, for learning code of your own; needs ``pip install 'xreset[gymnasium]'``."""

import sys
from pathlib import Path

import torch

import xreset
from xreset.env import make_scene
from xreset.eval.evaluate import load_motion
from xreset.resets.distribution import ResetDistribution
from xreset.task.config import ResetConfig, TaskConfig, TerminationConfig

NUM_WORLDS, STEPS = 4, 40


def main(demos: str | Path) -> None:
    """Act at random; ``demos``: a file of ``xreset demos``."""
    robot = xreset.load_robot("openarm")
    bank, _ = load_motion(Path(demos), robot, None, trajectories=False)
    objects = tuple(xreset.load_object(name) for name in bank.object_names)
    task = TaskConfig(reset=ResetConfig(demo_probability=0.0), termination=TerminationConfig(episode_seconds=0.25))
    worlds = torch.arange(NUM_WORLDS) % len(objects)
    backend = xreset.make_backend("mujoco", make_scene(robot, objects, task), NUM_WORLDS, object_index=worlds)
    resets = ResetDistribution(bank, robot, bank.object_names, task.reset)
    envs = xreset.VectorEnv(xreset.ManipulationEnv(backend, task, resets))
    observations, _ = envs.reset(seed=0)
    episodes = 0
    for _ in range(STEPS):
        observations, reward, terminated, truncated, _ = envs.step(envs.action_space.sample())
        episodes += int((terminated | truncated).sum())
    print(f"{envs.num_envs} worlds, observations {sorted(observations)}, {episodes} episodes, last reward {reward.mean():.3f}")
    envs.close()


if __name__ == "__main__":
    main(sys.argv[1])
