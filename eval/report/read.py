"""Read what reports and comparisons show: configuration, learning curves and evaluations, from folders of runs and of
results."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from xreset.errors import FileFormatError, RunError, XResetError, needs
from xreset.eval.report.clips import missed_by_student
from xreset.eval.results import EvalResult, Table, read_evaluation
from xreset.eval.stress import Stress, read_stress
from xreset.files import read_json
from xreset.learning.choice import Choice, read_choice
from xreset.learning.clock import FILE as LIFT_FILE
from xreset.learning.clock import Lift, read_lift
from xreset.learning.run import SCHEMA as RUN_SCHEMA
from xreset.learning.run import TEACHER, RunInfo, read_run
from xreset.policies import results_folder, shipped
from xreset.text import short_name

CURVES = {
    "episode/return": "episode return",
    "task/grasped": "worlds with a grasp",
    "task/success": "worlds at the goal",
}
"""TensorBoard tag -> what the report calls the curve."""


@dataclass(frozen=True, kw_only=True)
class Curve:
    """A scalar over the iterations of a training."""

    label: str
    iteration: np.ndarray
    """[T] rising"""
    value: np.ndarray
    """[T]"""


class Fact(NamedTuple):
    """One property of a training."""

    value: Any
    """Two trainings agree in the property if their values are equal."""
    text: str
    """The property as tables show it."""


@dataclass(frozen=True, kw_only=True)
class Training:
    """A training or a baseline, as comparisons read it."""

    label: str
    folder: Path
    facts: dict[str, Fact]
    """Configuration by name of the field, such as ``task.reset.demo_probability``; empty without ``run.json``."""
    scalars: dict[str, Curve]
    """TensorBoard tag -> curve; empty without event files."""
    results: dict[str, EvalResult]
    """Engine -> result."""
    episodes: Table
    """Episodes in all engines (:func:`xreset.eval.results.episode_table`), where ``run`` is the label."""
    lift: Lift | None = None
    """When the training first succeeded from home; None without ``lift.json``."""


@dataclass(frozen=True, kw_only=True)
class ReportData:
    """Results of one policy in several engines, and how it was trained."""

    name: str
    """Name of the run or folder."""
    folder: Path
    """Folder of the results."""
    results: tuple[EvalResult, ...]
    """The result of every engine, in order of name."""
    episodes: Table
    """Episodes in all engines."""
    run: RunInfo | None
    """The training; None for baselines, and where ``run.json`` cannot be read."""
    trained_with: str | None
    """Version of xreset that the policy was trained with."""
    curves: tuple[Curve, ...]
    choice: Choice | None = None
    """How the evaluated policy was chosen among the run's checkpoints."""
    stress: tuple[Stress, ...] = ()
    """Robustness of the policy in every engine in which it was measured."""
    notes: tuple[str, ...]
    """What the reader must know before comparing engines, or what is missing."""

    @property
    def engines(self) -> tuple[str, ...]:
        """Names of the engines."""
        return tuple(s.backend for s in self.results)

    @property
    def robot(self) -> str:
        """Name or folder of the robot."""
        return self.results[0].robot if self.run is None else self.run.robot

    @property
    def title(self) -> str:
        """What was evaluated."""
        return f"{self.results[0].policy} on {self.results[0].robot}"

    def episodes_in(self, engine: str) -> Table:
        """Return the episodes in one engine."""
        return self.episodes[self.episodes["engine"] == engine]


def collect(folder: Path) -> ReportData:
    """Read everything that a report shows.

    Args:
        folder: a run folder, or a folder that holds ``ENGINE.json`` files, itself or in ``eval/``.

    Raises:
        RunError: the folder does not exist or holds no results.
        FileFormatError: a file is damaged or of another version.
    """
    is_run = (folder / "run.json").is_file()
    results = results_in(folder)
    evaluation = read_evaluation(results)
    if not evaluation:
        policy = str(folder) if is_run else "POLICY"
        out = "" if is_run else f" --out {results}"
        raise RunError(
            f"{results} holds no evaluation results. "
            f"Make them first: xreset eval {policy} --backend mujoco --demos DEMOS{out}"
        )
    curves, curve_note = read_curves(folder)
    notes = differences(evaluation)
    if curve_note:
        notes.append(curve_note)
    run = None
    trained_with = None
    if is_run:
        try:
            run = read_run(folder)
            trained_with = str(read_json(folder / "run.json", RUN_SCHEMA, keep_version=True).get("xreset"))
        except FileFormatError as error:  # results outlive a change of the training's configuration
            notes.append(f"The training is not described here: {error}")
    if run is not None and run.teacher is not None:
        if taught := read_evaluation(folder / "teacher"):
            notes.append(missed_by_student(evaluation.to_frame(), taught.to_frame()))
        else:
            notes.append(
                "The teacher was not evaluated from the same starts. Make its results first: "
                f"xreset eval {folder / TEACHER} --out {folder / 'teacher'} --demos DEMOS"
            )
    choice = read_choice(results.parent)
    if choice is not None and choice.policy_hash not in {s.inputs.get("policy") for s in evaluation}:
        choice = None
    return ReportData(
        name=name_of(folder),
        folder=results,
        results=tuple(evaluation),
        episodes=evaluation.to_frame(),
        run=run,
        trained_with=trained_with,
        curves=curves,
        choice=choice,
        stress=read_stress(results.parent / "stress", evaluation[0].inputs.get("policy")),
        notes=tuple(notes),
    )


def results_in(folder: Path) -> Path:
    """Return the folder with the results of a run folder, or of a folder of results; it may not exist yet.

    Raises:
        RunError: the folder does not exist.
    """
    if not folder.is_dir():
        raise RunError(
            f"there is no folder {folder}. Give a run folder, or a folder that xreset eval wrote results into."
        )
    if (folder / "eval").is_dir() or (folder / "run.json").is_file():
        return folder / "eval"
    return folder


def name_of(folder: Path) -> str:
    """Return the name of a run, or of the owner of a folder of results."""
    whole = folder.resolve()
    return whole.parent.name if whole.name == "eval" else whole.name


def conditions(result: EvalResult) -> dict[str, Any]:
    """Return what was evaluated, and how: results that differ in any of it are not comparable."""
    return {
        "policy": result.policy,
        "robot": result.robot,
        "policy file": result.inputs.get("policy", "")[:12],
        "demonstrations": result.inputs.get("demos", "")[:12],
        "object meshes": result.objects_folder or "stand-ins",
        "number of episodes": result.episodes,
        "seed": result.seed,
    }


def differences(results: Sequence[EvalResult]) -> list[str]:
    """Return a sentence for each condition in which the engines of one policy differ."""
    notes = []
    table: Table = pd.DataFrame([conditions(s) for s in results], index=[s.backend for s in results])
    for what in table:
        if table[what].nunique() > 1:
            listing = ", ".join(f"{engine}: {value}" for engine, value in table[what].items())
            notes.append(
                f"These results are not comparable: the {what} differs ({listing}). "
                "Evaluate all engines in one command."
            )
    return notes


# Learning curves ------------------------------------------------------------------------------------------------------


def read_curves(folder: Path) -> tuple[tuple[Curve, ...], str | None]:
    """Return the learning curves of :data:`CURVES` in a folder, and a note if the curves cannot be read."""
    try:
        scalars = read_scalars(folder)
    except XResetError as error:
        return (), str(error)
    return tuple(replace(scalars[tag], label=label) for tag, label in CURVES.items() if tag in scalars), None


def read_scalars(folder: Path) -> dict[str, Curve]:
    """Return all scalars of TensorBoard's event files in a folder, by tag; empty if there are no event files.

    Raises:
        FileFormatError: an event file is damaged.
        XResetError: there are event files, and TensorBoard, which reads them, cannot be imported.
    """
    values: dict[str, dict[int, float]] = {}
    for file in sorted(folder.glob("events.out.tfevents.*")):
        for tag, step, value in _scalars(file):
            # A resumed run repeats the steps after its checkpoint: the later value counts.
            values.setdefault(tag, {})[step] = value
    curves = {}
    for tag, by_step in values.items():
        steps = sorted(by_step)
        curves[tag] = Curve(label=tag, iteration=np.array(steps), value=np.array([by_step[step] for step in steps]))
    return curves


def _scalars(file: Path) -> Iterator[tuple[str, int, float]]:
    """Yield tag, step and value of all scalars of an event file; ignore a last record that is not complete."""
    with needs("TensorBoard, which reads learning curves,", "train"):
        from tensorboard.compat.proto.event_pb2 import Event  # pyright: ignore[reportMissingImports]
        from tensorboard.compat.tensorflow_stub import errors
        from tensorboard.compat.tensorflow_stub.pywrap_tensorflow import PyRecordReader_New
    records = PyRecordReader_New(str(file))
    last_step = 0
    has_head = False
    while True:
        try:
            records.GetNext()
            event = Event.FromString(records.record())
        except errors.OutOfRangeError:
            return
        except Exception as error:  # protobuf's own exceptions depend on its implementation
            if isinstance(error, errors.DataLossError) and "truncated" in str(error):
                return
            raise FileFormatError(
                f"{file} is damaged: TensorBoard reads it up to step {last_step} and no farther. "
                "Put back a whole copy, or move it out of the folder."
            ) from error
        has_head = has_head or bool(event.file_version)
        if not has_head:
            raise FileFormatError(
                f"{file} is damaged: its beginning is missing. Put back a whole copy, or move it out of the folder."
            )
        for value in event.summary.value:
            if value.HasField("simple_value"):
                last_step = max(last_step, event.step)
                yield value.tag, event.step, value.simple_value


# Trainings to compare -------------------------------------------------------------------------------------------------


def read_trainings(runs: Sequence[str]) -> tuple[Training, ...]:
    """Read the trainings to compare.

    Args:
        runs: ``FOLDER`` or ``LABEL=FOLDER``: run folders, folders of results, or names of shipped policies (their
            ``runs/NAME``).

    Raises:
        RunError: none is given, a folder does not exist or is empty, or two have the same label or are the same folder.
        FileFormatError: a file is damaged or of another version.
    """
    if not runs:
        raise RunError("there is nothing to compare. Give run folders, or folders that xreset eval wrote results into.")
    folders: dict[str, Path] = {}
    for text in runs:
        label, folder = _split(text)
        if label in folders:
            raise RunError(
                f"{folders[label]} and {folder} would both be called {label!r}. "
                f"Name them: {label}-1={folders[label]} {label}-2={folder}"
            )
        for other, known in folders.items():
            if folder.resolve() == known.resolve():
                raise RunError(f"{other!r} and {label!r} are the same folder {folder}. Give every run once.")
        folders[label] = folder
    return tuple(read_training(label, folder) for label, folder in folders.items())


def read_training(label: str, folder: Path, results: Path | None = None) -> Training:
    """Read one training; configuration, curves or evaluations may be missing, but not all of them.

    Args:
        label: name of the training in tables and pictures.
        folder: run folder, or folder of results.
        results: folder of its evaluations; default: as ``xreset eval`` chooses it.

    Raises:
        RunError: the folder does not exist, or holds neither learning curves nor results.
        FileFormatError: a file is damaged or of another version.
    """
    results = results or results_in(folder)
    evaluation = read_evaluation(results, label)
    scalars = read_scalars(folder)
    if not scalars and any(folder.glob("events.out.tfevents.*")):
        advice = "Leave it out, or compare later."
        if evaluation:
            advice = f"Compare its evaluations alone: {label}={results}"
        raise FileFormatError(
            f"the event files in {folder} hold no learning curve: they are damaged, or the training has not finished "
            f"an iteration. {advice}"
        )
    lift = read_lift(folder) if (folder / LIFT_FILE).is_file() else None
    if not evaluation and not scalars and lift is None:
        raise RunError(
            f"{folder} holds neither learning curves (events.out.tfevents.*) nor evaluation results. "
            f"Evaluate it first: xreset eval {folder} --backend mujoco --demos DEMOS"
        )
    file = folder / "run.json"
    return Training(
        label=label,
        folder=folder,
        facts=run_facts(read_json(file, RUN_SCHEMA, keep_version=True), file) if file.is_file() else {},
        scalars=scalars,
        results={s.backend: s for s in evaluation},
        episodes=evaluation.to_frame(),
        lift=lift,
    )


def _split(text: str) -> tuple[str, Path]:
    """Return label and folder of an argument. The name of a folder may contain an equals sign."""
    label = ""
    name = text
    if "=" in text and not Path(text).is_dir():
        label, _, name = text.partition("=")
        if not label or not name:
            raise RunError(f"{text!r} is not NAME=FOLDER: a {'folder' if label else 'name'} is missing.")
    folder = Path(name)
    if not folder.exists() and name in shipped():
        folder = results_folder(name)
    return label or name_of(folder), folder


_RUN_TYPES = {"robot": str, "resets": str, "resets_hash": str, "device": str, "seed": int, "config": dict}


def run_facts(run: dict[str, Any], file: Path) -> dict[str, Fact]:
    """Return the content of ``run.json``, flat.

    The content is not checked against this version's configuration, so that trainings of different versions of xreset
    can be compared. A reset bank is identified by its hash, wherever the file is; a folder of meshes by whether there
    is one, because the bank was made with certain meshes; a device by its kind, because the number of a GPU does not
    matter.
    """
    wrong = [name for name, kind in _RUN_TYPES.items() if not isinstance(run.get(name), kind)]
    contract = run.get("contract") or {}
    names = contract.get("objects") or [] if isinstance(contract, dict) else None
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        wrong.append("contract")
    if wrong:
        raise FileFormatError(
            f"{file} lacks {', '.join(wrong)}, or holds it as another type. Train again, or leave this run out."
        )
    bank = str(run["resets_hash"])
    version = str(run.get("xreset"))
    meshes = run.get("objects")
    facts = {
        "robot": Fact((run["robot"], contract.get("robot_fingerprint")), str(run["robot"])),
        "objects": Fact(names, ", ".join(map(short_name, names or ())) or "-"),
        "meshes": Fact(meshes is None, "stand-ins" if meshes is None else str(meshes)),
        "bank": Fact(bank, f"{Path(run['resets']).name} ({bank[:8]})"),
        "weights": Fact(run.get("weights_hash"), str(run.get("weights") or "new")),
        "backend": _fact(f"{run.get('backend')} {run.get('backend_version')}"),
        "device": Fact(run["device"].partition(":")[0], run["device"]),
        "num_envs": _fact(run.get("num_envs")),
        "seed": _fact(run["seed"]),
        "xreset": Fact(version.partition("+")[0], version),  # runs of another commit are repetitions
    }
    return facts | _flat_facts(run["config"], "")


def _flat_facts(data: dict[str, Any], prefix: str) -> dict[str, Fact]:
    facts = {}
    for name, value in data.items():
        if isinstance(value, dict):
            facts |= _flat_facts(value, f"{prefix}{name}.")
        else:
            facts[prefix + name] = _fact(value)
    return facts


def _fact(value: Any) -> Fact:
    if isinstance(value, list):
        return Fact(tuple(map(str, value)), ", ".join(map(_text, value)))
    return Fact(value, _text(value))


def _text(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.6g}" if isinstance(value, float) else str(value)
