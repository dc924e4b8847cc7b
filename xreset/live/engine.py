"""An engine in place of a robot: the worlds of an environment as a driver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from xreset.env.manipulation import ManipulationEnv
from xreset.geometry.rotations import quat_rotate
from xreset.live.deploy import check_made_for, known_of, training_of
from xreset.objects.sampling import center
from xreset.runtime import Controller, Driver, Reading


class EngineDriver(Driver):
    """N worlds of an environment as N robots, on the clock of the simulation.

    It reads and steps the engine directly; of the environment it uses resets, physical parameters and readings.
    """

    def __init__(
        self,
        env: ManipulationEnv,
        look: Callable[[], None] = lambda: None,
    ) -> None:
        """Wrap worlds that were just reset.

        Args:
            env: the worlds.
            look: called after every control step.
        """
        self.env = env
        self._look = look
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
            if self._substeps % scene.substeps == 0:
                self._look()

    def _advance(self, substeps: int) -> None:
        self.env.backend.set_joint_targets(self._target)
        self.env.backend.step(substeps)

    def read(self) -> Reading:
        """Return the present state of every world."""
        backend = self.env.backend
        state = backend.state()
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
        )

    def send(self, target: np.ndarray) -> None:
        """Set the targets [N, J] of the drives."""
        self._target = torch.as_tensor(target, device=self.env.device)

    def stop(self) -> None:
        """Do nothing: the drives hold the last targets."""


def _array(value: Tensor) -> np.ndarray:
    return value.cpu().numpy().copy()


def begin_episodes(controller: Controller, env: ManipulationEnv) -> None:
    """Begin an episode in every world of an environment, with its object, goal and targets.

    Args:
        controller: the policy.
        env: the worlds, just reset.
    """
    objects = env.backend.scene.objects
    index = env.backend.object_index.tolist()
    count = controller.shapes.get("object_points", (1, 3))[0]
    known = [known_of(each, count) for each in objects]
    of_worlds = {}
    for name in known[0]:
        of_worlds[name] = np.stack([each[name] for each in known])[index]
    goal = (_array(env.goal_pos), _array(env.goal_quat))
    controller.begin(of_worlds, *goal, _array(env.joint_target))


def centers(env: ManipulationEnv) -> np.ndarray:
    """[N, 3] center of each world's object, in its frame [m]."""
    each = np.stack([center(spec) for spec in env.backend.scene.objects])
    return each[env.backend.object_index.tolist()].astype(np.float32)


class GraphPolicy:
    """A deployed policy in an environment: the graph takes readings, and its targets become actions."""

    def __init__(self, controller: Controller) -> None:
        """Take a policy."""
        self._controller = controller

    def begin(self, env: ManipulationEnv) -> None:
        """Begin an episode in every world; ``PolicyError`` if the policy is of another robot."""
        contract = training_of(self._controller, "The graph")
        check_made_for("The graph", contract, env.backend.scene.robot)
        self._env = env
        self._driver = EngineDriver(env)
        self._center = torch.as_tensor(centers(env), device=env.device)
        begin_episodes(self._controller, env)

    def act(self, observations: Any) -> Tensor:
        """[N, J] actions whose targets are those of the graph. The tracker of the environment reports the object."""
        env = self._env
        reading = self._driver.read()
        pos, quat = env.tracked_pose
        if env.task.object_frame == "center":
            pos = pos - quat_rotate(quat, self._center)
        reading = replace(reading, object_pos=_array(pos), object_quat=_array(quat))
        self._controller.set_goal(_array(env.goal_pos), _array(env.goal_quat))
        self._controller.target = _array(env.joint_target)
        target = torch.as_tensor(self._controller.step(reading), device=env.device)
        action = env.actions.action_for(target, env.joint_target)
        return action if env.slots is None else env.slots.joints(action)
