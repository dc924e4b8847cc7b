"""Differences between one world and the next: physical parameters, delays, pushes and faults of sensors.

All are drawn again with every episode.
"""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from xreset.errors import CapabilityError
from xreset.physics import Backend, State
from xreset.task.config import RandomizationConfig
from xreset.task.latency import DelayLine
from xreset.task.pushes import Pushes
from xreset.task.randomization import (
    Drawn,
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
        lasting: all buffers by name, for a snapshot.
        fault_scale: [] factor on delays, lost actions, faults of the tracker and the probability of pushes.
    """

    def __init__(
        self, backend: Backend, config: RandomizationConfig, is_arm: Tensor, proprio_width: int
    ) -> None:
        """Allocate.

        Args:
            is_arm: [J] bool.
            proprio_width: numbers in the observation group ``proprio``.

        Raises:
            CapabilityError: the engine cannot set a parameter that is drawn.
        """
        scene = backend.scene
        n = backend.num_worlds
        c = config
        mass = torch.tensor([o.mass for o in scene.objects], device=backend.device)[
            backend.object_index
        ]
        offset = own_friction([o.friction for o in scene.objects], c).to(backend.device)[
            backend.object_index
        ]

        def friction(generator: torch.Generator) -> Tensor:
            drawn = sample_friction(n, c, generator) + offset
            return drawn.clamp(min=0.05)  # slippery, not negative

        def torsional(generator: torch.Generator) -> Tensor:
            return scene.friction.torsional * sample_range(n, c.torsional_friction, generator)

        mass_scale = c.mass_scale if c.enabled else (1.0, 1.0)
        self._physical = Drawn(n, backend.device)
        self.parameters: dict[str, Tensor] = {}
        for name, shape, is_drawn, sample in (
            ("friction", (3,), True, friction),
            (
                "object_mass",
                (),
                True,
                lambda generator: mass * sample_range(n, mass_scale, generator),
            ),
            ("drives", (3, len(is_arm)), c.scales_drives, partial(sample_drives, is_arm, n, c)),
            ("torsional_friction", (), c.draws("torsional_friction"), torsional),
            (
                "object_inertia",
                (),
                c.draws("object_inertia"),
                partial(sample_range, n, c.object_inertia),
            ),
            ("object_com", (3,), c.draws("object_com"), partial(sample_offset, n, c.object_com)),
        ):
            if is_drawn:
                self.parameters[name] = self._physical.keep(
                    name, self._physical.zeros(*shape), sample
                )
        pushed = c.draws("push")
        needed = [*self.parameters, *(["object_wrench"] if pushed and c.push.moves_object else [])]
        missing = [name.replace("_", " ") for name in needed if name not in backend.capabilities]
        if missing:
            raise CapabilityError(
                f"The backend {backend.name!r} cannot set {', '.join(missing)} in each world, which this task draws. "
                "Leave these ranges of task.randomization at their defaults, or use another backend."
            )
        self.force_gain: Tensor | None = None
        if c.draws("force_gain"):
            self.force_gain = self._physical.ranged("force_gain", c.force_gain, 1, 1)
        self.fault_scale = torch.ones((), device=backend.device)
        faults = Drawn(n, backend.device)
        self._faults = faults
        self._commands: DelayLine | None = None
        if c.draws("action_latency", "hand_latency"):

            def delay(generator: torch.Generator) -> Tensor:
                of_arm = sample_range(n, c.action_latency, generator)[:, None]
                of_hand = of_arm
                if c.hand_latency is not None:
                    of_hand = sample_range(n, c.hand_latency, generator)[:, None]
                return torch.where(is_arm, of_arm, of_hand)

            longest = max(c.action_latency[1], (c.hand_latency or (0.0, 0.0))[1])
            self._commands = faults.delay_line(
                "commands", len(is_arm), longest, delay, by_column=True
            )
        self._tracker = Tracker(faults, c, self.fault_scale)
        self._proprio: DelayLine | None = None
        if c.draws("proprio_latency"):
            age = partial(sample_range, n, c.proprio_latency)
            self._proprio = faults.delay_line("proprio", proprio_width, c.proprio_latency[1], age)
        self._lost_actions: Tensor | None = None
        if c.draws("lost_actions"):
            self._lost_actions = faults.ranged("lost_actions", c.lost_actions, 1)
        self.pushes = Pushes(faults, backend, c.push, is_arm) if pushed else None
        self.lasting = self._physical.lasting | faults.lasting

    def draw(self, generator: torch.Generator) -> list[tuple[Tensor, Tensor]]:
        """Draw for every world; return pairs of the drawn values [N, ...] and the buffer that they belong to."""
        drawn = self._physical.draw(generator)
        faults = self._faults.draw(generator)
        return drawn + [(value * self.fault_scale, kept) for value, kept in faults]

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
        lost = (
            torch.rand(self._lost_actions.shape, generator=generator, device=new.device)
            < self._lost_actions
        )
        return torch.where(lost, old, new)

    def sent_targets(self, target: Tensor, state: State, generator: torch.Generator) -> Tensor:
        """[N, J] the joint targets that reach the drives in this step, moved where the arm is pushed."""
        if self._commands is not None:
            target = self._commands.push(target)
        if self.pushes is None:
            return target
        inertia_scale = self.parameters.get("object_inertia", 1.0)
        return target + self.pushes.act(
            state, self.parameters["object_mass"], inertia_scale, generator
        )

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

    def observed_pose(
        self, state: State, fresh: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Return the object's position [N, 3] and orientation [N, 4] as its tracker reports them.

        In the ``fresh`` worlds [N] the present pose becomes the whole past.
        """
        return self._tracker.observe(state.object_pos, state.object_quat, fresh, generator)
