"""``train``, a function and a command: its signature has the options, its docstring the help.

It imports most of what it needs when it is called, because the help of a command is shown at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from xreset.cameras.config import CameraConfig
from xreset.errors import RunError, XResetError
from xreset.files.checks import Option, Output, PositiveFloat, PositiveInt, Seed, obeys_rules
from xreset.learning.config import TrainConfig
from xreset.learning.recipes import for_robots, from_home, starting_config
from xreset.learning.run import RobotData, RunInfo, checkpoints, read_run
from xreset.physics.plugins import Device, EngineName, RobotName, backend_class, device_for

if TYPE_CHECKING:
    from xreset.resets.bank import ResetBank
    from xreset.resets.goals import GoalSet
    from xreset.resets.inputs import Inputs
    from xreset.spec import RobotSpec
else:  # a command has files in place of these
    ResetBank = GoalSet = Any

ENGINE = "mujoco-warp"
"""Where trainings run if nothing is said."""
_WORLDS = 4096
_WORLDS_OF_STUDENT = 1024


@obeys_rules
def train(
    bank: Annotated[str | Path | ResetBank | Sequence[str | Path] | None, Option("resets")] = None,
    *,
    out: Output,
    robot: RobotName | None = None,
    goals: str | Path | GoalSet | None = None,
    meshes: str | Path | None = None,
    engine: EngineName | None = None,
    device: Device | None = None,
    num_envs: PositiveInt | None = None,
    iterations: PositiveInt | None = None,
    minutes: PositiveFloat | None = None,
    seed: Seed | None = None,
    recipe: str | Path | None = None,
    weights: str | Path | None = None,
    teacher: str | Path | None = None,
    cameras: Annotated[str | CameraConfig | Sequence[str | CameraConfig], Option("camera")] = (),
    wandb: str | None = None,
    config: TrainConfig | None = None,
) -> Path:
    """Train a policy by its rewards; or a student that sees the object, which imitates a teacher that is told its pose.

    The same command continues a training that was stopped or killed, and does nothing if it is finished. So does the
    command with no other options than --out, iterations and minutes, and reward terms of your own. After a signal, it
    writes a checkpoint and exits with 128 and the signal's number: 130 after Ctrl-C, 143 after SIGTERM.

    Args:
        bank: reset bank, made by xreset resets. With a goal set and no bank, every episode begins at home. With the
            banks of several robots, one policy learns all of them, each in an equal share of the worlds.
        out: run folder to make, or to continue.
        robot: name or folder of the robot; default: that of the bank or of the goal set.
        goals: goal set, made by xreset goals. With a bank, its starts and goals are added to the demonstrated ones.
        meshes: folder of real meshes; default: that of the bank, else the stand-ins.
        engine: physics engine to train on; default: mujoco-warp.
        device: where to train: cpu or cuda; default: cuda where there is a GPU and the engine can use it.
        num_envs: worlds to simulate (per GPU); default: 4096, for a student 1024.
        iterations: iterations of the whole training; default: the configuration's, unless minutes are given.
        minutes: time of the whole training, without compiling kernels: a run that continues has the rest of it. With
            iterations and minutes, the training ends with what is reached first.
        seed: seed of every random number; default: 0.
        recipe: where the configuration starts from: a recipe (default, any_object, live, paper, published), a TOML file
            of your own with the tables that it changes (docs/clusters.md), or another run's folder, or a policy.
            Options --config.* change it; see them with xreset train --help-config [PART]. Reward terms of your own are
            not taken from a file or a run; name them again. Default: the recipe of the headline results; with weights,
            that of the weights.
        weights: another run's folder: start with the networks of its newest checkpoint, actor and critic, including the
            standard deviation of the actions and the learning rate. Or many-objects, a policy that ships with a
            checkpoint.
        teacher: run folder, exported policy (.onnx), or name of a policy that ships with xreset: a student learns its
            actions, in its task, from what cameras show (DAgger). Options of the images: --teacher NAME
            --help-config task.vision.
        cameras: camera of a student: front, side, or wrist, or two of them; default: front.
        wandb: project of Weights & Biases to which learning curves are sent as well. Needs the package wandb, and a
            login. Its variables, such as WANDB_RUN_GROUP and WANDB_MODE=offline, say the rest.
        config: task, model and algorithm. The defaults shown are those of the recipe. Terms of rewards and
            observations: --config.task.reward.terms.reach.width 0.4.

    Returns:
        The run folder, which ``xreset.load_policy`` reads. The policy is in it as ``policy.onnx``, a bank without a
        file as ``resets.npz``, a student's teacher as ``teacher.onnx``.

    Raises:
        Stopped: a signal ended the training early; a checkpoint and the policy are written.
        RunError: the folder holds another training, there is no state to reset to, ``weights`` has no checkpoint of
            networks like these, or there is too little memory.
        PolicyError: ``weights`` is of another robot, or its policy observes something else; or the teacher is unknown,
            sees itself, or is for another robot.
        XResetError: bank, robot, objects and configuration do not fit together; or a camera is unknown, given twice or
            inside a body, or never shows some object.
    """
    from xreset.resets.goals import GoalSet
    from xreset.resets.inputs import load_inputs

    out = Path(out)
    first, others = _first_and_others(bank, robot, goals, teacher)
    length = {"iterations": iterations, "minutes": minutes, "wandb": wandb}
    if first is None and goals is None:
        given = {"robot": robot, "meshes": meshes, "engine": engine, "device": device}
        given |= {"num_envs": num_envs, "seed": seed, "teacher": teacher}
        given |= {"recipe": recipe, "weights": weights, "cameras": cameras or None}
        from xreset.learning import train as training

        training.refuse_options(out, given, config)
        own = config.task.reward.own if config else None
        return training.resume(out, own=own, **length)
    config = _configuration(config, recipe, weights, teacher, cameras)
    if num_envs is None:
        num_envs = _WORLDS if teacher is None else _WORLDS_OF_STUDENT
    # before torch is imported and meshes are cut
    for source in (first, *others):
        _check_worlds(source, goals, num_envs // (1 + len(others)), config)
    from xreset.learning import train as training
    from xreset.learning.log import wandb_init
    from xreset.policy.onnx_policy import policy_contract

    if wandb is not None:
        wandb_init()  # fails where the package is missing

    present = read_run(out) if checkpoints(out) else None
    engine = engine or ENGINE
    device = _device(device, engine, present)
    data = training.bank_or_goals(first, goals)
    accept = "goals" if first is None else "bank"
    load = partial(load_inputs, robot=robot, meshes=meshes, accept=(accept,))
    inputs = load(data)
    if isinstance(inputs.data, GoalSet):
        config = from_home(config)
    loaded = [inputs, *map(load, others)]
    robots = [each.robot for each in loaded]
    if others:
        config = for_robots(config, _different(robots))
    for each in loaded:
        training.check_config(config, each, has_teacher=teacher is not None)
    version = backend_class(engine).engine_version()  # fails where the engine is missing
    start = None
    if weights is not None:
        start = training.networks_to_start_with(weights, robots, config)
    teacher_policy = None
    if teacher is not None:
        teacher_policy = training.read_teacher(teacher, inputs, config)
    info = RunInfo(
        **vars(_robot_data(inputs)),
        engine=engine,
        engine_version=version,
        device=device,
        num_envs=num_envs,
        seed=seed or 0,
        config=config,
        contract=policy_contract(inputs.robot, config.task, _object_names(loaded), robots[1:]),
        weights=str(start[0]) if start else None,
        weights_hash=start[1] if start else None,
        teacher=str(teacher) if teacher else None,
        others=tuple(map(_robot_data, loaded[1:])),
        iterations=iterations,
        minutes=minutes,
    )
    if present is None:
        training.start(out, info, data, load, loaded[1:], teacher_policy, wandb=wandb)
        return out
    if not isinstance(data, str | Path):
        info = replace(info, resets_hash=training.hash_of(data))
    training.refuse_another_training(out, present, info, teacher_policy)
    length["iterations"] = info.total
    return training.resume(out, own=config.task.reward.own, **length)


def _first_and_others(
    bank: Any, robot: Any, goals: Any, teacher: Any
) -> tuple[Any, Sequence[str | Path]]:
    """Return the first of the reset banks, and those of other robots, which exclude some arguments of :func:`train`."""
    if not isinstance(bank, list | tuple):
        return bank, ()
    if not bank:
        return None, ()
    if len(bank) == 1:
        return bank[0], ()
    for name, value in (("robot", robot), ("goals", goals), ("teacher", teacher)):
        if value is not None:
            raise RunError(
                f"{len(bank)} reset banks and {name} are given. A policy for several robots learns each robot from "
                f"the bank that names it. Omit {name}, or give one bank."
            )
    if not all(isinstance(each, str | Path) for each in bank):
        raise RunError("Several reset banks must be files. Write them with xreset.write_bank.")
    return bank[0], bank[1:]


def _check_worlds(bank: Any, goals: Any, num_envs: int, config: TrainConfig) -> None:
    """Refuse, with ``XResetError``, an object of a bank, of a goal set or of both that would get none of the worlds."""
    from xreset.resets.bank import ResetBank
    from xreset.resets.goals import GoalSet
    from xreset.resets.inputs import read_data
    from xreset.resets.schedule import shared_worlds

    names: dict[str, None] = {}
    for given in (bank, goals):
        data = read_data(Path(given), ("bank", "goals")) if isinstance(given, str | Path) else given
        if given is bank and isinstance(data, GoalSet):
            raise RunError(
                f"{given if isinstance(given, str | Path) else 'bank'} is a goal set, expected a reset bank. "
                "Give it as goals: --goals"
            )
        if isinstance(data, ResetBank):  # a goal set, too
            names |= dict.fromkeys(data.object_names)
    shared_worlds(tuple(names), num_envs, config.task.reset.object_share)


def _different(robots: Sequence[RobotSpec]) -> Sequence[RobotSpec]:
    """Return the robots; ``RunError`` if two have the same name."""
    names = [robot.name for robot in robots]
    if len(set(names)) < len(names):
        raise RunError(
            f"The reset banks are for {', '.join(names)}, expected another robot for each. Put all demonstrations of "
            "a robot into one bank."
        )
    return robots


def _object_names(loaded: Sequence[Inputs]) -> tuple[str, ...]:
    """Return the names of all objects of a training, those of the first robot first."""
    names: dict[str, None] = {}
    for each in loaded:
        names |= dict.fromkeys(o.name for o in each.objects)
    return tuple(names)


def _robot_data(inputs: Inputs) -> RobotData:
    return RobotData(
        robot=str(inputs.robot_name),
        resets=str(inputs.path),
        resets_hash=str(inputs.hash),
        meshes=str(inputs.meshes) if inputs.meshes else None,
    )


def _configuration(
    config: TrainConfig | None,
    recipe: str | Path | None,
    weights: str | Path | None,
    teacher: str | Path | None,
    cameras: str | CameraConfig | Sequence[str | CameraConfig],
) -> TrainConfig:
    """Return the configuration that was given, or the one that the other arguments of :func:`train` decide."""
    if teacher is not None and (recipe is not None or weights is not None):
        given = "weights" if recipe is None else "recipe"
        raise RunError(f"The configuration of a student follows from its teacher. Omit {given}.")
    if cameras and teacher is None:
        raise RunError(
            "Cameras are for students, and there is no teacher. Add --teacher, or omit --camera."
        )
    if config is not None and recipe is not None:
        raise XResetError("Both recipe and config are given. Give one of them.")
    if config is not None:
        return config
    if teacher is not None:
        from xreset.learning.train import config_of_student

        return config_of_student(teacher, cameras or "front")
    return starting_config(str(recipe or weights or "default"))


def _device(device: str | None, engine: str, present: RunInfo | None) -> str:
    """Return where to train: the given device, that of the run in the folder, or the best for the engine."""
    from xreset.learning.train import default_device

    if device is None:
        return default_device(engine) if present is None else present.device
    if device_for(engine, device) != device:
        raise RunError(
            f"The engine {engine!r} does not run on {device!r}. Omit the device, or choose another engine."
        )
    return device
