"""Rollouts of a policy in one engine: the same episodes, from the same states, in every engine.

Shape letters: N worlds, T recorded states, C control steps, J joints.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator
from contextlib import closing
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch

from xreset.checks import NotNegative, Share
from xreset.env import ManipulationEnv
from xreset.eval.metrics import EpisodeMetrics, MetricPoints
from xreset.eval.trial import Engine, Trial
from xreset.policy import Policy
from xreset.resets.bank import ResetBank
from xreset.resets.distribution import Reset, ResetDistribution
from xreset.schedule import schedule
from xreset.task.reading import Reading
from xreset.task.terminations import out_of_bounds

TRACE_INTERVAL = 0.05
"""Time between the states of a trace [s]."""

Progress = Callable[[int, int], None]
"""Called with (control steps done, control steps in all)."""


@dataclass(frozen=True, kw_only=True)
class Episode:
    """Result of one episode."""

    sequence: NotNegative[int]
    """Index of the demonstration."""
    sequence_name: str
    object: str
    repetition: NotNegative[int]
    """Number of the perturbation of the demonstration's start."""
    approach: bool
    grasp: bool
    reorient: bool
    reorient_once: bool
    """Whether the object was at the goal at any time."""
    reorientation_progress: Share[float]
    task_progress: Share[float]
    out_of_bounds: bool
    nonfinite: bool
    overflow: bool
    """Whether the engine dropped contacts or constraints."""
    published_success: bool | None = None
    """Whether ``least_distance`` is at most 2 cm: the success of the published paper. None, as in the fields below:
    recorded by an earlier version, which did not measure it."""
    least_distance: NotNegative[float] | None = None
    """Least mean distance of 64 surface points to the goal over the episode [m]."""
    final_distance: NotNegative[float] | None = None
    """This distance at the end; of an episode that ended early, before its end [m]."""
    final_position_error: NotNegative[float] | None = None
    """Distance of the object's origin from its place at the goal, likewise [m]."""
    final_angle: NotNegative[float] | None = None
    """Angle between the object and the goal, likewise [rad]."""


@dataclass(frozen=True, kw_only=True)
class Trace:
    """States of one episode, for pictures, and the drives' targets, for replays."""

    sequence: int
    object: str
    goal_pos: np.ndarray
    goal_quat: np.ndarray
    time: np.ndarray
    """[T] s"""
    joint_pos: np.ndarray
    """[T, J]"""
    object_pos: np.ndarray
    """[T, 3]"""
    object_quat: np.ndarray
    """[T, 4]"""
    joint_target: np.ndarray | None = None
    """[C, J] of every control step; None in files of older versions."""


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
    progress: Progress = lambda done, total: None,
) -> Rollouts:
    """Play demonstrations ``repetitions`` times each.

    Args:
        policy: what acts.
        engine: where it acts.
        trial: what it plays.
        repetitions: episodes of each demonstration, each with another perturbation of robot and object.
        progress: called with (control steps done, control steps in all).
    """
    bank = trial.bank
    count = len(bank.sequence_name)
    sequences = np.repeat(np.arange(count), repetitions)
    repetition = np.tile(np.arange(repetitions), count)
    objects = [trial.names.index(name) for name in bank.sequence_object[sequences]]
    starts = trial.starts()
    found: dict[int, Episode] = {}
    traces: list[Trace] = []
    steps = 0
    seconds = 0.0

    def start(items: np.ndarray) -> Reset:
        return episode_starts(starts, sequences[items], repetition[items], trial.seed)

    with closing(play_rounds(engine, trial, objects, start)) as rounds:
        for r in rounds:
            env = r.env
            length = env.max_episode_length
            recorder = _Recorder(
                env, [world for world in r.fresh if repetition[r.items[world]] == 0]
            )
            policy.begin(env)
            reading = env.reading()
            result = EpisodeMetrics(reading, env.task_goal_pos, env.goal_quat, r.points)
            recorder.look(0, reading)
            for step in range(1, length + 1):
                before = time.perf_counter()
                reading, _ = env.advance(policy.act(env.get_observations()))
                lost = out_of_bounds(
                    reading.task_state.object_pos, env.backend.scene.table, env.task.termination
                )
                result.update(reading, lost)
                seconds += time.perf_counter() - before
                recorder.look(step, reading)
                progress(r.number * length + step, r.total * length)
            steps += length * env.num_envs
            traces += recorder.traces(trial.names)
            for world in r.fresh:
                item = int(r.items[world])
                found[item] = episode_of(
                    result, world, bank, int(sequences[item]), int(repetition[item])
                )
    return Rollouts(
        episodes=tuple(found[i] for i in sorted(found)),
        traces=tuple(sorted(traces, key=lambda t: t.sequence)),
        control_steps_per_second=steps / seconds,
    )


@dataclass(frozen=True, kw_only=True)
class Round:
    """Worlds that were just reset, each to play one item."""

    env: ManipulationEnv
    points: MetricPoints
    """The metric's points of each world's object."""
    items: np.ndarray
    """[N] item of each world."""
    fresh: list[int]
    """Worlds whose item was not played before; the others only keep busy."""
    number: int
    total: int
    """Number of rounds."""


def play_rounds(
    engine: Engine, trial: Trial, object_index: list[int], start: Callable[[np.ndarray], Reset]
) -> Generator[Round]:
    """Open an engine, and yield as many rounds as its worlds need to play one episode for each of some items.

    Args:
        engine: where to play.
        trial: what to play.
        object_index: index of each item's object.
        start: makes the starts [N] of items [N].
    """
    plan = schedule(np.array(object_index), trial.num_envs)
    with trial.worlds(engine, torch.as_tensor(plan.object_index)) as (env, points):
        for number, (items, fresh) in enumerate(plan):
            env.reset(start=start(items).to(env.device))
            worlds = np.flatnonzero(fresh).tolist()
            yield Round(
                env=env,
                points=points,
                items=items,
                fresh=worlds,
                number=number,
                total=len(plan.rounds),
            )


def episode_starts(
    distribution: ResetDistribution, sequence: np.ndarray, repetition: np.ndarray, seed: int
) -> Reset:
    """Return one start for each world. Each has random numbers of its own, whatever the engine and number of worlds."""
    parts = []
    for s, r in zip(sequence.tolist(), repetition.tolist(), strict=True):
        state = np.random.SeedSequence([seed, s, r]).generate_state(1)
        generator = torch.Generator().manual_seed(int(state[0]))
        parts.append(distribution.home(torch.tensor([s]), generator))
    return Reset.cat(parts)


def episode_of(
    result: EpisodeMetrics, world: int, bank: ResetBank, sequence: int, repetition: int
) -> Episode:
    """Return the result of one world, which has played a start of a demonstration."""
    values: dict[str, Any] = {}
    for field in fields(Episode):
        if hasattr(result, field.name):
            value = getattr(result, field.name)[world].item()
            values[field.name] = value if isinstance(value, bool) else round(value, 6)
    return Episode(
        sequence=sequence,
        sequence_name=str(bank.sequence_name[sequence]),
        object=str(bank.sequence_object[sequence]),
        repetition=repetition,
        **values,
    )


_STATES = ("joint_pos", "object_pos", "object_quat")


class _Recorder:
    """Records the states of some worlds over an episode."""

    def __init__(self, env: ManipulationEnv, worlds: list[int]) -> None:
        self._env = env
        self._worlds = worlds
        self._dt = env.backend.scene.control_dt
        self._every = max(1, round(TRACE_INTERVAL / self._dt))
        self._time: list[float] = []
        self._frames: dict[str, list[np.ndarray]] = {name: [] for name in _STATES}
        self._targets: list[np.ndarray] = []

    def look(self, step: int, reading: Reading) -> None:
        """Record a state every few steps, and the targets of every step."""
        if not self._worlds:
            return
        if step % self._every == 0:
            self._time.append(step * self._dt)
            for name, frames in self._frames.items():
                frames.append(self._rows(getattr(reading.state, name)))
        if step:
            self._targets.append(self._rows(self._env.joint_target))

    def _rows(self, values: torch.Tensor) -> np.ndarray:
        """A copy, because the environment writes the next values in place."""
        return values[self._worlds].cpu().numpy().copy()

    def traces(self, names: tuple[str, ...]) -> list[Trace]:
        """One trace of each recorded world; ``names``: of the objects."""
        if not self._worlds:
            return []
        env = self._env
        frames = {name: np.stack(rows) for name, rows in self._frames.items()}
        targets = np.stack(self._targets)
        goal_pos = self._rows(env.goal_pos)
        goal_quat = self._rows(env.goal_quat)
        out = []
        for i, world in enumerate(self._worlds):
            trace = Trace(
                sequence=int(env.sequence[world]),
                object=names[int(env.backend.object_index[world])],
                goal_pos=goal_pos[i],
                goal_quat=goal_quat[i],
                time=np.array(self._time),
                joint_target=targets[:, i],
                **{name: values[:, i] for name, values in frames.items()},
            )
            out.append(trace)
        return out
