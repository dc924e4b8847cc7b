"""Depth cameras in the worlds of a task: their differences between episodes, and the age of their images."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from xreset.cameras.sensor import Cameras
from xreset.errors import XResetError
from xreset.physics import Backend, State
from xreset.task.config import TaskConfig
from xreset.task.latency import DelayLine
from xreset.task.randomization import sample_offset, sample_range
from xreset.task.worlds import Worlds


class Vision:
    """Cameras of N worlds. A range that has its default costs nothing and draws no random number.

    Attributes:
        cameras: the cameras.
    """

    def __init__(self, worlds: Worlds, backend: Backend, task: TaskConfig) -> None:
        """Allocate, register what is drawn at each reset, and start the renderer.

        Raises:
            XResetError: as for :class:`~xreset.cameras.sensor.Cameras`.
        """
        self._backend = backend
        c = task.randomization
        vision = task.vision
        n = worlds.num_worlds
        cameras = Cameras(
            backend.scene, backend.object_index, vision, scale=task.observation.cloud_scale
        )
        self.cameras = cameras
        count = cameras.fov_scale.numel()
        for name, buffer, sample in (
            ("camera_shift", cameras.shift, partial(sample_offset, count, c.camera_shift)),
            ("camera_turn", cameras.turn, partial(sample_offset, count, c.camera_turn)),
            ("camera_fov", cameras.fov_scale, partial(sample_range, count, c.camera_fov)),
            ("camera_noise", cameras.noise_scale, partial(sample_range, n, c.camera_noise)),
        ):
            worlds.keep(name, buffer, sample if c.draws(name) else None)
        worlds.keep("images", cameras.image)
        worlds.keep("views", cameras.view)

        def age(generator: torch.Generator) -> Tensor:
            steps = torch.full((n,), vision.latency, device=worlds.device)
            if c.draws("camera_latency"):
                steps = steps + sample_range(n, c.camera_latency, generator)
            return steps.round()

        width = cameras.view[0].numel()
        longest = round(vision.latency + c.longest("camera_latency"))
        self._delay = DelayLine(worlds, "delayed_views", width, longest, age)

    def aim(self, state: State, goal_pos: Tensor, goal_quat: Tensor, episode_step: Tensor) -> None:
        """Move the renderer's bodies and cameras to the present state.

        Args:
            state: [N, ...] as for :meth:`Cameras.aim`.
            goal_pos: [N, 3] as for :meth:`Cameras.aim`.
            goal_quat: [N, 4] as for :meth:`Cameras.aim`.
            episode_step: [N] control steps since each world's reset.
        """
        due = episode_step % self.cameras.config.interval == 0
        self.cameras.aim(state, goal_pos, goal_quat, due)

    def check_sees_objects(self) -> None:
        """Refuse cameras that never show one of the objects.

        Raises:
            XResetError: some objects are shown in no world. The message names them.
        """
        shown = self.cameras.shows_object()
        unseen = []
        for i, spec in enumerate(self._backend.scene.objects):
            holds = self._backend.object_index == i
            if holds.any() and not shown[holds].any():
                unseen.append(spec.name)
        if unseen:
            raise XResetError(
                f"No camera shows {', '.join(unseen)} at the start of any of {len(shown)} episodes. Turn a camera to "
                "the table (target), widen it (fov), or check what it measures (near, far)."
            )

    def observe(self, fresh: Tensor, generator: torch.Generator) -> Tensor:
        """[N, ...] points that the policy observes, of shape :attr:`~xreset.cameras.config.VisionConfig.view_shape`.

        In the ``fresh`` worlds [N] the present view becomes the whole past.
        """
        view = self.cameras.observe(generator)
        values = view.flatten(1)
        self._delay.fill(fresh, values)
        return self._delay.push(values).view_as(view)
