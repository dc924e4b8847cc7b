"""Training from files: reset bank in, run folder out."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from xreset.description import load_robot
from xreset.env import make_env
from xreset.errors import RunError
from xreset.files import claim_folder, file_hash
from xreset.learning.choice import Choice, read_choice
from xreset.learning.config import TrainConfig, rsl_rl_config
from xreset.learning.distributed import Processes, leave
from xreset.learning.export import export_onnx
from xreset.learning.model import PointNetLstmModel
from xreset.learning.recipes import own_terms_flag
from xreset.learning.run import RunInfo, checkpoints, latest_checkpoint, read_run, write_run
from xreset.learning.runner import TrainingRunner, read_checkpoint
from xreset.objects.catalogue import load_objects
from xreset.plugins import backend_class, device_for
from xreset.policy import check_contract, policy_contract
from xreset.resets.bank import ResetBank, check_objects, read_bank
from xreset.spec import ObjectSpec, RobotSpec


@dataclass(frozen=True, kw_only=True)
class RunInputs:
    """The files of a run, loaded once and checked against one another."""

    robot_name: str
    """Name or folder, as given."""
    resets: Path
    """Path of the reset bank."""
    resets_hash: str
    """Its SHA-256."""
    objects_folder: Path | None
    """Folder of object meshes; None: the built-in stand-ins."""
    robot: RobotSpec
    bank: ResetBank
    objects: tuple[ObjectSpec, ...]


def load_inputs(robot: str, resets: str | Path, objects: str | Path | None) -> RunInputs:
    """Load robot, bank and objects, and refuse what does not belong together."""
    folder = Path(objects) if objects else None
    spec = load_robot(robot)
    bank = read_bank(resets, robot=spec)
    loaded = tuple(load_objects(bank.object_names, folder))
    check_objects(resets, bank, loaded)
    return RunInputs(
        robot_name=robot,
        resets=Path(resets),
        resets_hash=file_hash(resets),
        objects_folder=folder,
        robot=spec,
        bank=bank,
        objects=loaded,
    )


def start_run(
    inputs: RunInputs, *, backend: str, device: str, num_envs: int, seed: int, config: TrainConfig, out: Path, weights: Path | None = None,
) -> RunInfo:  # fmt: skip
    """Check everything that a training needs; :func:`train` then writes ``run.json``, once the engine stands.

    Args:
        inputs: the run's files.
        backend: engine.
        device: where it and the networks run.
        num_envs: worlds of each process.
        seed: of every random number.
        config: task, model and algorithm.
        out: the run's folder.
        weights: another run's folder, whose newest checkpoint gives the networks to begin with; None: new ones.

    Raises:
        RunError: the folder holds a run already, there is no state to reset to, or ``weights`` is no run with a checkpoint of networks
            like these.
        PolicyError: ``weights`` is of another robot, or its policy observes something else.
    """
    if checkpoints(out):
        raise RunError(f"{out} holds a run already. Continue it with --resume, or choose another --out.")
    if num_envs < 1:
        raise RunError(f"--num-envs is {num_envs}, expected at least 1.")
    if device_for(backend, device) != device:
        raise RunError(
            f"the engine {backend!r} does not run on {device!r}. Leave out --device, or choose another --backend."
        )
    version = backend_class(backend).engine_version()
    if uses_bank(config) and not inputs.bank.num_states:
        raise RunError(
            f"{inputs.resets} holds no state to reset to: every candidate was rejected. Look at its reasons (xreset resets), "
            "or train without it: --config.task.reset.demo-probability 0"
        )
    checkpoint = None
    if weights is not None:
        other = read_run(weights)
        check_contract(str(weights), other.contract, inputs.robot, config.task)
        if other.config.model.layers != config.model.layers:
            raise RunError(
                f"the networks of {weights} have the layers {other.config.model.layers}, this run's {config.model.layers}. "
                f"Start from its configuration: --like {weights}"
            )
        checkpoint = latest_checkpoint(weights)
    return RunInfo(
        robot=inputs.robot_name,
        resets=str(inputs.resets),
        resets_hash=inputs.resets_hash,
        objects=str(inputs.objects_folder) if inputs.objects_folder else None,
        backend=backend,
        backend_version=version,
        device=device,
        num_envs=num_envs,
        seed=seed,
        config=config,
        contract=policy_contract(inputs.robot, config.task, tuple(o.name for o in inputs.objects)),
        weights=str(checkpoint) if checkpoint else None,
        weights_hash=file_hash(checkpoint) if checkpoint else None,
    )


def uses_bank(config: TrainConfig) -> bool:
    """Whether a training ever begins episodes with states of the bank."""
    points = config.schedule.demo_probability
    if points:
        return any(value > 0 for _, value in points)
    return config.task.reset.demo_probability > 0


def train(
    out: Path, info: RunInfo, inputs: RunInputs | None = None, *, resume: bool = False, seconds: float = math.inf
) -> None:
    """Train a run that :func:`start_run` has set up, or continue it; export the policy at the end.

    With ``torchrun``, every process simulates ``num_envs`` worlds of its own, each on its own GPU, or all on the CPU.

    Args:
        out: the run's folder.
        info: what is in its ``run.json``.
        inputs: the run's files, if they are loaded already.
        resume: continue from the newest checkpoint.
        seconds: most time to spend on iterations.

    Raises:
        RunError: another command trains here, the bank is not the run's, the newest checkpoint does not fit, or there is too little memory.
    """
    processes = Processes.of_environment()
    with ExitStack() as claims:
        if processes.is_main:
            claims.enter_context(claim_folder(out))
            claims.enter_context(claim_folder(out / "checkpoints"))
        try:
            _train(processes, out, info, inputs, resume=resume, seconds=seconds)
        except (MemoryError, torch.OutOfMemoryError) as error:
            raise RunError(_too_little_memory(out, info)) from error
        except RuntimeError as error:  # how Warp tells of it
            if "allocate" not in str(error) and "out of memory" not in str(error):
                raise
            raise RunError(_too_little_memory(out, info)) from error
        finally:
            leave()


def _too_little_memory(out: Path, info: RunInfo) -> str:
    goes_on = "the last checkpoint is sound" if checkpoints(out) else "nothing was lost"
    return (
        f"{info.num_envs} worlds on {info.device} need more memory than there is; {goes_on}. Start with fewer (--num-envs), or smaller "
        "minibatches (--config.ppo.minibatch-size), in another --out."
    )


def _train(
    processes: Processes, out: Path, info: RunInfo, inputs: RunInputs | None, *, resume: bool, seconds: float
) -> None:
    device, seed = processes.device(info.device), processes.seed(info.seed)
    if device.startswith("cuda:"):
        torch.cuda.set_device(device)
    inputs = inputs or load_inputs(info.robot, info.resets, info.objects)
    if inputs.resets_hash != info.resets_hash:
        raise RunError(
            f"{info.resets} is not the file that this run was started with. Put it back, or start a new run."
        )
    config, world = info.config, (inputs.robot, inputs.objects, inputs.bank)
    torch.manual_seed(seed)
    with make_env(*world, config.task, engine=info.backend, num_envs=info.num_envs, device=device, seed=seed) as env:
        runner = TrainingRunner(env, config, out)
        if resume and checkpoints(out):
            runner.load_checkpoint(latest_checkpoint(out))
        elif info.weights is not None:
            runner.load_networks(Path(info.weights))
        if processes.is_main:
            _begin(out, info, runner.iteration, resume=resume)
        runner.learn(config.iterations, init_at_random_ep_len=config.random_episode_start, seconds=seconds)
        if processes.is_main:
            export_onnx(runner.alg.get_policy(), out / "policy.onnx", info.contract)  # pyright: ignore[reportArgumentType]


def _begin(out: Path, info: RunInfo, iteration: int, *, resume: bool) -> None:
    """Write ``run.json``, now that the engine stands; before the first checkpoint a killed run leaves nothing that is worth keeping."""
    if not iteration:
        for events in out.glob("events.out.tfevents.*"):
            events.unlink()
    write_run(out, info)
    if resume:
        print(
            f"continuing after iteration {iteration}" if iteration else "there is no checkpoint yet: beginning anew",
            flush=True,
        )


def default_device(backend: str) -> str:
    """``cuda`` where there is a GPU that the engine can use, else ``cpu``."""
    return device_for(backend, "cuda" if torch.cuda.is_available() else "cpu")


def resumed(out: Path, *, iterations: int | None, own: Mapping[str, float] | None = None) -> RunInfo:
    """Return the run of a folder, with another total number of iterations if given.

    Args:
        out: the run's folder.
        iterations: iterations in all; None: as many as ``run.json`` says.
        own: the user's own reward terms with which the run was started. They name code to import, which a file must not decide.

    Raises:
        RunError: the run has other reward terms of the user's own.
    """
    info = read_run(out)
    expected = info.config.task.reward.own
    if expected != dict(own or {}):
        fix = f"add {own_terms_flag(expected)}" if expected else "omit --config.task.reward.own"
        raise RunError(
            f"{out} was trained with {len(expected)} reward terms of your own, but {len(own or {})} were named. A run folder must not decide "
            f"which code is imported. If you trust this code, {fix}."
        )
    if iterations is not None and iterations != info.config.iterations:
        info = replace(info, config=replace(info.config, iterations=iterations))
    return info


def ensure_policy(out: Path) -> Path:
    """The run's ``policy.onnx``, exported if it is missing or old: the checkpoint that was chosen among all, else the newest one."""
    policy, checkpoint = out / "policy.onnx", latest_checkpoint(out)
    if choice := current_choice(out):
        if policy.exists() and file_hash(policy) == choice.policy_hash:
            return policy
        checkpoint = checkpoint.with_name(choice.chosen)
    elif policy.exists() and policy.stat().st_mtime >= checkpoint.stat().st_mtime:
        return policy
    export_checkpoint(out, checkpoint, policy)
    return policy


def current_choice(out: Path) -> Choice | None:
    """What ``xreset select`` chose, while the run has no newer checkpoint than it knew, and still has the chosen one."""
    choice, names = read_choice(out), [c.name for c in checkpoints(out)]
    return (
        choice
        if choice is not None and names and names[-1] == choice.candidates[0].name and choice.chosen in names
        else None
    )


def export_checkpoint(out: Path, checkpoint: Path, policy: Path) -> None:
    """Write the policy of one of a run's checkpoints as an ONNX file."""
    from tensordict import TensorDict

    info = read_run(out)
    weights = read_checkpoint(checkpoint)["actor_state_dict"]
    cfg = rsl_rl_config(info.config, info.num_envs)
    actor_cfg = {k: v for k, v in cfg["actor"].items() if k != "class_name"}
    widths = {group: sum(terms.values()) for group, terms in info.contract["observation_layout"].items()}
    o = info.config.task.observation
    example = TensorDict(
        {
            "policy": torch.zeros(1, widths["policy"]),
            "proprio": torch.zeros(1, widths["proprio"]),
            "perception": torch.zeros(1, *o.cloud_shape),
        },
        batch_size=[1],
    )
    actor = PointNetLstmModel(
        example, {"actor": cfg["obs_groups"]["actor"]}, "actor", len(info.contract["joint_names"]), **actor_cfg
    )
    actor.load_state_dict(weights)
    export_onnx(actor, policy, info.contract)
