"""What an evaluation plays: robot, objects, starts, goals and task in a trial, and the engine to play in.

Shape letters: N worlds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from xreset.env import ManipulationEnv, make_scene, object_origins
from xreset.eval.metrics import MetricPoints
from xreset.eval.policy_spec import PolicySpec
from xreset.inputs import Data, load_inputs
from xreset.physics import Backend
from xreset.plugins import backend_class, device_for, make_backend
from xreset.resets.bank import ResetBank
from xreset.resets.distribution import ResetDistribution
from xreset.resets.goals import GoalSet
from xreset.resets.settle import settle_starts
from xreset.retarget.file import Retargeted
from xreset.spec import ObjectSpec, RobotSpec, SceneSpec
from xreset.task.config import TaskConfig, evaluation_task
from xreset.task.randomization import sample_friction

MakeBackend = Callable[[SceneSpec, int, Tensor], Backend]
"""Makes the worlds of a scene, given their number and the index of the object in each world [N]."""

SLOW_ON_CPU = frozenset({"mujoco-warp"})
"""Backends that need a GPU to play many episodes."""


@dataclass(frozen=True, kw_only=True)
class Engine:
    """An engine to play in."""

    name: str
    make: MakeBackend
    version: str
    device: str = "cpu"
    slow: bool = False
    """Whether it is too slow on its device to play many episodes."""


def engine(name: str, *, device: str = "cpu", **options: Any) -> Engine:
    """Return an installed backend.

    Args:
        name: name of the backend.
        device: where the backend runs if it can run there; else it runs on the CPU.
        options: keywords of the backend.

    Raises:
        BackendUnavailableError: the backend cannot be used here.
    """
    version = backend_class(name).engine_version()
    used = device_for(name, device)

    def make(scene: SceneSpec, num_worlds: int, object_index: Tensor) -> Backend:
        return make_backend(
            name, scene, num_worlds, object_index=object_index, device=used, **options
        )

    return Engine(
        name=name,
        make=make,
        version=version,
        device=used,
        slow=name in SLOW_ON_CPU and used == "cpu",
    )


@dataclass(frozen=True, kw_only=True)
class Trial:
    """Everything that decides how an episode goes, except the policy and the engine."""

    robot: RobotSpec
    objects: tuple[ObjectSpec, ...]
    bank: ResetBank
    """Starts and goals; and states, for episodes that begin with them."""
    task: TaskConfig
    """Usually :func:`xreset.task.config.evaluation_task` of the policy's own task."""
    seed: int = 0
    """Seed of the perturbations of robot and object: the same in every engine and for every number of worlds."""
    num_envs: int = 64
    """Worlds that run at the same time."""
    motion: Retargeted | None = None
    """Motion for the baseline ``ik``; None for other policies."""
    objects_folder: Path | None = None
    """Folder of the object meshes; None: the stand-ins."""
    inputs: dict[str, str] = field(default_factory=dict)
    """SHA-256 of the files of policy and data, by what they are."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the objects."""
        return tuple(o.name for o in self.objects)

    @property
    def scene(self) -> SceneSpec:
        """The scene of the task. Its friction is a placeholder, because the environment sets friction itself."""
        return make_scene(self.robot, self.objects, self.task)

    @property
    def nominal_scene(self) -> SceneSpec:
        """The scene with the pair friction of an evaluation, which draws none at random."""
        return nominal_scene(self.robot, self.objects, self.task)

    def starts(self, device: str | torch.device = "cpu") -> ResetDistribution:
        """Return the distribution of starts. Drawn on the CPU, they are the same in every engine."""
        pivots = object_origins(self.objects, self.task)
        return ResetDistribution(self.bank, self.robot, self.names, self.task.reset, device, pivots)

    @contextmanager
    def worlds(
        self, engine: Engine, object_index: Tensor
    ) -> Iterator[tuple[ManipulationEnv, MetricPoints]]:
        """Open an environment in an engine.

        Args:
            engine: where to play.
            object_index: [N] index of the object in each world.

        Yields:
            The environment, and the metric's points of each world's object.
        """
        with engine.make(self.scene, len(object_index), object_index) as backend:
            env = ManipulationEnv(backend, self.task, self.starts(backend.device), seed=self.seed)
            yield (
                env,
                MetricPoints.of(self.objects, self.task.object_frame).to(backend.device)[
                    backend.object_index
                ],
            )


def load_trial(
    policy: PolicySpec,
    source: str | Path | Data,
    *,
    objects: str | Path | None = None,
    seed: int = 0,
    num_envs: int = 64,
    settle: bool = False,
) -> Trial:
    """Load what a policy is to play. For the baseline ``ik``, demonstrations are retargeted here.

    Args:
        policy: the policy, whose robot and task are taken.
        source: demonstrations, motion or a goal set, or a file of them; or a loaded bank. The starts of a goal set are
            played as they are, because they are perturbed already; only the robot's joints are.
        objects: folder of object meshes; default: the folder of the policy's training.
        seed: seed of the perturbations.
        num_envs: worlds that run at the same time.
        settle: whether objects come to rest before episodes begin (:mod:`xreset.resets.settle`), in MuJoCo for every
            engine, so that all engines play the same starts. Default: the recorded poses, as in the paper.
    """
    folder = policy.meshes(objects)
    inputs = load_inputs(
        source, robot=policy.robot, objects=folder, accept=("demos", "motion", "goals")
    )
    hashes = {} if policy.hash is None else {"policy": policy.hash}
    if inputs.hash is not None:
        is_bank = isinstance(inputs.data, ResetBank) and not isinstance(inputs.data, GoalSet)
        hashes["resets" if is_bank else "demos"] = inputs.hash
    bank = inputs.bank
    used = [o for o in inputs.objects if o.name in bank.sequence_object]
    if settle:
        bank, _ = settle_starts(bank, policy.robot, used, num_envs=num_envs)
        hashes["starts"] = "settled"
    task = evaluation_task(policy.task)
    if isinstance(inputs.data, GoalSet):
        task = replace(task, reset=replace(task.reset, spawn_xy=0.0, spawn_yaw=0.0))
    return Trial(
        robot=policy.robot,
        objects=tuple(sorted(used, key=lambda o: o.name)),
        bank=bank,
        task=task,
        seed=seed,
        num_envs=num_envs,
        motion=inputs.motion() if policy.follows_motion else None,
        objects_folder=folder,
        inputs=hashes,
    )


def nominal_scene(robot: RobotSpec, objects: tuple[ObjectSpec, ...], task: TaskConfig) -> SceneSpec:
    """Return the scene of :attr:`Trial.nominal_scene`."""
    scene = make_scene(robot, objects, task)
    nominal = replace(task.randomization, enabled=False)
    tip, link, table = sample_friction(1, nominal, torch.Generator())[0].tolist()
    return replace(scene, friction=replace(scene.friction, tip=tip, link=link, table=table))
