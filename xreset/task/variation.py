"""What differs between one world and the next, drawn anew with every episode: physical parameters, latencies, the gain of felt forces."""

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
    """Fixed buffers of N worlds. What a task leaves as it is has none: then it costs nothing, and draws no random number.

    Attributes:
        parameters: physical parameters [N, ...] by name, besides the gravity fraction, which belongs to an episode's start.
        force_gain: [N, 1, 1] factor on the forces that are observed; None: 1.
    """

    def __init__(self, backend: Backend, config: RandomizationConfig, is_arm: Tensor) -> None:
        """Allocate.

        Args:
            is_arm: [J] bool.

        Raises:
            CapabilityError: the engine cannot set what is to be drawn.
        """
        self._backend, self._config, self._is_arm = backend, config, is_arm
        n, joints, objects, device = backend.num_worlds, len(is_arm), backend.scene.objects, backend.device
        self._nominal_mass = torch.tensor([o.mass for o in objects], device=device)[backend.object_index]
        self._own_friction = own_friction([o.friction for o in objects], config).to(device)[backend.object_index]

        def zeros(*shape: int) -> Tensor:
            return torch.zeros(n, *shape, device=device)

        self.parameters = {"friction": zeros(3), "object_mass": zeros()}
        if config.scales_drives:
            self.parameters["drives"] = zeros(3, joints)
        for name, shape in (("torsional_friction", ()), ("object_inertia", ()), ("object_com", (3,))):
            if config.draws(name):
                self.parameters[name] = zeros(*shape)
        if missing := [name.replace("_", " ") for name in self.parameters if name not in backend.capabilities]:
            raise CapabilityError(
                f"the backend {backend.name!r} cannot set {', '.join(missing)} world by world, which this task draws at random: leave "
                "those ranges of task.randomization as they are by default, or use another backend."
            )
        self.force_gain = torch.ones(n, 1, 1, device=device) if config.draws("force_gain") else None
        late_actions, late_poses = (
            limits[1] if config.enabled else 0.0 for limits in (config.action_latency, config.observation_latency)
        )
        self._commands = DelayLine(zeros(joints), late_actions) if late_actions else None
        self._poses = DelayLine(zeros(7), late_poses) if late_poses else None

    def lasting(self) -> dict[str, Tensor]:
        """All buffers by name: what a snapshot holds."""
        lasting = {f"_parameters.{name}": value for name, value in self.parameters.items()}
        if self.force_gain is not None:
            lasting["_force_gain"] = self.force_gain
        for name in ("_commands", "_poses"):
            if (line := getattr(self, name)) is not None:
                lasting |= {f"{name}.values": line.values, f"{name}.delay": line.delay}
        return lasting

    def draw(self, generator: torch.Generator) -> list[tuple[Tensor, Tensor]]:
        """Draw all anew, for every world: pairs of what was drawn [N, ...] and the buffer that it belongs into."""
        c, n = self._config, self._backend.num_worlds
        samples: dict[str, Callable[[], Tensor]] = {
            "friction": lambda: (sample_friction(n, c, generator) + self._own_friction).clamp(
                min=0.05
            ),  # slippery, not negative
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
        """In the worlds of a mask [N], the drives have been told their targets [N, J] for long."""
        if self._commands is not None:
            self._commands.fill(fresh, target)

    def heard(self, target: Tensor) -> Tensor:
        """[N, J] the drives' targets as they arrive, which may be late."""
        return target if self._commands is None else self._commands.push(target)

    def felt(self, force: Tensor) -> Tensor:
        """Forces [N, E, 3] as they are observed."""
        return force * (1.0 if self.force_gain is None else self.force_gain)

    def seen(self, state: State, fresh: Tensor) -> tuple[Tensor, Tensor]:
        """[N, 3], [N, 4] the object's pose as it is seen, which may be late; in the ``fresh`` worlds [N] it has been there for long."""
        if self._poses is None:
            return state.object_pos, state.object_quat
        last = self._poses.values[:, 0, 3:]
        facing = (state.object_quat * last).sum(
            dim=-1, keepdim=True
        ) < 0  # of a rotation's two quaternions, the one near the last
        pose = torch.cat((state.object_pos, torch.where(facing, -state.object_quat, state.object_quat)), dim=-1)
        self._poses.fill(fresh, pose)
        pos, quat = self._poses.push(pose).split((3, 4), dim=-1)
        return pos, torch.nn.functional.normalize(quat, dim=-1)
