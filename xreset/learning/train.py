"""Train a policy: reset bank or goal set in, run folder out."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from xreset.cameras.config import (
    CAMERAS,
    STUDENT_VISION,
    CameraConfig,
    VisionConfig,
    check_each_once,
)
from xreset.env.manipulation import make_env
from xreset.errors import PolicyError, RunError, Stopped, XResetError
from xreset.files.checks import Seed, obeys_rules
from xreset.files.storage import claim_folder, file_hash, write_whole
from xreset.files.text import shown
from xreset.learning.config import TrainConfig
from xreset.learning.distributed import Processes, leave
from xreset.learning.export import export_checkpoint
from xreset.learning.exported import read_policy
from xreset.learning.recipes import (
    default_config,
    from_home,
    own_terms_flags,
    starting_config,
    student_config,
)
from xreset.learning.run import (
    TEACHER,
    RunInfo,
    checkpoints,
    flat,
    latest_checkpoint,
    read_run,
    training_left,
    write_run,
)
from xreset.learning.runner import TrainingRunner
from xreset.physics.plugins import backend_class, device_for
from xreset.policy.onnx_policy import OnnxPolicy, check_contract, policy_contract
from xreset.policy.shipped import shipped
from xreset.resets.bank import ResetBank, read_bank, write_bank
from xreset.resets.goals import GoalSet, read_goals, with_goals, write_goals
from xreset.resets.inputs import Inputs, load_inputs
from xreset.task.rewards import RewardFunction


@obeys_rules
def train(
    bank: str | Path | ResetBank | None = None,
    *,
    out: str | Path,
    goals: str | Path | GoalSet | None = None,
    recipe: str | None = None,
    config: TrainConfig | None = None,
    robot: str | Path | None = None,
    meshes: str | Path | None = None,
    engine: str = "mujoco-warp",
    device: str | None = None,
    num_envs: int = 4096,
    iterations: int | None = None,
    minutes: float = math.inf,
    seed: Seed = 0,
    weights: str | Path | None = None,
    teacher: str | Path | None = None,
    wandb: str | None = None,
) -> Path:
    """Train a policy, and export it as ``policy.onnx`` in the run folder.

    If the folder holds this very training already, stopped or killed, the training goes on from its newest checkpoint;
    if it is finished, nothing is trained. So a job may give the same command, or call, again and again.

    With ``torchrun``, every process simulates ``num_envs`` worlds of its own, each on its own GPU, or all on the CPU.

    Args:
        bank: reset bank, or its file. A bank without a file is written to ``resets.npz`` in the run folder. None: there
            are no demonstrated states, and every episode begins at home.
        out: run folder to make, or to continue.
        goals: goal set, or its file. With a bank, its starts and goals are added to the demonstrated ones.
        recipe: where the configuration comes from: a recipe such as ``paper``, a TOML file of the user's own, or
            another run's folder. Reward terms of the user's own are not taken from a file or a run: name them in
            ``config``. Default: the recipe of the headline results; with ``weights`` and ``goals``, the run of
            ``weights``.
        config: the whole configuration, instead of a recipe.
        robot: name or folder of the robot; default: the robot that the bank names.
        meshes: folder of object meshes; default: the built-in stand-ins.
        engine: name of the physics engine.
        device: cpu or cuda; default: cuda if there is a GPU that the engine can use.
        num_envs: number of worlds, in each process.
        iterations: number of iterations; default: as configured.
        minutes: most time of the whole training, without compiling kernels; a run that continues has the rest of it.
        seed: seed of every random number.
        weights: another run's folder, whose networks are the start; default: new networks.
        teacher: policy whose actions the new one learns instead of learning from rewards; see :func:`distill`.
        wandb: project of Weights & Biases to which learning curves and configuration are sent; default: nothing is
            sent.

    Returns:
        The run folder, which ``xreset.load_policy`` reads.

    Raises:
        Stopped: a signal ended the training early; a checkpoint and the policy are written.
        RunError: the folder holds another training, there is no state to reset to, ``weights`` has no checkpoint of
            networks like these, or there is too little memory.
        PolicyError: ``weights`` is of another robot, or its policy observes something else.
        XResetError: bank, robot, objects and configuration do not fit together.
    """
    out = Path(out)
    if config is not None and recipe is not None:
        raise XResetError("Both recipe and config are given. Give one of them.")
    if recipe is not None:
        config = starting_config(recipe)
    elif config is None:
        _, config = default_config(goals, weights)
    if iterations is not None:
        config = replace(config, iterations=iterations)
    present = read_run(out) if checkpoints(out) else None
    if device is None:
        here = device_for(engine, "cuda" if torch.cuda.is_available() else "cpu")
        device = here if present is None else present.device
    if num_envs < 1:
        raise RunError(f"num_envs is {num_envs}, expected at least 1.")
    _check_minutes(minutes)
    if device_for(engine, device) != device:
        raise RunError(
            f"The engine {engine!r} does not run on {device!r}. Omit the device, or choose another engine."
        )
    data = _bank_or_goals(bank, goals)
    load = partial(load_inputs, robot=robot, meshes=meshes, accept=("bank", "goals"))
    inputs = load(data)
    if isinstance(inputs.data, GoalSet):
        config = from_home(config)
    _check_config(config, inputs, has_teacher=teacher is not None)
    version = backend_class(engine).engine_version()  # fails where the engine is missing
    start = None
    if weights is not None:
        start = _checkpoint_to_start_from(Path(weights), inputs, config)
    teacher_policy = None if teacher is None else read_policy(teacher)
    if teacher_policy is not None:
        _check_teacher(teacher_policy, inputs, config)
    info = RunInfo(
        robot=str(inputs.robot_name),
        resets=str(inputs.path),
        resets_hash=str(inputs.hash),
        meshes=str(inputs.meshes) if inputs.meshes else None,
        engine=engine,
        engine_version=version,
        device=device,
        num_envs=num_envs,
        seed=seed,
        config=config,
        contract=policy_contract(inputs.robot, config.task, tuple(o.name for o in inputs.objects)),
        weights=str(start) if start else None,
        weights_hash=file_hash(start) if start else None,
        teacher=str(teacher) if teacher else None,
    )
    if present is not None:
        if not isinstance(data, str | Path):
            info = replace(info, resets_hash=_hash_of(data))
        _refuse_another_training(out, present, info, teacher_policy)
        own = config.task.reward.own
        return resume(out, iterations=config.iterations, minutes=minutes, own=own, wandb=wandb)
    with _new_run(out):
        if teacher_policy is not None:
            write_whole(out / TEACHER, teacher_policy.content)
        # the training reads its own file, so that it has the same data as a resumed one, and values are checked
        if not isinstance(data, str | Path):
            path = out / ("goals.npz" if isinstance(data, GoalSet) else "resets.npz")
            _write_data(path, data)
            inputs = load(path)
            info = replace(info, resets=str(inputs.path), resets_hash=str(inputs.hash))
        with _cleanly(out, info):
            _train(out, info, inputs, minutes=minutes, resumed=False, wandb=wandb)
    return out


def _write_data(path: Path, data: ResetBank | GoalSet) -> None:
    if isinstance(data, GoalSet):
        write_goals(path, data)
    else:
        write_bank(path, data)


def _hash_of(data: ResetBank | GoalSet) -> str:
    """Return the hash that the file of a bank or a goal set has in a run folder."""
    with TemporaryDirectory() as folder:
        path = Path(folder, "data.npz")
        _write_data(path, data)
        return file_hash(path)


def _refuse_another_training(
    out: Path, present: RunInfo, wanted: RunInfo, teacher: OnnxPolicy | None
) -> None:
    """Refuse to continue the run in a folder as a training that it is not. Its length may differ."""
    before = _identity(present, file_hash(out / TEACHER) if present.teacher else None)
    now = _identity(wanted, teacher.hash if teacher else None)
    for name, value in before.items():
        if now.get(name) != value:
            raise RunError(
                f"{out} holds another training: {name} is {shown(value)} there and {shown(now.get(name))} here. Choose "
                "another folder, or continue it as it was started (xreset.resume or --resume)."
            )


def _identity(info: RunInfo, teacher: str | None) -> dict[str, Any]:
    """Return what makes a training the same one, by name; ``teacher`` is the hash of its teacher's policy."""
    config = dict(flat(asdict(info.config)))
    del config["iterations"], config["save_interval"]
    return {
        "robot": str(Path(info.robot).resolve()),
        "hash of the reset bank": info.resets_hash,
        "meshes": str(Path(info.meshes).resolve()) if info.meshes else None,
        "engine": info.engine,
        "device": info.device,
        "num_envs": info.num_envs,
        "seed": info.seed,
        "hash of the weights": info.weights_hash,
        "hash of the teacher": teacher,
    } | config


def resume(
    out: str | Path,
    *,
    iterations: int | None = None,
    minutes: float = math.inf,
    own: Mapping[str, Mapping[str, Any]] | None = None,
    wandb: str | None = None,
) -> Path:
    """Continue a run from its newest checkpoint, and export its policy; see :func:`train`.

    Args:
        out: the run's folder.
        iterations: number of iterations in all; default: as the run was started.
        minutes: most time of the whole training, as for :func:`train`.
        own: the user's own reward terms with which the run was started: name -> parameters. They name code to import,
            which a file must not decide.
        wandb: as for :func:`train`.

    Raises:
        Stopped: as for :func:`train`.
        RunError: the run has other reward terms of the user's own, the bank is not the run's, the newest checkpoint
            does not fit, another process is training here, or there is too little memory.
        PolicyError: the robot has changed, or the policy observed something else in an earlier version of xreset.
    """
    _check_minutes(minutes)
    out = Path(out)
    info = read_run(out)
    expected = info.config.task.reward.own
    if expected != dict(own or {}):
        fix = f"add {own_terms_flags(expected)} (or own={expected})" if expected else "omit them"
        raise RunError(
            f"{out} was trained with {len(expected)} reward terms of your own, but {len(own or {})} were named. "
            f"A run folder must not decide which code is imported. If you trust this code, {fix}."
        )
    if iterations is not None:
        info = replace(info, config=replace(info.config, iterations=iterations))
    if checkpoints(out) and not training_left(out, info.config.iterations, minutes):
        print(
            f"{out} is trained. To prolong the training, give more --iterations (or --minutes).",
            flush=True,
        )
        with _claimed(out):
            _export(out)
        return out
    inputs = load_inputs(
        info.resets, robot=info.robot, meshes=info.meshes, accept=("bank", "goals")
    )
    if inputs.hash != info.resets_hash:
        raise RunError(
            f"{info.resets} is not the file that this run was started with. Put it back, or start a new run."
        )
    check_contract(str(out), info.contract, inputs.robot, info.config.task)
    with _claimed(out), _cleanly(out, info):
        _train(out, info, inputs, minutes=minutes, resumed=True, wandb=wandb)
    return out


def distill(
    teacher: str | Path,
    bank: str | Path | ResetBank | None,
    *,
    out: str | Path,
    cameras: str | CameraConfig | Sequence[str | CameraConfig] = "front",
    vision: VisionConfig | None = None,
    config: TrainConfig | None = None,
    **options: Any,
) -> Path:
    """Train a policy that sees, by imitating one that is told the object's pose and shape (DAgger).

    The student gets what its cameras show, the joints and the goal. It learns in the teacher's own task, with cameras.

    Args:
        teacher: run folder, exported policy (.onnx) or name of a policy that ships with xreset.
        bank: reset bank, or its file; None: with ``goals``, as for :func:`train`.
        out: run folder to make.
        cameras: name of one of :data:`xreset.cameras.config.CAMERAS`, or a camera; or several.
        vision: images, their timing and what the student gets of them; its cameras are replaced by ``cameras``.
            Default: points, and the object at its goal.
        config: the whole configuration, cameras included; default: :func:`xreset.learning.recipes.student_config`.
        options: keywords of :func:`train`: robot, objects, engine, device, num_envs, iterations, minutes and seed.

    Returns:
        The run folder, which ``xreset.load_policy`` reads; the teacher is in it as ``teacher.onnx``.

    Raises:
        PolicyError: the teacher is unknown, sees itself, or is for another robot.
        XResetError: a camera is unknown, given twice or inside a body, no camera ever shows some object, the images
            have fewer pixels than points, or the renderer cannot start.
    """
    if config is None:
        config = config_of_student(teacher, cameras, vision)
    if not config.task.vision.cameras:
        raise XResetError(
            "A student needs a camera. Give one or two of: " + ", ".join(CAMERAS) + "."
        )
    check_each_once(config.task.vision.cameras)
    return train(bank, out=out, config=config, teacher=teacher, **options)


def config_of_student(
    teacher: str | Path,
    cameras: str | CameraConfig | Sequence[str | CameraConfig] = "front",
    vision: VisionConfig | None = None,
) -> TrainConfig:
    """Return the configuration of a distillation; arguments and errors as of :func:`distill`."""
    wanted = [cameras] if isinstance(cameras, str | CameraConfig) else cameras
    chosen = tuple(_camera(each) for each in wanted)
    try:
        vision = replace(vision or STUDENT_VISION, cameras=chosen)
    except ValueError as error:
        raise XResetError(
            f"vision.{error}. Give fewer points, or a larger width and height."
        ) from None
    return student_config(read_policy(teacher).contract.task, vision)


def _bank_or_goals(
    bank: str | Path | ResetBank | None, goals: str | Path | GoalSet | None
) -> str | Path | ResetBank:
    """Return a bank or a goal set, as they were given, or a bank with the goals of both."""
    if bank is not None and goals is not None:
        bank = bank if isinstance(bank, ResetBank) else read_bank(bank)
        bank = with_goals(bank, goals if isinstance(goals, GoalSet) else read_goals(goals))
    given = goals if bank is None else bank
    if given is None:
        raise RunError("A training needs a reset bank (--resets), a goal set (--goals), or both.")
    return given


def _check_minutes(minutes: float) -> None:
    if not minutes > 0:
        raise RunError(f"minutes is {minutes}, expected more than 0.")


def _check_config(config: TrainConfig, inputs: Inputs, *, has_teacher: bool) -> None:
    """Refuse, with ``XResetError``, a schedule without effect, bank states where there are none, and unknown terms of
    the reward."""
    RewardFunction(config.task.reward)
    if config.schedule.teacher and not has_teacher:
        raise RunError(
            "schedule.teacher is for students (--teacher), and this training has no teacher. Leave it empty: "
            "--config.schedule.teacher without a value"
        )
    if config.task.reset.demo_probability > 0 and not inputs.bank.num_states:
        raise RunError(
            f"There is no state to reset to in {inputs.name}: every candidate was rejected. Look at its reasons "
            "(xreset resets), or train without it: --config.task.reset.demo-probability 0"
        )


def _checkpoint_to_start_from(run: Path, inputs: Inputs, config: TrainConfig) -> Path:
    """Return the newest checkpoint of another run, whose networks must be like those of this run."""
    if run.suffix == ".onnx" or (not run.exists() and str(run) in shipped()):
        raise RunError(
            f"{run} has no critic and no checkpoint, so no training can start from it. Give a run folder (--weights)."
        )
    other = read_run(run)
    if other.teacher is not None:
        raise RunError(
            f"{run} is the run of a student (--teacher) and has no critic, so no training can start from it. Give "
            f"another run (--weights), or continue the student: --out {run} --resume"
        )
    start = f"Start from its configuration, with recipe=... or --recipe {run}"
    try:
        check_contract(str(run), other.contract, inputs.robot, config.task)
    except PolicyError as error:
        if other.contract.robot != inputs.robot.name:
            raise
        raise PolicyError(f"{error} {start}") from error
    layers = config.model.layers
    differing = [name for name, value in other.config.model.layers.items() if value != layers[name]]
    if differing:
        theirs = {name: other.config.model.layers[name] for name in differing}
        ours = {name: layers[name] for name in differing}
        raise RunError(
            f"The networks of {run} have the layers {theirs}, this run's {ours}. {start}"
        )
    return latest_checkpoint(run)


def _check_teacher(teacher: OnnxPolicy, inputs: Inputs, config: TrainConfig) -> None:
    """Refuse the policy of a teacher that does not fit the robot and the task."""
    contract = teacher.contract
    if contract.task.vision.cameras:
        raise PolicyError(
            f"{teacher.path} sees through cameras itself. Give a teacher that is told pose and shape."
        )
    check_contract(
        str(teacher.path), contract, inputs.robot, replace(config.task, vision=VisionConfig())
    )


def _camera(camera: str | CameraConfig) -> CameraConfig:
    """Return a camera, or the one of a name."""
    if isinstance(camera, CameraConfig):
        return camera
    if camera not in CAMERAS:
        raise XResetError(f"Unknown camera {shown(camera)}. Choose from: {', '.join(CAMERAS)}.")
    return CAMERAS[camera]


@contextmanager
def _claimed(out: Path) -> Iterator[None]:
    """Let no other training write the run folder."""
    with ExitStack() as stack:
        if Processes.of_environment().is_main:
            stack.enter_context(claim_folder(out))
            stack.enter_context(claim_folder(out / "checkpoints"))
        yield


@contextmanager
def _new_run(out: Path) -> Iterator[None]:
    """Like :func:`_claimed`; leave nothing new in the folder if the run does not get its ``run.json``."""
    written = (out / TEACHER, out / "goals.npz", out / "resets.npz", out / "checkpoints", out)
    new = [path for path in written if not path.exists()]
    with _claimed(out):
        try:
            yield
        finally:
            if Processes.of_environment().is_main and not (out / "run.json").exists():
                for path in new:
                    with suppress(OSError):  # not written yet, or a folder with other files
                        path.rmdir() if path.is_dir() else path.unlink()


_MANY_ON_A_CPU = 256
"""More worlds than these keep a CPU busy for minutes in each iteration."""
_NO_MEMORY = re.compile("Failed to allocate|out of memory")
"""How Warp reports too little memory, as a ``RuntimeError``."""


@contextmanager
def _cleanly(out: Path, info: RunInfo) -> Iterator[None]:
    """Say what to do if there is too little memory, and leave the process's global state as it was."""
    if info.device == "cpu" and info.num_envs > _MANY_ON_A_CPU:
        print(
            f"With {info.num_envs:,} worlds on a CPU, an iteration takes minutes. Train on a GPU; to see that a "
            "training runs, 8 worlds are enough (--num-envs 8).",
            file=sys.stderr,
        )
    with ExitStack() as stack:
        stack.callback(torch.set_float32_matmul_precision, torch.get_float32_matmul_precision())
        if not torch.distributed.is_initialized():
            stack.callback(leave)
        try:
            yield
        except (MemoryError, RuntimeError) as error:
            if isinstance(error, RuntimeError) and not _NO_MEMORY.search(str(error)):
                raise
            state = "no checkpoint was written"
            if checkpoints(out):
                state = "the last checkpoint can be used"
            raise RunError(
                f"{info.num_envs} worlds on {info.device} need more memory than there is; {state}. "
                "Start with fewer (--num-envs), or smaller minibatches (--config.ppo.minibatch-size), in another --out."
            ) from error


def _train(
    out: Path,
    info: RunInfo,
    inputs: Inputs,
    *,
    minutes: float,
    resumed: bool,
    wandb: str | None,
) -> None:
    """Train from the newest checkpoint, from the networks of ``weights`` or from new ones, and export the policy."""
    processes = Processes.of_environment()
    device = processes.device(info.device)
    newest = latest_checkpoint(out) if resumed and checkpoints(out) else None
    # a run that continues draws other numbers than it began with
    seed = processes.seed(info.seed) + (0 if newest is None else int(newest.stem))
    if device.startswith("cuda:"):
        torch.cuda.set_device(device)
    torch.manual_seed(seed)
    with make_env(
        inputs.robot,
        inputs.objects,
        inputs.bank,
        info.config.task,
        engine=info.engine,
        num_envs=info.num_envs,
        device=device,
        seed=seed,
    ) as env:
        if env.vision is not None:
            env.vision.check_sees_objects()
        teacher = out / TEACHER if info.teacher else None
        runner = TrainingRunner(env, info.config, out, teacher=teacher, wandb=wandb)
        if newest is not None:
            runner.load_checkpoint(newest)
        elif info.weights is not None:
            runner.load_networks(Path(info.weights))
        if processes.is_main:
            _write_start(out, info, runner.iteration, is_new=newest is None, resumed=resumed)
        stopped_by = runner.learn(info.config.iterations, seconds=60 * minutes)
    _export(out)
    if stopped_by is not None:
        raise Stopped(stopped_by)


def _export(out: Path) -> None:
    """Export the policy of the newest checkpoint, in the main process."""
    if Processes.of_environment().is_main:
        newest = latest_checkpoint(out)
        policy = out / "policy.onnx"
        export_checkpoint(newest, policy)
        print(f"policy after {int(newest.stem)} iterations in {policy}", flush=True)


def _write_start(out: Path, info: RunInfo, iteration: int, *, is_new: bool, resumed: bool) -> None:
    """Write ``run.json``, and say where a resumed run continues."""
    # A run that was killed before its first checkpoint begins again, so its curves are deleted. Curves in a folder
    # without run.json are somebody else's.
    if is_new and (out / "run.json").is_file():
        for events in out.glob("events.out.tfevents.*"):
            events.unlink()
    stated = read_run(out, as_stated=True) if resumed else info
    write_run(out, replace(stated, config=info.config))
    if resumed:
        done = f"continuing after iteration {iteration}"
        if is_new:
            done = "there is no checkpoint yet: starting from the beginning"
        print(done, flush=True)
