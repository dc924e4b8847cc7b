"""Find the policy that a name means: a run folder, an exported file, a policy that ships with xreset, or a baseline."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from xreset.env.manipulation import ManipulationEnv, make_env
from xreset.errors import PolicyError
from xreset.eval.deployed import deployed, played_objects
from xreset.files.checks import Checked, Seed, frozen, obeys_rules
from xreset.files.text import Brief, shown
from xreset.geometry.description import load_robot
from xreset.learning.exported import read_policy
from xreset.learning.run import read_run
from xreset.live.deploy import deployed_graph, is_deployed, made_for, task_of
from xreset.live.engine import GraphPolicy
from xreset.policy.onnx_policy import OnnxPolicy, Policy, RandomPolicy, ZeroPolicy, check_contract
from xreset.policy.shipped import graph_of, results_folder
from xreset.resets.bank import ResetBank
from xreset.retarget.file import Retargeted
from xreset.runtime import Controller
from xreset.runtime.contract import POLICY
from xreset.spec import ObjectSpec, RobotSpec
from xreset.task.config import TaskConfig, evaluation_task

if TYPE_CHECKING:
    from tensordict import TensorDict

BASELINES = ("zero", "random", "ik")
"""Names of the policies that need no training."""
LEAD_IN = 1.0
"""Time in which the baseline ``ik`` moves from home to the first frame [s]."""


@frozen
class PolicySpec(Brief, Checked):
    """A policy, the robot and the task that it was trained for, and where its results go."""

    name: str
    start: Callable[[Retargeted | None], Policy]
    """Makes a new policy for each engine. Only the baseline ``ik`` needs motion, and follows it."""
    robot: RobotSpec
    task: TaskConfig
    """The task of the training."""
    folder: Path
    """Default folder of evaluations; other measurements of the policy go next to it."""
    meshes: Path | None = None
    """Folder of object meshes of the training; None: the stand-ins."""
    objects: tuple[str, ...] | None = None
    """Names of the objects of the training; None: a baseline, which was not trained."""
    hash: str | None = None
    """SHA-256 of the policy's file; None: a baseline."""
    content: bytes | None = None
    """Content of the exported policy's file; None: a baseline."""

    def __post_init__(self) -> None:
        if not isinstance(self.folder, str | Path):
            raise PolicyError(f"folder is {shown(self.folder)}, expected a path.")
        object.__setattr__(self, "folder", Path(self.folder))
        super().__post_init__()

    @property
    def follows_motion(self) -> bool:
        """Whether the policy needs the robot's motion."""
        return self.name == "ik"

    def unseen(self, names: Iterable[str]) -> tuple[str, ...]:
        """Return the names of objects that the training did not have, sorted; none for a baseline."""
        return () if self.objects is None else tuple(sorted(set(names) - set(self.objects)))

    def meshes_folder(self, given: str | Path | None) -> Path | None:
        """Return the stated folder of meshes, or else that of the training; None: the stand-ins."""
        return Path(given) if given else self.meshes

    def objects_of(self, folder: Path | None) -> tuple[str, ...]:
        """Return the default objects: those of the training that the folder has, or else all objects of the folder.

        The folder may lack some objects of the training, such as shapes that were made for this training only.

        Args:
            folder: folder of meshes; None: the stand-ins.
        """
        return played_objects(self.objects or (), folder)

    @obeys_rules
    def make_env(
        self,
        objects: Sequence[ObjectSpec],
        bank: ResetBank,
        *,
        engine: str = "mujoco",
        num_envs: int = 1,
        device: str = "cpu",
        seed: Seed = 0,
    ) -> ManipulationEnv:
        """Make an environment of the policy's own task, as evaluations play it: from home, at full gravity.

        Args:
            objects: objects of the bank; the policy need not know them.
            bank: starts and goals.
            engine: name of a physics engine.
            num_envs: number of worlds.
            device: where the engine runs: cpu or cuda.
            seed: seed of every random number.
        """
        return make_env(
            self.robot,
            objects,
            bank,
            evaluation_task(self.task),
            engine=engine,
            num_envs=num_envs,
            device=device,
            seed=seed,
        )

    def begin(self, env: ManipulationEnv) -> Policy:
        """Return the policy, ready to act in an environment whose episodes have just begun.

        Raises:
            PolicyError: observations or actions have another meaning in this environment.
        """
        if self.follows_motion:
            raise PolicyError("The baseline 'ik' follows recorded motion. Use xreset.evaluate.")
        policy = self.start(None)
        if isinstance(policy, OnnxPolicy):
            check_contract(self.name, policy.contract, env.backend.scene.robot, env.task)
        policy.begin(env)
        return policy

    def exported(self) -> bytes:
        """Return the content of the exported policy's file.

        Raises:
            PolicyError: a baseline has none.
        """
        if self.content is None:
            raise PolicyError(
                f"The baseline {self.name!r} is not an exported policy. Give a run folder or a .onnx file."
            )
        return self.content

    @cached_property
    def graph(self) -> bytes:
        """Content of the deployed policy, from readings to joint targets. Its contract lists no objects, unless the
        policy was loaded as a graph.

        Raises:
            PolicyError: a baseline, a policy with cameras, or one that observes something that no robot measures.
        """
        content = self.exported()
        if is_deployed(content):
            return content
        graph = graph_of(content)
        if graph is not None and made_for(graph, self.robot):
            return graph
        return deployed_graph(content, self.robot, self.task)


def load_policy(
    policy: str | Path | PolicySpec, *, robot: str | Path | None = None, seed: Seed = 0
) -> PolicySpec:
    """Load the policy that a name means. A file or folder comes before a shipped policy of the same name.

    Args:
        policy: run folder, one of its checkpoints (.pt), exported or deployed policy (.onnx), folder of a deployed one
            (``docs/live.md``), name of a policy that ships with xreset, or one of :data:`BASELINES`. A loaded policy is
            returned as it is; ``robot`` must be its own then.
        robot: name or folder of the robot; default: the policy's own. Baselines need it.
        seed: seed of the baseline ``random``.

    Raises:
        PolicyError: the policy is unknown, or does not fit the robot.
        FileFormatError: ``run.json`` next to it is damaged.
    """
    if isinstance(policy, PolicySpec):
        if robot is not None and load_robot(robot).fingerprint != policy.robot.fingerprint:
            raise PolicyError(
                f"The policy {policy.name!r} is loaded for the robot {policy.robot.name!r} already. Leave out the "
                "robot, or give the policy by its name."
            )
        return policy
    if not isinstance(policy, str | Path):
        raise PolicyError(
            f"policy is {shown(policy)}, expected a name, a path or a PolicySpec (docs/gymnasium.md)."
        )
    name = str(policy)
    if name in BASELINES:
        return _baseline(name, robot, seed)
    path = Path(policy)
    if os.path.isdir(path / "runtime"):  # of xreset export deploy
        path = path / POLICY
        policy = path
    if path.suffix == ".onnx" and path.is_file() and is_deployed(path.read_bytes()):
        return _deployed(path, robot)
    run = None
    if os.path.isdir(path):
        run = read_run(path)
    elif path.suffix == ".pt" and path.is_file():
        run = read_run(path.parent.parent)
    loaded = read_policy(policy, also=BASELINES)
    file = loaded.path
    folder = file.parent
    if run is not None:
        name = path.name
        robot = robot or run.robot
        if file == path:
            name = f"{path.parent.parent.name}-{path.stem}"
            folder = path.with_suffix("")
    elif file == path:
        name = path.stem
    else:
        folder = results_folder(name)
    contract = loaded.contract
    spec = load_robot(robot or contract.robot)
    check_contract(str(file), contract, spec, contract.task)
    return PolicySpec(
        name=name,
        start=lambda motion: loaded.another(),
        robot=spec,
        task=contract.task,
        folder=folder / "eval",
        meshes=Path(run.meshes) if run and run.meshes else None,
        objects=contract.objects,
        hash=loaded.hash,
        content=loaded.content,
    )


def _deployed(file: Path, robot: str | Path | None) -> PolicySpec:
    """Return a policy whose file is a graph from readings to joint targets, whoever trained it."""
    content = file.read_bytes()
    controller = Controller(content, str(file))
    found = deployed(file, robot)
    return PolicySpec(
        name=found.name,
        start=lambda motion: GraphPolicy(Controller(content, str(file))),
        robot=found.robot,
        task=task_of(controller, str(file)),
        folder=file.parent / "eval",
        objects=tuple(controller.contract.get("objects", ())),
        hash=sha256(content).hexdigest(),
        content=content,
    )


def _baseline(name: str, robot: str | Path | None, seed: int) -> PolicySpec:
    if robot is None:
        raise PolicyError(f"The baseline {name!r} needs a robot. Name it (robot=... or --robot).")
    spec = load_robot(robot)

    joints = len(spec.joints)
    makers: dict[str, Callable[..., Policy]] = {
        "zero": lambda motion: ZeroPolicy(joints),
        "random": lambda motion: RandomPolicy(joints, seed),
        "ik": KinematicRetargeting,
    }
    folder = Path("runs") / f"{name}-{spec.name}" / "eval"
    return PolicySpec(name=name, start=makers[name], robot=spec, task=TaskConfig(), folder=folder)


class KinematicRetargeting:
    """The open-loop baseline (the paper's "Kinematic Retargeting", "IK Oracle"): retargeted motion, played as targets.

    Episodes start at home, so the robot first moves to the first frame in a straight line in joint space. Then it plays
    the demonstration at its own speed, and holds its last frame. Actions go through the same interface as a policy's.
    """

    def __init__(self, motion: Retargeted) -> None:
        """Take motion, in the order of the environment's demonstrations."""
        self._motion = motion

    def begin(self, env: ManipulationEnv) -> None:
        """Compute the joint targets [N, steps, J] of the episodes that have just begun."""
        motion = self._motion
        dt = env.backend.scene.control_dt
        lead = max(1, round(LEAD_IN / dt))
        time = torch.arange(env.max_episode_length) * dt
        blend = ((torch.arange(len(time)) + 1) / lead).clamp(0, 1)[:, None]
        plans = []
        for world, sequence in enumerate(env.sequence.tolist()):
            first, last = motion.frame_offsets[sequence : sequence + 2]
            path = torch.as_tensor(motion.joint_pos[first:last], dtype=torch.float32)
            frame = ((time - lead * dt) * float(motion.fps)).clamp(0, len(path) - 1)
            before = frame.floor().long().clamp_max(max(len(path) - 2, 0))
            after = (before + 1).clamp_max(len(path) - 1)
            share = (frame - before)[:, None]
            plan = path[before] * (1 - share) + path[after] * share
            start = env.joint_target[world].cpu()
            plans.append(start * (1 - blend) + plan * blend)
        self._plan = torch.stack(plans).to(env.device)
        self._step = 0
        self._env = env

    def act(self, observations: TensorDict) -> Tensor:
        """Return the actions [N, J] that bring the targets nearest to the plan."""
        env = self._env
        wanted = self._plan[:, min(self._step, self._plan.shape[1] - 1)]
        self._step += 1
        return env.actions.action_for(wanted, env.joint_target)
