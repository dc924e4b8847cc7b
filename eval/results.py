"""Evaluation results as files: one JSON per engine, its episodes and traces beside it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from xreset.checks import Checked, NotNegative, Positive, Range, Share
from xreset.errors import FileFormatError
from xreset.eval.rollout import Episode, Rollouts, Trace
from xreset.eval.stats import bootstrap_ci95
from xreset.files import read_json, write_json
from xreset.records import POSITION, UNIT_TOLERANCE, Field, read_npz, write_npz
from xreset.typed import from_dict

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
    "joint_pos": "joint_pos", "object_pos": "object_pos", "object_quat": "object_quat_wxyz", "goal_pos": "goal_pos",
    "goal_quat": "goal_quat_wxyz",
}  # fmt: skip
"""Field of :class:`~xreset.eval.rollout.Trace` -> array."""


@dataclass(frozen=True, kw_only=True)
class TaskProgress(Checked):
    """Mean score of the highest stage of the episodes."""

    mean: Share[float]
    ci95: Range
    """95 % bootstrap interval over demonstrations."""


@dataclass(frozen=True, kw_only=True)
class DemoResult(Checked):
    """The episodes of one demonstration."""

    sequence: str
    object: str
    episodes: Positive[int]
    task_progress: Share[float]
    approach_rate: Share[float]
    grasp_rate: Share[float]
    reorient_rate: Share[float]
    reorientation_progress: Share[float]


@dataclass(frozen=True, kw_only=True)
class EpisodeFaults(Checked):
    """Episodes that ended early."""

    nonfinite: NotNegative[int]
    """Because a number was not finite: the engine broke down, or the policy's action was none."""
    overflow: NotNegative[int]
    """In which the engine dropped contacts or constraints."""
    out_of_bounds: NotNegative[int]
    """Because the object left the scene."""


@dataclass(frozen=True, kw_only=True)
class EvalResult(Checked):
    """Contents of ``eval/BACKEND.json``: one policy in one engine."""

    backend: str
    backend_version: str
    robot: str
    objects: tuple[str, ...]
    """Sorted."""
    objects_folder: str | None
    """Folder of meshes; None: the stand-ins."""
    policy: str
    episodes: Positive[int]
    episodes_per_demo: Positive[int]
    seed: NotNegative[int]
    task_progress: TaskProgress
    approach_rate: Share[float]
    grasp_rate: Share[float]
    reorient_rate: Share[float]
    reorient_once_rate: Share[float]
    reorientation_progress: Share[float]
    per_demo: tuple[DemoResult, ...]
    health: EpisodeFaults
    control_steps_per_second: Positive[float]
    inputs: dict[str, str]
    """SHA-256 by name."""
    unseen: tuple[str, ...] = ()
    """Those of the objects that the policy was not trained with, sorted; none of a baseline's."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.objects or not self.per_demo:
            raise ValueError("it tells of no object or no demonstration")
        if "/" in self.backend or not self.backend:
            raise ValueError(f"backend is {self.backend!r}, expected an engine's name")


def summarize(
    rollouts: Rollouts, *, backend: str, backend_version: str, robot: str, policy: str, seed: int, inputs: dict[str, str],
    objects_folder: str | None, unseen: tuple[str, ...] = (),
) -> EvalResult:  # fmt: skip
    """What the episodes come to."""
    episodes = rollouts.episodes
    progress, groups = (np.array([getattr(e, name) for e in episodes]) for name in ("task_progress", "sequence"))
    low, high = (round(x, 6) for x in bootstrap_ci95(progress, groups))
    return EvalResult(
        backend=backend,
        backend_version=backend_version,
        robot=robot,
        objects=tuple(sorted({e.object for e in episodes})),
        objects_folder=objects_folder,
        policy=policy,
        episodes=len(episodes),
        episodes_per_demo=1 + max(e.repetition for e in episodes),
        seed=seed,
        task_progress=TaskProgress(mean=mean(episodes, "task_progress"), ci95=(low, high)),
        reorient_once_rate=mean(episodes, "reorient_once"),
        per_demo=tuple(_per_demo([e for e in episodes if e.sequence == s]) for s in dict.fromkeys(groups.tolist())),
        health=EpisodeFaults(**{f.name: sum(getattr(e, f.name) for e in episodes) for f in fields(EpisodeFaults)}),
        control_steps_per_second=round(rollouts.control_steps_per_second, 1),
        inputs=inputs,
        unseen=unseen,
        **_rates(episodes),
    )


def mean(episodes: Sequence[Episode], metric: str) -> float:
    """Of a field of episodes, to six digits."""
    return round(float(np.mean([getattr(e, metric) for e in episodes])), 6)


def _rates(episodes: Sequence[Episode]) -> dict[str, float]:
    rates = {f"{stage}_rate": mean(episodes, stage) for stage in ("approach", "grasp", "reorient")}
    return rates | {"reorientation_progress": mean(episodes, "reorientation_progress")}


def _per_demo(episodes: Sequence[Episode]) -> DemoResult:
    return DemoResult(
        sequence=episodes[0].sequence_name,
        object=episodes[0].object,
        episodes=len(episodes),
        task_progress=mean(episodes, "task_progress"),
        **_rates(episodes),
    )


def mesh_folder(given: Path | None, recorded: str | None) -> Path | None:
    """The folder of meshes to use: the given one, else the one that a run or its results name; None: the stand-ins."""
    return given or (Path(recorded) if recorded else None)


def write_results(folder: Path, summary: EvalResult, rollouts: Rollouts, joint_names: tuple[str, ...]) -> Path:
    """Write ``BACKEND.json``, ``BACKEND.episodes.json`` and ``BACKEND.trace.npz``; returns the first."""
    name = summary.backend
    write_json(
        folder / f"{name}.episodes.json",
        {"schema": EPISODES_SCHEMA, "episodes": [asdict(e) for e in rollouts.episodes]},
    )
    traces = rollouts.traces
    recorded = [t.joint_target for t in traces if t.joint_target is not None]
    targets = np.stack(recorded) if len(recorded) == len(traces) else None
    write_npz(
        folder / f"{name}.trace.npz",
        TRACE_SCHEMA,
        {
            "time": traces[0].time,
            "joint_names": np.array(joint_names),
            **{key: np.stack([getattr(t, name) for t in traces]) for name, key in _STACKED.items()},
            "object_name": np.array([t.object for t in traces]),
            "sequence_index": np.array([t.sequence for t in traces]),
            **({} if targets is None else {"joint_target": targets}),
        },
    )
    write_json(folder / f"{name}.json", {"schema": SCHEMA} | asdict(summary))
    return folder / f"{name}.json"


def read_results(folder: Path) -> list[EvalResult]:
    """Every engine's result in an ``eval`` folder, in order of name."""
    files = [f for f in folder.glob("*.json") if not f.name.endswith(".episodes.json")]
    return [read_result(file) for file in sorted(files, key=lambda f: f.stem)]


def read_result(path: Path) -> EvalResult:
    """One engine's result.

    Raises:
        FileFormatError: it is damaged, or lacks an entry; the message names it.
    """
    return from_dict(EvalResult, read_json(path, SCHEMA), str(path))


def read_episodes(folder: Path, backend: str) -> tuple[Episode, ...]:
    """The episodes of one engine."""
    path = folder / f"{backend}.episodes.json"
    episodes = read_json(path, EPISODES_SCHEMA).get("episodes")
    if not isinstance(episodes, list):
        raise FileFormatError(f"{path} has no list 'episodes'. Evaluate again.")
    return tuple(from_dict(Episode, episode, f"{path}: episodes[{i}]") for i, episode in enumerate(episodes))


def read_traces(folder: Path, backend: str, joint_names: tuple[str, ...]) -> tuple[Trace, ...]:
    """The traces of one engine.

    Raises:
        FileFormatError: the file is damaged, or its joints are not ``joint_names`` in that order.
    """
    path = folder / f"{backend}.trace.npz"
    a = read_npz(path, TRACE_SCHEMA, _TRACE_FIELDS, what="an evaluation trace", check=_check_traces)
    found = tuple(a["joint_names"].tolist())
    if found != joint_names:
        raise FileFormatError(
            f"{path} is a trace of the joints {', '.join(found)}; the robot has {', '.join(joint_names)}. Evaluate again."
        )
    return tuple(
        Trace(
            sequence=int(a["sequence_index"][i]),
            object=str(a["object_name"][i]),
            time=a["time"],
            joint_target=a["joint_target"][i] if "joint_target" in a else None,
            **{name: a[key][i] for name, key in _STACKED.items()},
        )
        for i in range(len(a["object_name"]))
    )


_FAR = 1e6
"""[m, rad] An object may fall for a while and a joint may run away, but not so far."""


def _check_traces(a: dict[str, np.ndarray]) -> str | None:
    """What no engine can have given. One that breaks down gives numbers that are not finite, from some frame after the first on."""
    if len(a["time"]) < 2 or (np.diff(a["time"]) <= 0).any():
        return "the times of its frames do not rise."
    state = np.concatenate((a["joint_pos"], a["object_pos"], a["object_quat_wxyz"]), axis=2)
    sound = np.isfinite(state).all(axis=2)
    if not sound[:, 0].all():
        return "an episode begins with numbers that are not finite."
    if (np.abs(state[sound]) > _FAR).any():
        return f"a state holds {np.abs(state[sound]).max():.3g}, expected at most {_FAR:g}."
    if (np.abs(np.linalg.norm(a["object_quat_wxyz"][sound].astype(float), axis=-1) - 1) > UNIT_TOLERANCE).any():
        return "array 'object_quat_wxyz' holds quaternions that are not unit."
    targets = a.get("joint_target")
    if targets is not None and not (np.abs(targets[sound.min(axis=1)]) <= _FAR).all():
        return "array 'joint_target' holds numbers that are not finite, or far too large."
    return None
