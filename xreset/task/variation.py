"""Differences between one world and the next: physical parameters, delays, pushes and faults of sensors.

All are drawn again with every episode.
"""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from xreset.errors import CapabilityError
from xreset.physics import Backend, Links, Parameter, Parameters, State
from xreset.task.config import RandomizationConfig
from xreset.task.latency import DelayLine
from xreset.task.pushes import Pushes
from xreset.task.randomization import (
    own_friction,
    sample_drives,
    sample_friction,
    sample_offset,
    sample_range,
    uniform,
)
from xreset.task.tracker import Tracker
from xreset.task.worlds import Sample, Worlds

_OF_LINK = 13
"""Numbers of a link: position, orientation and velocities."""


class Variation:
    """Differences between N worlds, in fixed buffers. A range that has its default costs nothing and draws no random
    number.

    Attributes:
        parameters: physical parameters [N, ...] by name, without the gravity fraction, which belongs to the start of an
            episode.
        force_gain: [N, 1, 1] factor on the observed forces, or 1.
        tracker: reports the object's pose.
        pushes: pushes on object and arm; None: there are none.
    """

    def __init__(
        self,
        worlds: Worlds,
        backend: Backend,
        config: RandomizationConfig,
        is_arm: Tensor,
        proprio_width: int,
    ) -> None:
        """Allocate.

        Args:
            worlds: state of the worlds; this object adds its buffers.
            backend: the worlds.
            config: what is drawn.
            is_arm: [J] bool.
            proprio_width: numbers in the observation group ``proprio``.

        Raises:
            CapabilityError: the engine cannot set a parameter that is drawn.
        """
        c = config
        n = worlds.num_worlds
        self._is_arm = is_arm
        self._config = config
        self.parameters = self._keep_parameters(worlds, backend)
        self._check_capabilities(backend)
        self.force_gain: Tensor | float = 1.0
        if c.draws("force_gain"):
            gain = partial(sample_range, n, c.force_gain)
            self.force_gain = worlds.keep("force_gain", worlds.zeros(1, 1), gain)
        longest = max(c.longest("action_latency"), c.longest("hand_latency"))
        self._commands = DelayLine(
            worlds, "commands", len(is_arm), longest, self._sample_action_latency, by_column=True
        )
        self.tracker = Tracker(worlds, c)
        age = partial(sample_range, n, c.proprio_latency)
        longest = c.longest("proprio_latency")
        width = proprio_width + _OF_LINK * len(backend.scene.robot.tracked_links)
        self._proprio = DelayLine(worlds, "proprio", width, longest, age)
        self._lost_actions: Tensor | None = None
        if c.draws("lost_actions"):
            share = partial(sample_range, n, c.lost_actions)
            self._lost_actions = worlds.keep("lost_actions", worlds.zeros(1), share)
        self.pushes = Pushes(worlds, backend, c.push, is_arm) if c.draws("push") else None

    def _check_capabilities(self, backend: Backend) -> None:
        """Raise ``CapabilityError`` if the engine cannot set a parameter that is drawn."""
        needed = list(self.parameters)
        if self._config.draws("push") and self._config.push.moves_object:
            needed.append("object_wrench")
        missing = [name.replace("_", " ") for name in needed if name not in backend.capabilities]
        if missing:
            raise CapabilityError(
                f"The engine {backend.name!r} cannot set {', '.join(missing)} in each world, which this task draws. "
                "Use another engine, or in a training leave these ranges of task.randomization at their defaults."
            )

    def _keep_parameters(self, worlds: Worlds, backend: Backend) -> dict[str, Tensor]:
        """Return the physical parameters that are drawn, by name."""
        c = self._config
        n = worlds.num_worlds
        objects = backend.scene.objects
        nominal = Parameters.nominal(backend.scene, backend.object_index).to(backend.device).given()
        offset_of_object = own_friction([o.friction for o in objects], c).to(backend.device)
        offset = offset_of_object[backend.object_index]

        def friction(generator: torch.Generator) -> Tensor:
            drawn_friction = sample_friction(n, c, generator) + offset
            return drawn_friction.clamp(min=0.05)  # slippery, not negative

        def scaled(name: Parameter, limits: tuple[float, float]) -> Sample:
            return lambda generator: nominal[name] * sample_range(n, limits, generator)

        samples: dict[Parameter, Sample] = {
            "friction": friction,
            "object_mass": scaled("object_mass", c.mass_scale if c.enabled else (1.0, 1.0)),
        }
        if c.scales_drives:
            samples["drives"] = partial(sample_drives, self._is_arm, n, c)
        if c.draws("torsional_friction"):
            samples["torsional_friction"] = scaled("torsional_friction", c.torsional_friction)
        if c.draws("object_inertia"):
            samples["object_inertia"] = scaled("object_inertia", c.object_inertia)
        if c.draws("object_com"):
            samples["object_com"] = partial(sample_offset, n, c.object_com)
        return {
            name: worlds.keep(name, torch.zeros_like(nominal[name]), sample)
            for name, sample in samples.items()
        }

    def _sample_action_latency(self, generator: torch.Generator) -> Tensor:
        """[N, J] delays of the joints' targets [control steps]."""
        c = self._config
        n = len(self.parameters["object_mass"])
        of_arm = sample_range(n, c.action_latency, generator)[:, None]
        of_hand = of_arm
        if c.hand_latency is not None:
            of_hand = sample_range(n, c.hand_latency, generator)[:, None]
        return torch.where(self._is_arm, of_arm, of_hand)

    def begin_episodes(self, fresh: Tensor, target: Tensor) -> None:
        """Fill the delay line of the worlds of a mask [N] with the start's joint targets [N, J], and close the gate of
        their pushes."""
        self._commands.fill(fresh, target)
        if self.pushes is not None:
            self.pushes.gate &= ~fresh

    def received_targets(self, new: Tensor, old: Tensor, generator: torch.Generator) -> Tensor:
        """[N, J] the new joint targets, or the old ones in worlds whose action is lost."""
        if self._lost_actions is None:
            return new
        lost = uniform(self._lost_actions.shape, generator) < self._lost_actions
        return torch.where(lost, old, new)

    def sent_targets(self, target: Tensor, state: State, generator: torch.Generator) -> Tensor:
        """[N, J] the joint targets that reach the drives in this step, with the offsets of pushes on the arm."""
        target = self._commands.push(target)
        if self.pushes is None:
            return target
        inertia_scale = self.parameters.get("object_inertia", 1.0)
        mass = self.parameters["object_mass"]
        return target + self.pushes.act(state, mass, inertia_scale, generator)

    def observed_proprio(
        self, proprio: Tensor, links: Links, fresh: Tensor
    ) -> tuple[Tensor, Links]:
        """Return what a robot observes of itself, possibly delayed.

        Args:
            proprio: [N, D] the observation group.
            links: [N, 1 + E, ...] palm and fingertips, as late as the joints that they follow from.
            fresh: [N] bool: worlds in which the present values become the whole past.
        """
        if not self._proprio.longest:
            return proprio, links
        of_links = torch.cat((links.pos, links.quat, links.linvel, links.angvel), dim=-1)
        now = torch.cat((proprio, of_links.flatten(1)), dim=1)
        self._proprio.fill(fresh, now)
        late = self._proprio.push(now, self._proprio.delay.round())
        proprio, of_links = late.split((proprio.shape[1], of_links[0].numel()), dim=1)
        each = of_links.unflatten(1, (-1, _OF_LINK))
        pos, quat, linvel, angvel = each.split((3, 4, 3, 3), dim=-1)
        return proprio, Links(pos=pos, quat=quat, linvel=linvel, angvel=angvel)
