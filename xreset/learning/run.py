"""The run folder: the description of a training, its checkpoints and its policy.

RUN/run.json                 everything that the training was started with
RUN/checkpoints/000050.pt    model, optimizer and counters after 50 iterations
RUN/policy.onnx              the policy, with its contract
RUN/teacher.onnx             the policy that a distillation learned from
RUN/choice.json              the checkpoint whose policy this is, if ``xreset select`` chose one
RUN/events.out.tfevents.*    TensorBoard
RUN/eval/, RUN/report/       made by ``xreset eval`` and ``xreset report``
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar

from xreset.errors import RunError, WrongValueError
from xreset.files.checks import Checked, NonNegativeInt, PositiveInt, Rule, Share, from_dict, frozen
from xreset.files.storage import read_json, read_typed, write_json
from xreset.files.text import shown
from xreset.learning.clock import Lift, read_lift
from xreset.learning.config import TrainConfig
from xreset.physics.plugins import robot_names
from xreset.task.contract import Contract

SCHEMA = "xreset-run/1"
TEACHER = "teacher.onnx"
"""File of the teacher's policy in the run folder of a distillation."""
ENOUGH = 0.97
"""Share of the minutes from which a training counts as done, because a new start would take longer than the rest."""


@frozen
class RunInfo(Checked):
    """Contents of ``run.json``."""

    RENAMED: ClassVar = {
        "objects": "meshes",
        "backend": "engine",
        "backend_version": "engine_version",
    }
    robot: str
    """Name or folder, as given."""
    resets: str
    """Path of the reset bank, or of a goal set."""
    resets_hash: str
    """SHA-256 of this file."""
    meshes: str | None
    """Folder of object meshes; None: the built-in stand-ins."""
    engine: str
    engine_version: str
    device: str
    num_envs: PositiveInt
    seed: NonNegativeInt
    config: TrainConfig
    contract: Contract
    """:func:`xreset.policy.onnx_policy.policy_contract`."""
    weights: str | None = None
    """Path of the checkpoint whose networks the training started with; None: new networks."""
    weights_hash: str | None = None
    """SHA-256 of the checkpoint."""
    teacher: str | None = None
    """Name of the policy that a distillation learns from; it is copied to ``teacher.onnx``. None: the rewards teach."""
    lift: Lift = Lift()
    """When success from home passed its marks, and how far the training has come."""


def write_run(folder: Path, info: RunInfo) -> None:
    """Write ``run.json``."""
    write_json(folder / "run.json", {"schema": SCHEMA} | asdict(info))


def read_run(folder: str | Path, *, as_stated: bool = False) -> RunInfo:
    """Read ``run.json``.

    The training was probably started from one of the folders above the run. So paths of robot, bank and objects that do
    not exist here are looked for from these folders, unless ``as_stated``.

    Raises:
        RunError: the folder is not a run.
        FileFormatError: the file is damaged, or of another version of xreset.
    """
    folder = Path(folder)
    if os.path.isfile(folder):
        raise RunError(f"{folder} is a file. Give the folder of its run, which has a run.json.")
    if not os.path.isfile(folder / "run.json"):
        to_do = f"Make one with: xreset train --out {folder} ..."
        if os.path.isfile(folder.parent / "run.json"):
            to_do = f"The folder above has one: give {folder.parent}."
        raise RunError(f"{folder} is not a run folder: it has no run.json. {to_do}")
    data = read_json(folder / "run.json", SCHEMA, keep_version=True)
    version = data.pop("xreset", None)
    where = f"{folder / 'run.json'} (of xreset {shown(version)})"
    info = from_dict(RunInfo, data, where, version)
    if as_stated:
        return info
    found = {}
    for name in ("robot", "resets", "meshes"):
        path = getattr(info, name)
        if path and path not in robot_names() and not os.path.exists(path):
            places = (above / path for above in folder.resolve().parents)
            found[name] = str(next(filter(os.path.exists, places), path))
    return replace(info, **found)


def flat(data: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the entries of nested dictionaries: names, joined by dots, and values."""
    for name, value in data.items():
        if isinstance(value, dict):
            yield from flat(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def checkpoints(folder: Path) -> list[Path]:
    """Return the checkpoints, oldest first."""
    return sorted((folder / "checkpoints").glob("[0-9]*.pt"))


def latest_checkpoint(folder: Path) -> Path:
    """Return the newest checkpoint; ``RunError`` if there is none."""
    found = checkpoints(folder)
    if not found:
        raise RunError(
            f"{folder} has no checkpoint yet. Give a run folder, or train it: xreset train --out {folder} --resume"
        )
    return found[-1]


def training_left(folder: Path, iterations: int, minutes: float = math.inf) -> str:
    """Return what is left to do of a training, in words; empty if it is done.

    Args:
        folder: run folder, which need not exist.
        iterations: iterations in all.
        minutes: time of the training in all, without compiling.
    """
    done = read_lift(folder)
    found = checkpoints(folder)
    iteration = int(found[-1].stem) if found else done.iteration
    if iteration >= iterations or done.minutes >= ENOUGH * minutes:
        return ""
    if not iteration:
        return "not begun"
    left = f"{iteration} of {iterations} iterations"
    return left if minutes == math.inf else f"{left}, {done.minutes:.1f} of {minutes:g} minutes"


# The checkpoint that ``xreset select`` chose --------------------------------------------------------------------------

CHOICE_FILE = "choice.json"
CHOICE_SCHEMA = "xreset-choice/1"


@frozen
class Candidate(Checked):
    """One checkpoint."""

    name: str
    """File name of the checkpoint or policy."""
    task_progress: Annotated[dict[str, Share], Rule("an engine at least", bool)]
    """Engine -> mean over the episodes. Engines are missing once the candidate could no longer be chosen."""

    @property
    def worst(self) -> float:
        """Task progress in the worst engine."""
        return min(self.task_progress.values())


@frozen
class Choice(Checked):
    """The candidates that were played, and the one that is best in its worst engine."""

    chosen: str
    """Name of the candidate."""
    policy_hash: str
    """SHA-256 of the chosen candidate as an ONNX file."""
    candidates: tuple[Candidate, ...]
    """The newest first."""
    engines: dict[str, str]
    """Name -> version."""
    seed: NonNegativeInt
    """Seed of the starts that were played; results with another seed are of other starts."""
    episodes_per_demo: PositiveInt
    demos: str
    """SHA-256 of the demonstrations."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.chosen not in [c.name for c in self.candidates]:
            raise WrongValueError(f"chosen is {self.chosen!r}, expected one of the candidates")

    @property
    def candidate(self) -> Candidate:
        """The chosen candidate."""
        return next(c for c in self.candidates if c.name == self.chosen)

    def sentence(self) -> str:
        """Return what was chosen and why, in one line."""
        newest = self.candidates[0]
        own = self.candidate
        engine = min(own.task_progress, key=own.task_progress.__getitem__)
        against = f"the newest, {newest.name}, has {100 * newest.worst:.1f} %"
        if newest is own:
            against = "it is the newest"
        return (
            f"{self.chosen}, {100 * own.worst:.1f} % in its worst engine ({engine}), of {len(self.candidates)} "
            f"checkpoints in {len(self.engines)} engines; {against}."
        )


def write_choice(folder: Path, choice: Choice) -> None:
    """Write a run's ``choice.json``."""
    write_json(folder / CHOICE_FILE, {"schema": CHOICE_SCHEMA} | asdict(choice))


def read_choice(folder: Path) -> Choice | None:
    """Return the choice that was made in a folder, or None.

    Raises:
        FileFormatError: the file is damaged, or of another version.
    """
    path = folder / CHOICE_FILE
    return read_typed(Choice, path, CHOICE_SCHEMA) if path.is_file() else None
