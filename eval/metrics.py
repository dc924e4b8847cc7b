"""Metrics of both versions of the paper: what they are called, and how they are computed.

This is the one place of a metric. A field of :class:`Episode` with a title is a column of the table of episodes and of
result files, a row of tables, and a column of the report's page and of its CSV file. :class:`EpisodeMetrics` has an
attribute of the same name, updated at every control step of an episode in N worlds.

The published paper (https://arxiv.org/abs/2609.35715, section V): an episode succeeds if the mean distance of 64
surface points to the goal pose is at most 2 cm at any time, the start included, whether or not a hand holds the object.

The draft (section V and appendix A) has stages: approach (a fingertip within 5 cm of the object), grasp (thumb and one
other finger in contact while the object is lifted by at least 1 cm), reorientation (object within 2 cm and 15 degrees
of the goal at the episode's end). Task progress is 0, 0.33, 0.66 or 1 for the highest stage. Reorientation progress is
1 - min_t d(o_t, g) / d(o_0, g), in [0, 1], with d the largest distance of four object keypoints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field, fields
from math import isnan
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np

from xreset.files.checks import NonNegativeFloat, NonNegativeInt, Share, frozen
from xreset.objects.sampling import Frame, keypoints, metric_points
from xreset.physics.tensors import Tensors
from xreset.spec import ObjectSpec

if TYPE_CHECKING:  # functions import torch, so that results are read without it
    from torch import Tensor

    from xreset.task.reading import Reading

STAGE_SCORES = (0.0, 0.33, 0.66, 1.0)
"""Task progress if the highest stage is: none, approach, grasp, reorientation."""
PUBLISHED_DISTANCE = 0.02
"""Largest mean distance of the surface points to the goal in a success of the published paper [m]."""
APPROACH_DISTANCE = 0.05
"""Largest distance of a fingertip from the object in the stage approach [m]."""
LIFT = 0.01
"""Least height of the object above its start in the stage grasp [m]."""
GOAL_DISTANCE = 0.02
"""Largest distance of the object's origin from the goal in the stage reorientation [m]."""
GOAL_ANGLE = 0.2617993877991494
"""Largest angle between the object and the goal in this stage [rad]: 15 degrees."""


@frozen
class Metric:
    """How tables show a field of :class:`Episode`."""

    title: str
    unit: Literal["%", "cm", "episodes"] = "%"
    """Percent of a share, centimetres of a length, or the number of episodes."""
    digits: int = 0
    headline: bool = False
    """Whether tables show the interval, too."""
    fault: bool = False
    """Whether every number but 0 makes the others doubtful."""

    def text(self, mean: float, episodes: int) -> str:
        """Return the mean over a number of episodes as text."""
        if isnan(mean):
            return "missing"
        if self.unit == "episodes":
            return str(round(mean * episodes))
        return f"{100 * mean:.{self.digits}f}{'%' if self.unit == '%' else ' cm'}"

    def interval_text(self, low: float, high: float) -> str:
        """Return an interval of the mean as text."""
        digits = 1 if self.unit == "cm" else 0
        return f"{100 * low:.{digits}f}-{100 * high:.{digits}f}{'%' if self.unit == '%' else ' cm'}"


def _shown(title: str, *, default: Any = ..., **how: Any) -> Any:
    """Return a field that tables show."""
    options = {} if default is ... else {"default": default}
    return field(metadata={"metric": Metric(title=title, **how)}, **options)


@frozen
class Episode:
    """Result of one episode. :class:`EpisodeMetrics` computes the metrics."""

    sequence: NonNegativeInt
    """Index of the demonstration."""
    sequence_name: str
    object: str
    repetition: NonNegativeInt
    """Number of the perturbation of the demonstration's start."""
    task_progress: Share = _shown("task progress", digits=1, headline=True)
    approach: bool = _shown("approach")
    grasp: bool = _shown("grasp")
    reorient: bool = _shown("reorient")
    """Whether the object was at the goal at the end."""
    reorient_once: bool = _shown("at the goal at any time")
    """Whether the object was at the goal at any time."""
    reorientation_progress: Share = _shown("reorientation progress", digits=1)
    """1 - least / first distance to the goal, the largest of four keypoints of the object."""
    published_success: bool | None = _shown(
        "published success", default=None, digits=1, headline=True
    )
    """Whether ``least_distance`` is at most 2 cm: the success of the published paper. This field and those that follow
    may be None in files of an earlier version, which did not measure them."""
    least_distance: NonNegativeFloat | None = _shown(
        "published distance", default=None, unit="cm", digits=1
    )
    """Least mean distance of 64 surface points to the goal over the episode [m]."""
    final_distance: NonNegativeFloat | None = None
    """This distance in the last reading, or the last before an early end [m]."""
    final_position_error: NonNegativeFloat | None = None
    """Distance of the object's origin, in the task's ``object_frame``, from the goal in the same reading [m]."""
    final_angle: NonNegativeFloat | None = None
    """Angle between the object and the goal in the same reading [rad]."""
    turn: NonNegativeFloat | None = None
    """Angle between the object and the goal at the start [rad]: by how much the object must turn."""
    nonfinite: bool = _shown("not finite", unit="episodes", fault=True)
    """Whether a number was not finite: the engine broke down, or the policy's action was not finite."""
    overflow: bool = _shown("overflow", unit="episodes", fault=True)
    """Whether the engine dropped contacts or constraints."""
    out_of_bounds: bool = _shown("left the scene", unit="episodes")
    """Whether the object left the scene."""


METRICS: dict[str, Metric] = {
    f.name: f.metadata["metric"] for f in fields(Episode) if "metric" in f.metadata
}
"""Field of :class:`Episode` -> how it is shown, in the order of tables."""


@frozen
class MetricPoints(Tensors):
    """Points of N objects, each in its object's frame in the task [m]."""

    keypoints: Tensor
    """[N, 4, 3] keypoints, for the draft's reorientation progress."""
    surface: Tensor
    """[N, 64, 3] points of the surface, for the published success."""

    @classmethod
    def of(cls, objects: Sequence[ObjectSpec], frame: Frame = "mesh") -> Self:
        """Return the points of some objects; ``frame``: the task's ``object_frame``."""

        import torch

        def stacked(points: list[np.ndarray]) -> Tensor:
            return torch.as_tensor(np.stack(points), dtype=torch.float32)

        return cls(
            keypoints=stacked([keypoints(o, frame) for o in objects]),
            surface=stacked([metric_points(o, frame) for o in objects]),
        )


class EpisodeMetrics:
    """Metrics of one episode in N worlds. Steps after a world has ended do not change its metrics."""

    def __init__(
        self, start: Reading, goal_pos: Tensor, goal_quat: Tensor, points: MetricPoints
    ) -> None:
        """Start with the first reading.

        Args:
            start: reading before the first step.
            goal_pos: [N, 3] goal of the origin of the object's frame in the task [m].
            goal_quat: [N, 4] goal of its orientation.
            points: points of each world's object.
        """
        import torch

        from xreset.geometry.rotations import quat_angle

        self._points = points
        self._goal_pos = goal_pos.clone()
        self._goal_quat = goal_quat.clone()
        self._start_height = start.task_state.object_pos[:, 2].clone()
        self._start_keypoint_distance = self._distances(start, points.keypoints).amax(dim=-1)
        self._least_keypoint_distance = self._start_keypoint_distance
        infinite = torch.full_like(self._least_keypoint_distance, torch.inf)
        self.turn = quat_angle(start.task_state.object_quat, goal_quat)
        """[N] angle between the object and the goal at the start [rad]."""
        self.least_distance = infinite
        """[N] least mean distance of the surface points to the goal [m]."""
        self.final_distance = infinite
        """[N] mean distance of the surface points to the goal in the last reading, or the last before an early end
        [m]."""
        self.final_position_error = infinite
        """[N] distance of the object's origin from the goal in the same reading [m]."""
        self.final_angle = infinite
        """[N] angle between the object and the goal in the same reading [rad]."""
        # flags are updated in place, so each has a tensor of its own; the distances above are replaced
        false = torch.zeros_like(self._least_keypoint_distance, dtype=torch.bool)
        self.approach = false.clone()
        self.grasp = false.clone()
        self.reorient = false.clone()
        self.reorient_once = false.clone()
        self.nonfinite = false.clone()
        self.overflow = false.clone()
        self.out_of_bounds = false.clone()
        self._ended = false.clone()
        self._add(start)

    def update(self, reading: Reading, out_of_bounds: Tensor) -> None:
        """Add the reading after a step.

        Args:
            reading: the reading; a number that is not finite ends a world.
            out_of_bounds: [N] bool: whether the object has left the scene, which ends a world, too.
        """
        live = ~self._ended
        self.nonfinite |= reading.health.nonfinite & live
        self.overflow |= reading.health.overflow & live
        self.out_of_bounds |= out_of_bounds & live & ~self.nonfinite
        self._ended |= self.nonfinite | self.out_of_bounds
        self._add(reading)

    @property
    def published_success(self) -> Tensor:
        """[N] bool: whether the episode is a success of the published paper."""
        return self.least_distance <= PUBLISHED_DISTANCE

    @property
    def reorientation_progress(self) -> Tensor:
        """[N] reorientation progress, in [0, 1]."""
        return (
            1.0 - self._least_keypoint_distance / self._start_keypoint_distance.clamp_min(1e-9)
        ).clamp(0.0, 1.0)

    @property
    def task_progress(self) -> Tensor:
        """[N] score of the highest stage, one of :data:`STAGE_SCORES`."""
        import torch

        stage = torch.where(self.reorient, 3, torch.where(self.grasp, 2, self.approach.long()))
        return torch.tensor(STAGE_SCORES, device=stage.device)[stage]

    def _add(self, reading: Reading) -> None:
        """Update the metrics of the worlds that have not ended."""
        import torch

        from xreset.geometry.rotations import quat_angle
        from xreset.task.rewards import CONTACT_FORCE, contact_gate

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
        self._least_keypoint_distance = torch.minimum(
            self._least_keypoint_distance, torch.where(live, farthest, torch.inf)
        )
        distance = self._distances(reading, self._points.surface).mean(dim=-1)
        self.final_distance = torch.where(live, distance, self.final_distance)
        self.final_position_error = torch.where(live, position_error, self.final_position_error)
        self.final_angle = torch.where(live, angle, self.final_angle)
        self.least_distance = torch.minimum(self.least_distance, self.final_distance)

    def _distances(self, reading: Reading, points: Tensor) -> Tensor:
        """[N, P] distances of the objects' points [N, P, 3] from the same points at the goal [m]."""
        from xreset.task.rewards import point_distances

        state = reading.task_state
        return point_distances(
            state.object_pos, state.object_quat, self._goal_pos, self._goal_quat, points
        )
