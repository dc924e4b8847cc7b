"""Object poses as a tracker reports them: late, wrong, or missing."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from xreset.geometry.rotations import quat_from_axis_angle, quat_multiply
from xreset.task.config import RandomizationConfig, TrackerConfig
from xreset.task.latency import DelayLine
from xreset.task.randomization import sample_range, symmetric, uniform
from xreset.task.worlds import Worlds


class Tracker:
    """Fixed buffers of N worlds. A fault that is off costs nothing and draws no random number."""

    def __init__(self, worlds: Worlds, config: RandomizationConfig) -> None:
        """Allocate, and register what is drawn at each reset."""
        c = config.tracker if config.enabled else TrackerConfig()
        self._config = c
        delay = partial(sample_range, worlds.num_worlds, config.observation_latency)
        longest = config.longest("observation_latency")
        self._delays = DelayLine(worlds, "poses", 7, longest, delay)
        if c.has_errors:
            shape = (worlds.num_worlds, 6)
            device = worlds.device
            bias = torch.tensor([c.position_bias] * 3 + [c.rotation_bias] * 3, device=device)
            noise = [c.position_noise] * 3 + [c.rotation_noise] * 3
            self._noise = torch.tensor(noise, device=device)
            self._bias = worlds.keep(
                "tracker.bias",
                worlds.zeros(6),
                lambda generator: bias * symmetric(shape, generator),
            )
        if c.skips_steps:
            self._wait = worlds.keep("tracker.wait", worlds.zeros())
            self._last = worlds.keep("tracker.last", worlds.zeros(7))

    def observe(
        self, pos: Tensor, quat: Tensor, fresh: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Return position [N, 3] and orientation [N, 4] as they are observed.

        Args:
            pos: [N, 3] true position.
            quat: [N, 4] true orientation.
            fresh: [N] bool, worlds that have just begun: their present pose is their whole past.
            generator: random numbers.
        """
        if self._config.has_errors:
            noise = self._noise * symmetric(self._bias.shape, generator)
            error = self._bias + noise
            pos = pos + error[:, :3]
            quat = quat_multiply(quat_from_axis_angle(error[:, 3:]), quat)
        if self._config.skips_steps:
            pose = self._last_seen(torch.cat((pos, quat), dim=-1), fresh, generator)
            pos, quat = pose.split((3, 4), dim=-1)
        if self._delays.longest:
            pos, quat = self._delayed(pos, quat, fresh, generator)
        return pos, quat

    def _last_seen(self, pose: Tensor, fresh: Tensor, generator: torch.Generator) -> Tensor:
        """Return the given poses [N, 7] where the tracker has a new one in this step, elsewhere its last ones."""
        c = self._config
        arrives = fresh | (self._wait <= 0)
        pose = torch.where(arrives[:, None], pose, self._last)
        self._last.copy_(pose)
        lost = uniform(self._wait.shape, generator) < c.loss
        pause = sample_range(len(pose), c.loss_steps, generator).round()
        until_next = sample_range(len(pose), c.interval, generator).round()
        until_next = until_next + torch.where(lost, pause, 0.0)
        self._wait.copy_(torch.where(arrives, until_next, self._wait) - 1.0)
        return pose

    def _delayed(
        self, pos: Tensor, quat: Tensor, fresh: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Return the positions [N, 3] and orientations [N, 4] that arrive in this step."""
        last_quat = self._delays.values[:, 0, 3:]
        is_opposite = (quat * last_quat).sum(dim=-1, keepdim=True) < 0
        # q and -q are the same rotation. The one nearer to the last makes interpolation take the short way.
        pose = torch.cat((pos, torch.where(is_opposite, -quat, quat)), dim=-1)
        self._delays.fill(fresh, pose)
        delay = self._delays.delay
        if self._config.jitter:
            delay = delay + self._config.jitter * symmetric(delay.shape, generator)
            delay = delay.clamp(0.0, self._delays.longest)
        pos, quat = self._delays.push(pose, delay).split((3, 4), dim=-1)
        return pos, torch.nn.functional.normalize(quat, dim=-1)
