"""``xreset train``."""

from __future__ import annotations

import inspect
import math
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from functools import partial, wraps
from inspect import signature
from pathlib import Path
from typing import Annotated, Any

from xreset.cli import asks_for_help
from xreset.cli._common import Device, Several, given_flags, refuse_changes
from xreset.cli._options import Output
from xreset.cli._terminal import show_table
from xreset.cli._terms import take_terms
from xreset.errors import RunError
from xreset.files.checks import PositiveInt, Seed
from xreset.learning.config import TrainConfig
from xreset.learning.recipes import default_config, starting_config


def train(
    *,
    out: Output,
    robot: str | None = None,
    resets: Path | None = None,
    goals: Path | None = None,
    meshes: Path | None = None,
    engine: str = "mujoco-warp",
    device: Device | None = None,
    num_envs: PositiveInt | None = None,
    iterations: PositiveInt | None = None,
    minutes: float = math.inf,
    seed: Seed = 0,
    resume: bool = False,
    recipe: str = "default",
    weights: Path | None = None,
    teacher: str | None = None,
    camera: Several = (),
    wandb: str | None = None,
    config: TrainConfig = TrainConfig(),
) -> None:
    """Train a policy by its rewards; or a student that sees the object, which imitates a teacher that is told its pose.

    The same command continues a training that was stopped or killed. After a signal, it writes a checkpoint and exits
    with 128 and the signal's number: 130 after Ctrl-C, 143 after SIGTERM.

    Args:
        out: Run folder to make, or to continue.
        robot: Name or folder of the robot; default: that of the bank or of the goal set.
        resets: Reset bank, made by `xreset resets`.
        goals: Goal set, made by `xreset goals`. With --resets, its starts and goals are added to the demonstrated ones;
            without, every episode begins at home.
        meshes: Folder of real meshes; default: that of the bank, else the stand-ins.
        engine: Physics engine to train on.
        device: cpu or cuda; default: cuda where there is a GPU and the engine can use it.
        num_envs: Worlds to simulate (per GPU). Default: 4096; for a student 1024.
        iterations: Total number of iterations; default: the configuration's.
        minutes: Longest time of the whole training, without compiling kernels: a run that continues has the rest of it.
        seed: Seed of every random number.
        resume: Continue the run in --out as it was started: its other options need not be given. Name reward terms of
            your own again.
        recipe: Where the configuration starts from: a recipe (default, robust, live, paper, published), a TOML file of
            your own with the tables that it changes (docs/clusters.md), or another run's folder. Options --config.*
            change it; see them with xreset train --help-config [PART]. Reward terms of your own are not taken from a
            file or a run; name them again. Default: the recipe of the headline results; with --weights and --goals, the
            run of --weights.
        weights: Another run's folder: start with the networks of its newest checkpoint, including the standard
            deviation of the actions and the learning rate.
        teacher: Run folder, exported policy (.onnx), or name of a policy that ships with xreset: a student learns its
            actions, in its task, from what cameras show. Images and their timing: --help-config task.vision.
        camera: Camera of a student: front, side, or wrist; give it again for two. Default: front.
        wandb: Project of Weights & Biases to which learning curves are sent as well. Needs the package wandb, and a
            login. Its variables, such as WANDB_RUN_GROUP and WANDB_MODE=offline, say the rest.
        config: Task, model and algorithm. The defaults shown are those of --recipe. Terms of rewards and observations:
            --config.task.reward.terms.reach.width 0.4.
    """
    from xreset.learning import train as training

    started: dict[str, Any] = {
        "robot": robot,
        "meshes": meshes,
        "engine": engine,
        "device": device,
        "num_envs": num_envs,
        "seed": seed,
    }
    length: dict[str, Any] = {"iterations": iterations, "minutes": minutes, "wandb": wandb}
    if resume:
        _refuse_new_start(out)
        refuse_changes(out, resets=resets, goals=goals, teacher=teacher, **started)
        training.resume(out, own=config.task.reward.own, **length)
        return
    if goals is None and resets is None:
        raise RunError(
            "A new run needs --resets or --goals. To continue the run in --out, add --resume."
        )
    options: dict[str, Any] = {"out": out, "goals": goals, "config": config, **started, **length}
    if teacher is None:
        options["num_envs"] = num_envs or 4096
        training.train(resets, **options, weights=weights)
    else:
        options["num_envs"] = num_envs or 1024
        training.distill(teacher, resets, **options)


def _refuse_new_start(out: Path) -> None:
    """Refuse options that only a new run can have."""
    for flag in given_flags():
        name = flag.partition(".")[0]
        is_own = flag.startswith("--config.task.reward.terms.") and ":" in flag
        if name in ("--recipe", "--config", "--weights", "--camera") and not is_own:
            raise RunError(
                f"--resume continues with the run's own networks and configuration. Omit {name}, or start another run "
                f"with this run's networks: --weights {out} --recipe {out}"
            )


_HELP_CONFIG = "--help-config"


def command_for(arguments: list[str]) -> Callable[..., None]:
    """Return :func:`train` with the defaults of ``--recipe``, which must be known before the other flags are read.

    Flags of terms are taken from the arguments.
    """
    parser = ArgumentParser(add_help=False, allow_abbrev=False)
    for flag in ("--recipe", "--weights", "--goals", "--teacher"):
        parser.add_argument(flag, nargs="?")  # tyro reports a missing value
    parser.add_argument("--camera", action="append")
    parser.add_argument("--resume", action="store_true")
    parser.add_argument(_HELP_CONFIG, nargs="?", const="")
    given = parser.parse_known_args(arguments)[0]
    recipe = given.recipe
    if given.teacher and not given.resume:
        config = _config_of_student(given)
        recipe = "default"
    elif recipe:
        config = starting_config(recipe)
    else:
        recipe, config = default_config(given.goals, given.weights)
    config = take_terms(config, arguments)
    if given.help_config is not None:
        _show_config(given.help_config.removeprefix("config."), config)
        raise SystemExit(0)
    if asks_for_help(arguments):
        return partial(_without_configuration(train), recipe=recipe)
    return partial(train, recipe=recipe, config=config)


def _config_of_student(given: Namespace) -> TrainConfig:
    """Return the configuration that follows from a student's teacher and cameras."""
    from xreset.learning.train import config_of_student

    for name in ("recipe", "weights"):
        if getattr(given, name):
            raise RunError(
                f"The configuration of a student follows from its teacher. Omit --{name}."
            )
    return config_of_student(given.teacher, given.camera or "front")


def _without_configuration(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command whose help leaves out the configuration, which has a help of its own."""

    @wraps(command)
    def short(**options: Any) -> None:
        command(**options)

    whole = signature(command)
    kept = [each for each in whole.parameters.values() if each.name != "config"]
    vars(short)["__signature__"] = whole.replace(parameters=kept)
    return short


def _show_config(part: str, config: TrainConfig) -> None:
    """Print the options of a part of the configuration, such as ``task.reward``; or, without a part, all parts."""
    import tyro

    from xreset.cli._options import RULES

    parts = {"all": config, **dict(_parts(config))}
    if part and part not in parts:
        raise RunError(f"The configuration has no part {part!r}. Choose from: {', '.join(parts)}.")
    if not part:
        show_table([("PART", "options"), *((name, _summary(each)) for name, each in parts.items())])
        return

    def options(chosen: Any) -> None: ...

    named = Annotated[
        type(parts[part]), tyro.conf.arg(name="config" if part == "all" else f"config.{part}")
    ]
    options.__annotations__["chosen"] = named
    options.__defaults__ = (parts[part],)
    tyro.cli(options, prog="xreset train", args=["--help"], registry=RULES)


def _parts(config: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the names of a configuration's parts, and the parts, in order."""
    for field in fields(config):
        value = getattr(config, field.name)
        if is_dataclass(value):
            yield prefix + field.name, value
            yield from _parts(value, f"{prefix}{field.name}.")


def _summary(part: Any) -> str:
    return (inspect.getdoc(type(part)) or "").partition("\n")[0]
