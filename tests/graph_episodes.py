"""The graphs of the policies that ship, on the readings of whole evaluated episodes in MuJoCo, one of each object:

python -m tests.graph_episodes
"""

import time

import numpy as np
import torch

from xreset import load_policy, synthesize
from xreset.errors import PolicyError
from xreset.eval.rollout import engine, load_trial, roll_out
from xreset.live.engine import EngineDriver, begin_episodes
from xreset.policy.shipped import shipped
from xreset.runtime import Controller


class Compared:
    """A policy that plays, and its graph, which gets the same readings and the same targets of the last step."""

    def __init__(self, policy, graph):
        self.policy = policy
        self.graph = Controller(graph)
        self.alone = Controller(graph)
        """The graph that keeps its own targets, as on a robot: differences add up."""
        self.differences = []
        """Largest difference of the targets in each step, of both graphs [rad]."""
        self.seconds = []
        """Time of each step of a graph, of all worlds together."""

    def begin(self, env):
        self.env = env
        self.policy.begin(env)
        begin_episodes(self.graph, env)
        begin_episodes(self.alone, env)

    def act(self, observations):
        env = self.env
        reading = EngineDriver(env).read()
        action = self.policy.act(observations)
        joints = torch.as_tensor(reading.joint_pos)
        target = env.actions.targets(action, env.joint_target, joints).numpy()
        self.graph.target = env.joint_target.numpy().copy()
        before = time.perf_counter()
        found = self.graph.step(reading)
        self.seconds.append(time.perf_counter() - before)
        alone = self.alone.step(reading)
        self.differences.append([np.abs(each - target).max() for each in (found, alone)])
        return action


def compared(name, names=None, seconds=None, graph=None):
    """Evaluate a policy with a graph next to it, by default its own: one demonstration of each object; default: those of
    the training."""
    spec = load_policy(name)
    played = Compared(spec.start(None), graph or spec.graph)
    demos = synthesize(names or spec.objects_of(None), 1)
    trial = load_trial(spec, demos, episode_seconds=seconds)
    rollouts = roll_out(played, engine("mujoco", workers=0), trial, episodes=1)
    return played, rollouts.episodes


def main():
    for name in shipped():
        try:
            played, episodes = compared(name)
        except PolicyError as error:
            print(f"{name}: {error}")
            continue
        progress = np.mean([episode.task_progress for episode in episodes])
        same, alone = np.max(played.differences, axis=0)
        milliseconds = 1000 * np.median(played.seconds)
        print(
            f"{name}: {len(episodes)} episodes of {len(played.seconds)} steps, task progress {progress:.2f}; targets "
            f"differ by at most {same:.1e} rad, with targets of its own {alone:.1e}; a step of {len(episodes)} robots "
            f"takes {milliseconds:.2f} ms"
        )


if __name__ == "__main__":
    main()
