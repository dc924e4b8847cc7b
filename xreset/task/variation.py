"""Differences between one world and the next: physical parameters, delays and the gain of observed forces.

All are drawn again with every episode.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from xreset.errors import CapabilityError
from xreset.physics import Backend, State
from xreset.task.config import RandomizationConfig
from xreset.task.latency import DelayLine
from xreset.task.randomization import (
    own_friction,
    sample_drives,
    sample_friction,
    sample_mass_scale,
    sample_offset,
    sample_range,
)


class Variation:
    """Fixed buffers of N worlds. A range that has its default costs nothing and draws no random number.

    Attributes:
        parameters: physical parameters [N, ...] by name, without the gravity fraction, which belongs to the start of an
            episode.
        force_gain: [N, 1, 1] factor on the observed forces; None: 1.
    """

    def __init__(self, backend: Backend, config: RandomizationConfig, is_arm: Tensor) -> None:
        """Allocate.

        Args:
            is_arm: [J] bool.

        Raises:
            CapabilityError: the engine cannot set a parameter that is drawn.
        """
        self._backend = backend
        self._config = config
        self._is_arm = is_arm
        objects = backend.scene.objects
        device = backend.device
        joints = len(is_arm)
        self._nominal_mass = torch.tensor([o.mass for o in objects], device=device)[backend.object_index]
        self._own_friction = own_friction([o.friction for o in objects], config).to(device)[backend.object_index]

        def zeros(*shape: int) -> Tensor:
            return torch.zeros(backend.num_worlds, *shape, device=device)

        self.parameters = {"friction": zeros(3), "object_mass": zeros()}
        if config.scales_drives:
            self.parameters["drives"] = zeros(3, joints)
        for name, shape in (("torsional_friction", ()), ("object_inertia", ()), ("object_com", (3,))):
            if config.draws(name):
                self.parameters[name] = zeros(*shape)
        missing = [name.replace("_", " ") for name in self.parameters if name not in backend.capabilities]
        if missing:
            raise CapabilityError(
                f"The backend {backend.name!r} cannot set {', '.join(missing)} in each world, which this task draws. "
                "Leave these ranges of task.randomization at their defaults, or use another backend."
            )
        self.force_gain = zeros(1, 1) + 1 if config.draws("force_gain") else None
        action_latency = config.action_latency[1] if config.enabled else 0.0
        observation_latency = config.observation_latency[1] if config.enabled else 0.0
        self._commands = DelayLine(zeros(joints), action_latency) if action_latency else None
        self._poses = DelayLine(zeros(7), observation_latency) if observation_latency else None

    def lasting(self) -> dict[str, Tensor]:
        """Return all buffers by name, for a snapshot."""
        lasting = {f"_parameters.{name}": value for name, value in self.parameters.items()}
        if self.force_gain is not None:
            lasting["_force_gain"] = self.force_gain
        for name in ("_commands", "_poses"):
            if (line := getattr(self, name)) is not None:
                lasting |= {f"{name}.values": line.values, f"{name}.delay": line.delay}
        return lasting

    def draw(self, generator: torch.Generator) -> list[tuple[Tensor, Tensor]]:
        """Draw for every world; return pairs of the drawn values [N, ...] and the buffer that they belong to."""
        c = self._config
        n = self._backend.num_worlds

        def friction() -> Tensor:
            drawn = sample_friction(n, c, generator) + self._own_friction
            return drawn.clamp(min=0.05)  # slippery, not negative

        samples: dict[str, Callable[[], Tensor]] = {
            "friction": friction,
            "object_mass": lambda: self._nominal_mass * sample_mass_scale(n, c, generator),
            "drives": lambda: sample_drives(self._is_arm, n, c, generator),
            "torsional_friction": lambda: (
                self._backend.scene.friction.torsional * sample_range(n, c.torsional_friction, generator)
            ),
            "object_inertia": lambda: sample_range(n, c.object_inertia, generator),
            "object_com": lambda: sample_offset(n, c.object_com, generator),
        }
        drawn = [(samples[name](), kept) for name, kept in self.parameters.items()]
        if self.force_gain is not None:
            drawn.append((sample_range(n, c.force_gain, generator).view(-1, 1, 1), self.force_gain))
        for line, limits in ((self._commands, c.action_latency), (self._poses, c.observation_latency)):
            if line is not None:
                drawn.append((sample_range(n, limits, generator), line.delay))
        return drawn

    def begin(self, fresh: Tensor, target: Tensor) -> None:
        """Fill the delay line of the worlds of a mask [N] with the start's joint targets [N, J]."""
        if self._commands is not None:
            self._commands.fill(fresh, target)

    def delayed_targets(self, target: Tensor) -> Tensor:
        """[N, J] the joint targets that reach the drives in this step."""
        return target if self._commands is None else self._commands.push(target)

    def scaled_forces(self, force: Tensor) -> Tensor:
        """[N, E, 3] forces as they are observed."""
        return force * (1.0 if self.force_gain is None else self.force_gain)

    def observed_pose(self, state: State, fresh: Tensor) -> tuple[Tensor, Tensor]:
        """Return the object's position [N, 3] and orientation [N, 4] as they are observed, possibly delayed.

        In the ``fresh`` worlds [N] the present pose becomes the whole past.
        """
        if self._poses is None:
            return state.object_pos, state.object_quat
        last = self._poses.values[:, 0, 3:]
        opposite = (state.object_quat * last).sum(dim=-1, keepdim=True) < 0
        # Of a rotation's two quaternions the one near the last is kept, so that interpolation takes the short way.
        quat = torch.where(opposite, -state.object_quat, state.object_quat)
        pose = torch.cat((state.object_pos, quat), dim=-1)
        self._poses.fill(fresh, pose)
        pos, quat = self._poses.push(pose).split((3, 4), dim=-1)
        return pos, torch.nn.functional.normalize(quat, dim=-1)
