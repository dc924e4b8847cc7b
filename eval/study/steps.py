"""The steps of a study that are left to do, and the commands of ``xreset`` that do them.

    OUT/data/SUBSET/demos.npz               demonstrations of a subset of the data, which states its definition
    OUT/data/SUBSET/ROBOT/resets.npz        reset bank, made by xreset retarget and xreset resets
    OUT/RUN/                                run folder of xreset train
    OUT/RUN/EVALUATION/                     results of xreset eval

Studies with the same OUT share its content: a run of the same name and configuration is trained once.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any, Literal

import numpy as np

from xreset.demos.archive import read_demos, write_demos
from xreset.demos.verbs import synthesize
from xreset.errors import RunError
from xreset.eval.results import read_result
from xreset.eval.study.file import Data, Evaluation, Runs
from xreset.files.checks import frozen
from xreset.files.records import read_meta
from xreset.files.storage import file_hash
from xreset.files.text import shown
from xreset.learning.config import TrainConfig
from xreset.learning.run import checkpoints, differences, flat, read_run, training_left
from xreset.task.terms import Terms

XRESET = (sys.executable, "-P", "-m", "xreset")
"""Command line of ``xreset``. ``-P``: Python files in the current folder, which may be a download, are not imported."""

Todo = tuple[str, list[list[str]]]
"""What is left to do, in words, and the commands to run next, in order; both are empty if nothing is left."""


@dataclass(frozen=True)
class Step:
    """A part of a study that commands of ``xreset`` do."""

    name: str
    kind: Literal["data", "train", "eval"]
    folder: Path
    """Folder that the commands write."""
    todo: Callable[[], Todo]
    needs: Sequence[str] = ()
    """Names of the steps before it."""

    def left(self) -> str:
        """Return what is left to do, in words; empty if the step is done."""
        return self.todo()[0]


@frozen
class Subset:
    """Demonstrations of some objects of a study's data."""

    folder: Path
    data: Data
    given: Path
    """Folder that the data's files are relative to."""
    objects: tuple[str, ...]
    """Empty: all objects."""
    per_object: int | None

    @property
    def demos(self) -> Path:
        """The archive."""
        return self.folder / "demos.npz"

    @property
    def meshes(self) -> Path | None:
        """Folder of meshes; None: the stand-ins."""
        return self.given / self.data.meshes if self.data.meshes else None

    def robot(self, name: str) -> Path:
        """Return the folder with the files of a robot, given by name or folder."""
        return self.folder / Path(name).name

    def bank(self, robot: str) -> Path:
        """Return the reset bank of a robot."""
        return self.robot(robot) / "resets.npz"

    @cached_property
    def definition(self) -> dict[str, Any]:
        """Everything that the archive and the banks depend on."""
        data = self.data
        if data.demos:
            source: dict[str, Any] = {"demos": file_hash(self.given / data.demos)}
        else:
            source = {
                "synthetic_per_object": data.synthetic_per_object,
            }
        return source | {
            "retarget": list(data.retarget),
            "resets": list(data.resets),
            "objects": list(self.objects),
            "per_object": self.per_object,
            "meshes": data.meshes,
        }

    def is_made(self) -> bool:
        """Return whether the archive exists; refuse one of another definition."""
        if self.demos.is_file():
            made = read_meta(self.demos).get("config")
            made = made if isinstance(made, dict) else {}
            _refuse_other(f"{self.folder} was made otherwise", "data", made, self.definition)
        return self.demos.is_file()

    def make(self) -> None:
        """Write the archive, unless it exists."""
        if self.is_made():
            return
        data = self.data
        objects = self.objects or None
        if data.demos:
            demos = read_demos(self.given / data.demos)
        else:
            demos = synthesize(objects, data.synthetic_per_object)
        chosen = demos.select(objects=objects, per_object=self.per_object)
        write_demos(self.demos, chosen, config=self.definition)


@frozen
class Run:
    """One training, or one baseline."""

    group: str
    """Name of the run in the study; trainings with other seeds and objects share it."""
    spec: Runs
    objects: tuple[str, ...]
    subset: Subset
    folder: Path
    seed: int = 0
    config: TrainConfig | None = None
    """None: a baseline."""
    weights: Path | None = None

    @property
    def label(self) -> str:
        """Name in tables; trainings of one seed, each with an object alone, share it."""
        return self.group if self.config is None else f"{self.group}-seed{self.seed}"

    @property
    def bank(self) -> Path:
        """The run's reset bank."""
        return self.subset.bank(self.spec.robot)

    def check(self) -> None:
        """Refuse a folder with a run of another configuration. The length may differ: a run can be continued."""
        if self.config is None or not (self.folder / "run.json").is_file():
            return
        info = read_run(self.folder, as_stated=True)
        found: dict[str, Any] = {"seed": info.seed, "config": _without_length(info.config)}
        wanted: dict[str, Any] = {"seed": self.seed, "config": _without_length(self.config)}
        for name in ("robot", "engine", "num_envs"):
            found[name] = getattr(info, name)
            wanted[name] = getattr(self.spec, name)
        found["stand-ins"] = info.meshes is None
        wanted["stand-ins"] = self.subset.meshes is None
        # RUN/checkpoints/NUMBER.pt
        found["networks of"] = info.weights and Path(info.weights).parent.parent.name
        wanted["networks of"] = self.weights and self.weights.name
        if self.bank.is_file():
            found["reset bank"] = info.resets_hash[:12]
            wanted["reset bank"] = file_hash(self.bank)[:12]
        _refuse_other(f"{self.folder} holds a run of another configuration", "runs", found, wanted)


def _without_length(config: TrainConfig) -> dict[str, Any]:
    return asdict(replace(config, iterations=1, save_interval=1))


def _refuse_other(problem: str, what: str, found: dict[str, Any], wanted: dict[str, Any]) -> None:
    """Refuse files whose description differs from the study's.

    Raises:
        RunError: an entry differs; the message names it.
    """
    for name, there, here in differences(found, wanted):
        raise RunError(
            f"{problem}: {name} is {shown(there)} there and {shown(here)} in the study. Nothing was changed; give the "
            f"{what} another name, or choose another --out."
        )


# What is left to do ---------------------------------------------------------------------------------------------------


def bank_todo(subset: Subset, robot: str) -> Todo:
    """Return what is left to do for a robot's reset bank."""
    folder = subset.robot(robot)
    motion = folder / "retargeted.npz"
    bank = subset.bank(robot)
    if bank.is_file():
        return "", []
    commands = []
    if not motion.is_file():
        retarget = _xreset("retarget", subset.demos, robot=robot, out=motion, meshes=subset.meshes)
        commands.append([*retarget, *subset.data.retarget])
    own_robot = robot if Path(robot).is_dir() else None
    resets = _xreset("resets", motion, out=bank, robot=own_robot, meshes=subset.meshes)
    return "to do", [*commands, [*resets, *subset.data.resets]]


def train_todo(run: Run) -> Todo:
    """Return what is left to do of a training: start it, or continue from its newest checkpoint."""
    spec = run.spec
    assert run.config is not None
    iterations = run.config.iterations if spec.steps or not spec.minutes else None
    left = training_left(run.folder, iterations, spec.minutes)
    if not left:
        return "", []
    length = {"out": run.folder, "iterations": iterations, "minutes": spec.minutes}
    if checkpoints(run.folder):
        return left, [_xreset("train", **length)]
    command = _xreset(
        "train",
        **length,
        robot=spec.robot,
        resets=run.bank,
        engine=spec.engine,
        device=spec.device,
        num_envs=spec.num_envs,
        seed=run.seed,
        recipe=spec.recipe,
        weights=run.weights,
        meshes=run.subset.meshes,
        config=_as_options(spec.config, TrainConfig()),
    )
    return left, [command]


def eval_todo(run: Run, folder: Path, spec: Evaluation, subset: Subset, engines: list[str]) -> Todo:
    """Return the engines in which an evaluation has no result, or a result of other episodes or files. Results of a
    policy whose training goes on are of another file, too."""
    policy = run.spec.policy
    files = {"demos": subset.demos}
    demos = subset.demos
    if policy == "ik":
        demos = subset.robot(run.spec.robot) / "retargeted.npz"
    command = _xreset(
        "eval",
        policy or run.folder,
        robot=run.spec.robot if policy else None,
        demos=demos,
        episodes=spec.episodes,
        episode_seconds=spec.episode_seconds,
        seed=spec.seed,
        num_envs=spec.num_envs,
        out=folder,
        meshes=subset.meshes,
    )
    if policy is None:
        files["policy"] = run.folder / "policy.onnx"
    trained = (run.config or TrainConfig()).task.termination.episode_seconds
    missing = engines_left(
        folder,
        engines,
        files,
        seed=spec.seed,
        episodes=spec.episodes,
        seconds=spec.episode_seconds,
        trained=trained,
    )
    if policy is None and train_todo(run)[0]:
        missing = engines
    command += [f"--engine={engine}" for engine in missing]
    return (f"in {', '.join(missing)}", [command]) if missing else ("", [])


def engines_left(
    folder: Path,
    engines: Sequence[str],
    files: Mapping[str, Path],
    *,
    seed: int,
    episodes: int,
    seconds: float | None = None,
    trained: float,
) -> list[str]:
    """Return the engines without results of certain episodes and files.

    Args:
        folder: folder of the results.
        engines: names of the engines.
        files: the files as they are now, by their name in the results; those that do not exist are not compared.
        seed: seed of the starts.
        episodes: episodes of each demonstration.
        seconds: length of an episode [s]; None: as in the policy's training.
        trained: length of an episode in the policy's training [s]; results may not state theirs.
    """
    hashes = {name: file_hash(file) for name, file in files.items() if file.is_file()}
    left = []
    for engine in engines:
        result = folder / f"{engine}.json"
        if result.is_file():
            found = read_result(result)
            played = (found.seed, found.episodes_per_demo, found.episode_seconds or trained)
            is_same = played == (seed, episodes, seconds or trained)
            if is_same and hashes.items() <= found.inputs.items():
                continue
        left.append(engine)
    return left


def _as_options(changes: dict[str, Any], config: Any) -> dict[str, Any]:
    """Return nested changes of a configuration as its options take them: terms with words for true and false, other
    tables as lists of names and values."""
    found = {}
    for name, value in changes.items():
        default = getattr(config, name)
        if isinstance(default, Terms):
            found[name] = _in_words(value)
        elif isinstance(default, dict):
            found[name] = list(chain.from_iterable(value.items()))
        elif isinstance(value, dict):
            found[name] = _as_options(value, default)
        else:
            found[name] = value
    return found


def _in_words(terms: Any) -> Any:
    """Return terms, which may be nested, with the words ``true`` and ``false``. One without parameters is ``true``."""
    if isinstance(terms, dict) and terms:
        return {name: _in_words(value) for name, value in terms.items()}
    if terms == {} or isinstance(terms, bool):
        return "false" if terms is False else "true"
    return terms


def _xreset(verb: str, *words: object, **options: Any) -> list[str]:
    """Return a command of ``xreset``; see :func:`flags`."""
    return [*XRESET, verb, *map(str, words), *flags(options)]


def flags(values: dict[str, Any]) -> Iterator[str]:
    """Yield values, which may be nested, as options of a command; None gives no option."""
    for name, value in flat(values):
        group, dot, last = name.replace("_", "-").rpartition(".")
        flag = f"--{group}{dot}{last}"
        if isinstance(value, bool):
            yield flag if value else f"--{group}{dot}no-{last}"
        elif value is not None:
            yield flag
            yield from map(str, np.array(value, dtype=object).ravel())
