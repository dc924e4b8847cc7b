"""Pushes on object and arm at random times, each one control step long."""

from __future__ import annotations

from math import log

import torch
from torch import Tensor

from xreset.geometry.rotations import quat_rotate, quat_rotate_inverse
from xreset.physics import Backend, State
from xreset.task.config import PushConfig
from xreset.task.randomization import Drawn, sample_offset, sample_range


class Pushes:
    """Fixed buffers of N worlds.

    Attributes:
        force: [N, 3] force of this step's pushes at the object's centre of mass [N], world frame.
        torque: [N, 3] their torque [N m], world frame.
        gate: [N] bool, whether the reward's gate was open after the last step.
    """

    def __init__(self, faults: Drawn, backend: Backend, config: PushConfig, is_arm: Tensor) -> None:
        """Allocate, and have the probabilities drawn with the other ``faults``; ``is_arm`` [J] bool."""
        self.config = config
        n = backend.num_worlds
        device = backend.device
        low, high = (log(limit) for limit in config.probability)
        scene = backend.scene
        self._control_dt = scene.control_dt
        self._inertia = torch.stack(
            [torch.as_tensor(o.inertia / o.mass, dtype=torch.float32) for o in scene.objects]
        )
        self._inertia = self._inertia.to(device)[backend.object_index]
        """[N, 3, 3] for a mass of 1 kg, in the mesh frame."""
        effort_over_stiffness = [
            joint.drive.effort / joint.drive.kp for joint in scene.robot.joints
        ]
        self._largest_offset = torch.where(
            is_arm, torch.tensor(effort_over_stiffness, device=device), 0.0
        )
        self._largest_offset *= config.arm_torque
        self._probability = faults.keep(
            "pushes.probability",
            faults.zeros(),
            lambda generator: sample_range(n, (low, high), generator).exp(),
        )
        """[N] of a push in a control step."""
        self.force = faults.zeros(3)
        self.torque = faults.zeros(3)
        self.gate = faults.keep("pushes.gate", faults.zeros().bool())

    def act(
        self, state: State, mass: Tensor, inertia_scale: Tensor | float, generator: torch.Generator
    ) -> Tensor:
        """Set force and torque on the object for this step, and return offsets [N, J] of the joints' targets.

        Args:
            state: present state.
            mass: [N] of the object [kg].
            inertia_scale: [N] or number, factor on the object's inertia in addition to that of its mass.
            generator: random numbers.
        """
        c = self.config
        n = len(mass)
        happens = (
            torch.rand(n, 3, generator=generator, device=generator.device)
            < self._probability[:, None]
        )
        if c.moves_object:
            allowed = happens[:, :2] if c.when == "always" else happens[:, :2] & self.gate[:, None]
            velocity = sample_offset(n, (0.0, c.object_velocity), generator) * allowed[:, :1]
            self.force.copy_(mass[:, None] * velocity / self._control_dt)
            spin = sample_offset(n, (0.0, c.object_spin), generator) * allowed[:, 1:]
            local = quat_rotate_inverse(state.object_quat, spin)
            moment = (self._inertia @ local[..., None])[..., 0] * (mass * inertia_scale)[:, None]
            self.torque.copy_(quat_rotate(state.object_quat, moment) / self._control_dt)
        size = (
            2.0 * torch.rand(state.joint_pos.shape, generator=generator, device=generator.device)
            - 1.0
        )
        return self._largest_offset * size * happens[:, 2:]
