"""What reports and comparisons are made of: configuration, learning curves and evaluations, from the folders of runs and of results."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from xreset.errors import FileFormatError, RunError, XResetError, needs
from xreset.eval.results import EvalResult, read_episodes, read_results
from xreset.eval.rollout import Episode
from xreset.eval.stress import Stress, read_stress
from xreset.files import read_json
from xreset.learning.choice import Choice, read_choice
from xreset.learning.clock import FILE as LIFT_FILE
from xreset.learning.clock import Lift, read_lift
from xreset.learning.run import SCHEMA as RUN_SCHEMA
from xreset.learning.run import RunInfo, read_run
from xreset.policies import results_folder, shipped
from xreset.text import short_name

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
    choice: Choice | None = None
    """How the policy that was evaluated was chosen among the run's checkpoints."""
    stress: tuple[Stress, ...] = ()
    """What the policy bears, in every engine in which that was tried."""
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
    choice = read_choice(results.parent)
    return ReportData(
        name=name_of(folder),
        results=results,
        summaries=summaries,
        episodes={s.backend: read_episodes(results, s.backend) for s in summaries},
        run=run,
        trained_with=trained_with,
        curves=curves,
        choice=choice if choice and choice.policy_hash in {s.inputs.get("policy") for s in summaries} else None,
        stress=read_stress(results.parent / "stress", summaries[0].inputs.get("policy")),
        notes=tuple(notes),
    )


def results_in(folder: Path) -> Path:
    """Where the results of a run folder, or of a folder of results, lie; there may be none yet.

    Raises:
        RunError: the folder does not exist.
    """
    if not folder.is_dir():
        raise RunError(
            f"there is no folder {folder}. Give a run folder, or a folder that xreset eval wrote results into."
        )
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
            notes.append(
                f"These results are not comparable: the {what} differs ({listing}). Evaluate all engines in one command."
            )
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
    latest: dict[str, dict[int, float]] = {}
    for file in sorted(folder.glob("events.out.tfevents.*")):
        for tag, step, value in _scalars(
            file
        ):  # a resumed run repeats the steps after its checkpoint: the later ones count
            latest.setdefault(tag, {})[step] = value
    curves = {}
    for tag, values in latest.items():
        steps = sorted(values)
        curves[tag] = Curve(label=tag, iteration=np.array(steps), value=np.array([values[step] for step in steps]))
    return curves


def _scalars(file: Path) -> Iterator[tuple[str, int, float]]:
    """Tag, step and value of all of an event file. A last record that is not complete is none yet, and no damage."""
    with needs("TensorBoard, which reads learning curves,", "train"):
        from tensorboard.compat.proto.event_pb2 import Event  # pyright: ignore[reportMissingImports]
        from tensorboard.compat.tensorflow_stub import errors
        from tensorboard.compat.tensorflow_stub.pywrap_tensorflow import PyRecordReader_New
    records, last, whole = PyRecordReader_New(str(file)), 0, False
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
                f"{file} is damaged: TensorBoard reads it up to step {last} and no farther. "
                "Put back a whole copy, or move it out of the folder."
            ) from error
        if not (whole := whole or bool(event.file_version)):
            raise FileFormatError(
                f"{file} is damaged: its beginning is missing. Put back a whole copy, or move it out of the folder."
            )
        for value in event.summary.value:
            if value.HasField("simple_value"):
                last = max(last, event.step)
                yield value.tag, event.step, value.simple_value


class Fact(NamedTuple):
    """One property of a training."""

    value: Any
    """Two trainings agree in it if these are equal."""
    text: str
    """As shown."""


@dataclass(frozen=True, kw_only=True)
class Training:
    """One of the trainings, or baselines, that are compared."""

    label: str
    folder: Path
    facts: dict[str, Fact]
    """Its configuration by name of the field, such as ``task.reset.demo_probability``; empty where there is no ``run.json``."""
    scalars: dict[str, Curve]
    """TensorBoard tag -> curve; empty where there are no event files."""
    summaries: dict[str, EvalResult]
    """Engine -> ``BACKEND.json``."""
    episodes: dict[str, tuple[Episode, ...]]
    """Engine -> its episodes."""
    lift: Lift | None = None
    """When it first succeeded from home; None where there is no ``lift.json``."""


def read_trainings(runs: Sequence[str]) -> tuple[Training, ...]:
    """Read them all.

    Args:
        runs: as ``FOLDER`` or ``LABEL=FOLDER``: run folders, folders of results, or names of shipped policies (their ``runs/NAME``).

    Raises:
        RunError: none is given, a folder does not exist or holds nothing, or two have the same label or are the same folder.
        FileFormatError: a file is damaged or of another version.
    """
    if not runs:
        raise RunError("there is nothing to compare. Give run folders, or folders that xreset eval wrote results into.")
    named: dict[str, Path] = {}
    for text in runs:
        label, folder = _split(text)
        if label in named:
            raise RunError(
                f"{named[label]} and {folder} would both be called {label!r}. Name them: {label}-1={named[label]} {label}-2={folder}"
            )
        for other, known in named.items():
            if folder.resolve() == known.resolve():
                raise RunError(f"{other!r} and {label!r} are the same folder {folder}. Give every run once.")
        named[label] = folder
    return tuple(read_training(label, folder) for label, folder in named.items())


def read_training(label: str, folder: Path, results: Path | None = None) -> Training:
    """Read one; what is missing (configuration, curves or evaluations) is empty, but not all of them.

    Args:
        label: what to call it.
        folder: run folder, or folder of results.
        results: where its evaluations lie; default: as ``xreset eval`` puts them.

    Raises:
        RunError: the folder does not exist, or holds neither learning curves nor results.
        FileFormatError: a file is damaged or of another version.
    """
    results = results or results_in(folder)
    summaries = {}
    for summary in read_results(results):
        summaries[summary.backend] = summary
    episodes = {engine: read_episodes(results, engine) for engine in summaries}
    for engine, found in episodes.items():
        if not found or len(found) != summaries[engine].episodes:
            raise FileFormatError(
                f"{results / engine}.json tells of {summaries[engine].episodes} episodes, {engine}.episodes.json holds {len(found)}. "
                "They are not of the same evaluation; evaluate again."
            )
    scalars = read_scalars(folder)
    if not scalars and any(folder.glob("events.out.tfevents.*")):
        raise FileFormatError(
            f"the event files in {folder} hold no learning curve: they are damaged, or the training has not finished an iteration. "
            + (f"Compare its evaluations alone: {label}={results}" if summaries else "Leave it out, or compare later.")
        )
    lift = read_lift(folder) if (folder / LIFT_FILE).is_file() else None
    if not summaries and not scalars and lift is None:
        raise RunError(
            f"{folder} holds neither learning curves (events.out.tfevents.*) nor evaluation results. "
            f"Evaluate it first: xreset eval {folder} --backend mujoco --demos DEMOS"
        )
    file = folder / "run.json"
    facts = run_facts(read_json(file, RUN_SCHEMA), file) if file.is_file() else {}
    return Training(
        label=label, folder=folder, facts=facts, scalars=scalars, summaries=summaries, episodes=episodes, lift=lift
    )


def run_facts(run: dict[str, Any], file: Path) -> dict[str, Fact]:
    """The content of ``run.json``, flat.

    It is taken as it is, so that trainings of different versions of xreset can be compared. A reset bank is known by its hash, wherever
    the file lies; it was made with certain meshes, so their folder is known by whether there is one. A device is known by its kind: which
    of several GPUs it was says nothing.
    """
    kinds = {"robot": str, "resets": str, "resets_hash": str, "device": str, "seed": int, "config": dict}
    wrong = [name for name, kind in kinds.items() if not isinstance(run.get(name), kind)]
    contract, meshes, device = run.get("contract") or {}, run.get("objects"), str(run.get("device"))
    names = contract.get("objects") or [] if isinstance(contract, dict) else None
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        wrong.append("contract")
    if wrong:
        raise FileFormatError(
            f"{file} lacks {', '.join(wrong)}, or holds it as another type. Train again, or leave this run out."
        )
    bank = str(run["resets_hash"])
    facts = {
        "robot": Fact((run["robot"], contract.get("robot_fingerprint")), str(run["robot"])),
        "objects": Fact(names, ", ".join(map(short_name, names or ())) or "-"),
        "meshes": Fact(meshes is None, "stand-ins" if meshes is None else str(meshes)),
        "bank": Fact(bank, f"{Path(run['resets']).name} ({bank[:8]})"),
        "weights": Fact(run.get("weights_hash"), str(run.get("weights") or "new")),
        "backend": _fact(f"{run.get('backend')} {run.get('backend_version')}"),
        "device": Fact(device.partition(":")[0], device),
        "num_envs": _fact(run.get("num_envs")),
        "seed": _fact(run["seed"]),
        "xreset": _fact(run.get("xreset")),
    }
    return facts | _flat(run["config"], "")


def _split(text: str) -> tuple[str, Path]:
    """Label and folder of an argument; a folder with a ``=`` in its name is one, too."""
    label, equals, rest = text.partition("=")
    if not equals or Path(text).is_dir():
        label, rest = "", text
    elif not label or not rest:
        raise RunError(f"{text!r} is not NAME=FOLDER: {'a name' if not label else 'a folder'} is missing.")
    folder = Path(rest)
    if not folder.exists() and rest in shipped():
        folder = results_folder(rest)
    return label or name_of(folder), folder


def _flat(data: dict[str, Any], prefix: str) -> dict[str, Fact]:
    facts = {}
    for name, value in data.items():
        facts |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: _fact(value)}
    return facts


def _fact(value: Any) -> Fact:
    if isinstance(value, list):
        return Fact(tuple(map(str, value)), ", ".join(_text(item) for item in value))
    return Fact(value, _text(value))


def _text(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.6g}" if isinstance(value, float) else str(value)
