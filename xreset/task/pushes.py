"""Pushes on object and arm at random times, each one control step long."""

from __future__ import annotations

from math import log

import torch
from torch import Tensor

from xreset.geometry.rotations import quat_rotate, quat_rotate_inverse
from xreset.physics import Backend, State
from xreset.task.config import PushConfig
from xreset.task.randomization import sample_offset, sample_range, symmetric, uniform
from xreset.task.worlds import Worlds


class Pushes:
    """Pushes of N worlds, in fixed buffers.

    Attributes:
        force: [N, 3] force of this step's pushes at the object's centre of mass [N], world frame.
        torque: [N, 3] their torque [N m], world frame.
        gate: [N] bool, whether the reward's gate was open after the last step.
    """

    def __init__(
        self, worlds: Worlds, backend: Backend, config: PushConfig, is_arm: Tensor
    ) -> None:
        """Allocate, and register what is drawn at each reset; ``is_arm`` [J] bool."""
        self.config = config
        low, high = (log(limit) for limit in config.probability)
        scene = backend.scene
        self._control_dt = scene.control_dt
        inertia = [torch.as_tensor(o.inertia / o.mass, dtype=torch.float32) for o in scene.objects]
        self._inertia = torch.stack(inertia).to(backend.device)[backend.object_index]
        """[N, 3, 3] for a mass of 1 kg, in the mesh frame."""
        drives = [joint.drive for joint in scene.robot.joints]
        offsets = torch.tensor([each.effort / each.kp for each in drives], device=backend.device)
        self._largest_offset = torch.where(is_arm, offsets, 0.0) * config.arm_torque
        self._probability = worlds.keep(
            "pushes.probability",
            worlds.zeros(),
            lambda generator: sample_range(worlds.num_worlds, (low, high), generator).exp(),
        )
        """[N] probability of a push in a control step."""
        self.force = worlds.zeros(3)
        self.torque = worlds.zeros(3)
        self.gate = worlds.keep("pushes.gate", worlds.zeros().bool())

    def act(
        self, state: State, mass: Tensor, inertia_scale: Tensor | float, generator: torch.Generator
    ) -> Tensor:
        """Set force and torque on the object for this step, and return offsets [N, J] of the joints' targets.

        Args:
            state: present state.
            mass: [N] mass of the object [kg].
            inertia_scale: [N] or number, factor on the object's inertia in addition to the change with its mass.
            generator: random numbers.
        """
        c = self.config
        n = len(mass)
        happens = uniform((n, 3), generator) < self._probability[:, None]
        if c.moves_object:
            allowed = happens[:, :2]
            if c.when == "gated":
                allowed = allowed & self.gate[:, None]
            velocity = sample_offset(n, (0.0, c.object_velocity), generator) * allowed[:, :1]
            self.force.copy_(mass[:, None] * velocity / self._control_dt)
            spin = sample_offset(n, (0.0, c.object_spin), generator) * allowed[:, 1:]
            local = quat_rotate_inverse(state.object_quat, spin)
            moment = (self._inertia @ local[..., None])[..., 0] * (mass * inertia_scale)[:, None]
            self.torque.copy_(quat_rotate(state.object_quat, moment) / self._control_dt)
        size = symmetric(state.joint_pos.shape, generator)
        return self._largest_offset * size * happens[:, 2:]
