"""Results of experiments: a table with a row for each episode, and its files.

``ENGINE.json`` holds the episodes of one engine, under all conditions, and ``ENGINE.trace.npz`` recorded states.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import MISSING, asdict, field, fields, make_dataclass
from functools import cache, cached_property
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, get_type_hints

import numpy as np
import pandas as pd

from xreset.cameras.config import VisionConfig
from xreset.errors import FileFormatError, RunError
from xreset.eval.metrics import METRICS, Episode
from xreset.eval.stats import Interval, Table, ci95, difference, mean
from xreset.eval.table import table_text
from xreset.files.checks import (
    Checked,
    NonNegativeInt,
    PositiveFloat,
    Rule,
    from_dict,
    frozen,
    renamed,
)
from xreset.files.records import POSITION, UNIT_TOLERANCE, Field, read_npz, write_npz
from xreset.files.storage import check_schema, matches, read_json, write_json
from xreset.files.text import Brief, shown
from xreset.spec import first_difference

SCHEMA = "xreset-eval/2"
EARLIER_SCHEMA = "xreset-eval/1"
EARLIER_EPISODES = "xreset-episodes/1"
"""Schemas of 0.1 to 0.3, which had a summary in ``ENGINE.json`` and its episodes in ``ENGINE.episodes.json``."""
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
_SAME_TURN = 1e-3
"""Difference of two turns that is only rounding [rad]."""


_MAY_LACK = {"value", *(f.name for f in fields(Episode) if f.default is None)}
"""Columns in which a file may have null."""


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
    stopped: dict[str, int] = field(default_factory=dict)
    """Reason why a robot's control loop stopped -> number of episodes."""


@frozen
class EvalResult(Brief, Checked):
    """Contents of ``ENGINE.json``: every episode of one policy in one engine, and what they were made with."""

    RENAMED: ClassVar = {
        "backend": "engine",
        "backend_version": "engine_version",
        "objects_folder": "meshes",
    }
    engine: Annotated[str, Rule("an engine's name", lambda name: bool(name) and "/" not in name)]
    engine_version: str
    robot: str
    policy: str
    seed: NonNegativeInt
    """Seed of the starts."""
    inputs: dict[str, str]
    """SHA-256 of the policy and the demonstrations."""
    meshes: str | None = None
    """Folder of meshes; None: the stand-ins."""
    control_steps_per_second: PositiveFloat
    """World steps per second of wall time, policy and observations included."""
    unseen: tuple[str, ...] = ()
    """Objects that the policy was not trained with, sorted; empty for a baseline."""
    vision: VisionConfig | None = None
    """Cameras of the policy. None: it has none, or an earlier version did not state them."""
    episode_seconds: PositiveFloat | None = None
    """Length of an episode [s]. None: an earlier version did not state it; it was that of the policy's training."""
    object_frame: Literal["mesh", "center"] | None = None
    """What objects are turned about at the start, and measured at. None: an earlier version did not state it."""
    left_out: dict[str, str] = field(default_factory=dict)
    """Property that was not changed -> reason."""
    stopped: dict[str, int] = field(default_factory=dict)
    """Reason why a robot's control loop stopped -> number of episodes."""
    episodes: Table = field(compare=False)
    """A row for each episode: property (what was changed; empty: nothing), value, and the fields of
    :class:`~xreset.eval.metrics.Episode`. A metric that an earlier version did not measure is NaN."""

    @cached_property
    def nominal(self) -> Table:
        """The episodes in which nothing was changed."""
        return self.episodes[self.episodes["property"] == ""]

    @property
    def changed(self) -> Table:
        """The episodes with a changed property."""
        return self.episodes[self.episodes["property"] != ""]

    @property
    def objects(self) -> tuple[str, ...]:
        """Names of the objects, sorted."""
        return tuple(sorted(self.nominal["object"].unique()))

    @property
    def episodes_per_demo(self) -> int:
        """Episodes of each demonstration."""
        return 1 + int(self.nominal["repetition"].max())

    def mean(self, metric: str) -> float:
        """Return the mean of a metric over the unchanged episodes; NaN if it was not measured in all of them."""
        return mean(self.nominal, metric)

    def ci95(self, metric: str) -> Interval:
        """Return the 95 % interval of this mean over demonstrations."""
        return ci95(self.nominal, metric)

    def to_frame(self, run: str = "") -> Table:
        """Return the episodes with columns that say whose they are: run (default: the policy), policy, engine, robot
        and seed."""
        about = {"run": run or self.policy}
        about |= {name: getattr(self, name) for name in ("policy", "engine", "robot", "seed")}
        return pd.concat([self.episodes.assign(**about)[list(about)], self.episodes], axis=1)

    def meshes_folder(self, given: str | Path | None) -> Path | None:
        """Return the given folder of meshes, or else that of the evaluation; None: the stand-ins."""
        folder = given or self.meshes
        return Path(folder) if folder else None


class Evaluation(list[EvalResult]):
    """Results of one policy, one for each engine. It prints as a table; :meth:`to_frame` gives every episode."""

    folder: Path | None = None
    """Folder of the files."""

    def to_frame(self, run: str = "") -> Table:
        """Return the table of all episodes; see :meth:`EvalResult.to_frame`."""
        tables = [result.to_frame(run) for result in self]
        return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()

    def minus(self, other: Evaluation) -> Table:
        """Return how much better this policy is than another one that played the same episodes.

        Columns: engine, object (or ``all``), metric, and mean, low and high: the difference, and its 95 % interval. The
        interval is a bootstrap that draws the same demonstrations for both.

        Raises:
            RunError: no engine is in both, or the starts, goals, their seed, the meshes, the objects' frame or the
                length of episodes differ.
        """
        theirs = {result.engine: result for result in other}
        rows = []
        for result in self:
            engine = result.engine
            if engine not in theirs:
                continue
            if different := _different(result, theirs[engine]):
                raise RunError(
                    f"{result.policy} and {theirs[engine].policy} did not play the same episodes in {engine}: "
                    f"{different}. Evaluate both alike."
                )
            tables = [theirs[engine].nominal, result.nominal]
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


def _different(one: EvalResult, other: EvalResult) -> str:
    """Return what differs between the episodes of two results, as text; empty if they are the same. The frame and turns
    of objects that an earlier version did not state count as equal."""
    for name in ("seed", "meshes", "episode_seconds", "object_frame"):
        values = [getattr(result, name) for result in (one, other)]
        if name == "meshes":  # a relative path may mean the same folder
            values = [str(Path(folder).resolve()) if folder else "stand-ins" for folder in values]
        if values[0] != values[1] and not (name == "object_frame" and None in values):
            return f"{name} is {shown(values[0])} and {shown(values[1])}"
    starts = ["sequence", "sequence_name", "object", "repetition"]
    if one.nominal[starts].to_numpy().tolist() != other.nominal[starts].to_numpy().tolist():
        return "not the same demonstrations, or not as many episodes"
    # the names in goal sets are alike
    turns = other.nominal["turn"].to_numpy(float) - one.nominal["turn"].to_numpy(float)
    return "not the same goals" if (np.abs(turns) > _SAME_TURN).any() else ""


# Tables of episodes ---------------------------------------------------------------------------------------------------


def episode_table(
    episodes: Sequence[Episode], changed: str = "", value: float | None = None
) -> Table:
    """Return a row for each episode; ``changed``: name of the property that had a value, empty if nothing was
    changed."""
    columns = ["property", "value", *(f.name for f in fields(Episode))]
    about = {"property": changed, "value": value}
    return _with_nan(pd.DataFrame([about | vars(e) for e in episodes], columns=columns))


def _with_nan(table: Table) -> Table:
    """Return a table with NaN in place of None."""
    unknown = {name: float for name in table if table[name].isna().any()}
    return table.astype(unknown | {"value": float})


# Files ----------------------------------------------------------------------------------------------------------------


def write_result(
    folder: Path, result: EvalResult, traces: Sequence[Trace], joint_names: tuple[str, ...]
) -> None:
    """Write ``ENGINE.json``, and the recorded episodes, if there are any, as ``ENGINE.trace.npz``."""
    name = result.engine
    header = {f.name: getattr(result, f.name) for f in fields(result)}
    if result.vision is not None:
        header["vision"] = asdict(result.vision)
    columns = {}
    for column, values in result.episodes.items():
        columns[column] = values.tolist()
        if column in _MAY_LACK:
            columns[column] = [None if x != x else x for x in columns[column]]
    content = {"schema": SCHEMA} | header | {"episodes": columns}
    json.dumps(
        columns, allow_nan=False
    )  # refuses a number that is not finite before anything is written
    trace = folder / f"{name}.trace.npz"
    path = folder / f"{name}.json"
    path.unlink(missing_ok=True)  # a kill leaves no earlier results next to new states
    if traces:
        write_traces(trace, traces, joint_names)
    else:
        trace.unlink(missing_ok=True)
    write_json(path, content)
    (folder / f"{name}.episodes.json").unlink(missing_ok=True)  # of an earlier version


def write_traces(path: Path, traces: Sequence[Trace], joint_names: tuple[str, ...]) -> None:
    """Write recorded episodes."""
    arrays = {
        "time": traces[0].time,
        "joint_names": np.array(joint_names),
        "object_name": np.array([t.object for t in traces]),
        "sequence_index": np.array([t.sequence for t in traces]),
    }
    for name, key in _STACKED.items():
        arrays[key] = np.stack([getattr(t, name) for t in traces])
    targets = [t.joint_target for t in traces if t.joint_target is not None]
    if len(targets) == len(traces):
        arrays["joint_target"] = np.stack(targets)
    write_npz(path, TRACE_SCHEMA, arrays)


def read_evaluation(folder: Path) -> Evaluation:
    """Read the results of every engine in a folder, in order of name; none if the folder does not exist.

    Raises:
        FileFormatError: a file is damaged, or the files are of different evaluations.
    """
    files = [f for f in matches(folder, "*.json") if not f.name.endswith(".episodes.json")]
    found = Evaluation(map(read_result, sorted(files, key=lambda f: f.stem)))
    found.folder = folder
    return found


def has_results(folder: Path) -> bool:
    """Return whether a folder has results of an engine."""
    return bool(matches(folder, "*.json"))


def read_result(path: Path) -> EvalResult:
    """Read the results of one engine.

    Raises:
        FileFormatError: the file is damaged, has the results of another engine, or lacks an entry.
    """
    data = read_json(path)
    version = data.pop("xreset", None)
    schema = data.pop("schema", None)
    if schema == EARLIER_SCHEMA:
        data = _of_earlier_version(path, data)
    else:
        check_schema(path, schema, SCHEMA)
    columns = from_dict(_columns(), data.get("episodes"), f"{path}: episodes", version)
    every = {name: values for name, values in vars(columns).items() if values}
    lengths = {len(values) for values in every.values()}
    if len(lengths) != 1:
        raise FileFormatError(
            f"{path}: the columns of episodes have {sorted(lengths)} entries, expected the same number, one or more, "
            "in each. Evaluate again."
        )
    names = ["property", "value", *(f.name for f in fields(Episode))]
    table = _with_nan(pd.DataFrame({name: every.get(name) for name in names}))
    if not (table["property"] == "").any():
        raise FileFormatError(f"{path} has no unchanged episode. Evaluate again.")
    _check_same_episodes(path, table)
    result = from_dict(EvalResult, data | {"episodes": table}, str(path), version)
    if path.stem != result.engine:
        raise FileFormatError(
            f"{path} has the results of {result.engine}, expected in {result.engine}.json. If it is a copy, move it "
            "out of the folder."
        )
    return result


def _check_same_episodes(path: Path, table: Table) -> None:
    """Raise ``FileFormatError`` if a condition was not played with the same episodes as no condition."""
    unchanged = table[table["property"] == ""]
    expected = unchanged[["sequence", "repetition"]].to_numpy().tolist()
    for condition, own in table.groupby(["property", "value"], dropna=False):
        if own[["sequence", "repetition"]].to_numpy().tolist() != expected:
            raise FileFormatError(
                f"{path}: the change {shown(condition)} was not played with the {len(expected)} episodes in which "
                "nothing was changed. Evaluate again."
            )


@cache
def _columns() -> type:
    """Return a dataclass of the columns of episodes in a file, to check them."""
    hints = get_type_hints(Episode, include_extras=True)
    columns: list[Any] = [("property", tuple[str, ...]), ("value", tuple[float | None, ...])]
    for f in fields(Episode):
        default = () if f.default is MISSING else (field(default=()),)
        columns.append((f.name, tuple[hints[f.name], ...], *default))
    return make_dataclass("Episodes", columns, kw_only=True)


def _of_earlier_version(path: Path, data: dict[str, Any]) -> dict[str, Any]:
    """Return the entries of today from a summary of 0.1 to 0.3 and the file of its episodes."""
    file = path.with_name(f"{path.stem}.episodes.json")
    rows = read_json(file, EARLIER_EPISODES).get("episodes")
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise FileFormatError(f"{file} has no list 'episodes'. Evaluate again.")
    if len(rows) != data.get("episodes"):
        raise FileFormatError(
            f"{path} states {data.get('episodes')} episodes, {file.name} holds {len(rows)}. The files are of different "
            "evaluations; evaluate again."
        )
    names = dict.fromkeys(chain.from_iterable(rows))
    columns: dict[str, list[Any]] = {"property": [""] * len(rows), "value": [None] * len(rows)}
    for name in names:
        columns[name] = [row.get(name) for row in rows]
    kept = {f.name for f in fields(EvalResult)}
    header = {name: x for name, x in renamed(EvalResult, data).items() if name in kept}
    return header | {"episodes": columns}


def read_traces(
    folder: Path, engine: str, joint_names: tuple[str, ...] | None
) -> tuple[Trace, ...]:
    """Read the traces of one engine.

    Raises:
        FileFormatError: the file is damaged, or its joints are not ``joint_names`` in that order, unless that is None.
    """
    path = folder / f"{engine}.trace.npz"
    if not path.exists():
        raise FileFormatError(
            f"there is no {path}, which holds recorded episodes: xreset eval makes it, xreset stress does not."
        )
    arrays = read_npz(
        path, TRACE_SCHEMA, _TRACE_FIELDS, what="an evaluation trace", check=_trace_problem
    )
    found = tuple(arrays["joint_names"].tolist())
    if joint_names is not None and found != joint_names:
        raise FileFormatError(
            f"{path} is a trace of other joints than the robot's: {first_difference(found, joint_names)}. "
            "Evaluate again."
        )
    traces = []
    for i, name in enumerate(arrays["object_name"]):
        trace = Trace(
            sequence=int(arrays["sequence_index"][i]),
            object=str(name),
            time=arrays["time"],
            joint_target=arrays["joint_target"][i] if "joint_target" in arrays else None,
            **{name: arrays[key][i] for name, key in _STACKED.items()},
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
    is_own = (episodes["engine"] == engine) & (episodes["property"] == "")
    own = episodes[is_own].sort_values("repetition", kind="stable")
    own = own.drop_duplicates("sequence").set_index("sequence", drop=False)
    for trace in traces:
        if trace.sequence not in own.index:
            raise FileFormatError(
                f"{engine}.trace.npz has a trace of demonstration {trace.sequence}, but no episode of it. "
                "Evaluate again."
            )
    traced = own.loc[[trace.sequence for trace in traces]]
    return traced.assign(trace=list(traces)).reset_index(drop=True)


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
