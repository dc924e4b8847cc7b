"""Named starting points for a training's configuration: ``default`` and ``paper``, those of ``recipes.toml``, and the
user's own files."""

from __future__ import annotations

import shlex
import sys
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import reduce
from pathlib import Path
from typing import Any

from xreset.cameras.config import VisionConfig
from xreset.errors import PolicyError, RunError
from xreset.files.checks import from_dict, merged
from xreset.files.storage import read_toml
from xreset.files.text import plain, shown
from xreset.learning.config import ModelConfig, PpoConfig, TrainConfig
from xreset.learning.run import read_run
from xreset.policy.shipped import shipped_checkpoints, shipped_name
from xreset.spec import RobotSpec
from xreset.task.config import TaskConfig


def _read_recipes() -> dict[str, TrainConfig]:
    paper = TrainConfig(task=TaskConfig(), model=ModelConfig(), ppo=PpoConfig(), iterations=10_000)
    recipes = {"default": TrainConfig(), "paper": paper}
    for name, changes in tomllib.loads(_FILE.read_text()).items():
        recipes[name] = _changed(changes, recipes, f"{_FILE}: {name}")
    return recipes


def _changed(
    changes: dict[str, Any], recipes: Mapping[str, TrainConfig], where: str
) -> TrainConfig:
    """Return the configuration of a recipe as it is written, which may extend one of ``recipes``."""
    base = changes.pop("extends", None)
    config = asdict(recipes[base] if base else TrainConfig())
    for table in changes.pop("replaces", ()):
        reduce(dict.__getitem__, table.split("."), config).clear()
    return from_dict(TrainConfig, merged(config, _with_none(changes)), where)


def read_recipe(path: Path) -> TrainConfig:
    """Read a recipe of the user's own: a TOML file like a table of ``recipes.toml``.

    Raises:
        FileFormatError: the file is damaged, or has an entry or a value that a configuration cannot have.
        RunError: it extends or replaces something that does not exist.
    """
    changes = read_toml(path)
    changes.pop("about", None)
    base = changes.get("extends")
    if base is not None and (not isinstance(base, str) or base not in RECIPES):
        raise RunError(
            f"{path}: extends is {shown(base)}. Choose from: {', '.join(RECIPES)}; or omit it for the default."
        )
    replaced = changes.get("replaces", [])
    if not isinstance(replaced, list) or any(_is_no_table(name) for name in replaced):
        raise RunError(
            f"{path}: replaces is {shown(replaced)}, expected a list of names of tables, such as task.reward.terms."
        )
    return _changed(changes, RECIPES, str(path))


def _is_no_table(name: Any) -> bool:
    table: Any = asdict(TrainConfig())
    for part in str(name).split("."):
        table = table.get(part) if isinstance(table, dict) else None
    return not isinstance(table, dict)


def _with_none(changes: dict[str, Any]) -> dict[str, Any]:
    """Return nested changes with None in place of the text ``"None"``, because TOML has no word for it."""
    found = {}
    for name, value in changes.items():
        found[name] = _with_none(value) if isinstance(value, dict) else value
        if value == "None":
            found[name] = None
    return found


_FILE = Path(__file__).with_name("recipes.toml")
_STUDENT = _FILE.with_name("student.toml")
RECIPES = _read_recipes()
"""Name of the recipe -> configuration."""


def starting_config(recipe: str) -> TrainConfig:
    """Return the configuration of a recipe, of a file, of a run or of a policy, without reward terms that a user added.

    Such a term names code to import. A file must not decide that, so the user has to name the terms again. A note on
    standard error says so.

    Args:
        recipe: name of a recipe, a file of the user's own (``.toml``), a run folder, or a policy: its file
            (``.onnx``), or its name if it ships with xreset.

    Raises:
        RunError: it is none of them.
        FileFormatError: the file or the run is damaged.
        PolicyError: the policy is damaged, or sees through cameras.
    """
    if recipe in RECIPES:
        return RECIPES[recipe]
    if is_policy(recipe):
        config = _config_of_policy(recipe)
    elif not Path(recipe).exists():
        raise RunError(
            f"There is no recipe, file, run folder or policy {recipe!r}. Recipes: {', '.join(RECIPES)}. Policies whose "
            f"networks a training can start with (--weights): {', '.join(shipped_checkpoints())}."
        )
    elif recipe.endswith(".toml"):
        config = read_recipe(Path(recipe))
    else:
        config = read_run(recipe).config
    reward = config.task.reward
    if reward.own:
        flags = own_terms_flags(reward.own)
        print(
            f"{recipe} has reward terms of your own. They are off unless you name them again, because a file must not "
            "decide which code is imported. If you trust this code, add "
            f"{flags}.",
            file=sys.stderr,
        )
    return without_own(config)


def without_own(config: TrainConfig) -> TrainConfig:
    """Return a configuration without reward terms of the user's own."""
    reward = config.task.reward.without_own()
    return replace(config, task=replace(config.task, reward=reward))


def is_policy(name: str) -> bool:
    """Whether this is the file of an exported policy, or the name of one that ships with xreset."""
    return name.endswith(".onnx") or (not Path(name).exists() and shipped_name(name) is not None)


def _config_of_policy(name: str) -> TrainConfig:
    """Return the default configuration with the task and the layers of a policy."""
    from xreset.learning.exported import read_policy
    from xreset.learning.from_onnx import layers_of

    policy = read_policy(name)
    task = policy.contract.task
    if task.vision.cameras:
        raise PolicyError(
            f"{name} sees through cameras. Give a policy that is told pose and shape, or train a student (--teacher)."
        )
    return TrainConfig(task=task, model=layers_of(policy))


def from_home(config: TrainConfig) -> TrainConfig:
    """Return the configuration for goals without demonstrated states: every episode begins at home."""
    reset = replace(config.task.reset, demo_probability=0.0)
    return replace(config, task=replace(config.task, reset=reset))


def for_robots(config: TrainConfig, robots: Sequence[RobotSpec]) -> TrainConfig:
    """Return the configuration for a policy of several robots: slots that each of them fits into, and observations that
    describe the robot. A configuration that has slots stays as it is.

    Raises:
        RobotError: a robot does not fit into any slots.
    """
    from xreset.task.slots import needed_slots

    if config.task.joint_slots is not None:
        return config
    observation = config.task.observation
    proprio = observation.proprio | {"joint_mask": {}, "joint_pos_limits": {}, "tip_mask": {}}
    task = replace(
        config.task,
        observation=replace(observation, proprio=proprio),
        joint_slots=needed_slots(robots),
    )
    return replace(config, task=task)


def own_terms_flags(own: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the options of ``xreset train`` that name reward terms of the user's own."""
    flags = []
    for name, term in own.items():
        for parameter, value in term.items():
            flag = f"--config.task.reward.terms.{name}.{parameter}={value}"
            flags.append(shlex.quote(plain(flag)))
    return " ".join(flags)


def resume_command(folder: Path, own: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the command that continues a run, with the reward terms of the user's own."""
    words = f"xreset train --out {shlex.quote(str(folder))}"
    return f"{words} {own_terms_flags(own)}" if own else words


def student_config(teacher: TaskConfig, vision: VisionConfig) -> TrainConfig:
    """Return the configuration of a distillation: ``student.toml``, with images up to 33 ms older than the newest. What
    it does not name is as in the recipe ``paper``.

    Args:
        teacher: the teacher's task, without cameras.
        vision: the cameras of the student.
    """
    task = replace(teacher, vision=vision, reward=teacher.reward.without_own())
    changes = tomllib.loads(_STUDENT.read_text())
    latency = round(1 / 30 / teacher.control_dt, 3)
    changes["task"]["randomization"]["camera_latency"] = [0.0, latency]
    base = asdict(replace(RECIPES["paper"], task=task))
    return from_dict(TrainConfig, merged(base, changes), str(_STUDENT))
