"""Recorded episodes of evaluations in one form: states at an even rate and the action at each of them.

Shape letters: T frames, J actuated joints.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from xreset.errors import RunError
from xreset.eval.report.read import results_in
from xreset.eval.results import Trace, read_evaluation, read_traces, recorded
from xreset.eval.stats import Table
from xreset.files.checks import first_repeated, frozen
from xreset.files.records import write_npz
from xreset.files.storage import file_hash
from xreset.files.text import short_name, shown, texts
from xreset.geometry.description import load_robot
from xreset.spec import RobotSpec

SCHEMA = "xreset-rollouts/1"
TASK = "Grasp the {object} and bring it to the goal pose."
_COLUMNS = {
    "engine": "engine",
    "policy": "policy",
    "task": "task",
    "seed": "seed",
    "object_name": "object",
    "sequence_name": "sequence_name",
    "success": "reorient",
    "task_progress": "task_progress",
    "published_success": "published_success",
    "least_distance": "least_distance",
}
"""Array of the npz file -> column of the table of episodes."""


@frozen
class RecordedEpisodes:
    """Recorded episodes of one robot at one rate."""

    robot: RobotSpec
    fps: float
    """Frames per second."""
    episodes: Table
    """One row for each recorded episode (:meth:`xreset.EvalResult.to_frame`), with further columns: ``task`` in
    words; ``trace``, its states [T]; ``action`` [T, J], joint targets: the last target before the next frame, of
    the last frame its own; ``meshes``, folder of the object's mesh or None: a stand-in. Joint positions in rad
    (prismatic: m), poses in the world frame (z up, table top at z = 0), quaternions (w, x, y, z)."""
    inputs: dict[str, str]
    """Name -> SHA-256 of each file of traces."""

    @property
    def offsets(self) -> np.ndarray:
        """[E + 1] episode i owns the frames ``offsets[i] : offsets[i + 1]``."""
        return np.cumsum([0, *map(len, self.episodes["action"])])


def read_recorded(
    folders: str | Path | Sequence[str | Path],
    *,
    engines: str | Sequence[str] = (),
    robot: str | Path | None = None,
    meshes: str | Path | None = None,
    task: str | None = None,
) -> RecordedEpisodes:
    """Read the recorded episodes of evaluations: the first of each demonstration and engine.

    An episode in which the engine broke down is left out, with a warning.

    Args:
        folders: run folders, or folders that ``xreset eval`` wrote into.
        engines: only this engine, or these; empty: all.
        robot: name or folder of the robot; None: as the results name it.
        meshes: folder of meshes; None: as the results name it.
        task: the task in words, in which ``{object}`` stands for the object's name; default: :data:`TASK`.

    Raises:
        RunError: no folder is given, one does not exist, or none holds episodes of the engines; or the episodes have
            two robots or rates; or the task has another placeholder.
        FileFormatError: a file is damaged, or older than recorded actions.
    """
    if not folders:
        raise RunError(
            "Nothing to export. Give a run folder, or a folder that xreset eval wrote into."
        )
    sentence = TASK if task is None else task
    _check_placeholders(sentence)
    rows = []
    robots: dict[str, RobotSpec] = {}
    intervals: dict[float, Path] = {}
    inputs: dict[str, str] = {}
    every = [folders] if isinstance(folders, str | Path) else folders
    wanted = texts(engines)
    places = [results_in(Path(folder)) for folder in every]
    if (i := first_repeated([place.resolve() for place in places])) is not None:
        raise RunError(f"The results in {places[i]} are given twice. Give each folder once.")
    for results in places:
        evaluation = read_evaluation(results)
        for result in evaluation:
            if wanted and result.engine not in wanted:
                continue
            name = str(robot or result.robot)
            if name not in robots:
                robots[name] = load_robot(name)
            file = results / f"{result.engine}.trace.npz"
            traces = read_traces(results, result.engine, robots[name].joint_names)
            inputs[f"trace {len(inputs)}"] = file_hash(file)
            for trace in traces:
                intervals.setdefault(_interval(trace), results)
            table = recorded(evaluation.to_frame(), result.engine, traces)
            for episode, action in _sound_episodes(table, file):
                episode["task"] = sentence.replace("{object}", short_name(episode["object"]))
                episode["action"] = action
                episode["meshes"] = result.meshes_folder(meshes)
                rows.append(episode)
    if not rows:
        of = f" of {', '.join(wanted)}" if wanted else ""
        raise RunError(
            f"{', '.join(map(str, every))}: there are no recorded episodes{of}. Make them first: xreset eval"
        )
    if len(robots) > 1:
        raise RunError(
            f"the episodes are of the robots {', '.join(sorted(robots))}, expected one robot. Export them one by one."
        )
    if len(intervals) > 1:
        listing = ", ".join(f"{1 / dt:.4g} in {path}" for dt, path in intervals.items())
        raise RunError(
            f"the episodes have different rates, frames per second: {listing}. Export them one by one."
        )
    return RecordedEpisodes(
        robot=next(iter(robots.values())),
        fps=_rate(next(iter(intervals))),
        episodes=pd.DataFrame(rows),
        inputs=inputs,
    )


def _check_placeholders(task: str) -> None:
    """Refuse, with ``RunError``, a task in words that is empty or has another placeholder than ``{object}``."""
    if not task.strip():
        raise RunError("The task is empty. Say in words what the episodes show, or omit --task.")
    unknown = re.search(r"\{[^{}]*\}?|\}", task.replace("{object}", ""))
    if unknown:
        raise RunError(
            f"Unknown placeholder {unknown[0]!r} in the task {shown(task)}. The only placeholder is {{object}}, the "
            "name of the object."
        )


def _interval(trace: Trace) -> float:
    """Return the time from one state to the next [s]."""
    return round(float(np.median(np.diff(trace.time))), 6)


def _sound_episodes(table: Table, file: Path) -> Iterator[tuple[dict[str, Any], np.ndarray]]:
    """Yield recorded episodes and their actions [T, J]; an episode in which the engine broke down is left out, with a
    warning."""
    for episode in table.to_dict("records"):
        trace = episode["trace"]
        action = _actions(trace, file)
        if trace.finite.all() and np.isfinite(action).all():
            yield episode, action
            continue
        logging.getLogger(__name__).warning(
            "%s, %s, demonstration %d is left out: its engine broke down.",
            file.parent,
            episode["engine"],
            trace.sequence,
        )


def _actions(trace: Trace, file: Path) -> np.ndarray:
    """Return the action [T, J] at each state."""
    targets, every = trace.actions(str(file))
    last = np.arange(1, len(trace.time) + 1) * every - 1
    return targets[np.minimum(last, len(targets) - 1)]


def _rate(interval: float) -> float:
    rate = 1 / interval
    return float(round(rate)) if abs(rate - round(rate)) < 1e-3 else rate


def write_arrays(path: str | Path, recording: RecordedEpisodes) -> None:
    """Write all episodes, one after another, as plain arrays in one npz file; ``docs/rollouts.md`` has the schema.

    Raises:
        XResetError: the file cannot be written.
    """
    traces = recording.episodes["trace"]
    per_frame = {
        "time": [t.time for t in traces],
        "joint_pos": [t.joint_pos for t in traces],
        "joint_target": recording.episodes["action"],
        "object_pos": [t.object_pos for t in traces],
        "object_quat_wxyz": [t.object_quat for t in traces],
    }
    arrays = {name: np.concatenate(parts).astype(np.float32) for name, parts in per_frame.items()}
    arrays |= {
        name: np.array(recording.episodes[column].tolist()) for name, column in _COLUMNS.items()
    }
    arrays |= {
        "frame_offsets": recording.offsets,
        "fps": np.array(recording.fps),
        "robot": np.array(recording.robot.name),
        "joint_names": np.array(recording.robot.joint_names),
        "goal_pos": np.stack([t.goal_pos for t in traces]).astype(np.float32),
        "goal_quat_wxyz": np.stack([t.goal_quat for t in traces]).astype(np.float32),
    }
    write_npz(path, SCHEMA, arrays, inputs=recording.inputs)
