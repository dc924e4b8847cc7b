"""An engine in place of a robot: the worlds of an environment as a driver."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from xreset.env.manipulation import ManipulationEnv
from xreset.live.deploy import deploy_contract
from xreset.runtime import Controller, Driver, Links, OnnxActor, Reading


class EngineDriver(Driver):
    """N worlds of an environment as N robots, on the clock of the simulation.

    It reads and steps the engine directly; of the environment it uses resets, physical parameters and readings.
    """

    def __init__(
        self,
        env: ManipulationEnv,
        look: Callable[[], None] = lambda: None,
        *,
        real_time: bool = False,
    ) -> None:
        """Wrap worlds that were just reset.

        Args:
            env: the worlds.
            look: called after every control step.
            real_time: whether the simulation runs no faster than the wall clock.
        """
        self.env = env
        self._look = look
        self._begun = time.monotonic() if real_time else -math.inf
        self._substeps = 0
        self._target = env.joint_target.clone()

    def now(self) -> float:
        """Return the simulated time since the driver was made [s]."""
        return self._substeps * self.env.backend.scene.timestep

    def wait_until(self, moment: float) -> None:
        """Let the simulation run until that time [s]."""
        scene = self.env.backend.scene
        due = round((moment - self.now()) / scene.timestep)
        while due > 0:
            count = min(due, scene.substeps - self._substeps % scene.substeps)
            self._advance(count)
            self._substeps += count
            due -= count
            time.sleep(max(0.0, self._begun + self.now() - time.monotonic()))
            if self._substeps % scene.substeps == 0:
                self._look()

    def _advance(self, substeps: int) -> None:
        self.env.backend.set_joint_targets(self._target)
        self.env.backend.step(substeps)

    def read(self) -> Reading:
        """Return the present state of every world."""
        backend = self.env.backend
        state = backend.state()
        links = backend.links()
        force = backend.contacts().tip_force * self.env.variation.force_gain
        now = np.full(backend.num_worlds, self.now())
        return Reading(
            joint_pos=_array(state.joint_pos),
            joint_vel=_array(state.joint_vel),
            joint_time=now,
            object_pos=_array(state.object_pos),
            object_quat=_array(state.object_quat),
            object_time=now,
            tip_force=_array(force),
            links=Links(
                palm_pos=_array(links.pos[:, 0]),
                palm_quat=_array(links.quat[:, 0]),
                palm_linvel=_array(links.linvel[:, 0]),
                palm_angvel=_array(links.angvel[:, 0]),
                tip_pos=_array(links.pos[:, 1:]),
            ),
        )

    def send(self, target: np.ndarray) -> None:
        """Set the targets [N, J] of the drives."""
        self._target = torch.as_tensor(target, device=self.env.device)

    def stop(self) -> None:
        """Do nothing: the drives hold the last targets."""


def _array(value: Tensor) -> np.ndarray:
    return value.cpu().numpy().copy()


def make_controller(env: ManipulationEnv, actor: OnnxActor | Any) -> Controller:
    """Return a controller whose episode begins in the worlds of an environment, with their objects, goals and targets.

    Args:
        env: the worlds, just reset, of the policy's own task.
        actor: the policy's network.
    """
    scene = env.backend.scene
    controller = Controller(deploy_contract(scene.robot, env.task, scene.objects), actor)
    names = [scene.objects[i].name for i in env.backend.object_index.tolist()]
    points = np.stack([controller.points(name) for name in names])
    centers = np.stack([controller.center(name) for name in names])
    goal = (_array(env.goal_pos), _array(env.goal_quat))
    controller.begin(points, *goal, _array(env.joint_target), centers)
    return controller
