"""What is played when a policy is judged: one setting for every evaluation, and the engine that it is played in.

Shape letters: N worlds, M episodes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from xreset.env import ManipulationEnv, make_scene
from xreset.objects.sampling import keypoints
from xreset.physics import Backend
from xreset.plugins import backend_class, device_for, make_backend
from xreset.resets.bank import ResetBank
from xreset.resets.distribution import ResetDistribution
from xreset.spec import ObjectSpec, RobotSpec, SceneSpec
from xreset.task.config import TaskConfig
from xreset.task.randomization import sample_friction

MakeBackend = Callable[[SceneSpec, int, Tensor], Backend]
"""Builds worlds of a scene: how many, and which object each holds [N]."""

SAME_EQUATIONS = frozenset({"mujoco-warp"})
"""Backends that solve the equations of ``mujoco``, in other arithmetic."""


@dataclass(frozen=True, kw_only=True)
class Engine:
    """An engine to play in."""

    name: str
    make: MakeBackend
    version: str
    device: str = "cpu"
    grasps: bool = True
    """Whether press, closing and hold are measured in a comparison of engines."""
    path: bool = False
    """Whether paths are compared."""


def engine(name: str, *, device: str = "cpu", **options: Any) -> Engine:
    """An installed backend.

    If it solves the reference's equations, its paths are compared; and on the CPU nothing else is, for a GPU engine is slow there.

    Args:
        device: where it runs if it can run there; else the CPU.

    Raises:
        BackendUnavailableError: it cannot be used here.
    """
    version = backend_class(name).engine_version()
    used = device_for(name, device)

    def make(scene: SceneSpec, num_worlds: int, object_index: Tensor) -> Backend:
        return make_backend(name, scene, num_worlds, object_index=object_index, device=used, **options)

    same = name in SAME_EQUATIONS
    return Engine(name=name, make=make, version=version, device=used, grasps=not same or used != "cpu", path=same)


@dataclass(frozen=True, kw_only=True)
class Trial:
    """Everything that decides how an episode goes, but for policy and engine."""

    robot: RobotSpec
    objects: tuple[ObjectSpec, ...]
    """Objects of the demonstrations."""
    bank: ResetBank
    """Starts and goals; its states, if episodes begin with them."""
    task: TaskConfig
    """Usually :func:`xreset.task.config.evaluation_task` of the policy's own."""
    seed: int = 0
    """Of the perturbations of robot and object: the same in every engine and for every number of worlds."""
    num_envs: int = 64
    """Worlds at a time."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of the objects."""
        return tuple(o.name for o in self.objects)

    @property
    def scene(self) -> SceneSpec:
        """Without randomisation: the environment sets friction itself."""
        return make_scene(self.robot, self.objects, self.task)

    @property
    def nominal_scene(self) -> SceneSpec:
        """With the pair friction of an evaluation, which draws none at random."""
        return nominal_scene(self.robot, self.objects, self.task)

    def starts(self) -> ResetDistribution:
        """What starts are drawn from, on the CPU: neither the engine nor its device changes them."""
        return ResetDistribution(self.bank, self.robot, self.names, self.task.reset)

    @contextmanager
    def worlds(self, engine: Engine, object_index: Tensor) -> Iterator[tuple[ManipulationEnv, Tensor]]:
        """An environment in an engine, whose worlds hold given objects [N], and the keypoints [N, 4, 3] of those in their frames."""
        with engine.make(self.scene, len(object_index), object_index) as backend:
            resets = ResetDistribution(self.bank, self.robot, self.names, self.task.reset, backend.device)
            points = torch.stack([torch.as_tensor(keypoints(o), dtype=torch.float32) for o in self.objects])
            yield (
                ManipulationEnv(backend, self.task, resets, seed=self.seed),
                points.to(backend.device)[backend.object_index],
            )


def nominal_scene(robot: RobotSpec, objects: tuple[ObjectSpec, ...], task: TaskConfig) -> SceneSpec:
    """See :attr:`Trial.nominal_scene`."""
    scene = make_scene(robot, objects, task)
    tip, link, table = sample_friction(1, replace(task.randomization, enabled=False), torch.Generator())[0].tolist()
    return replace(scene, friction=replace(scene.friction, tip=tip, link=link, table=table))
