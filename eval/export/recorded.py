"""The episodes that evaluations recorded, of any engine, in one form: states at an even rate and the action at each of them.

Shape letters: T frames, J actuated joints.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from xreset.description import load_robot
from xreset.errors import FileFormatError, RunError
from xreset.eval.report.clips import recorded_episode
from xreset.eval.report.read import results_in
from xreset.eval.results import mesh_folder, read_episodes, read_results, read_traces
from xreset.eval.rollout import Episode, Trace
from xreset.records import write_npz
from xreset.spec import RobotSpec
from xreset.text import short_name

SCHEMA = "xreset-rollouts/1"
TASK = "Grasp the {object} and bring it to the goal pose."


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """One episode. Joint positions in rad (prismatic: m), poses in the world frame (z up, table top at z = 0), quaternions (w, x, y, z)."""

    engine: str
    policy: str
    seed: int
    episode: Episode
    """Its result."""
    task: str
    """In words."""
    trace: Trace
    """[T] finite states."""
    action: np.ndarray
    """[T, J] joint targets: what the drives were told last before the next frame; the last frame's is repeated if nothing came after it."""
    objects: Path | None
    """Folder of the object's mesh; None: a stand-in."""


@dataclass(frozen=True, kw_only=True)
class Recording:
    """Episodes of one robot at one rate."""

    robot: RobotSpec
    fps: float
    """Frames per second."""
    episodes: tuple[Recorded, ...]

    @property
    def offsets(self) -> np.ndarray:
        """[E + 1] episode i owns the frames ``offsets[i] : offsets[i + 1]``."""
        return np.cumsum([0, *(len(e.action) for e in self.episodes)])


def read_recorded(
    folders: Sequence[Path],
    *,
    backends: Sequence[str] = (),
    robot: str | None = None,
    objects: Path | None = None,
    task: str = TASK,
) -> Recording:
    """Read the recorded episodes of evaluations: the first of each demonstration and engine.

    An episode in which the engine broke down ends at its last finite state, and is left out if that is its first.

    Args:
        folders: run folders, or folders that ``xreset eval`` wrote into.
        backends: only of these engines; none: of all.
        robot: name or folder of the robot; None: as the results name it.
        objects: folder of meshes; None: as the results name it.
        task: the task in words; ``{object}`` stands for the object's name.

    Raises:
        RunError: a folder does not exist, or none holds episodes of the engines; or they are of two robots or rates.
        FileFormatError: a file is damaged, or older than recorded actions.
    """
    found: list[Recorded] = []
    robots: dict[str, RobotSpec] = {}
    intervals: dict[float, Path] = {}
    for folder in folders:
        results = results_in(folder)
        for summary in read_results(results):
            if backends and summary.backend not in backends:
                continue
            name = robot or summary.robot
            if name not in robots:
                robots[name] = load_robot(name)
            episodes = read_episodes(results, summary.backend)
            for trace in read_traces(results, summary.backend, robots[name].joint_names):
                action = _actions(trace, results, summary.backend)
                intervals.setdefault(round(float(np.median(np.diff(trace.time))), 6), results)
                episode = recorded_episode(episodes, trace.sequence)
                words = task.replace("{object}", short_name(trace.object))
                whole = Recorded(
                    engine=summary.backend,
                    policy=summary.policy,
                    seed=summary.seed,
                    episode=episode,
                    task=words,
                    trace=trace,
                    action=action,
                    objects=mesh_folder(objects, summary.objects_folder),
                )
                found += _finite(whole, results)
    if not found:
        what = f" of {', '.join(backends)}" if backends else ""
        raise RunError(
            f"{', '.join(map(str, folders))}: there are no recorded episodes{what}. Make them first: xreset eval"
        )
    if len(robots) > 1:
        raise RunError(
            f"the episodes are of the robots {', '.join(sorted(robots))}; a data set is of one. Export them one by one."
        )
    if len(intervals) > 1:
        listing = ", ".join(f"{1 / dt:.4g} in {path}" for dt, path in intervals.items())
        raise RunError(f"the episodes have different rates, frames per second: {listing}. Export them one by one.")
    return Recording(robot=next(iter(robots.values())), fps=_rate(next(iter(intervals))), episodes=tuple(found))


def _actions(trace: Trace, results: Path, engine: str) -> np.ndarray:
    if trace.joint_target is None:
        raise FileFormatError(
            f"{results / engine}.trace.npz holds states without the actions that led to them. Evaluate again."
        )
    frames, steps = len(trace.time), len(trace.joint_target)
    every = steps // (frames - 1)
    if every < 1:
        raise FileFormatError(
            f"{results / engine}.trace.npz has {steps} actions for {frames} states, expected as many or more."
        )
    return trace.joint_target[np.minimum(np.arange(1, frames + 1) * every - 1, steps - 1)]


def _finite(whole: Recorded, results: Path) -> list[Recorded]:
    trace = whole.trace
    sound = np.isfinite(
        np.concatenate((trace.joint_pos, trace.object_pos, trace.object_quat, whole.action), axis=1)
    ).min(axis=1)
    last = len(sound) if sound.all() else int(np.argmin(sound))
    if last == len(sound):
        return [whole]
    fate = "is left out" if last < 2 else f"ends at {trace.time[last - 1]:.2f} s"
    logging.getLogger(__name__).warning(
        "%s, %s, demonstration %d: its states stop being finite, so it %s.", results, whole.engine, trace.sequence, fate
    )
    if last < 2:
        return []
    cut = {name: getattr(trace, name)[:last] for name in ("time", "joint_pos", "object_pos", "object_quat")}
    return [replace(whole, trace=replace(trace, **cut), action=whole.action[:last])]


def _rate(interval: float) -> float:
    rate = 1 / interval
    return float(round(rate)) if abs(rate - round(rate)) < 1e-3 else rate


def write_arrays(path: str | Path, recording: Recording) -> None:
    """Write them as plain arrays in one npz file, behind one another; ``docs/rollouts.md`` has the schema.

    Raises:
        XResetError: the file cannot be written.
    """
    episodes = recording.episodes
    traces = [e.trace for e in episodes]
    per_frame = {
        "time": [t.time for t in traces],
        "joint_pos": [t.joint_pos for t in traces],
        "joint_target": [e.action for e in episodes],
        "object_pos": [t.object_pos for t in traces],
        "object_quat_wxyz": [t.object_quat for t in traces],
    }
    arrays = {name: np.concatenate(parts).astype(np.float32) for name, parts in per_frame.items()} | {
        "frame_offsets": recording.offsets,
        "fps": np.array(recording.fps),
        "robot": np.array(recording.robot.name),
        "joint_names": np.array(recording.robot.joint_names),
        "goal_pos": np.stack([t.goal_pos for t in traces]).astype(np.float32),
        "goal_quat_wxyz": np.stack([t.goal_quat for t in traces]).astype(np.float32),
        "engine": np.array([e.engine for e in episodes]),
        "policy": np.array([e.policy for e in episodes]),
        "task": np.array([e.task for e in episodes]),
        "seed": np.array([e.seed for e in episodes]),
        "object_name": np.array([t.object for t in traces]),
        "sequence_name": np.array([e.episode.sequence_name for e in episodes]),
        "success": np.array([e.episode.reorient for e in episodes]),
        "task_progress": np.array([e.episode.task_progress for e in episodes]),
    }
    write_npz(path, SCHEMA, arrays)
