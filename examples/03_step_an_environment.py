"""An environment is stepped by hand: N worlds of the task in any engine, which reset themselves."""

import sys
from pathlib import Path

import torch

import xreset
from xreset.env import make_scene
from xreset.eval.evaluate import load_motion
from xreset.resets.distribution import ResetDistribution
from xreset.task.config import ResetConfig, TaskConfig

NUM_WORLDS, STEPS = 4, 20


def main(demos: str | Path) -> None:
    """Act at random for a third of a second, from home; ``demos``: a file of ``xreset demos``."""
    robot = xreset.load_robot("openarm")
    bank, _ = load_motion(Path(demos), robot, None, trajectories=False)  # starts and goals; a reset bank has states to start from, too
    objects = tuple(xreset.load_object(name) for name in bank.object_names)
    task = TaskConfig(reset=ResetConfig(demo_probability=0.0))
    worlds = torch.arange(NUM_WORLDS) % len(objects)
    with xreset.make_backend("mujoco", make_scene(robot, objects, task), NUM_WORLDS, object_index=worlds) as backend:
        env = xreset.ManipulationEnv(backend, task, ResetDistribution(bank, robot, bank.object_names, task.reset), seed=0)
        total = torch.zeros(NUM_WORLDS)
        for _ in range(STEPS):
            observations, reward, *_ = env.step(2 * torch.rand(NUM_WORLDS, env.num_actions) - 1)
            total += reward
    print(f"groups of observations: {', '.join(map(str, observations.keys()))}; return after {STEPS} steps: {total.mean():.3f}")


if __name__ == "__main__":
    main(sys.argv[1])
