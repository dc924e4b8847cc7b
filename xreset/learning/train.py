"""Training from files: reset bank in, run folder out."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from xreset import robots
from xreset.backends import make_backend
from xreset.backends.registry import backend_class
from xreset.env import ManipulationEnv, make_scene
from xreset.errors import RunError
from xreset.files import file_hash
from xreset.learning.config import TrainConfig
from xreset.learning.export import export_onnx
from xreset.learning.run import RunInfo, latest_checkpoint, read_run, write_run
from xreset.learning.runner import TrainingRunner
from xreset.objects import load_objects
from xreset.policy import policy_contract
from xreset.resets.bank import ResetBank, check_objects, read_bank
from xreset.spec import ObjectSpec, RobotSpec
from xreset.task.resets import ResetDistribution


@dataclass(frozen=True, kw_only=True)
class _Inputs:
    """What a run's files say, loaded and checked against one another."""

    robot: RobotSpec
    bank: ResetBank
    objects: tuple[ObjectSpec, ...]


def load_inputs(robot: str, resets: str | Path, objects: str | Path | None) -> _Inputs:
    """Load robot, bank and objects, and refuse what does not belong together."""
    spec = robots.load(robot)
    bank = read_bank(resets, robot=spec)
    loaded = tuple(load_objects(bank.object_names, Path(objects) if objects else None))
    check_objects(resets, bank, loaded)
    return _Inputs(robot=spec, bank=bank, objects=loaded)


def start_run(
    *, robot: str, resets: str | Path, objects: str | Path | None, backend: str, device: str, num_envs: int, seed: int,
    config: TrainConfig, out: Path,
) -> RunInfo:  # fmt: skip
    """Check everything that a training needs and write ``run.json``.

    Raises:
        RunError: the folder holds a run already.
    """
    if (out / "run.json").exists():
        raise RunError(f"{out} holds a run already. Continue it with --resume, or choose another --out.")
    inputs = load_inputs(robot, resets, objects)
    version = backend_class(backend).engine_version()
    if config.task.reset.demo_probability > 0 and not inputs.bank.num_states:
        raise RunError(
            f"{resets} holds no state to reset to: every candidate was rejected. Look at its reasons (xreset resets), "
            "or train without it: --config.task.reset.demo-probability 0"
        )
    info = RunInfo(
        robot=robot,
        resets=str(resets),
        resets_hash=file_hash(resets),
        objects=str(objects) if objects else None,
        backend=backend,
        backend_version=version,
        device=device,
        num_envs=num_envs,
        seed=seed,
        config=config,
        contract=policy_contract(inputs.robot, config.task, tuple(o.name for o in inputs.objects)),
    )
    write_run(out, info)
    return info


def train(out: Path, info: RunInfo, *, resume: bool = False) -> None:
    """Train a run that :func:`start_run` has set up, or continue it; export the policy at the end.

    With ``torchrun``, every process simulates ``num_envs`` worlds on its own GPU.
    """
    rank, device = int(os.environ.get("RANK", "0")), info.device
    if int(os.environ.get("WORLD_SIZE", "1")) > 1:
        device = f"cuda:{os.environ.get('LOCAL_RANK', '0')}"
    if device.startswith("cuda:"):
        torch.cuda.set_device(device)
    inputs = load_inputs(info.robot, info.resets, info.objects)
    if file_hash(info.resets) != info.resets_hash:
        raise RunError(f"{info.resets} is not the file that this run was started with. Put it back, or start a new run.")
    config = info.config
    torch.manual_seed(info.seed + 7919 * rank)
    scene = make_scene(inputs.robot, inputs.objects, config.task)
    with make_backend(info.backend, scene, info.num_envs, device=device) as backend:
        resets = ResetDistribution(inputs.bank, inputs.robot, tuple(o.name for o in inputs.objects), config.task.reset, backend.device)
        env = ManipulationEnv(backend, config.task, resets, seed=info.seed + 7919 * rank)
        runner = TrainingRunner(env, config, out)
        if resume:
            runner.load_checkpoint(latest_checkpoint(out))
            print(f"continuing after iteration {runner.iteration}", flush=True)
        runner.learn(config.iterations, init_at_random_ep_len=config.random_episode_start)
        if rank == 0:
            export_onnx(runner.alg.get_policy(), out / "policy.onnx", info.contract)  # pyright: ignore[reportArgumentType]
            _report_health(env)


def default_device(backend: str) -> str:
    """``cuda`` where there is a GPU that the engine can use, else ``cpu``."""
    return "cuda" if "cuda" in backend_class(backend).devices() and torch.cuda.is_available() else "cpu"


def resumed(out: Path, *, iterations: int | None) -> RunInfo:
    """The run of a folder, with another total number of iterations if given."""
    info = read_run(out)
    if iterations is not None and iterations != info.config.iterations:
        info = replace(info, config=replace(info.config, iterations=iterations))
        write_run(out, info)
    return info


def ensure_policy(out: Path) -> Path:
    """The run's ``policy.onnx``, exported from the newest checkpoint if it is missing or older."""
    policy, checkpoint = out / "policy.onnx", latest_checkpoint(out)
    if policy.exists() and policy.stat().st_mtime >= checkpoint.stat().st_mtime:
        return policy
    from tensordict import TensorDict

    from xreset.learning.config import rsl_rl_config
    from xreset.learning.model import PointNetLstmModel
    from xreset.learning.runner import read_checkpoint

    info = read_run(out)
    cfg = rsl_rl_config(info.config, info.num_envs)
    actor_cfg = {k: v for k, v in cfg["actor"].items() if k != "class_name"}
    widths = {group: sum(terms.values()) for group, terms in info.contract["observation_layout"].items()}
    o = info.config.task.observation
    example = TensorDict(
        {
            "policy": torch.zeros(1, widths["policy"]),
            "proprio": torch.zeros(1, widths["proprio"]),
            "perception": torch.zeros(1, o.cloud_history, o.cloud_points, 3),
        },
        batch_size=[1],
    )
    actor = PointNetLstmModel(example, {"actor": cfg["obs_groups"]["actor"]}, "actor", len(info.contract["joint_names"]), **actor_cfg)
    actor.load_state_dict(read_checkpoint(checkpoint)["actor_state_dict"])
    export_onnx(actor, policy, info.contract)
    return policy


def _report_health(env: ManipulationEnv) -> None:
    """Say how many worlds were ended for a reason that is not the policy's."""
    nonfinite, overflow = int(env.nonfinite_count), int(env.overflow_count)
    if nonfinite or overflow:
        print(f"health: {nonfinite} times a world was not finite and was ended; {overflow} control steps dropped contacts or constraints")
