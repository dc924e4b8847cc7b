"""Read configurations, learning curves and evaluations, for reports and comparisons, from run folders and folders of
results."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import Any

import pandas as pd

from xreset.cameras.config import VisionConfig
from xreset.errors import FileFormatError, RunError, WrongValueError, needs
from xreset.eval.results import (
    EARLIER_SCHEMA,
    SCHEMA,
    EvalResult,
    Evaluation,
    read_evaluation,
    read_result,
    read_traces,
    recorded,
)
from xreset.eval.stats import Table
from xreset.files.checks import frozen, renamed
from xreset.files.storage import file_hash, matches, read_json
from xreset.files.text import Brief, short_name, shown
from xreset.geometry.description import load_robot
from xreset.learning.clock import Lift, read_lift
from xreset.learning.run import SCHEMA as RUN_SCHEMA
from xreset.learning.run import TEACHER, RunInfo, flat, read_run
from xreset.policy.shipped import run_folder
from xreset.spec import RobotSpec


@frozen
class Training(Brief):
    """Learning curves and evaluations of a training or a baseline."""

    label: str
    folder: Path
    """Run folder, or folder of results."""
    results_folder: Path
    """Folder of the evaluations."""
    facts: dict[str, str]
    """Configuration by name of the field, such as ``task.reset.demo_probability``, as tables show it; empty without
    ``run.json``."""
    curves: Table
    """Learning curves, see :func:`read_curves`."""
    results: dict[str, EvalResult]
    """Engine -> result."""
    episodes: Table
    """Episodes in all engines (:meth:`xreset.EvalResult.to_frame`), where ``run`` is the label."""
    lift: Lift
    """When the training first succeeded from home; empty for runs that have no clock."""
    run: RunInfo | None = None
    """The training's configuration; None for baselines, and where this version cannot read ``run.json``."""
    sweeps: tuple[Evaluation, ...] = ()
    """Results of ``xreset stress`` of the same policy."""
    notes: tuple[str, ...] = ()
    """Sentences about missing results."""

    @property
    def first(self) -> EvalResult:
        """The result of the first engine."""
        return next(iter(self.results.values()))

    @property
    def robot(self) -> str:
        """Name or folder of the robot."""
        return (self.run or self.first).robot

    @property
    def vision(self) -> VisionConfig | None:
        """Cameras of the policy; None: it has none, or the results do not state them."""
        if self.run is None:
            return self.first.vision
        vision = self.run.config.task.vision
        return vision if vision.cameras else None

    def recorded(self, robot: str | Path | RobotSpec | None = None) -> Table:
        """Return the recorded episodes in all engines: the first of each demonstration.

        A row holds the figures of the episode (:meth:`xreset.EvalResult.to_frame`) and in the column ``trace`` its
        arrays over time, a :class:`xreset.eval.results.Trace`.

        Args:
            robot: the robot, its name or its folder; default: whatever robot was recorded.

        Raises:
            RunError: there are no results.
            FileFormatError: a recording is damaged, or is of other joints than the robot's.
        """
        if not self.results:
            raise without_results(self.results_folder)
        names = None if robot is None else load_robot(robot).joint_names
        parts = [
            recorded(self.episodes, engine, read_traces(self.results_folder, engine, names))
            for engine in self.results
        ]
        return pd.concat(parts, ignore_index=True)


def by_engine(members: Iterable[Training]) -> Sequence[tuple[Any, Table]]:
    """Return every engine in which trainings were evaluated, with the episodes of all of them there."""
    evaluated = [member.episodes for member in members if member.results]
    return list(pd.concat(evaluated).groupby("engine")) if evaluated else []


def versions(trainings: Iterable[Training], engine: str) -> str:
    """Return the engine's versions in which trainings were evaluated."""
    found = {t.results[engine].engine_version for t in trainings if engine in t.results}
    return ", ".join(sorted(found))


def results_in(folder: Path) -> Path:
    """Return the folder with the results of a run folder, or of a folder of results; it may not exist yet.

    Raises:
        RunError: the folder does not exist.
    """
    if not folder.is_dir():
        problem = (
            f"{folder} is not a folder"
            if folder.exists()
            else f"The folder {folder} does not exist"
        )
        raise RunError(
            f"{problem}. Give a run folder, or a folder that xreset eval wrote results into. "
            "For a policy that ships with xreset, make results first: xreset eval NAME --demos DEMOS"
        )
    if (folder / "eval").is_dir() or (folder / "run.json").is_file():
        return folder / "eval"
    return folder


def name_of(folder: Path) -> str:
    """Return the name of a run folder, also for the ``eval`` folder in it."""
    whole = folder.resolve()
    return whole.parent.name if whole.name == "eval" else whole.name


# Learning curves ------------------------------------------------------------------------------------------------------


def read_curves(folder: Path) -> Table:
    """Return all scalars of TensorBoard's event files in a folder: a row for each iteration, a column for each tag, NaN
    where nothing was logged. The table is empty if there are no event files.

    Raises:
        FileFormatError: an event file is damaged.
        XResetError: there are event files, and TensorBoard, which reads them, cannot be imported.
    """
    files = []
    for file in matches(folder, "events.out.tfevents.*"):
        if found := list(_scalars(file)):
            files.append(found)
    # By where each begins, as a resumed run begins later: the names hold a clock, which may have run back.
    files.sort(key=lambda found: found[0][1])
    scalars = []
    end = inf
    for found in reversed(files):
        # What was logged after the checkpoint from which a run was resumed is of a training that was given up.
        scalars += [scalar for scalar in found if scalar[1] < end]
        end = min(end, found[0][1])
    table: Table = pd.DataFrame(scalars, columns=["tag", "iteration", "value"])
    return table.drop_duplicates(["tag", "iteration"], keep="last").pivot(
        index="iteration", columns="tag", values="value"
    )


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


# Runs ----------------------------------------------------------------------------------------------------------------


def read_trainings(runs: Sequence[str | Path]) -> tuple[Training, ...]:
    """Read the runs of a report.

    Args:
        runs: ``FOLDER`` or ``LABEL=FOLDER``: run folders, folders of results, or names of shipped policies (their
            ``runs/NAME``).

    Raises:
        RunError: none is given, a folder does not exist or is empty, or two have the same label.
        FileFormatError: a file is damaged or of another version.
    """
    if not runs:
        raise RunError(
            "there is nothing to report. Give run folders, or folders that xreset eval wrote results into."
        )
    folders: dict[str, Path] = {}
    for text in map(str, runs):
        label = ""
        name = text
        if "=" in text and not Path(text).is_dir():  # a folder's name may contain an equals sign
            label, _, name = text.partition("=")
            if not label or not name:
                raise RunError(
                    f"{text!r} is not NAME=FOLDER: a {'folder' if label else 'name'} is missing."
                )
        folder = Path(name)
        label = label or name_of(folder)
        if label in folders:
            raise RunError(
                f"{folders[label]} and {folder} would both be called {label!r}. "
                f"Name them: {label}-1={folders[label]} {label}-2={folder}"
            )
        folders[label] = folder
    return tuple(read_training(folder, label) for label, folder in folders.items())


def read_training(
    folder: str | Path, label: str | None = None, results: str | Path | None = None
) -> Training:
    """Read learning curves and evaluations of a training; one of them may be missing.

    Args:
        folder: run folder, or folder of results, or the name of a shipped policy.
        label: name of the training in tables and pictures; default: that of the folder.
        results: folder of its evaluations; default: as ``xreset eval`` chooses it.

    Raises:
        WrongValueError: the label is not a text.
        RunError: the folder does not exist, or holds neither learning curves nor results.
        FileFormatError: a file is damaged or of another version.
    """
    if not isinstance(label, str | None):
        raise WrongValueError(f"label is {shown(label)}, expected a text.")
    folder = run_folder(folder)
    label = label or name_of(folder)
    results = Path(results) if results else results_in(folder)
    evaluation = read_evaluation(results)
    curves = read_curves(folder)
    lift = read_lift(folder)
    if not evaluation and curves.empty and not lift.iteration:
        raise RunError(
            f"{folder} holds neither learning curves (events.out.tfevents.*) nor evaluation results. "
            + how_to_evaluate(folder)
        )
    episodes = evaluation.to_frame(label)
    if len(episodes):
        episodes = episodes[episodes["property"] == ""].reset_index(drop=True)
    found = Training(
        label=label,
        folder=folder,
        results_folder=results,
        facts={},
        curves=curves,
        results={result.engine: result for result in evaluation},
        episodes=episodes,
        lift=lift,
    )
    return _with_run(found)


def _with_run(training: Training) -> Training:
    """Add what is known of a training besides its curves and evaluations."""
    folder = training.folder
    facts: dict[str, str] = {}
    run = None
    notes = []
    file = folder / "run.json"
    if file.is_file():
        facts = run_facts(read_json(file, RUN_SCHEMA, keep_version=True), file)
        try:
            run = read_run(folder)
        except FileFormatError as error:
            # results are shown even if an older configuration is unreadable
            notes.append(f"The training is not described here: {error}")
    lift = training.lift
    if run is not None and lift.iteration:
        steps = lift.iteration * run.config.ppo.horizon * run.num_envs
        if lift.env_steps != steps:
            facts["num_envs"] += f" in each of {lift.env_steps / steps:.3g} processes"
    sweeps = []
    if training.results:
        policies = {result.inputs.get("policy") for result in training.results.values()}
        own = training.results_folder.parent
        places = [training.results_folder, own / "stress", own / "faults"]
        for place in {place.resolve(): place for place in places}.values():
            if sweep := _sweep(place, policies, notes):
                sweeps.append(sweep)
    return replace(training, facts=facts, run=run, sweeps=tuple(sweeps), notes=tuple(notes))


def _sweep(folder: Path, policies: set[str | None], notes: list[str]) -> Evaluation:
    """Return the results of ``xreset stress`` in a folder that are of the same policy. Those of 0.1 to 0.3, which had
    no episodes, are left out, with a note."""
    found = Evaluation()
    for file in matches(folder, "*.json"):
        if file.name.endswith(".episodes.json"):
            continue
        schema = read_json(file).get("schema")
        if schema not in (SCHEMA, EARLIER_SCHEMA):
            notes.append(
                f"{file} is of an earlier version, without episodes. Run xreset stress again."
            )
        if schema != SCHEMA:
            continue
        result = read_result(file)
        if len(result.changed) and result.inputs.get("policy") in policies:
            found.append(result)
    played = {(each.inputs.get("demos"), each.seed, len(each.nominal)) for each in found}
    if len(played) > 1:
        notes.append(
            f"The engines of {folder} did not play the same episodes, so what they show is not comparable. Give all of "
            "them to one xreset stress."
        )
    return found


def without_results(folder: Path) -> RunError:
    """Return the error about a run folder, or a folder of results, without results."""
    return RunError(f"{folder} holds no evaluation results. {how_to_evaluate(folder)}")


def how_to_evaluate(folder: Path) -> str:
    """Return a sentence that says how to make the missing results."""
    run = folder.parent if folder.name == "eval" else folder
    if (run / "run.json").is_file():
        return f"Make them first: xreset eval {run} --demos DEMOS"
    return f"Make them first: xreset eval POLICY --demos DEMOS --out {folder}"


_RUN_TYPES = {
    "robot": str,
    "resets": str,
    "resets_hash": str,
    "device": str,
    "seed": int,
    "config": dict,
}


def run_facts(run: dict[str, Any], file: Path) -> dict[str, str]:
    """Return the entries of ``run.json`` as text, by name; names of nested entries are joined by dots.

    The entries are not checked against this version's configuration, so that trainings of different versions of xreset
    can be compared. Entries that do not change a training are left out: the folder of meshes, because the bank was made
    with certain meshes; the number of a GPU; the commit of xreset.

    Raises:
        FileFormatError: an entry is missing or has another type.
    """
    run = renamed(RunInfo, run)
    contract = run.get("contract") or {}
    names = contract.get("objects") or [] if isinstance(contract, dict) else None
    wrong = [name for name, kind in _RUN_TYPES.items() if not isinstance(run.get(name), kind)]
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        wrong.append("contract")
    if wrong:
        raise FileFormatError(
            f"{file} lacks {', '.join(wrong)}, or holds it as another type. Train again, or leave this run out."
        )
    robots = [f"{run['robot']} ({str(contract.get('robot_fingerprint'))[:8]})"]
    banks = [_file_fact(run["resets"], run["resets_hash"])]
    others = run.get("others")
    for each in others if isinstance(others, list) else ():
        if isinstance(each, dict):
            robots.append(str(each.get("robot")))
            banks.append(_file_fact(str(each.get("resets")), str(each.get("resets_hash"))))
    weights = "new"
    if run.get("weights") is not None:
        # RUN/checkpoints/NUMBER.pt, wherever RUN is
        weights = _file_fact(str(run["weights"]), str(run.get("weights_hash")), parts=3)
    teacher = "-"
    if run.get("teacher") is not None:
        copy = file.parent / TEACHER
        teacher = _file_fact(str(run["teacher"]), file_hash(copy) if copy.is_file() else "?")
    return {
        "robot": ", ".join(robots),
        "objects": ", ".join(map(short_name, names or ())) or "-",
        "meshes": "stand-ins" if run.get("meshes") is None else "meshes",
        "bank": ", ".join(banks),
        "weights": weights,
        "teacher": teacher,
        "engine": f"{run.get('engine')} {run.get('engine_version')}",
        "device": run["device"].partition(":")[0],
        "num_envs": str(run.get("num_envs")),
        "seed": str(run["seed"]),
        "xreset": str(run.get("xreset")).partition("+")[0],
        **{name: f"{x:.6g}" if isinstance(x, float) else str(x) for name, x in flat(run["config"])},
    }


def _file_fact(path: str, hash_: str, *, parts: int = 1) -> str:
    return f"{Path(*Path(path).parts[-parts:])} ({hash_[:8]})"
