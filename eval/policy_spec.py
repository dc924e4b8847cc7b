"""Find the policy that a name means: a run folder, an exported file, a policy that ships with xreset, or a baseline."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING

from xreset.errors import PolicyError
from xreset.files.checks import Checked, Seed, frozen, obeys_rules
from xreset.files.text import quantity, shown
from xreset.geometry.description import load_robot
from xreset.learning.exported import PolicyFile, find_policy
from xreset.live.deploy import check_made_for, deployed_graph, is_deployed, training_of
from xreset.objects.catalogue import object_names
from xreset.physics.plugins import robot_of_file
from xreset.policy.onnx_policy import (
    OnnxPolicy,
    Policy,
    check_contract,
    check_robot_of,
)
from xreset.policy.shipped import graph_of, no_policy_for, shipped_name
from xreset.resets.bank import ResetBank
from xreset.retarget.file import Retargeted
from xreset.runtime import Controller
from xreset.spec import ObjectSpec, RobotSpec
from xreset.task.config import TaskConfig, evaluation_task
from xreset.task.contract import Contract

if TYPE_CHECKING:  # functions import torch, which playing a deployed policy does not need
    from xreset.env.manipulation import ManipulationEnv

BASELINES = ("zero", "ik")
"""Names of the policies that need no training."""
DEFAULT = "many-objects"
"""Policy that is played where neither a policy nor a robot is named."""


@frozen
class PolicySpec(Checked):
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
        if isinstance(self.folder, str):
            object.__setattr__(self, "folder", Path(self.folder))
        super().__post_init__()

    def __repr__(self) -> str:
        trained = "baseline" if self.objects is None else quantity(len(self.objects), "object")
        return (
            f"PolicySpec({self.name!r}, {self.robot.name!r}, {trained}, results in {self.folder})"
        )

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
        names = object_names(folder)
        return tuple(name for name in names if name in (self.objects or ())) or names

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
        from xreset.env.manipulation import make_env

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
        policy = self.start(None)
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
        if graph and f'"robot_fingerprint": "{self.robot.fingerprint}"'.encode() in graph:
            return graph
        if self.task.vision.cameras:
            raise PolicyError(
                f"The policy {self.name!r} has cameras, so no graph plays it. Choose one that is told the pose."
            )
        check_contract(self.name, OnnxPolicy(self.name, content).contract, self.robot, self.task)
        return deployed_graph(content, self.robot, self.task)


def default_policy(robot: str | Path | None) -> str:
    """Return the name of the policy that ships for a robot; without a robot :data:`DEFAULT`.

    Args:
        robot: name or folder.

    Raises:
        PolicyError: no policy ships for the robot.
    """
    if robot is None:
        return DEFAULT
    spec = load_robot(robot)
    name = shipped_name(spec.name)
    if name is None:
        raise PolicyError(no_policy_for(spec.name))
    return name


def load_policy(policy: str | Path | PolicySpec, *, robot: str | Path | None = None) -> PolicySpec:
    """Load the policy that a name means. A file or folder comes before a shipped policy of the same name.

    Args:
        policy: run folder, one of its checkpoints (.pt), exported or deployed policy (.onnx), folder of a deployed one
            (``docs/live.md``), name of a policy that ships with xreset, name of a robot for which one ships, or one of
            :data:`BASELINES`. A loaded policy is returned as it is; ``robot`` must be its own then.
        robot: name or folder of the robot; default: the policy's own, or the first of several. Baselines need it.

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
    if str(policy) in BASELINES:
        return _baseline(str(policy), robot)
    found = find_policy(policy, also=BASELINES)
    run = found.run
    is_graph = is_deployed(found.content)
    contract, start = _opened_graph(found) if is_graph else _opened(found)
    if robot is None:
        robot = run.robot if run else robot_of_file(found.path, contract.robot)
    spec = load_robot(robot)
    if not is_graph:
        check_robot_of(str(found.path), contract, spec)
    else:
        check_made_for(str(found.path), contract, spec)
    results = found.results
    if contract.task.joint_slots is not None and spec.name != contract.robot:
        results = results / spec.name  # not in place of the results of the policy's first robot
    return PolicySpec(
        name=found.folder_name if is_graph else found.name,
        start=start,
        robot=spec,
        task=contract.task,
        folder=results / "eval",
        meshes=Path(run.meshes) if run and run.meshes else None,
        objects=contract.objects,
        hash=sha256(found.content).hexdigest(),
        content=found.content,
    )


Start = Callable[[Retargeted | None], Policy]


def _opened(found: PolicyFile) -> tuple[Contract, Start]:
    """Return the contract of a policy that xreset has trained, and what starts it."""
    loaded = OnnxPolicy(found.path, found.content)
    return loaded.contract, lambda motion: loaded.another()


def _opened_graph(found: PolicyFile) -> tuple[Contract, Start]:
    """Return the same of a policy whose file is a graph from readings to joint targets, whoever trained it."""
    source = str(found.path)

    def start(motion: Retargeted | None) -> Policy:
        from xreset.live.engine import GraphPolicy

        return GraphPolicy(Controller(found.content, source))

    return training_of(Controller(found.content, source), source), start


def _baseline(name: str, robot: str | Path | None) -> PolicySpec:
    if robot is None:
        raise PolicyError(f"The baseline {name!r} needs a robot. Name it (robot=... or --robot).")
    spec = load_robot(robot)

    def start(motion: Retargeted | None) -> Policy:
        from xreset.eval import baselines

        if name == "zero":
            return baselines.ZeroPolicy(len(spec.joints))
        if motion is None:
            raise PolicyError("The baseline 'ik' follows recorded motion. Use xreset.evaluate.")
        return baselines.KinematicRetargeting(motion)

    folder = Path("runs") / f"{name}-{spec.name}" / "eval"
    return PolicySpec(name=name, start=start, robot=spec, task=TaskConfig(), folder=folder)
