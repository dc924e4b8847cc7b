"""Results of evaluations: their files, and a table with a row for each episode.

``ENGINE.json`` holds the summary of one engine, ``ENGINE.episodes.json`` its episodes and ``ENGINE.trace.npz`` recorded
states.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
import pandas as pd

from xreset.cameras.config import VisionConfig
from xreset.errors import FileFormatError, RunError
from xreset.eval.stats import Interval, bootstrap_ci95, difference_ci95
from xreset.eval.table import METRICS, table_text
from xreset.files.checks import (
    Checked,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    Range,
    Rule,
    Share,
    from_dict,
    frozen,
)
from xreset.files.records import POSITION, UNIT_TOLERANCE, Field, read_npz, write_npz
from xreset.files.storage import read_json, read_typed, write_json
from xreset.files.text import Brief

SCHEMA = "xreset-eval/1"
EPISODES_SCHEMA = "xreset-episodes/1"
TRACE_SCHEMA = "xreset-trace/1"

_TRACE_FIELDS = {
    "time": Field(("T",), "f", within=(0.0, 1e6)),
    "joint_names": Field(("J",), "U"),
    "joint_pos": Field(("K", "T", "J"), "f", within=None),
    "object_pos": Field(("K", "T", 3), "f", within=None),
    "object_quat_wxyz": Field(("K", "T", 4), "f", within=None),
    "goal_pos": Field(("K", 3), "f", within=POSITION),
    "goal_quat_wxyz": Field(("K", 4), "f", unit=True),
    "object_name": Field(("K",), "U"),
    "sequence_index": Field(("K",), "i", within=(0, 2**31)),
    "joint_target": Field(("K", "C", "J"), "f", required=False, within=None),
}
_STACKED = {
    "joint_pos": "joint_pos",
    "object_pos": "object_pos",
    "object_quat": "object_quat_wxyz",
    "goal_pos": "goal_pos",
    "goal_quat": "goal_quat_wxyz",
}
"""Field of :class:`Trace` -> array in the file."""
_LARGEST_STATE = 1e6
"""Largest number in a state [m, rad]. An object may fall and a joint may run away, but not beyond this."""


if TYPE_CHECKING:
    Table = Any  # pandas' own types do not tell the rows of a table from one of its columns
else:
    Table = pd.DataFrame


@frozen
class Episode:
    """Result of one episode. :mod:`xreset.eval.metrics` defines the metrics."""

    sequence: NonNegativeInt
    """Index of the demonstration."""
    sequence_name: str
    object: str
    repetition: NonNegativeInt
    """Number of the perturbation of the demonstration's start."""
    approach: bool
    grasp: bool
    reorient: bool
    """Whether the object was at the goal at the end."""
    reorient_once: bool
    """Whether the object was at the goal at any time."""
    reorientation_progress: Share
    """1 - least / first distance to the goal, the largest of four keypoints of the object."""
    task_progress: Share
    out_of_bounds: bool
    nonfinite: bool
    overflow: bool
    """Whether the engine dropped contacts or constraints."""
    published_success: bool | None = None
    """Whether ``least_distance`` is at most 2 cm: the success of the published paper. This field and those below are
    None in files of an earlier version, which did not measure them."""
    least_distance: NonNegativeFloat | None = None
    """Least mean distance of 64 surface points to the goal over the episode [m]."""
    final_distance: NonNegativeFloat | None = None
    """This distance in the last reading, or the last before an early end [m]."""
    final_position_error: NonNegativeFloat | None = None
    """Distance of the object's origin, in the task's ``object_frame``, from the goal in the same reading [m]."""
    final_angle: NonNegativeFloat | None = None
    """Angle between the object and the goal in the same reading [rad]."""


@frozen
class Trace(Brief):
    """States of one episode, for pictures, and the drives' targets, for replays. Poses are in the world frame, of the
    object's mesh frame; quaternions are w x y z.

    Shape letters: T states, the first one before the first control step, C control steps, J joints in the order of
    :attr:`xreset.RobotSpec.joint_names`.
    """

    sequence: int
    """Index of the demonstration."""
    object: str
    goal_pos: np.ndarray
    """[3] m"""
    goal_quat: np.ndarray
    """[4]"""
    time: np.ndarray
    """[T] s"""
    joint_pos: np.ndarray
    """[T, J] rad (m)"""
    object_pos: np.ndarray
    """[T, 3] m"""
    object_quat: np.ndarray
    """[T, 4]"""
    joint_target: np.ndarray | None = None
    """[C, J] rad (m); None in files of older versions."""

    @property
    def finite(self) -> np.ndarray:
        """[T] bool: which states are finite."""
        state = np.concatenate((self.joint_pos, self.object_pos, self.object_quat), axis=1)
        return np.asarray(np.isfinite(state).all(axis=1))

    def actions(self, source: str) -> tuple[np.ndarray, int]:
        """Return the targets [C, J] of every control step, and the number of control steps from one state to the next.

        Args:
            source: name of the trace's file, for messages.

        Raises:
            FileFormatError: the trace has no targets, or fewer targets than states.
        """
        if self.joint_target is None:
            raise FileFormatError(
                f"{source} holds states without the actions that led to them. Evaluate again."
            )
        steps = len(self.joint_target)
        every = steps // (len(self.time) - 1)
        if every < 1:
            raise FileFormatError(
                f"{source} has {steps} actions for {len(self.time)} states, expected as many or more."
            )
        return self.joint_target, every


@frozen
class Rollouts:
    """All episodes of one policy in one engine."""

    episodes: tuple[Episode, ...]
    traces: tuple[Trace, ...]
    """The first episode of each demonstration."""
    control_steps_per_second: float
    """World steps per second of wall time, policy and observations included."""


@frozen
class TaskProgress(Checked):
    """Mean score of the highest stage of the episodes."""

    mean: Share
    ci95: Range
    """95 % bootstrap interval over demonstrations."""


@frozen
class DemoResult(Checked):
    """Means over the episodes of one demonstration."""

    sequence: str
    object: str
    episodes: PositiveInt
    task_progress: Share
    approach_rate: Share
    grasp_rate: Share
    reorient_rate: Share
    reorientation_progress: Share
    published_success_rate: Share | None = None
    """None, as in the next field: an earlier version did not measure it."""
    least_distance: NonNegativeFloat | None = None
    """Mean of :attr:`Episode.least_distance` [m]."""


@frozen
class EpisodeFaults(Checked):
    """Numbers of episodes with a fault."""

    nonfinite: NonNegativeInt
    """A number was not finite: the engine broke down, or the policy's action was not finite."""
    overflow: NonNegativeInt
    """The engine dropped contacts or constraints."""
    out_of_bounds: NonNegativeInt
    """The object left the scene."""


@frozen
class EvalResult(Brief, Checked):
    """Contents of ``eval/ENGINE.json``: one policy in one engine."""

    RENAMED: ClassVar = {
        "backend": "engine",
        "backend_version": "engine_version",
        "objects_folder": "meshes",
    }
    engine: Annotated[str, Rule("an engine's name", lambda name: bool(name) and "/" not in name)]
    engine_version: str
    robot: str
    objects: Annotated[tuple[str, ...], Rule("one object or more", bool)]
    """Object names, sorted."""
    meshes: str | None
    """Folder of meshes; None: the stand-ins."""
    policy: str
    episodes: PositiveInt
    episodes_per_demo: PositiveInt
    seed: NonNegativeInt
    task_progress: TaskProgress
    approach_rate: Share
    grasp_rate: Share
    reorient_rate: Share
    reorient_once_rate: Share
    reorientation_progress: Share
    per_demo: Annotated[tuple[DemoResult, ...], Rule("one demonstration or more", bool)]
    health: EpisodeFaults
    control_steps_per_second: PositiveFloat
    inputs: dict[str, str]
    """SHA-256 of the policy and the demonstrations."""
    unseen: tuple[str, ...] = ()
    """Objects that the policy was not trained with, sorted; empty for a baseline."""
    vision: VisionConfig | None = None
    """Cameras of the policy. None: it has none, or an earlier version did not state them."""
    published_success_rate: Share | None = None
    """Share of episodes that succeed in the sense of the published paper. None, as in the next two fields: an earlier
    version did not measure it."""
    published_success_ci95: Range | None = None
    """95 % bootstrap interval over demonstrations."""
    least_distance: NonNegativeFloat | None = None
    """Mean of :attr:`Episode.least_distance` [m]."""

    episode_seconds: PositiveFloat | None = None
    """Length of an episode [s]. None: an earlier version did not state it; it was that of the policy's training."""

    def meshes_folder(self, given: Path | None) -> Path | None:
        """Return the given folder of meshes, or else that of the evaluation; None: the stand-ins."""
        if given is not None or self.meshes is None:
            return given
        return Path(self.meshes)


class Evaluation(list[EvalResult]):
    """Results of one policy, one for each engine. It prints as a table; :meth:`to_frame` gives every episode."""

    def __init__(self, results: Iterable[EvalResult], episodes: Sequence[Table]) -> None:
        """Join the tables of the engines."""
        super().__init__(results)
        self._episodes = pd.concat(episodes, ignore_index=True) if episodes else pd.DataFrame()

    def to_frame(self) -> Table:
        """Return the table of episodes; see :func:`episode_table`."""
        return self._episodes

    def minus(self, other: Evaluation) -> Table:
        """Return how much better this policy is than another one that played the same episodes.

        Columns: engine, object (or ``all``), metric (a column of :func:`episode_table`), and mean, low and high: the
        difference, and its 95 % interval. The interval is a bootstrap that draws the same demonstrations for both.

        Raises:
            RunError: no engine is in both, or the starts, their seed, the meshes or the length of episodes differ.
        """
        starts = ["sequence", "sequence_name", "object", "repetition"]
        theirs = {result.engine: result for result in other}
        rows = []
        for result in self:
            engine = result.engine
            if engine not in theirs:
                continue
            tables = []
            played = []
            for whole, own in ((other, theirs[engine]), (self, result)):
                table = whole.to_frame()
                tables.append(table[table["engine"] == engine])
                episodes = tables[-1][starts].to_numpy().tolist()
                played.append((episodes, own.seed, own.meshes, own.episode_seconds))
            if played[0] != played[1]:
                raise RunError(
                    f"{result.policy} and {theirs[engine].policy} did not play the same episodes in {engine}. "
                    "Evaluate both with the same demonstrations, episodes, seed, objects and episode_seconds."
                )
            for name in ("all", *tables[0]["object"].unique()):
                one, two = (t if name == "all" else t[t["object"] == name] for t in tables)
                rows += [
                    (engine, name, metric, *difference(one, two, metric)) for metric in METRICS
                ]
        if not rows:
            raise RunError("the two evaluations have no engine in common.")
        return pd.DataFrame(rows, columns=["engine", "object", "metric", "mean", "low", "high"])

    def __repr__(self) -> str:
        return table_text(self)


# Episodes as a table --------------------------------------------------------------------------------------------------


def episode_table(result: EvalResult, episodes: Sequence[Episode], run: str = "") -> Table:
    """Return a table with one row for each episode.

    Columns: run, policy, engine, robot and seed, then the fields of :class:`Episode`: sequence
    (index of the demonstration), sequence_name, object, repetition, approach, grasp, reorient (at the goal at the end),
    reorient_once, reorientation_progress, task_progress, out_of_bounds, nonfinite, overflow, published_success,
    least_distance, final_distance, final_position_error [m], final_angle [rad]. A metric that an earlier version did
    not measure is NaN.
    """
    about = {
        "run": run or result.policy,
        "policy": result.policy,
        "engine": result.engine,
        "robot": result.robot,
        "seed": result.seed,
    }
    return _table(episodes, about)


def _table(episodes: Sequence[Episode], about: dict[str, Any]) -> Table:
    """Return a row for each episode, after the columns ``about``; a metric that was not measured is NaN."""
    columns = [*about, *(f.name for f in fields(Episode))]
    table: Table = pd.DataFrame([about | asdict(e) for e in episodes], columns=columns)
    return table.astype({name: float for name in table if table[name].isna().any()})


def mean(episodes: Table, metric: str) -> float:
    """Return the mean of one metric over episodes, rounded to six digits; NaN if it was not measured in all of them."""
    return round(float(episodes[metric].to_numpy(float).mean()), 6)


def difference(one: Table, other: Table, metric: str) -> tuple[float, float, float]:
    """Return the mean of a metric in ``other`` minus that in ``one``, and the lower and upper end of its 95 % interval
    (:func:`xreset.eval.stats.difference_ci95`). Both have episodes on the same demonstrations."""
    interval = difference_ci95(crossed(one, metric), crossed(other, metric))
    return mean(other, metric) - mean(one, metric), *interval


def crossed(episodes: Table, metric: str) -> list[np.ndarray]:
    """Return the metric, the index of the training and the demonstration of each episode, [E] each."""
    runs = pd.factorize(episodes["run"])[0]
    return [episodes[metric].to_numpy(float), runs, episodes["sequence"].to_numpy()]


def measured(episodes: Table, metric: str) -> float | None:
    """Return :func:`mean`, or None if the metric was not measured in all of the episodes."""
    value = mean(episodes, metric)
    return None if np.isnan(value) else value


def summarize(rollouts: Rollouts, **about: Any) -> EvalResult:
    """Return the means, intervals and faults of the episodes of one engine.

    Args:
        about: the fields of the result that do not follow from the episodes, such as ``engine`` and ``seed``.
    """
    episodes = _table(rollouts.episodes, {})
    rates = _rates(episodes)
    is_measured = rates["published_success_rate"] is not None
    per_demo = []
    for _, own in episodes.groupby("sequence", sort=False):
        first = own.iloc[0]
        per_demo.append(
            DemoResult(
                sequence=first["sequence_name"],
                object=first["object"],
                episodes=len(own),
                task_progress=mean(own, "task_progress"),
                **_rates(own),
            )
        )
    return EvalResult(
        objects=tuple(sorted(episodes["object"].unique())),
        episodes=len(episodes),
        episodes_per_demo=1 + int(episodes["repetition"].max()),
        task_progress=TaskProgress(
            mean=mean(episodes, "task_progress"), ci95=_ci95(episodes, "task_progress")
        ),
        published_success_ci95=_ci95(episodes, "published_success") if is_measured else None,
        reorient_once_rate=mean(episodes, "reorient_once"),
        per_demo=tuple(per_demo),
        health=EpisodeFaults(
            **{f.name: int(episodes[f.name].sum()) for f in fields(EpisodeFaults)}
        ),
        control_steps_per_second=round(rollouts.control_steps_per_second, 1),
        **rates,
        **about,
    )


def _ci95(episodes: Table, metric: str) -> Interval:
    low, high = bootstrap_ci95(episodes[metric].to_numpy(float), episodes["sequence"].to_numpy())
    return round(low, 6), round(high, 6)


def _rates(episodes: Table) -> dict[str, Any]:
    """Return the means that a result and each of its demonstrations state, by field."""
    stages = ("approach", "grasp", "reorient", "published_success")
    rates = {f"{stage}_rate": measured(episodes, stage) for stage in stages}
    return rates | {
        name: measured(episodes, name) for name in ("reorientation_progress", "least_distance")
    }


# Files ----------------------------------------------------------------------------------------------------------------


def write_results(
    folder: Path, summary: EvalResult, rollouts: Rollouts, joint_names: tuple[str, ...]
) -> None:
    """Write ``ENGINE.json``, ``ENGINE.episodes.json`` and ``ENGINE.trace.npz``."""
    name = summary.engine
    episodes = [asdict(e) for e in rollouts.episodes]
    write_json(folder / f"{name}.episodes.json", {"schema": EPISODES_SCHEMA, "episodes": episodes})
    write_traces(folder / f"{name}.trace.npz", rollouts.traces, joint_names)
    write_json(folder / f"{name}.json", {"schema": SCHEMA} | asdict(summary))


def write_traces(
    path: Path, traces: Sequence[Trace], joint_names: tuple[str, ...], **others: Any
) -> None:
    """Write recorded episodes; ``others``: further arrays, which :func:`read_traces` ignores."""
    arrays = {
        "time": traces[0].time,
        "joint_names": np.array(joint_names),
        "object_name": np.array([t.object for t in traces]),
        "sequence_index": np.array([t.sequence for t in traces]),
    }
    for field, key in _STACKED.items():
        arrays[key] = np.stack([getattr(t, field) for t in traces])
    targets = [t.joint_target for t in traces if t.joint_target is not None]
    if len(targets) == len(traces):
        arrays["joint_target"] = np.stack(targets)
    write_npz(path, TRACE_SCHEMA, arrays | others)


def read_evaluation(folder: Path, run: str = "") -> Evaluation:
    """Read the results of every engine in an ``eval`` folder, in order of name, and their episodes.

    Args:
        run: name of the run in the table of episodes; default: the policy's name in the results.

    Raises:
        FileFormatError: a file is damaged, or the files are of different evaluations.
    """
    results = []
    tables = []
    if os.path.isdir(folder):
        files = [f for f in folder.glob("*.json") if not f.name.endswith(".episodes.json")]
        for file in sorted(files, key=lambda f: f.stem):
            result = read_result(file)
            check_name(file, result.engine)
            results.append(result)
    for result in results:
        episodes = read_episodes(folder, result.engine)
        if len(episodes) != result.episodes:
            raise FileFormatError(
                f"{folder / result.engine}.json states {result.episodes} episodes, {result.engine}.episodes.json "
                f"holds {len(episodes)}. The files are of different evaluations; evaluate again."
            )
        tables.append(episode_table(result, episodes, run))
    return Evaluation(results, tables)


def check_name(path: Path, engine: str) -> None:
    """Refuse, with ``FileFormatError``, results of an engine in a file of another name, because copies count twice."""
    if path.stem != engine:
        raise FileFormatError(
            f"{path} has the results of {engine}, expected in {engine}.json. If it is a copy, move it out of the "
            "folder."
        )


def read_result(path: Path) -> EvalResult:
    """Read the result of one engine.

    Raises:
        FileFormatError: the file is damaged, or lacks an entry; the message names the entry.
    """
    return read_typed(EvalResult, path, SCHEMA)


def read_episodes(folder: Path, engine: str) -> tuple[Episode, ...]:
    """Read the episodes of one engine.

    Raises:
        FileFormatError: the file is damaged, or a value is impossible.
    """
    path = folder / f"{engine}.episodes.json"
    episodes = read_json(path, EPISODES_SCHEMA).get("episodes")
    if not isinstance(episodes, list):
        raise FileFormatError(f"{path} has no list 'episodes'. Evaluate again.")
    return tuple(
        from_dict(Episode, episode, f"{path}: episodes[{i}]") for i, episode in enumerate(episodes)
    )


def read_traces(
    folder: Path, engine: str, joint_names: tuple[str, ...] | None
) -> tuple[Trace, ...]:
    """Read the traces of one engine.

    Raises:
        FileFormatError: the file is damaged, or its joints are not ``joint_names`` in that order, unless that is None.
    """
    path = folder / f"{engine}.trace.npz"
    arrays = read_npz(
        path, TRACE_SCHEMA, _TRACE_FIELDS, what="an evaluation trace", check=_trace_problem
    )
    found = tuple(arrays["joint_names"].tolist())
    if joint_names is not None and found != joint_names:
        raise FileFormatError(
            f"{path} is a trace of the joints {', '.join(found)}; the robot has {', '.join(joint_names)}. "
            "Evaluate again."
        )
    traces = []
    for i, name in enumerate(arrays["object_name"]):
        trace = Trace(
            sequence=int(arrays["sequence_index"][i]),
            object=str(name),
            time=arrays["time"],
            joint_target=arrays["joint_target"][i] if "joint_target" in arrays else None,
            **{field: arrays[key][i] for field, key in _STACKED.items()},
        )
        traces.append(trace)
    return tuple(traces)


def recorded(episodes: Table, engine: str, traces: Sequence[Trace]) -> Table:
    """Return the episodes that were recorded, each with its ``trace``. An evaluation records the first repetition of
    each demonstration.

    Args:
        episodes: episodes, of any engines.
        traces: recorded episodes of the engine.

    Raises:
        FileFormatError: a trace shows a demonstration without an episode.
    """
    own = episodes[episodes["engine"] == engine].sort_values("repetition", kind="stable")
    own = own.drop_duplicates("sequence").set_index("sequence", drop=False)
    for trace in traces:
        if trace.sequence not in own.index:
            raise FileFormatError(
                f"{engine}.trace.npz has a trace of demonstration {trace.sequence}, but no episode of it. "
                "Evaluate again."
            )
    shown = own.loc[[trace.sequence for trace in traces]]
    return shown.assign(trace=list(traces)).reset_index(drop=True)


def _trace_problem(arrays: dict[str, np.ndarray]) -> str | None:
    """Return why no engine can have written these arrays; None if one can.

    An engine that breaks down may write numbers that are not finite, but not in the first frame.
    """
    time = arrays["time"]
    if len(time) < 2 or (np.diff(time) <= 0).any():
        return "the times of its frames do not rise."
    state = np.concatenate(
        (arrays["joint_pos"], arrays["object_pos"], arrays["object_quat_wxyz"]), axis=2
    )
    finite = np.isfinite(state).all(axis=2)
    if not finite[:, 0].all():
        return "an episode begins with numbers that are not finite."
    largest = np.abs(state[finite]).max()
    if largest > _LARGEST_STATE:
        return f"a state holds {largest:.3g}, expected at most {_LARGEST_STATE:g}."
    lengths = np.linalg.norm(arrays["object_quat_wxyz"][finite].astype(float), axis=-1)
    if (np.abs(lengths - 1) > UNIT_TOLERANCE).any():
        return "array 'object_quat_wxyz' holds quaternions that are not unit."
    targets = arrays.get("joint_target")
    if targets is not None and not (np.abs(targets[finite.min(axis=1)]) <= _LARGEST_STATE).all():
        return "array 'joint_target' holds numbers that are not finite, or far too large."
    return None
