"""The run folder: the description of a training, its checkpoints and its policy.

RUN/run.json                 everything that the training was started with
RUN/checkpoints/000050.pt    model, optimizer and counters after 50 iterations
RUN/policy.onnx              the policy, with its contract
RUN/teacher.onnx             the policy that a distillation learned from
RUN/events.out.tfevents.*    TensorBoard
RUN/eval/, RUN/report/       made by ``xreset eval`` and ``xreset report``
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, ClassVar, TypeVar

from xreset.errors import RunError
from xreset.files.checks import (
    Checked,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    from_dict,
    frozen,
)
from xreset.files.storage import matches, read_json, stated_path, write_json
from xreset.files.text import shown
from xreset.learning.clock import Lift, read_lift
from xreset.learning.config import TrainConfig
from xreset.physics.plugins import robot_of_file
from xreset.task.contract import Contract

SCHEMA = "xreset-run/1"
TEACHER = "teacher.onnx"
"""File of the teacher's policy in the run folder of a distillation."""
CHOICE = "choice.json"
"""File in which earlier versions named the checkpoint to play."""
T = TypeVar("T", "RunInfo", "RobotData")
ENOUGH = 0.97
"""Share of the minutes from which a training counts as done, because a new start would take longer than the rest."""


@frozen
class RobotData(Checked):
    """Another robot of a training, and where its episodes begin."""

    robot: str
    resets: str
    resets_hash: str
    meshes: str | None
    """As in :class:`RunInfo`."""


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
    others: tuple[RobotData, ...] = ()
    """The other robots of a policy for several."""
    iterations: PositiveInt | None = None
    """Iterations of the whole training that the user gave."""
    minutes: PositiveFloat | None = None
    """Minutes of the whole training, without compiling, that the user gave."""
    lift: Lift = Lift()
    """When success from home passed its marks, and how far the training has come."""

    @property
    def total(self) -> int | None:
        """Number of iterations that ends the training: the given one; those of the configuration if no length was
        given; None if only minutes were given."""
        return self.iterations if self.iterations or self.minutes else self.config.iterations


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
    if not matches(folder, "run.json"):
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
    others = tuple(_with_paths(other, folder) for other in info.others)
    return replace(_with_paths(info, folder), others=others)


def _with_paths(data: T, folder: Path) -> T:
    """Return a run's description with the paths as they are from here."""
    found = {"robot": robot_of_file(folder, data.robot)}
    for name in ("resets", "meshes"):
        path = getattr(data, name)
        if path:
            found[name] = stated_path(path, folder) or path
    return replace(data, **found)


def flat(data: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the entries of nested dictionaries: names, joined by dots, and values."""
    for name, value in data.items():
        if isinstance(value, dict):
            yield from flat(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def differences(
    before: dict[str, Any], now: dict[str, Any], prefix: str = ""
) -> Iterator[tuple[str, Any, Any]]:
    """Yield the entries that differ between nested dictionaries: names, joined by dots, and both values; None: there is
    none."""
    for name in before | now:
        there = before.get(name)
        here = now.get(name)
        if isinstance(there, dict) and isinstance(here, dict):
            yield from differences(there, here, f"{prefix}{name}.")
        elif there != here:
            yield f"{prefix}{name}", there, here


def checkpoints(folder: Path) -> list[Path]:
    """Return the checkpoints, oldest first."""
    return matches(folder / "checkpoints", "[0-9]*.pt")


def latest_checkpoint(folder: Path) -> Path:
    """Return the newest checkpoint; ``RunError`` if there is none."""
    found = checkpoints(folder)
    if not found:
        raise RunError(
            f"{folder} has no checkpoint yet. Give a run folder, or train it: xreset train --out {folder}"
        )
    return found[-1]


def played_checkpoint(folder: Path) -> Path:
    """Return the newest checkpoint, or the one that ``xreset select`` of 0.1 to 0.3 chose, if the run still has it and
    has not gone on since; ``RunError`` if there is none."""
    newest = latest_checkpoint(folder)
    path = folder / CHOICE
    if not path.is_file() or newest.name not in path.read_text():
        return newest
    chosen = read_json(path).get("chosen")
    return next((each for each in checkpoints(folder) if each.name == chosen), newest)


def training_left(folder: Path, iterations: int | None, minutes: float | None = None) -> str:
    """Return what is left to do of a training, in words; empty if it is done.

    Args:
        folder: run folder, which need not exist.
        iterations: iterations in all; None: any number.
        minutes: time of the training in all, without compiling; None: any time.
    """
    done = read_lift(folder)
    found = checkpoints(folder)
    iteration = int(found[-1].stem) if found else done.iteration
    left = []
    if iterations is not None:
        left.append(f"{iteration} of {iterations} iterations")
        if iteration >= iterations:
            return ""
    if minutes is not None:
        left.append(f"{done.minutes:.1f} of {minutes:g} minutes")
        if done.minutes >= ENOUGH * minutes:
            return ""
    return ", ".join(left) if iteration else "not begun"
