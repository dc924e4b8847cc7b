"""The study file (TOML): trainings, evaluations, tables.

.. code-block:: toml

    schema = "xreset-study/1"
    about = "What the study asks."

    [data.right]                       # relative to --data
    demos = "dexycb_right_9x20.npz"
    meshes = "ycb"

    [evaluations.eval]                 # results go to RUN/eval, where xreset compare and xreset report look
    episodes = 5

    [defaults]                         # of every run
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

import re
from dataclasses import dataclass, field, fields
from math import isfinite
from pathlib import Path
from typing import Annotated, Any, Literal

from xreset.checks import Checked, Finite, Positive, Rule, from_dict
from xreset.errors import FileFormatError, RunError
from xreset.eval.study.paper import METRICS, paper_tables
from xreset.files import read_toml
from xreset.resets.config import ClosingConfig, SqueezeConfig
from xreset.retarget.arm.config import ArmConfig
from xreset.retarget.hand.config import HandConfig
from xreset.text import shown

SCHEMA = "xreset-study/1"
SHIPPED = Path(__file__).parent.parent / "studies"
"""Studies that ship with xreset, known by name."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")

_LARGEST_SEED = 2**32 - 1
"""numpy, torch and the engines take seeds up to this one."""
Seed = Annotated[int, Rule(f"a whole number from 0 to {_LARGEST_SEED}", lambda x: 0 <= x <= _LARGEST_SEED)]


def _are_seeds(seeds: tuple[int, ...]) -> bool:
    return len(seeds) > 0 and len(set(seeds)) == len(seeds) and min(seeds) >= 0 and max(seeds) <= _LARGEST_SEED


Axis = Literal["run", "object", "metric"]


def _config_flags(**configs: type) -> set[str]:
    """Return the command-line flags of configuration classes, such as ``--hand.jump-limit``."""
    flags = set()
    for group, config in configs.items():
        flags |= {f"--{group}.{f.name}".replace("_", "-") for f in fields(config)}
    return flags


COMMAND_FLAGS = {
    "retarget": _config_flags(hand=HandConfig, arm=ArmConfig) | {"--device"},
    "resets": _config_flags(closing=ClosingConfig, squeeze=SqueezeConfig)
    | {"--backend", "--device", "--num-envs", "--hold", "--no-hold"},
}
"""Flags that a study file may give to a command. Flags that name files are not among them: a study writes only into ``--out``."""


@dataclass(frozen=True, kw_only=True)
class Data(Checked):
    """Demonstrations, and how states to reset to are made of them."""

    demos: str | None = None
    """An archive (``xreset demos``), relative to ``--data``. None: synthetic ones of the stand-ins."""
    synthetic_per_object: Positive[int] = 4
    synthetic_seed: Seed = 0
    meshes: str | None = None
    """Folder of meshes, relative to ``--data``; None: the stand-ins."""
    retarget: tuple[str, ...] = ()
    """Further options of ``xreset retarget``: those of :data:`COMMAND_FLAGS`."""
    resets: tuple[str, ...] = ()
    """Further options of ``xreset resets``: those of :data:`COMMAND_FLAGS`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for command, allowed in COMMAND_FLAGS.items():
            for text in getattr(self, command):
                flag = text.partition("=")[0].replace("_", "-")
                if text.startswith("-") and not _is_number(text) and flag not in allowed:
                    raise ValueError(
                        f"{command} holds the option {shown(text)}, which a study file may not give. "
                        f"Choose from: {', '.join(sorted(allowed))}"
                    )


def _is_number(text: str) -> bool:
    try:
        return isfinite(float(text))
    except ValueError:
        return False


@dataclass(frozen=True, kw_only=True)
class Evaluation(Checked):
    """From where, how often and in what a policy is tried."""

    data: str | None = None
    """Of whose demonstrations starts and goals are; None: those that the policy was trained with."""
    objects: tuple[str, ...] = ()
    """Only these, where a run has them; empty: all of the run's."""
    per_object: Positive[int] | None = None
    """Only the first so many demonstrations of each; None: all (of the run's own data: as many as it was trained with)."""
    episodes: Positive[int] = 5
    """Perturbed starts of each demonstration."""
    seed: Seed = 0
    engines: tuple[str, ...] = ("mujoco", "mujoco-warp", "pybullet", "sapien")
    """Those that are not there are left out, and that is said."""
    num_envs: Positive[int] = 64


@dataclass(frozen=True, kw_only=True)
class Runs(Checked):
    """Trainings that differ in seed (and, with ``alone``, object), or a baseline."""

    data: str
    robot: str = "ur7e-sharpa"
    objects: tuple[str, ...] = ()
    """Empty: all that the data have."""
    alone: bool = False
    """A training for each object, not one for all."""
    per_object: Positive[int] | None = None
    """Only the first so many demonstrations of each object."""
    policy: Literal["ik", "zero", "random"] | None = None
    """A baseline that is evaluated and not trained."""
    recipe: str = "minutes"
    config: dict[str, Any] = field(default_factory=dict)
    """Changes of the recipe, nested as the configuration is."""
    seeds: Annotated[tuple[int, ...], Rule(f"one or more numbers from 0 to {_LARGEST_SEED}, each once", _are_seeds)] = (
        0,
    )
    minutes: Positive[Finite[float]] | None = None
    """Minutes of training, without compiling."""
    steps: Positive[Finite[float]] | None = None
    """Environment steps of all worlds; of both the one that is reached first. Neither: the recipe's iterations."""
    weights: str | None = None
    """Other runs of the study, whose networks these begin with: those of the same seed, and of the same object if they are alone, too."""
    backend: str = "mujoco-warp"
    device: Literal["cuda", "cpu"] = "cuda"
    gpus: Positive[int] = 1
    """Processes, each with a GPU and ``num_envs`` worlds of its own."""
    num_envs: Positive[int] = 4096
    """Worlds of each process."""
    evaluations: tuple[str, ...] = ()
    """Names of those that are done; none: all."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not _NAME.fullmatch(Path(self.robot).name):
            raise ValueError(f"robot is {shown(self.robot)}, expected the name of a robot or the folder of one")
        reward: Any = self.config
        for key in ("task", "reward"):
            reward = reward.get(key) if isinstance(reward, dict) else None
        if isinstance(reward, dict) and "own" in reward:
            raise ValueError("config.task.reward.own names code to run, which a study file may not. Use xreset train")


@dataclass(frozen=True, kw_only=True)
class TableSpec:
    """A table of the study's page: one for each engine, and a picture."""

    runs: dict[str, str]
    """Run -> what the paper's table calls it; without ``paper``, what the table shall call it."""
    paper: str | None = None
    """The paper's table whose figures stand beside ours, and whose rows and columns these are."""
    title: str | None = None
    evaluation: str = "eval"
    rows: Axis = "object"
    """Without ``paper``: what the rows are. The columns are runs, or if these are the rows, objects."""
    object: str | None = None
    """Only this one; None: all."""
    metric: str = "task_progress"


@dataclass(frozen=True, kw_only=True)
class Study:
    """Contents of a study file."""

    schema: str
    about: str
    data: dict[str, Data]
    runs: dict[str, Runs]
    evaluations: dict[str, Evaluation] = field(default_factory=lambda: {"eval": Evaluation()})
    tables: tuple[TableSpec, ...] = ()


def study_path(name: str) -> Path:
    """The file of a study, by path or, of those that ship with xreset, by name."""
    path, shipped = Path(name), {file.stem: file for file in sorted(SHIPPED.glob("*.toml"))}
    if path.is_file() or name not in shipped:
        if not path.is_file():
            raise RunError(
                f"there is no study {name!r}: expected a file, or one that ships with xreset: {', '.join(shipped)}."
            )
        return path
    return shipped[name]


def read_study(path: Path) -> Study:
    """Read a study file.

    Raises:
        FileFormatError: it is no TOML, holds an unknown key or a value of the wrong type, or names something that it does not define.
    """
    raw = read_toml(path, SCHEMA)
    defaults, runs = raw.pop("defaults", {}), raw.get("runs", {})
    if (
        not isinstance(defaults, dict)
        or not isinstance(runs, dict)
        or not all(isinstance(run, dict) for run in runs.values())
    ):
        raise FileFormatError(f"{path}: defaults, runs and each of the runs must be tables.")
    raw["runs"] = {name: merged(defaults, run) for name, run in runs.items()}
    study = from_dict(Study, raw, str(path))
    if problem := _problem(study):
        raise FileFormatError(f"{path}: {problem}")
    return study


def merged(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """``base`` with nested changes."""
    result = dict(base)
    for name, value in changes.items():
        both = isinstance(value, dict) and isinstance(base.get(name), dict)
        result[name] = merged(base[name], value) if both else value
    return result


def _problem(study: Study) -> str | None:
    def unknown(what: str, name: str | None, known: Any) -> str | None:
        return (
            None
            if name is None or name in known
            else f"{what} is {name!r}, expected one of {', '.join(map(repr, known)) or 'none'}."
        )

    for name in (*study.data, *study.runs, *study.evaluations):
        if not _NAME.fullmatch(name):
            return f"the name {name!r} is no name for a folder: use letters, digits, dots, dashes and underscores."
    for name, evaluation in study.evaluations.items():
        if name != "eval" and not name.startswith("eval-"):
            return f"the evaluation {name!r} would be a folder of that name in every run; call it 'eval', or 'eval-' and something."
        if found := unknown(f"evaluations.{name}.data", evaluation.data, study.data):
            return found
    for name, run in study.runs.items():
        problems = (
            unknown(f"runs.{name}.data", run.data, study.data),
            unknown(
                f"runs.{name}.weights",
                run.weights,
                [n for n, r in study.runs.items() if n != name and r.policy is None],
            ),
            *(unknown(f"runs.{name}.evaluations", evaluation, study.evaluations) for evaluation in run.evaluations),
        )
        if found := next(filter(None, problems), None):
            return found
        chain = [name]
        while (weights := study.runs[chain[-1]].weights) is not None:
            if weights in chain:
                return f"runs.{name}.weights lead back to themselves: {' -> '.join([*chain, weights])}."
            chain.append(weights)
            if weights not in study.runs:
                break
    for i, table in enumerate(study.tables):
        papers = paper_tables()
        problems = (
            unknown(f"tables[{i}].paper", table.paper, papers),
            unknown(f"tables[{i}].evaluation", table.evaluation, study.evaluations),
            unknown(f"tables[{i}].metric", table.metric, METRICS),
            *(unknown(f"tables[{i}].runs", run, study.runs) for run in table.runs),
        )
        if found := next(filter(None, problems), None):
            return found
        methods = papers[table.paper].methods if table.paper else ()
        if table.paper and (
            found := next(filter(None, (unknown(f"tables[{i}].runs", m, methods) for m in table.runs.values())), None)
        ):
            return found
    return None
