"""What a report is made of, read from a run folder or from a folder of results."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from xreset.errors import FileFormatError, RunError, XResetError
from xreset.eval.report.events import check_events
from xreset.eval.results import EvalResult, read_episodes, read_results
from xreset.eval.rollout import Episode
from xreset.files import read_json
from xreset.learning.run import SCHEMA as RUN_SCHEMA
from xreset.learning.run import RunInfo, read_run

CURVES = {
    "episode/return": "episode return",
    "task/grasped": "worlds with a grasp",
    "task/success": "worlds at the goal",
}
"""TensorBoard tag -> what it shows."""


ASPECTS: dict[str, Callable[[EvalResult], Any]] = {
    "policy": lambda s: s.policy,
    "robot": lambda s: s.robot,
    "policy file": lambda s: s.inputs.get("policy", "")[:12],
    "demonstrations": lambda s: s.inputs.get("demos", "")[:12],
    "object meshes": lambda s: s.objects_folder or "stand-ins",
    "number of episodes": lambda s: s.episodes,
    "seed": lambda s: s.seed,
}
"""What was evaluated, and how, from ``BACKEND.json``: results that differ in any of it cannot be compared as if they did not."""


@dataclass(frozen=True, kw_only=True)
class Curve:
    """A scalar over the iterations of a training."""

    label: str
    iteration: np.ndarray
    """[T] rising"""
    value: np.ndarray
    """[T]"""


@dataclass(frozen=True, kw_only=True)
class ReportData:
    """Results of one policy in several engines, and how it was trained."""

    name: str
    """Name of the run or folder."""
    results: Path
    """Folder of the results."""
    summaries: tuple[EvalResult, ...]
    """``BACKEND.json`` of every engine, in order of name."""
    episodes: dict[str, tuple[Episode, ...]]
    """Engine -> its episodes."""
    run: RunInfo | None
    """The training; None for baselines, and where ``run.json`` cannot be read."""
    trained_with: str | None
    """Version of xreset that the policy was trained with."""
    curves: tuple[Curve, ...]
    notes: tuple[str, ...]
    """What the reader must know before comparing engines, or what is missing."""

    @property
    def engines(self) -> tuple[str, ...]:
        """Names of the engines."""
        return tuple(s.backend for s in self.summaries)


def collect(folder: Path) -> ReportData:
    """Read everything.

    Args:
        folder: a run folder, or a folder that holds ``BACKEND.json`` files, itself or in ``eval/``.

    Raises:
        RunError: the folder does not exist or holds no results.
        FileFormatError: a file is damaged or of another version.
    """
    is_run = (folder / "run.json").is_file()
    results = results_in(folder)
    summaries = tuple(read_results(results))
    if not summaries:
        policy = str(folder) if is_run else "POLICY"
        raise RunError(
            f"{results} holds no evaluation results. Make them first: xreset eval {policy} --backend mujoco --demos DEMOS"
            + ("" if is_run else f" --out {results}")
        )
    curves, note = read_curves(folder)
    notes = [*differences(summaries), *([note] if note else [])]
    run, trained_with = None, None
    if is_run:
        try:
            run, trained_with = read_run(folder), str(read_json(folder / "run.json", RUN_SCHEMA).get("xreset"))
        except FileFormatError as error:  # results outlive a change of the training's configuration
            notes.append(f"The training is not described here: {error}")
    return ReportData(
        name=name_of(folder),
        results=results,
        summaries=summaries,
        episodes={s.backend: read_episodes(results, s.backend) for s in summaries},
        run=run,
        trained_with=trained_with,
        curves=curves,
        notes=tuple(notes),
    )


def results_in(folder: Path) -> Path:
    """Where the results of a run folder, or of a folder of results, lie; there may be none yet.

    Raises:
        RunError: the folder does not exist.
    """
    if not folder.is_dir():
        raise RunError(f"there is no folder {folder}. Give a run folder, or a folder that xreset eval wrote results into.")
    return folder / "eval" if (folder / "eval").is_dir() or (folder / "run.json").is_file() else folder


def name_of(folder: Path) -> str:
    """What a run, or the owner of a folder of results, is called."""
    whole = folder.resolve()
    return (whole.parent if whole.name == "eval" else whole).name


def differences(summaries: tuple[EvalResult, ...]) -> list[str]:
    """What makes engines' results incomparable: sentences, none if all were evaluated alike."""
    notes = []
    for what, get in ASPECTS.items():
        values = {s.backend: get(s) for s in summaries}
        if len(set(values.values())) > 1:
            listing = ", ".join(f"{engine}: {value}" for engine, value in values.items())
            notes.append(f"These results are not comparable: the {what} differs ({listing}). Evaluate all engines in one command.")
    return notes


def read_curves(folder: Path) -> tuple[tuple[Curve, ...], str | None]:
    """The learning curves of :data:`CURVES` in a folder, and a note if they are there but cannot be read."""
    try:
        scalars = read_scalars(folder)
    except XResetError as error:
        return (), str(error)
    return tuple(replace(scalars[tag], label=label) for tag, label in CURVES.items() if tag in scalars), None


def read_scalars(folder: Path) -> dict[str, Curve]:
    """Everything that TensorBoard's event files in a folder hold, by tag, which is its label too; empty if there are no event files.

    Raises:
        FileFormatError: an event file is damaged.
        XResetError: there are event files, and TensorBoard, which reads them, cannot be imported.
    """
    files = sorted(folder.glob("events.out.tfevents.*"))
    if not files:
        return {}
    try:
        from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
    except ImportError as error:
        raise XResetError(
            f"Learning curves need TensorBoard, which cannot be imported ({error}). Install it with: pip install 'xreset[train]'"
        ) from error
    latest: dict[str, dict[int, float]] = {}
    for file in files:
        events = EventAccumulator(str(file), size_guidance={"scalars": 0})
        events.Reload()
        found = {tag: events.Scalars(tag) for tag in events.Tags()["scalars"]}
        check_events(file, {tag: max(e.step for e in values) for tag, values in found.items()})
        for tag, values in found.items():  # a resumed run repeats the steps after its checkpoint: the later ones count
            latest.setdefault(tag, {}).update((e.step, e.value) for e in values)
    curves = {}
    for tag, values in latest.items():
        steps = sorted(values)
        curves[tag] = Curve(label=tag, iteration=np.array(steps), value=np.array([values[step] for step in steps]))
    return curves
