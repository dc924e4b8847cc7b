"""Train a policy: its parts, from the data to the run folder."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from xreset.cameras.config import (
    CAMERAS,
    CameraConfig,
    VisionConfig,
    camera_of,
    check_each_once,
)
from xreset.env.manipulation import make_env
from xreset.env.several import SeveralEnvs
from xreset.errors import PolicyError, RunError, Stopped, XResetError
from xreset.files.storage import claim_folder, file_hash, write_whole
from xreset.files.text import quantity, shown
from xreset.learning.config import TrainConfig
from xreset.learning.distributed import Processes, leave
from xreset.learning.export import export_checkpoint
from xreset.learning.exported import read_policy
from xreset.learning.from_onnx import layers_of
from xreset.learning.recipes import is_policy, own_terms_flags, student_config, without_own
from xreset.learning.run import (
    TEACHER,
    RunInfo,
    checkpoints,
    differences,
    latest_checkpoint,
    read_run,
    training_left,
    write_run,
)
from xreset.learning.runner import TrainingRunner
from xreset.physics.plugins import device_for, existing_device
from xreset.policy.onnx_policy import OnnxPolicy, check_contract
from xreset.policy.shipped import shipped_checkpoints, shipped_name
from xreset.resets.bank import ResetBank, read_bank, write_bank
from xreset.resets.goals import GoalSet, read_goals, with_goals, write_goals
from xreset.resets.inputs import Inputs, load_inputs
from xreset.spec import RobotSpec
from xreset.task.rewards import RewardFunction
from xreset.task.slots import Slots


def default_device(engine: str) -> str:
    """Return the GPU that ``cuda`` means if the engine can use it, else cpu."""
    return existing_device(device_for(engine, "cuda" if torch.cuda.is_available() else "cpu"))


def write_data(folder: Path, data: ResetBank | GoalSet) -> Path:
    """Write a bank or a goal set into a run folder, and return its file."""
    if isinstance(data, GoalSet):
        path = folder / "goals.npz"
        write_goals(path, data)
    else:
        path = folder / "resets.npz"
        write_bank(path, data)
    return path


def hash_of(data: ResetBank | GoalSet) -> str:
    """Return the hash that the file of a bank or a goal set has in a run folder."""
    with TemporaryDirectory() as folder:
        return file_hash(write_data(Path(folder), data))


def refuse_options(out: Path, given: Mapping[str, Any], config: TrainConfig | None) -> None:
    """Refuse, with ``RunError``, to continue without data where there is no run, or with other options than it was
    started with: of the configuration, only the user's own reward terms may be named.

    Args:
        out: the run's folder.
        given: values of further options by name; None: not given.
        config: configuration.
    """
    if not (out / "run.json").is_file():
        raise RunError(
            f"A training needs a reset bank (--resets), a goal set (--goals), or both; {out} holds no run to continue."
        )
    only_own = config and config.task.reward.own and without_own(config) == TrainConfig()
    if not only_own:
        given = {**given, "config": config}
    for name, value in given.items():
        if value is not None:
            raise RunError(
                f"Without a reset bank or a goal set, {out} continues as it was started. Omit {name}, give the whole "
                f"command again, or start another run with this run's networks: --weights {out}"
            )


def refuse_another_training(
    out: Path, present: RunInfo, wanted: RunInfo, teacher: OnnxPolicy | None
) -> None:
    """Refuse to continue the run in a folder as a training that it is not. Its length may differ."""
    before = _identity(present, file_hash(out / TEACHER) if present.teacher else None)
    now = _identity(wanted, teacher.hash if teacher else None)
    for name, there, here in differences(before, now):
        raise RunError(
            f"{out} holds another training: {name} is {shown(there)} there and {shown(here)} here. Choose another "
            f"folder, or continue it as it was started: xreset train --out {out}"
        )


def _identity(info: RunInfo, teacher: str | None) -> dict[str, Any]:
    """Return what makes a training the same one, by name; ``teacher`` is the hash of its teacher's policy."""
    config = asdict(info.config)
    del config["iterations"], config["save_interval"]
    return {
        "robot": str(Path(info.robot).resolve()) if Path(info.robot).is_dir() else info.robot,
        "hash of the reset bank": info.resets_hash,
        "meshes": str(Path(info.meshes).resolve()) if info.meshes else None,
        "engine": info.engine,
        "device": info.device,
        "num_envs": info.num_envs,
        "seed": info.seed,
        "hashes of the other banks": [other.resets_hash for other in info.others],
        "hash of the weights": info.weights_hash,
        "hash of the teacher": teacher,
    } | config


def resume(
    out: str | Path,
    *,
    iterations: int | None = None,
    minutes: float | None = None,
    own: Mapping[str, Mapping[str, Any]] | None = None,
    wandb: str | None = None,
) -> Path:
    """Continue a run from its newest checkpoint, and export its policy; see :func:`train`.

    Args:
        out: the run's folder.
        iterations: number of iterations in all.
        minutes: time of the whole training. With neither, the training ends as it was started to end.
        own: the user's own reward terms with which the run was started: name -> parameters. They name code to import,
            which a file must not decide.
        wandb: as for :func:`train`.

    Raises:
        Stopped: as for :func:`train`.
        RunError: the run has other reward terms of the user's own, the bank is not the run's, the newest checkpoint
            does not fit, another process is training here, or there is too little memory.
        PolicyError: the robot has changed, or the policy observed something else in an earlier version of xreset.
    """
    out = Path(out)
    info = read_run(out)
    expected = info.config.task.reward.own
    if expected != dict(own or {}):
        fix = f"add {own_terms_flags(expected)} (in Python: to config)" if expected else "omit them"
        raise RunError(
            f"{out} was trained with {quantity(len(expected), 'reward term')} of your own, but {len(own or {})} were"
            f" named. A run folder must not decide which code is imported. If you trust this code, {fix}."
        )
    if iterations is not None or minutes is not None:
        info = replace(info, iterations=iterations, minutes=minutes)
    if checkpoints(out) and not training_left(out, info.total, info.minutes):
        print(
            f"{out} is trained. To prolong the training, give more --iterations (or --minutes).",
            flush=True,
        )
        if Processes.of_environment().is_main:
            with _claimed(out):
                _export_if_missing(out)
        return out
    inputs = []
    for data in (info, *info.others):
        loaded = load_inputs(
            data.resets, robot=data.robot, meshes=data.meshes, accept=("bank", "goals")
        )
        if loaded.hash != data.resets_hash:
            raise RunError(
                f"{data.resets} is not the file that this run was started with. Put it back, or start a new run."
            )
        check_contract(str(out), info.contract, loaded.robot, info.config.task)
        inputs.append(loaded)
    with _claimed(out), cleanly(out, info):
        run_training(out, info, inputs, resumed=True, wandb=wandb)
    return out


def config_of_student(
    teacher: str | Path,
    cameras: str | CameraConfig | Sequence[str | CameraConfig] = "front",
) -> TrainConfig:
    """Return the configuration of a student of a teacher.

    Args:
        teacher: as for :func:`xreset.train`.
        cameras: name of one of :data:`xreset.cameras.config.CAMERAS`, or a camera; or several.

    Raises:
        PolicyError: the teacher is unknown.
        XResetError: a camera is unknown.
    """
    wanted = [cameras] if isinstance(cameras, str | CameraConfig) else cameras
    chosen = tuple(map(camera_of, wanted))
    return student_config(read_policy(teacher).contract.task, VisionConfig(cameras=chosen))


def bank_or_goals(
    bank: str | Path | ResetBank | None, goals: str | Path | GoalSet | None
) -> str | Path | ResetBank:
    """Return a bank or a goal set, as they were given, or a bank with the goals of both."""
    if bank is not None and goals is not None:
        bank = bank if isinstance(bank, ResetBank) else read_bank(bank)
        bank = with_goals(bank, goals if isinstance(goals, GoalSet) else read_goals(goals))
    given = goals if bank is None else bank
    assert given is not None, "one of them is given"
    return given


def check_config(config: TrainConfig, inputs: Inputs, *, has_teacher: bool) -> None:
    """Refuse, with ``XResetError``, bank states where there are none, unknown terms of the reward, a robot that does
    not fit into slots, and a student without cameras."""
    if has_teacher and not config.task.vision.cameras:
        raise XResetError(
            "A student needs a camera. Give one or two of: " + ", ".join(CAMERAS) + "."
        )
    check_each_once(config.task.vision.cameras)
    RewardFunction(config.task.reward)
    Slots.of(inputs.robot, config.task.joint_slots)
    reset = config.task.reset
    bank = inputs.bank
    if reset.pre_contact_only:
        bank = bank.with_states(~bank.post_contact)
    if reset.demo_probability > 0 and not bank.num_states:
        before = " before contact" if reset.pre_contact_only else ""
        raise RunError(
            f"There is no state{before} to reset to in {inputs.name}: every candidate was rejected. Look at its "
            "reasons (xreset resets), or train without it: --config.task.reset.demo-probability 0"
        )


def networks_to_start_with(
    weights: str | Path, robots: Sequence[RobotSpec], config: TrainConfig
) -> tuple[Path, str]:
    """Return the newest checkpoint of another run, or that of a policy that ships, whose networks must be like those of
    this run; and the hash of the file."""
    name = str(weights)
    if is_policy(name):
        policy = read_policy(name)
        checkpoint = shipped_checkpoints().get(shipped_name(name) or "")
        contract = policy.contract
        theirs = layers_of(policy).layers
        # the file tells of the actor alone
        del theirs["critic_mlp"], theirs["normalize_returns"]
    else:
        run = read_run(name)
        if run.teacher is not None:
            raise RunError(
                f"{name} is the run of a student (--teacher) and has no critic, so no training can start from it. Give "
                f"another run (--weights), or continue the student: xreset train --out {name}"
            )
        contract = run.contract
        theirs = run.config.model.layers
        checkpoint = latest_checkpoint(Path(weights))
    start = f"Start from its configuration, with recipe=... or --recipe {name}"
    for robot in robots:
        try:
            check_contract(name, contract, robot, config.task)
        except PolicyError as error:
            if contract.task.joint_slots is None and contract.robot != robot.name:
                raise
            raise PolicyError(f"{error} {start}") from error
    ours = config.model.layers
    differing = [layer for layer, value in theirs.items() if value != ours[layer]]
    if differing:
        theirs = {layer: theirs[layer] for layer in differing}
        ours = {layer: ours[layer] for layer in differing}
        raise RunError(
            f"The networks of {name} have the layers {theirs}, this run's {ours}. {start}"
        )
    if checkpoint is None:
        raise PolicyError(
            f"{name} holds no critic, without which a training loses what a policy knows. Give the folder of its run, "
            f"or a policy that ships with a critic: {', '.join(shipped_checkpoints())}."
        )
    return checkpoint, file_hash(checkpoint)


def read_teacher(name: str | Path, inputs: Inputs, config: TrainConfig) -> OnnxPolicy:
    """Read the policy of a teacher, which must fit the robot and the task."""
    teacher = read_policy(name)
    contract = teacher.contract
    if contract.task.vision.cameras:
        raise PolicyError(
            f"{teacher.path} sees through cameras itself. Give a teacher that is told pose and shape."
        )
    check_contract(
        str(teacher.path), contract, inputs.robot, replace(config.task, vision=VisionConfig())
    )
    return teacher


@contextmanager
def _claimed(out: Path) -> Iterator[None]:
    """Let no other training write the run folder."""
    with ExitStack() as stack:
        if Processes.of_environment().is_main:
            stack.enter_context(claim_folder(out))
            stack.enter_context(claim_folder(out / "checkpoints"))
        yield


@contextmanager
def new_run(out: Path) -> Iterator[None]:
    """Like :func:`_claimed`; leave nothing new in the folder if the run ends without its ``run.json``."""

    def written() -> list[Path]:
        curves = out.glob("events.out.tfevents.*")
        data = (out / TEACHER, out / "goals.npz", out / "resets.npz")
        return [*curves, *data, out / "checkpoints", out]

    before = [path for path in written() if path.exists()]
    with _claimed(out):
        try:
            yield
        finally:
            if Processes.of_environment().is_main and not (out / "run.json").exists():
                for path in written():
                    if path not in before:
                        with suppress(OSError):  # not written yet, or a folder with other files
                            path.rmdir() if path.is_dir() else path.unlink()


_MANY_ON_A_CPU = 256
"""More worlds than these keep a CPU busy for minutes in each iteration."""
_NO_MEMORY = re.compile("Failed to allocate|out of memory")
"""How Warp reports too little memory, as a ``RuntimeError``."""


@contextmanager
def cleanly(out: Path, info: RunInfo) -> Iterator[None]:
    """Say what to do if there is too little memory, and leave the process's global state as it was."""
    if info.device == "cpu" and info.num_envs > _MANY_ON_A_CPU:
        print(
            f"With {info.num_envs:,} worlds on a CPU, an iteration takes minutes. Train on a GPU; to see that a "
            "training runs, 8 worlds are enough (--num-envs 8).",
            file=sys.stderr,
        )
    minibatches = info.config.ppo.minibatches(info.num_envs)
    left = info.num_envs % minibatches
    if info.device != "cpu" and left:
        print(
            f"{info.num_envs:,} worlds cannot be divided into {minibatches} minibatches of one size, which a GPU needs "
            f"for fast updates. Take {info.num_envs - left:,} worlds (--num-envs).",
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


def start(
    out: Path,
    info: RunInfo,
    data: str | Path | ResetBank,
    load: Callable[[str | Path | ResetBank], Inputs],
    others: Sequence[Inputs],
    teacher: OnnxPolicy | None,
    *,
    wandb: str | None,
) -> None:
    """Make a run folder and train in it.

    Data that are in no file are written into the folder, and read again: a training that is resumed has the same data,
    and their values are checked.
    """
    with new_run(out):
        if teacher is not None:
            write_whole(out / TEACHER, teacher.content)
        if not isinstance(data, str | Path):
            data = write_data(out, data)
        inputs = load(data)
        info = replace(info, resets=str(inputs.path), resets_hash=str(inputs.hash))
        with cleanly(out, info):
            all_inputs = (inputs, *others)
            run_training(out, info, all_inputs, resumed=False, wandb=wandb)


def run_training(
    out: Path,
    info: RunInfo,
    inputs: Sequence[Inputs],
    *,
    resumed: bool,
    wandb: str | None,
) -> None:
    """Train from the newest checkpoint, from the networks of ``weights`` or from new ones, and export the policy.

    Several robots, each of which has inputs, share the worlds evenly.
    """
    processes = Processes.of_environment()
    device = processes.device(info.device)
    newest = latest_checkpoint(out) if resumed and checkpoints(out) else None
    # a run that continues draws other numbers than it began with
    seed = processes.seed(info.seed) + (0 if newest is None else int(newest.stem))
    if device.startswith("cuda:"):
        torch.cuda.set_device(device)
    torch.manual_seed(seed)
    with ExitStack() as stack:
        envs = []
        for i, each in enumerate(inputs):
            env = make_env(
                each.robot,
                each.objects,
                each.bank,
                info.config.task,
                engine=info.engine,
                num_envs=(info.num_envs + i) // len(inputs),
                device=device,
                seed=seed + i,
            )
            envs.append(stack.enter_context(env))
        env = envs[0] if len(envs) == 1 else SeveralEnvs(envs)
        if env.vision is not None:
            env.vision.check_sees_objects()
        teacher = out / TEACHER if info.teacher else None
        runner = TrainingRunner(env, info.config, out, teacher=teacher, wandb=wandb)
        if newest is not None:
            runner.load_checkpoint(newest)
        elif info.weights is not None:
            runner.load_networks(Path(info.weights))
        if info.weights is not None:
            # new observations leave its mean and variance as they are (docs/lab-book.md, "A policy that learns on")
            runner.alg.networks["actor"].trunk.normalizer.until = 0
        if processes.is_main:
            _write_start(out, info, runner.iteration, is_new=newest is None, resumed=resumed)
        try:
            stopped_by = runner.learn(info.total, minutes=info.minutes)
        except BaseException:
            # such as a mistake in a reward term; the corrected command is then a new training
            if processes.is_main and not (resumed or runner.iteration):
                (out / "run.json").unlink()
            raise
    if processes.is_main:
        policy = out / "policy.onnx"
        export_checkpoint(latest_checkpoint(out), policy)
        print(f"policy after {quantity(runner.iteration, 'iteration')} in {policy}", flush=True)
    if stopped_by is not None:
        raise Stopped(stopped_by)


def _export_if_missing(out: Path) -> None:
    """Write the run's policy, unless the file is the policy already, whose hash results state."""
    path = out / "policy.onnx"
    content = read_policy(out).content
    if not path.is_file() or path.read_bytes() != content:
        write_whole(path, content)


def _write_start(out: Path, info: RunInfo, iteration: int, *, is_new: bool, resumed: bool) -> None:
    """Write ``run.json``, and say where a resumed run continues."""
    # A run that was killed before its first checkpoint begins again, so its curves are deleted. Curves in a folder
    # without run.json are somebody else's.
    if is_new and (out / "run.json").is_file():
        for events in out.glob("events.out.tfevents.*"):
            events.unlink()
    stated = info
    if resumed:
        as_stated = read_run(out, as_stated=True)
        stated = replace(as_stated, iterations=info.iterations, minutes=info.minutes)
    write_run(out, stated)
    if resumed:
        done = f"continuing after iteration {iteration}"
        if is_new:
            done = "there is no checkpoint yet: starting from the beginning"
        print(done, flush=True)
