"""Rollouts of a policy in one engine: the same episodes, from the same states, in every engine."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from xreset.env import ManipulationEnv
from xreset.eval.metrics import EpisodeMetrics, MetricsConfig
from xreset.eval.trial import Engine, Trial
from xreset.policy import Policy
from xreset.resets.bank import ResetBank
from xreset.resets.distribution import Reset, ResetDistribution
from xreset.schedule import schedule
from xreset.task.reading import Reading
from xreset.task.terminations import out_of_bounds


@dataclass(frozen=True, kw_only=True)
class Episode:
    """Result of one episode."""

    sequence: int
    """Index of the demonstration."""
    sequence_name: str
    object: str
    repetition: int
    """Which perturbation of the demonstration's start."""
    approach: bool
    grasp: bool
    reorient: bool
    reorient_once: bool
    """Whether the object was at the goal at any time."""
    reorientation_progress: float
    task_progress: float
    out_of_bounds: bool
    nonfinite: bool
    overflow: bool
    """Whether the engine dropped contacts or constraints."""


@dataclass(frozen=True, kw_only=True)
class Trace:
    """States of one episode, for pictures, and what the drives were told, for replays."""

    sequence: int
    object: str
    goal_pos: np.ndarray
    goal_quat: np.ndarray
    time: np.ndarray
    """[T] s"""
    joint_pos: np.ndarray
    """[T, J]"""
    object_pos: np.ndarray
    object_quat: np.ndarray
    joint_target: np.ndarray | None = None
    """[C, J] of every control step; None in files that are older than this."""


@dataclass(frozen=True, kw_only=True)
class Rollouts:
    """All episodes of one policy in one engine."""

    episodes: tuple[Episode, ...]
    traces: tuple[Trace, ...]
    """The first episode of each demonstration."""
    control_steps_per_second: float
    """World steps per second of wall time, policy and observations included."""


def roll_out(
    policy: Policy,
    engine: Engine,
    trial: Trial,
    *,
    repetitions: int,
    only: np.ndarray | None = None,
    trace_interval: float = 0.05,
    metrics: MetricsConfig | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Rollouts:
    """Run demonstrations ``repetitions`` times each.

    Args:
        repetitions: episodes per demonstration, each with its own perturbation of robot and object.
        only: indices of the demonstrations to run; None: all.
        trace_interval: time between the states of a trace [s].
        progress: called with (control steps done, control steps in all).
    """
    demos, names = trial.bank, trial.names
    chosen = np.arange(len(demos.sequence_name)) if only is None else np.asarray(only)
    sequences = np.repeat(chosen, repetitions)
    repetition = np.tile(np.arange(repetitions), len(chosen))
    plan = schedule(np.array([names.index(name) for name in demos.sequence_object[sequences]]), trial.num_envs)
    recorded = np.flatnonzero(repetition == 0)
    found: dict[int, Episode] = {}
    traces: list[Trace] = []
    steps, spent, starts = 0, 0.0, trial.starts()
    with trial.worlds(engine, torch.as_tensor(plan.object_index)) as (env, points):
        dt = env.backend.scene.control_dt
        every = max(1, round(trace_interval / dt))
        for number, (items, fresh) in enumerate(plan):
            env.reset(start=episode_starts(starts, sequences[items], repetition[items], trial.seed).to(env.device))
            recorder = _Recorder([int(w) for w in np.flatnonzero(fresh & np.isin(items, recorded))])

            def look(step: int, reading: Reading, number: int = number, recorder: _Recorder = recorder) -> None:
                if step % every == 0:
                    recorder.add(step * dt, reading)
                if step:
                    recorder.add_targets(env.joint_target)
                    progress(number * env.max_episode_length + step, len(plan.rounds) * env.max_episode_length)

            result, seconds = play(policy, env, points, metrics or MetricsConfig(), look)
            spent += seconds
            steps += env.max_episode_length * env.backend.num_worlds
            traces += recorder.traces(env, names)
            for world in np.flatnonzero(fresh):
                found[int(items[world])] = _episode(
                    result, int(world), int(sequences[items[world]]), int(repetition[items[world]]), demos
                )
    episodes = tuple(found[i] for i in sorted(found))
    return Rollouts(
        episodes=episodes,
        traces=tuple(sorted(traces, key=lambda t: t.sequence)),
        control_steps_per_second=steps / spent,
    )


def play(
    policy: Policy,
    env: ManipulationEnv,
    points: torch.Tensor,
    metrics: MetricsConfig,
    look: Callable[[int, Reading], None],
) -> tuple[EpisodeMetrics, float]:
    """One episode in every world, from where it is now.

    Args:
        policy: what acts; it begins anew.
        env: the worlds, just reset.
        points: [N, 4, 3] of the objects, in their frames.
        look: called with (steps done, reading), first at the start and then after every control step.

    Returns:
        What was reached, and the seconds that it took without ``look``.
    """
    policy.begin(env)
    reading, spent = env.reading(), 0.0
    result = EpisodeMetrics(reading, env.goal_pos, env.goal_quat, points, metrics)
    look(0, reading)
    for step in range(1, env.max_episode_length + 1):
        before = time.perf_counter()
        reading, _ = env.advance(policy.act(env.get_observations()))
        result.update(reading, out_of_bounds(reading.state.object_pos, env.backend.scene.table, env.task.termination))
        spent += time.perf_counter() - before
        look(step, reading)
    return result, spent


def episode_starts(distribution: ResetDistribution, sequence: np.ndarray, repetition: np.ndarray, seed: int) -> Reset:
    """One start per world. Each has random numbers of its own, drawn on the CPU, so engine and number of worlds change nothing."""
    parts = []
    for s, r in zip(sequence.tolist(), repetition.tolist(), strict=True):
        generator = torch.Generator().manual_seed(int(np.random.SeedSequence([seed, s, r]).generate_state(1)[0]))
        parts.append(distribution.home(torch.tensor([s]), generator))
    return Reset.cat(parts)


_REACHED = ("approach", "grasp", "reorient", "reorient_once", "out_of_bounds", "nonfinite", "overflow")
_PROGRESS = ("reorientation_progress", "task_progress")


def _episode(result: EpisodeMetrics, world: int, sequence: int, repetition: int, demos: ResetBank) -> Episode:
    outcome: dict[str, Any] = {name: bool(getattr(result, name)[world]) for name in _REACHED}
    outcome |= {name: round(float(getattr(result, name)[world]), 6) for name in _PROGRESS}
    return Episode(
        sequence=sequence,
        sequence_name=str(demos.sequence_name[sequence]),
        object=str(demos.sequence_object[sequence]),
        repetition=repetition,
        **outcome,
    )


_STATES = ("joint_pos", "object_pos", "object_quat")


class _Recorder:
    """States of some worlds over an episode."""

    def __init__(self, worlds: list[int]) -> None:
        self._worlds, self._time, self._frames, self._targets = worlds, [], [], []

    def add(self, time: float, reading: Reading) -> None:
        if self._worlds:
            self._time.append(time)
            self._frames.append(
                {name: getattr(reading.state, name)[self._worlds].cpu().numpy().copy() for name in _STATES}
            )

    def add_targets(self, targets: torch.Tensor) -> None:
        if self._worlds:
            self._targets.append(targets[self._worlds].cpu().numpy().copy())

    def traces(self, env: ManipulationEnv, names: tuple[str, ...]) -> list[Trace]:
        return [
            Trace(
                sequence=int(env.sequence[world]),
                object=names[int(env.backend.object_index[world])],
                goal_pos=env.goal_pos[world]
                .cpu()
                .numpy()
                .copy(),  # the environment writes the next round's goals in place
                goal_quat=env.goal_quat[world].cpu().numpy().copy(),
                time=np.array(self._time),
                joint_target=np.stack([targets[i] for targets in self._targets]),
                **{name: np.stack([frame[name][i] for frame in self._frames]) for name in _STATES},
            )
            for i, world in enumerate(self._worlds)
        ]
