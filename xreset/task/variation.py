"""Differences between one world and the next: physical parameters, delays, pushes and faults of sensors.

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
from xreset.task.pushes import Pushes
from xreset.task.randomization import (
    own_friction,
    sample_drives,
    sample_friction,
    sample_offset,
    sample_range,
)
from xreset.task.tracker import Tracker


class Variation:
    """Fixed buffers of N worlds. A range that has its default costs nothing and draws no random number.

    Attributes:
        parameters: physical parameters [N, ...] by name, without the gravity fraction, which belongs to the start of an
            episode.
        force_gain: [N, 1, 1] factor on the observed forces; None: 1.
        pushes: pushes on object and arm; None: there are none.
        fault_scale: [] factor on delays, lost actions, faults of the tracker and the probability of pushes; None: 1.
    """

    def __init__(self, backend: Backend, config: RandomizationConfig, is_arm: Tensor, proprio_width: int) -> None:
        """Allocate.

        Args:
            is_arm: [J] bool.
            proprio_width: numbers in the observation group ``proprio``.

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
        push = config.push
        pushed = config.draws("push")
        needed = [*self.parameters, *(["object_wrench"] if pushed and push.moves_object else [])]
        missing = [name.replace("_", " ") for name in needed if name not in backend.capabilities]
        if missing:
            raise CapabilityError(
                f"The backend {backend.name!r} cannot set {', '.join(missing)} in each world, which this task draws. "
                "Leave these ranges of task.randomization at their defaults, or use another backend."
            )
        self.force_gain = zeros(1, 1) + 1 if config.draws("force_gain") else None
        self._commands = None
        if config.draws("action_latency", "hand_latency"):
            hand_latency = config.hand_latency or (0.0, 0.0)
            longest = max(config.action_latency[1], hand_latency[1])
            self._commands = DelayLine(zeros(joints), longest, by_column=config.hand_latency is not None)
        self._proprio = (
            DelayLine(zeros(proprio_width), config.proprio_latency[1]) if config.draws("proprio_latency") else None
        )
        self._lost_actions = zeros(1) if config.draws("lost_actions") else None
        self._tracker = Tracker(backend.num_worlds, config, device)
        self.fault_scale: Tensor | None = None
        self.pushes = Pushes(backend, push, is_arm) if pushed else None

    def set_fault_scale(self, scale: float) -> None:
        """Set the factor on all faults of a real loop. The first call must come before the first step."""
        if self.fault_scale is None:
            self.fault_scale = torch.ones((), device=self._backend.device)
            self._tracker.fault_scale = self.fault_scale
        self.fault_scale.fill_(scale)

    def lasting(self) -> dict[str, Tensor]:
        """Return all buffers by name, for a snapshot."""
        lasting = {f"_parameters.{name}": value for name, value in self.parameters.items()}
        if self.force_gain is not None:
            lasting["_force_gain"] = self.force_gain
        if self._commands is not None:
            lasting |= self._commands.lasting("_commands")
        if self._proprio is not None:
            lasting |= self._proprio.lasting("_proprio")
        if self._lost_actions is not None:
            lasting["_lost_actions"] = self._lost_actions
        if self.pushes is not None:
            lasting |= {"_pushes.probability": self.pushes.probability, "_pushes.gate": self.pushes.gate}
        return lasting | self._tracker.lasting()

    def draw(self, generator: torch.Generator) -> list[tuple[Tensor, Tensor]]:
        """Draw for every world; return pairs of the drawn values [N, ...] and the buffer that they belong to."""
        c = self._config
        n = self._backend.num_worlds
        mass_scale = c.mass_scale if c.enabled else (1.0, 1.0)

        def friction() -> Tensor:
            drawn = sample_friction(n, c, generator) + self._own_friction
            return drawn.clamp(min=0.05)  # slippery, not negative

        samples: dict[str, Callable[[], Tensor]] = {
            "friction": friction,
            "object_mass": lambda: self._nominal_mass * sample_range(n, mass_scale, generator),
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
        faults: list[tuple[Tensor, Tensor]] = []
        if self._commands is not None:
            delay = sample_range(n, c.action_latency, generator)
            if c.hand_latency is not None:
                hand_delay = sample_range(n, c.hand_latency, generator)
                delay = torch.where(self._is_arm, delay[:, None], hand_delay[:, None])
            faults.append((delay, self._commands.delay))
        faults += self._tracker.draw(generator)
        if self._proprio is not None:
            faults.append((sample_range(n, c.proprio_latency, generator), self._proprio.delay))
        if self._lost_actions is not None:
            faults.append((sample_range(n, c.lost_actions, generator)[:, None], self._lost_actions))
        if self.pushes is not None:
            faults.append(self.pushes.draw(generator))
        if self.fault_scale is not None:
            faults = [(value * self.fault_scale, kept) for value, kept in faults]
        return drawn + faults

    def begin(self, fresh: Tensor, target: Tensor) -> None:
        """Fill the delay line of the worlds of a mask [N] with the start's joint targets [N, J]."""
        if self._commands is not None:
            self._commands.fill(fresh, target)
        if self.pushes is not None:
            self.pushes.gate &= ~fresh

    def received_targets(self, new: Tensor, old: Tensor, generator: torch.Generator) -> Tensor:
        """[N, J] the new joint targets, or the old ones in worlds whose action is lost."""
        if self._lost_actions is None:
            return new
        lost = torch.rand(self._lost_actions.shape, generator=generator, device=new.device) < self._lost_actions
        return torch.where(lost, old, new)

    def sent_targets(self, target: Tensor, state: State, generator: torch.Generator) -> Tensor:
        """[N, J] the joint targets that reach the drives in this step, moved where the arm is pushed."""
        if self._commands is not None:
            target = self._commands.push(target)
        if self.pushes is None:
            return target
        inertia_scale = self.parameters.get("object_inertia", 1.0)
        return target + self.pushes.act(state, self.parameters["object_mass"], inertia_scale, generator)

    def observed_proprio(self, proprio: Tensor, fresh: Tensor) -> Tensor:
        """[N, D] joints, links and forces as they are observed, possibly delayed.

        In the ``fresh`` worlds [N] the present values become the whole past.
        """
        if self._proprio is None:
            return proprio
        self._proprio.fill(fresh, proprio)
        return self._proprio.push(proprio, self._proprio.delay.round())

    def scaled_forces(self, force: Tensor) -> Tensor:
        """[N, E, 3] forces as they are observed."""
        return force * (1.0 if self.force_gain is None else self.force_gain)

    def observed_pose(self, state: State, fresh: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return the object's position [N, 3] and orientation [N, 4] as its tracker reports them.

        In the ``fresh`` worlds [N] the present pose becomes the whole past.
        """
        return self._tracker.observe(state.object_pos, state.object_quat, fresh, generator)
