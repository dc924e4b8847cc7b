"""Depth cameras in the worlds of a task: their differences between episodes, and the age of what they show."""

from __future__ import annotations

import torch
from torch import Tensor

from xreset.cameras.sensor import Cameras
from xreset.errors import XResetError
from xreset.physics import Backend, State
from xreset.task.config import TaskConfig
from xreset.task.latency import DelayLine
from xreset.task.randomization import sample_offset, sample_range


class Vision:
    """What N worlds see. A range that has its default costs nothing and draws no random number.

    Attributes:
        cameras: the cameras.
    """

    def __init__(self, backend: Backend, task: TaskConfig) -> None:
        """Allocate, and start the renderer; errors as of :class:`~xreset.cameras.sensor.Cameras`."""
        self._backend = backend
        self._config = task.randomization
        self._latency = task.vision.latency
        self.cameras = Cameras(backend.scene, backend.object_index, task.vision, scale=task.observation.cloud_scale)
        longest = self._latency + (self._config.camera_latency[1] if self._config.enabled else 0.0)
        values = torch.zeros(backend.num_worlds, torch.Size(task.vision.view_shape).numel(), device=backend.device)
        self._delay = DelayLine(values, longest) if round(longest) else None
        if self._delay is not None:
            self._delay.delay.fill_(round(self._latency))

    def lasting(self) -> dict[str, Tensor]:
        """Return all buffers by name, for a snapshot."""
        lasting = self.cameras.lasting()
        if self._delay is not None:
            lasting |= self._delay.lasting("_views")
        return lasting

    def draw(self, generator: torch.Generator) -> list[tuple[Tensor, Tensor]]:
        """Draw for every world; return pairs of the drawn values [N, ...] and the buffer that they belong to."""
        c = self._config
        cameras = self.cameras
        worlds, count = cameras.fov_scale.shape
        drawn = []
        for name, buffer in (("camera_shift", cameras.shift), ("camera_turn", cameras.turn)):
            if c.draws(name):
                drawn.append((sample_offset(worlds * count, getattr(c, name), generator).view_as(buffer), buffer))
        for name, buffer in (("camera_fov", cameras.fov_scale), ("camera_noise", cameras.noise_scale)):
            if c.draws(name):
                drawn.append((sample_range(buffer.numel(), getattr(c, name), generator).view_as(buffer), buffer))
        if self._delay is not None and c.draws("camera_latency"):
            age = self._latency + sample_range(worlds, c.camera_latency, generator)
            drawn.append((age.round(), self._delay.delay))
        return drawn

    def aim(self, state: State, goal_pos: Tensor, goal_quat: Tensor, episode_step: Tensor) -> None:
        """Put bodies and cameras where they are; arguments as of :meth:`Cameras.aim`, and control steps [N] since each
        world's reset."""
        due = episode_step % self.cameras.config.interval == 0
        self.cameras.aim(state, goal_pos, goal_quat, due)

    def check_sees_objects(self) -> None:
        """Refuse cameras that show some object in no world.

        Raises:
            XResetError: names the objects.
        """
        shown = self.cameras.shows_object()
        unseen = []
        for i, spec in enumerate(self._backend.scene.objects):
            holds = self._backend.object_index == i
            if bool(holds.any()) and not bool(shown[holds].any()):
                unseen.append(spec.name)
        if unseen:
            raise XResetError(
                f"No camera shows {', '.join(unseen)} at the start of any of {len(shown)} episodes. Turn a camera to "
                "the table (target), widen it (fov), or check what it measures (near, far)."
            )

    def observe(self, fresh: Tensor, generator: torch.Generator) -> Tensor:
        """[N, ...] what the policy sees: :attr:`~xreset.cameras.config.VisionConfig.view_shape`.

        In the ``fresh`` worlds [N] the present view becomes the whole past.
        """
        view = self.cameras.observe(generator)
        if self._delay is None:
            return view
        values = view.flatten(1)
        self._delay.fill(fresh, values)
        return self._delay.push(values).view_as(view)
