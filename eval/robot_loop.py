"""Play a policy through the control loop of a real robot, with faults between the loop and the robot.

The loop is :mod:`xreset.runtime`, an engine takes the place of the robot's driver (:mod:`xreset.live.engine`), and
:mod:`xreset.live.faults` has the faults.
"""

from __future__ import annotations

import re
import time
from collections import Counter

from xreset.eval.results import Rollouts
from xreset.eval.rollout import Engine, Round, Trial, play_rounds
from xreset.live.engine import begin_episodes
from xreset.live.faults import Faults, FaultyDriver
from xreset.runtime import Controller, Runner


class SimulatedRunner(Runner):
    """Runs simulated robots: Ctrl-C is raised, because an episode that it cuts short must not count."""

    def _interrupted(self) -> None:
        raise KeyboardInterrupt


def roll_out_on_robot(
    controller: Controller,
    engine: Engine,
    trial: Trial,
    faults: Faults,
    *,
    episodes: int,
) -> Rollouts:
    """Play demonstrations ``episodes`` times each through the loop. Nothing is recorded.

    Args:
        controller: the policy.
        engine: the engine.
        trial: what is played.
        faults: faults of every robot.
        episodes: episodes of each demonstration.
    """
    stopped: Counter[str] = Counter()
    steps = 0
    began = time.perf_counter()

    def play(played: Round) -> None:
        nonlocal steps
        env = played.env
        begin_episodes(controller, env)
        driver = FaultyDriver(
            env, faults, played.seeds, lambda: played.update_metrics(env.reading())
        )
        length = env.max_episode_length * controller.dt
        outcome = SimulatedRunner(controller, driver).run(length)
        driver.wait_until(length)  # a runner ends early if it has stopped all of its robots
        for world in played.fresh:
            reason = outcome.reasons[world]
            if reason is not None:
                stopped[re.sub(r"-?\d+\.\d+", "...", reason)] += 1
        steps += env.max_episode_length * env.num_envs

    return Rollouts(
        episodes=play_rounds(engine, trial, episodes, play),
        traces=(),
        control_steps_per_second=steps / (time.perf_counter() - began),
        stopped=dict(stopped),
    )
