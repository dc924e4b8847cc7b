"""Metrics of both versions of the paper, accumulated at every control step of an episode for N worlds.

The published paper (https://arxiv.org/abs/2609.35715, section V): an episode succeeds if the mean distance of 64
surface points to the goal pose is at most 2 cm at any time, the start included, whether or not a hand holds the object.

The draft (section V and appendix A) has stages: approach (a fingertip within 5 cm of the object), grasp (thumb and one
other finger in contact while the object is lifted by at least 1 cm), reorientation (object within 2 cm and 15 degrees
of the goal at the episode's end). Task progress is 0, 0.33, 0.66 or 1 for the highest stage. Reorientation progress is
1 - min_t d(o_t, g) / d(o_0, g), in [0, 1], with d the largest distance of four object keypoints.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np
import torch
from torch import Tensor

from xreset.checks import frozen
from xreset.geometry.rotations import quat_angle
from xreset.objects.sampling import Frame, keypoints, metric_points
from xreset.spec import ObjectSpec
from xreset.task.reading import Reading
from xreset.task.rewards import contact_gate, point_distances
from xreset.tensors import Tensors

STAGE_SCORES = (0.0, 0.33, 0.66, 1.0)
"""Task progress of: no stage, approach, grasp, reorientation."""


PUBLISHED_DISTANCE = 0.02
"""Largest mean distance of the surface points to the goal that is a success of the published paper [m]."""
APPROACH_DISTANCE = 0.05
"""[m]"""
LIFT = 0.01
"""[m]"""
CONTACT_FORCE = 0.1
"""Force [N] from which a finger counts as in contact. Not in the paper."""
GOAL_DISTANCE = 0.02
"""[m]"""
GOAL_ANGLE = 0.2617993877991494
"""[rad], 15 degrees."""


@frozen
class MetricPoints(Tensors):
    """Points of N objects, in their frames of the task."""

    keypoints: Tensor
    """[N, 4, 3] of the draft's reorientation progress."""
    surface: Tensor
    """[N, 64, 3] of the published success."""

    @classmethod
    def of(cls, objects: Sequence[ObjectSpec], frame: Frame = "mesh") -> Self:
        """Return the points of some objects; ``frame``: ``object_frame`` of the task."""

        def stacked(points: list[np.ndarray]) -> Tensor:
            return torch.as_tensor(np.stack(points), dtype=torch.float32)

        return cls(
            keypoints=stacked([keypoints(o, frame) for o in objects]),
            surface=stacked([metric_points(o, frame) for o in objects]),
        )


class EpisodeMetrics:
    """Metrics of one episode in N worlds, accumulated step by step; a world that has ended no longer changes them."""

    def __init__(
        self, start: Reading, goal_pos: Tensor, goal_quat: Tensor, points: MetricPoints
    ) -> None:
        """Start with the first reading.

        Args:
            start: reading before the first step.
            goal_pos: [N, 3] of the object's origin in the task.
            goal_quat: [N, 4]
            points: of each world's object.
        """
        self._points = points
        self._goal_pos = goal_pos.clone()
        self._goal_quat = goal_quat.clone()
        self._start_height = start.task_state.object_pos[:, 2].clone()
        self._start_distance = self._distances(start, points.keypoints).amax(dim=-1)
        self._best = self._start_distance.clone()
        far = torch.full_like(self._best, torch.inf)
        self.least_distance = far.clone()
        """[N] least mean distance of the surface points to the goal [m]."""
        self.final_distance = far.clone()
        """[N] this distance at the end; of a world that has ended early, before its end [m]."""
        self.final_position_error = far.clone()
        """[N] distance of the object's origin from its place at the goal, likewise [m]."""
        self.final_angle = far.clone()
        """[N] angle between the object and the goal, likewise [rad]."""
        no = torch.zeros_like(self._best, dtype=torch.bool)
        self.approach = no.clone()
        self.grasp = no.clone()
        self.reorient = no.clone()
        self.reorient_once = no.clone()
        self.nonfinite = no.clone()
        self.overflow = no.clone()
        self.out_of_bounds = no.clone()
        self._ended = no.clone()
        self._look(start)

    def update(self, reading: Reading, out_of_bounds: Tensor) -> None:
        """Add the reading after a step; out_of_bounds [N] bool ends a world, and so does a number that is not
        finite."""
        self.nonfinite |= reading.health.nonfinite & ~self._ended
        self.overflow |= reading.health.overflow & ~self._ended
        self.out_of_bounds |= out_of_bounds & ~self._ended & ~self.nonfinite
        self._ended |= self.nonfinite | self.out_of_bounds
        self._look(reading)

    @property
    def published_success(self) -> Tensor:
        """[N] bool"""
        return self.least_distance <= PUBLISHED_DISTANCE

    @property
    def reorientation_progress(self) -> Tensor:
        """[N] in [0, 1]"""
        return (1.0 - self._best / self._start_distance.clamp_min(1e-9)).clamp(0.0, 1.0)

    @property
    def task_progress(self) -> Tensor:
        """[N] score of the highest stage."""
        stage = torch.where(
            self.reorient, 3, torch.where(self.grasp, 2, torch.where(self.approach, 1, 0))
        )
        return torch.tensor(STAGE_SCORES, device=stage.device)[stage]

    def _look(self, reading: Reading) -> None:
        state = reading.task_state
        live = ~self._ended
        self.approach |= live & (reading.tip_distance.amin(dim=-1) <= APPROACH_DISTANCE)
        lifted = state.object_pos[:, 2] - self._start_height >= LIFT
        self.grasp |= live & lifted & contact_gate(reading.contacts.tip_force, CONTACT_FORCE)
        position_error = (state.object_pos - self._goal_pos).norm(dim=-1)
        angle = quat_angle(state.object_quat, self._goal_quat)
        at_goal = live & (position_error <= GOAL_DISTANCE) & (angle <= GOAL_ANGLE)
        # Only the last reading counts; a world that ended early is not at its goal.
        self.reorient = at_goal
        self.reorient_once |= at_goal
        farthest = self._distances(reading, self._points.keypoints).amax(dim=-1)
        self._best = torch.where(live, torch.minimum(self._best, farthest), self._best)
        distance = self._distances(reading, self._points.surface).mean(dim=-1)
        self.final_distance = torch.where(live, distance, self.final_distance)
        self.final_position_error = torch.where(live, position_error, self.final_position_error)
        self.final_angle = torch.where(live, angle, self.final_angle)
        self.least_distance = torch.minimum(self.least_distance, self.final_distance)

    def _distances(self, reading: Reading, points: Tensor) -> Tensor:
        """[N, P] distances of points [N, P, 3] of the objects from their places at the goal [m]."""
        state = reading.task_state
        return point_distances(
            state.object_pos, state.object_quat, self._goal_pos, self._goal_quat, points
        )
