"""The study file (TOML): trainings, evaluations, tables.

.. code-block:: toml

    schema = "xreset-study/1"
    about = "What the study asks."

    [data.right]                       # relative to --data
    demos = "dexycb_right_9x20.npz"
    meshes = "ycb"

    [evaluations.eval]                 # results go to RUN/eval, where xreset report looks
    episodes = 5

    [defaults]                         # of every run; `resets`: of all data
    data = "right"
    minutes = 8.0

    [runs.x-reset]                     # one training for each seed; with `alone`, for each object and seed
    seeds = [0, 1]

    [runs.x-sim.config.task.reset]     # changes of the recipe, as --config.task.reset.demo-probability 0
    demo_probability = 0.0

    [[tables]]
    paper = "I"
    runs = { x-reset = "Ours", x-sim = "X-Sim" }
"""

from __future__ import annotations

import os
import re
from collections.abc import Collection
from dataclasses import field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from xreset.errors import FileFormatError, RunError
from xreset.eval.study.paper import paper_tables
from xreset.files.checks import (
    Checked,
    PositiveFloat,
    PositiveInt,
    Rule,
    Seed,
    first_repeated,
    from_dict,
    frozen,
    merged,
)
from xreset.files.storage import read_toml

SCHEMA = "xreset-study/1"
SHIPPED = Path(__file__).parent.parent / "studies"
"""Folder of the studies that ship with xreset."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")

Robot = Annotated[
    str,
    Rule(
        "the name of a robot or the folder of one",
        lambda name: bool(_NAME.fullmatch(Path(name).name)),
    ),
]


def _options(*allowed: str) -> Rule:
    """Return the rule that a study gives only certain options of a command. No such option names a file, because a
    study writes only into ``--out``."""

    def holds(texts: tuple[str, ...]) -> bool:
        given = [text.replace("_", "-") for text in texts if re.match(r"-\D", text)]
        return all(option.startswith(allowed) for option in given)

    return Rule(f"options that begin with {', '.join(allowed)}", holds)


@frozen
class Data(Checked):
    """Demonstrations, and the options with which reset states are made of them."""

    demos: str | None = None
    """An archive (``xreset demos``), relative to ``--data``. None: synthetic ones of the stand-ins."""
    synthetic_per_object: PositiveInt = 4
    meshes: str | None = None
    """Folder of meshes, relative to ``--data``; None: the stand-ins."""
    retarget: Annotated[tuple[str, ...], _options("--device")] = ()
    """Further options of ``xreset retarget``."""
    resets: Annotated[
        tuple[str, ...],
        _options(
            "--closing.",
            "--filter.",
            "--squeeze.",
            "--transfer.",
            "--engine",
            "--backend",
            "--device",
            "--num-envs",
        ),
    ] = ()
    """Further options of ``xreset resets``."""


@frozen
class Evaluation(Checked):
    """Starts, number of episodes and engines of an evaluation."""

    data: str | None = None
    """Data with the starts and goals; None: the data of the policy's training."""
    objects: tuple[str, ...] = ()
    """Only these objects, where a run has them; empty: all objects of the run."""
    per_object: PositiveInt | None = None
    """Largest number of demonstrations of each object; None: all (of the run's own data: as many as in training)."""
    episodes: PositiveInt = 5
    """Episodes of each demonstration, each with a perturbed start."""
    episode_seconds: PositiveFloat | None = None
    """Length of an episode [s]; None: as in the policy's training."""
    seed: Seed = 0
    engines: tuple[str, ...] = ("mujoco", "mujoco-warp", "pybullet", "sapien")
    """Engines that are not installed are left out, with a note."""
    num_envs: PositiveInt = 64


@frozen
class Runs(Checked):
    """Trainings that differ in seed (and, with ``alone``, object), or a baseline."""

    RENAMED: ClassVar = {"backend": "engine"}
    data: str
    robot: Robot = "ur7e-sharpa"
    objects: tuple[str, ...] = ()
    """Empty: all objects of the data."""
    alone: bool = False
    """Train a policy for each object, not one for all."""
    per_object: PositiveInt | None = None
    """Largest number of demonstrations of each object."""
    policy: Literal["ik", "zero"] | None = None
    """A baseline, which is evaluated and not trained."""
    recipe: str = "default"
    config: dict[str, Any] = field(default_factory=dict)
    """Changes of the recipe, nested as the configuration is."""
    seeds: Annotated[
        tuple[Seed, ...], Rule("one or more, each once", lambda x: 0 < len(x) == len(set(x)))
    ] = (0,)
    minutes: PositiveFloat | None = None
    """Minutes of training, without compiling."""
    steps: PositiveFloat | None = None
    """Environment steps of all worlds. With minutes and steps, the first limit ends the training; with neither, the
    recipe's iterations."""
    weights: str | None = None
    """An earlier run of the study, whose networks this run begins with: the training of the same seed, and of the same
    object if both train alone."""
    engine: str = "mujoco-warp"
    device: Literal["cuda", "cpu"] = "cuda"
    num_envs: PositiveInt = 4096


@frozen
class TableSpec:
    """A table of the study's page, one for each engine. Without ``paper``, rows are objects and columns runs."""

    runs: dict[str, str]
    """Run -> its name in the paper's table, or without ``paper`` its name in this table."""
    paper: str | None = None
    """Table of the paper: its figures are shown next to ours, and its rows and columns are used."""
    title: str | None = None
    evaluation: str = "eval"
    metric: str = "task_progress"


@frozen
class Study:
    """Contents of a study file."""

    schema: str
    about: str
    data: dict[str, Data]
    runs: dict[str, Runs]
    evaluations: dict[str, Evaluation] = field(default_factory=lambda: {"eval": Evaluation()})
    tables: tuple[TableSpec, ...] = ()


def study_path(name: str) -> Path:
    """Return the file of a study, given its path or the name of a study that ships with xreset.

    Raises:
        RunError: the file does not exist, and no such study ships with xreset.
    """
    path = Path(name)
    shipped = {file.stem: file for file in sorted(SHIPPED.glob("*.toml"))}
    if os.path.isfile(path):
        return path
    if name not in shipped:
        raise RunError(
            f"Unknown study {name!r}. Give a file, or a study that ships with xreset: {', '.join(shipped)}."
        )
    return shipped[name]


def read_study(path: Path) -> Study:
    """Read a study file.

    Raises:
        FileFormatError: the file is not TOML, holds an unknown key or a wrong value, or names something that it does
        not define.
    """
    raw = read_toml(path, SCHEMA)
    defaults = raw.pop("defaults", {})
    data = raw.get("data", {})
    runs = raw.get("runs", {})
    if not all(isinstance(table, dict) for table in (defaults, data, runs)):
        raise FileFormatError(f"{path}: defaults, data and runs must be tables.")
    data_defaults = {"resets": defaults.pop("resets", ())}
    base = {"runs": dict.fromkeys(runs, defaults)}
    if data:
        base["data"] = dict.fromkeys(data, data_defaults)
    study = from_dict(Study, merged(base, raw), str(path))
    try:
        _check_names(study)
    except ValueError as error:
        raise FileFormatError(f"{path}: {error}") from None
    return study


def _check_names(study: Study) -> None:
    """Raise ``ValueError`` if the study uses a name that it does not define, or that cannot be the name of a folder."""
    for name in (*study.data, *study.runs, *study.evaluations):
        if not _NAME.fullmatch(name):
            raise ValueError(
                f"{name!r} cannot be the name of a folder. Use letters, digits, dots, dashes and underscores."
            )
    for name, evaluation in study.evaluations.items():
        if name != "eval" and not name.startswith("eval-"):
            raise ValueError(
                f"the evaluation {name!r} is a folder in every run: call it 'eval', or begin its name with 'eval-'."
            )
        _expect(f"evaluations.{name}.data", study.data, evaluation.data)
    trained: list[str] = []
    for name, run in study.runs.items():
        _expect(f"runs.{name}.data", study.data, run.data)
        _expect(f"runs.{name}.weights", trained, run.weights)
        if run.policy is None:
            trained.append(name)
    from xreset.eval.metrics import METRICS  # imports torch

    papers = paper_tables()
    metrics = [name for name, metric in METRICS.items() if metric.unit != "episodes"]
    for i, table in enumerate(study.tables):
        where = f"tables[{i}]"
        _expect(f"{where}.paper", papers, table.paper)
        _expect(f"{where}.evaluation", study.evaluations, table.evaluation)
        _expect(f"{where}.metric", metrics, table.metric)
        _expect(f"{where}.runs", study.runs, *table.runs)
        shown = list(table.runs.values())
        if (repeated := first_repeated(shown)) is not None:
            raise ValueError(
                f"{where}.runs has two runs with the name {shown[repeated]!r}. Give each its own name."
            )
        if table.paper:
            methods = dict.fromkeys(method for method, _, _ in papers[table.paper].figures())
            _expect(f"{where}.runs", methods, *table.runs.values())


def _expect(where: str, known: Collection[str], *names: str | None) -> None:
    """Raise ``ValueError`` if one of the names, where it is not None, is unknown."""
    for name in names:
        if name is not None and name not in known:
            listing = ", ".join(map(repr, known)) or "none"
            raise ValueError(f"{where} is {name!r}, expected one of {listing}.")
