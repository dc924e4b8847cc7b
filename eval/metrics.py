"""The paper's evaluation metrics (section V and appendix A), accumulated over an episode for N worlds.

Stages: approach (a fingertip within 5 cm of the object), grasp (thumb and one other finger in contact while the object
is lifted by at least 1 cm), reorientation (object within 2 cm and 15 degrees of the goal at the episode's end). Task
progress is 0, 0.33, 0.66 or 1 for the highest stage. Reorientation progress is 1 - min_t d(o_t, g) / d(o_0, g), in [0,
1], with d the largest distance of four object keypoints.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from xreset.geometry.rotations import quat_angle
from xreset.task.reading import Reading
from xreset.task.rewards import contact_gate, keypoint_distance

STAGE_SCORES = (0.0, 0.33, 0.66, 1.0)
"""Task progress of: no stage, approach, grasp, reorientation."""


@dataclass(frozen=True, kw_only=True)
class MetricsConfig:
    """Thresholds of the stages."""

    approach_distance: float = 0.05
    """[m]"""
    lift: float = 0.01
    """[m]"""
    contact_force: float = 0.1
    """Force [N] from which a finger counts as in contact. Not in the paper."""
    goal_distance: float = 0.02
    """[m]"""
    goal_angle: float = 0.2617993877991494
    """[rad], 15 degrees."""


class EpisodeMetrics:
    """Metrics of one episode in N worlds, accumulated step by step; a world that has ended no longer changes them."""

    def __init__(
        self, start: Reading, goal_pos: Tensor, goal_quat: Tensor, keypoints: Tensor, config: MetricsConfig
    ) -> None:
        """Start with the first reading.

        Args:
            start: reading before the first step.
            goal_pos: [N, 3]
            goal_quat: [N, 4]
            keypoints: [N, 4, 3] in the object frame.
        """
        self._config = config
        self._keypoints = keypoints
        self._goal_pos = goal_pos.clone()
        self._goal_quat = goal_quat.clone()
        self._start_height = start.state.object_pos[:, 2].clone()
        self._start_distance = self._distance(start)
        self._best = self._start_distance.clone()
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
    def reorientation_progress(self) -> Tensor:
        """[N] in [0, 1]"""
        return (1.0 - self._best / self._start_distance.clamp_min(1e-9)).clamp(0.0, 1.0)

    @property
    def task_progress(self) -> Tensor:
        """[N] score of the highest stage."""
        stage = torch.where(self.reorient, 3, torch.where(self.grasp, 2, torch.where(self.approach, 1, 0)))
        return torch.tensor(STAGE_SCORES, device=stage.device)[stage]

    def _look(self, reading: Reading) -> None:
        c = self._config
        state = reading.state
        live = ~self._ended
        self.approach |= live & (reading.tip_distance.amin(dim=-1) <= c.approach_distance)
        lifted = state.object_pos[:, 2] - self._start_height >= c.lift
        self.grasp |= live & lifted & contact_gate(reading.contacts.tip_force, c.contact_force)
        near = (state.object_pos - self._goal_pos).norm(dim=-1) <= c.goal_distance
        at_goal = live & near & (quat_angle(state.object_quat, self._goal_quat) <= c.goal_angle)
        self.reorient = at_goal  # only the last reading counts; a world that ended early is not at its goal
        self.reorient_once |= at_goal
        self._best = torch.where(live, torch.minimum(self._best, self._distance(reading)), self._best)

    def _distance(self, reading: Reading) -> Tensor:
        return keypoint_distance(
            reading.state.object_pos, reading.state.object_quat, self._goal_pos, self._goal_quat, self._keypoints
        )
