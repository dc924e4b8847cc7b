"""What a pose tracker reports of the object: poses that are late, wrong, or missing."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from xreset.geometry.rotations import quat_from_axis_angle, quat_multiply
from xreset.task.config import RandomizationConfig, TrackerConfig
from xreset.task.latency import DelayLine
from xreset.task.randomization import Drawn, sample_range


class Tracker:
    """Fixed buffers of N worlds. What is off costs nothing and draws no random number."""

    def __init__(self, faults: Drawn, config: RandomizationConfig, fault_scale: Tensor) -> None:
        """Allocate, and have what lasts for an episode drawn with the other ``faults``.

        Args:
            faults: what is drawn at each reset.
            config: what to draw.
            fault_scale: [] factor on errors and losses of single poses.
        """
        self._config = config
        c = config.tracker if config.enabled else TrackerConfig()
        self._limits = torch.tensor(
            [
                [c.position_bias] * 3 + [c.rotation_bias] * 3,
                [c.position_noise] * 3 + [c.rotation_noise] * 3,
            ],
            device=faults.device,
        )
        self._delays: DelayLine | None = None
        if config.draws("observation_latency"):
            delay = partial(sample_range, faults.num_worlds, config.observation_latency)
            self._delays = faults.delay_line("poses", 7, config.observation_latency[1], delay)
        self._bias: Tensor | None = None
        if c.has_errors:
            zero = faults.zeros(6)
            self._bias = faults.keep(
                "tracker.bias", zero, lambda g: self._limits[0] * _symmetric(zero, g)
            )
        self._wait: Tensor | None = None
        if c.skips_steps:
            self._wait = faults.keep("tracker.wait", faults.zeros())
            self._last = faults.keep("tracker.last", faults.zeros(7))
        self._tracker = c
        self._fault_scale = fault_scale

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
        if self._bias is not None:
            error = self._bias + self._fault_scale * self._limits[1] * _symmetric(
                self._bias, generator
            )
            pos = pos + error[:, :3]
            quat = quat_multiply(quat_from_axis_angle(error[:, 3:]), quat)
        if self._wait is not None:
            arrives = fresh | (self._wait <= 0)
            pose = torch.where(arrives[:, None], torch.cat((pos, quat), dim=-1), self._last)
            self._last.copy_(pose)
            c = self._tracker
            chance = torch.rand(self._wait.shape, generator=generator, device=generator.device)
            lost = chance < c.loss * self._fault_scale
            pause = sample_range(len(pos), c.loss_steps, generator).round()
            until_next = sample_range(len(pos), c.interval, generator).round() + torch.where(
                lost, pause, 0.0
            )
            self._wait.copy_(torch.where(arrives, until_next, self._wait) - 1.0)
            pos, quat = pose.split((3, 4), dim=-1)
        if self._delays is None:
            return pos, quat
        last = self._delays.values[:, 0, 3:]
        opposite = (quat * last).sum(dim=-1, keepdim=True) < 0
        # Of a rotation's two quaternions the one near the last is kept, so that interpolation takes the short way.
        pose = torch.cat((pos, torch.where(opposite, -quat, quat)), dim=-1)
        self._delays.fill(fresh, pose)
        delay = self._delays.delay
        if self._tracker.jitter:
            delay = delay + self._fault_scale * self._tracker.jitter * _symmetric(delay, generator)
            delay = delay.clamp(0.0, self._config.observation_latency[1])
        pos, quat = self._delays.push(pose, delay).split((3, 4), dim=-1)
        return pos, torch.nn.functional.normalize(quat, dim=-1)


def _symmetric(like: Tensor, generator: torch.Generator) -> Tensor:
    """Uniform numbers in [-1, 1) of the shape of a tensor."""
    return 2.0 * torch.rand(like.shape, generator=generator, device=like.device) - 1.0
