"""Observations (the paper's appendix C): named terms as pure functions, and the layout that a policy file carries.

:class:`~xreset.task.config.ObservationConfig` and the recipes list terms of this module, group by group. A term returns
[N, D]; the numbers of a group are those of its terms, in order. To add an observation, write a function here and name
it in a recipe. Terms with ``noise`` (a standard deviation) draw random numbers, in the order of the configuration.
Shape letters: N worlds, J joints, E fingertips, P points, K numbers per point, H frames of history.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, partial
from math import prod

import torch
from torch import Tensor

from xreset.cameras.config import VisionConfig
from xreset.errors import WrongValueError
from xreset.files.checks import NonNegativeFloat, PositiveFloat, PositiveInt, frozen
from xreset.geometry.rotations import (
    quat_conjugate,
    quat_from_axis_angle,
    quat_multiply,
    quat_rotate,
    quat_rotate_inverse,
    quat_to_axis_angle,
    quat_to_matrix,
)
from xreset.physics import Links, State
from xreset.task.config import GROUPS, ObservationConfig
from xreset.task.slots import Slots
from xreset.task.terms import Functions


@frozen
class ObservationInput:
    """Quantities that observations are made of: world frame, quaternions (w, x, y, z).

    The object's origin is that of the task (``TaskConfig.object_frame``).
    """

    state: State
    """[N, ...] true state. The policy observes ``observed_pos`` and ``observed_quat`` instead of its object pose."""
    links: Links
    """[N, 1 + E, ...] the palm, then the fingertips."""
    joint_target: Tensor
    """[N, J] targets of the drives [rad, m]."""
    joint_lower: Tensor
    """[J] joint limits [rad, m]."""
    joint_upper: Tensor
    """[J]"""
    points: Tensor
    """[N, P, 3] surface points of each world's object, from its origin along the mesh frame's axes [m]."""
    normals: Tensor
    """[N, P, 3] outward unit normals of the surface at these points, along the mesh frame's axes."""
    observed_pos: Tensor
    """[N, 3] object position as the tracker reports it [m]: late, wrong, or old (``task.randomization``)."""
    observed_quat: Tensor
    """[N, 4]"""
    goal_pos: Tensor
    """[N, 3] m"""
    goal_quat: Tensor
    """[N, 4]"""
    start_quat: Tensor
    """[N, 4] object orientation at the start of the episode."""
    gravity_fraction: Tensor
    """[N] share of the object's weight that acts."""
    previous_action: Tensor
    """[N, J] in [-1, 1]."""
    tip_force: Tensor
    """[N, E, 3] force on the object [N]."""
    tip_distance: Tensor
    """[N, E] distance from each fingertip to the object's surface points [m]."""
    reward: Tensor
    """[N] of the last step, scaled; 0 when an episode begins."""
    generator: torch.Generator
    """Source of the noise."""

    def noisy(self, values: Tensor, std: float) -> Tensor:
        """Return values with normal noise."""
        return values + std * self._normal(values)

    def noisy_quat(self, std: float) -> Tensor:
        """[N, 4] observed orientation, turned by normal angles about all three axes [rad]."""
        error = quat_from_axis_angle(std * self._normal(self.observed_pos))
        return quat_multiply(error, self.observed_quat)

    def _normal(self, like: Tensor) -> Tensor:
        return torch.randn(
            like.shape, generator=self.generator, device=like.device, dtype=like.dtype
        )

    def scaled(self, joint_pos: Tensor) -> Tensor:
        """[N, J] joint positions between their limits, in [-1, 1]."""
        return 2.0 * (joint_pos - self.joint_lower) / (self.joint_upper - self.joint_lower) - 1.0

    @cached_property
    def world_points(self) -> Tensor:
        """[N, P, 3] the object's points in the world frame, at the pose that the tracker reports [m]."""
        return quat_rotate(self.observed_quat[:, None], self.points) + self.observed_pos[:, None]

    @cached_property
    def goal_points(self) -> Tensor:
        """[N, P, 3] the object's points in the world frame, at the goal [m]."""
        return quat_rotate(self.goal_quat[:, None], self.points) + self.goal_pos[:, None]

    @cached_property
    def to_nearest_point(self) -> Tensor:
        """[N, 1 + E, 3] vectors from the palm and the fingertips to the object's nearest points [m]."""
        offsets = self.world_points[:, None] - self.links.pos[:, :, None]
        nearest = offsets.square().sum(dim=-1).argmin(dim=-1)
        return offsets.gather(2, nearest[:, :, None, None].expand(-1, -1, 1, 3))[:, :, 0]


TERMS = Functions("observation")
"""Name -> observation."""
_OF_JOINTS: set[str] = set()
"""Terms with the same number of values for each joint."""
_OF_TIPS: set[str] = set()
"""Terms with the same number of values for each fingertip."""


def _of_joints(function: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """Decorate a term with the same number of values for each joint: a policy for several robots has slots for them."""
    _OF_JOINTS.add(function.__name__)
    return TERMS.add(function)


def _of_tips(function: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """Decorate a term with the same number of values for each fingertip."""
    _OF_TIPS.add(function.__name__)
    return TERMS.add(function)


# The object and its goal ----------------------------------------------------------------------------------------------


@TERMS.add
def object_pos(x: ObservationInput, *, noise: NonNegativeFloat) -> Tensor:
    """[N, 3] position that the tracker reports [m]; ``noise`` [m]."""
    return x.noisy(x.observed_pos, noise)


@TERMS.add
def object_quat(x: ObservationInput, *, noise: NonNegativeFloat) -> Tensor:
    """[N, 4] orientation that the tracker reports, as a quaternion with w >= 0, which jumps where w is 0; ``noise``
    [rad], about a random axis."""
    return _positive(x.noisy_quat(noise))


@TERMS.add
def object_rotation(x: ObservationInput, *, noise: NonNegativeFloat) -> Tensor:
    """[N, 6] as ``object_quat``, but the first two columns of the rotation matrix, which never jump (Zhou et al. 2019,
    On the Continuity of Rotation Representations)."""
    return _columns(x.noisy_quat(noise))


@TERMS.add
def goal_pos(x: ObservationInput) -> Tensor:
    """[N, 3] [m]"""
    return x.goal_pos


@TERMS.add
def goal_quat(x: ObservationInput) -> Tensor:
    """[N, 4] orientation of the goal, with w >= 0."""
    return _positive(x.goal_quat)


@TERMS.add
def goal_rotation(x: ObservationInput) -> Tensor:
    """[N, 6] orientation of the goal: two columns of its matrix."""
    return _columns(x.goal_quat)


@TERMS.add
def rotation_to_goal(x: ObservationInput, *, noise: NonNegativeFloat) -> Tensor:
    """[N, 6] columns of the rotation that leads from the object to its goal, along the world's axes. It does not depend
    on the axes of the mesh file."""
    return _columns(quat_multiply(x.goal_quat, quat_conjugate(x.noisy_quat(noise))))


@TERMS.add
def rotation_from_start(x: ObservationInput) -> Tensor:
    """[N, 6] columns of the rotation from the start of the episode to the goal, for policies with cameras: no image
    shows the axes in which a mesh was drawn."""
    return _columns(quat_multiply(x.goal_quat, quat_conjugate(x.start_quat)))


@TERMS.add
def gravity_fraction(x: ObservationInput) -> Tensor:
    """[N, 1] share of the object's weight that acts."""
    return x.gravity_fraction[:, None]


@_of_tips
def tip_to_object(x: ObservationInput) -> Tensor:
    """[N, 3 E] vectors from the fingertips to the object's nearest points [m]. The published paper does not state the
    form of this geometry, but its number of inputs agrees."""
    return x.to_nearest_point[:, 1:].flatten(1)


@TERMS.add
def palm_distance(x: ObservationInput) -> Tensor:
    """[N, 1] distance from the palm to the object's nearest point [m]."""
    square = x.to_nearest_point[:, 0].square().sum(dim=-1, keepdim=True)
    # Some processors round torch's square root of float32 differently; xreset.runtime always rounds correctly.
    return square.double().sqrt().to(square.dtype)


# The robot ------------------------------------------------------------------------------------------------------------


@_of_joints
def previous_action(x: ObservationInput) -> Tensor:
    """[N, J] in [-1, 1]."""
    return x.previous_action


@_of_joints
def joint_pos(x: ObservationInput, *, noise: NonNegativeFloat) -> Tensor:
    """[N, J] joint positions between their limits, in [-1, 1]; ``noise`` [rad]."""
    return x.scaled(x.noisy(x.state.joint_pos, noise))


@_of_joints
def joint_vel(x: ObservationInput, *, noise: NonNegativeFloat, scale: NonNegativeFloat) -> Tensor:
    """[N, J] joint velocities times ``scale`` [s/rad]; ``noise`` [rad/s]."""
    return scale * x.noisy(x.state.joint_vel, noise)


@_of_joints
def target_pos(x: ObservationInput) -> Tensor:
    """[N, J] targets of the drives between the joints' limits, in [-1, 1]."""
    return x.scaled(x.joint_target)


@_of_joints
def joint_target(x: ObservationInput) -> Tensor:
    """[N, J] distance from each joint to its drive's target [rad]. With relative hand targets no other observation of
    the draft contains it."""
    return x.joint_target - x.state.joint_pos


@TERMS.add
def palm_pos(x: ObservationInput) -> Tensor:
    """[N, 3] [m]"""
    return x.links.pos[:, 0]


@TERMS.add
def palm_quat(x: ObservationInput) -> Tensor:
    """[N, 4] with w >= 0."""
    return _positive(x.links.quat[:, 0])


@TERMS.add
def palm_rotation(x: ObservationInput) -> Tensor:
    """[N, 6] two columns of the palm's matrix."""
    return _columns(x.links.quat[:, 0])


@TERMS.add
def palm_linvel(x: ObservationInput) -> Tensor:
    """[N, 3] [m/s]"""
    return x.links.linvel[:, 0]


@TERMS.add
def palm_angvel(x: ObservationInput) -> Tensor:
    """[N, 3] [rad/s]"""
    return x.links.angvel[:, 0]


@_of_tips
def tip_pos(x: ObservationInput) -> Tensor:
    """[N, 3 E] [m]"""
    return x.links.pos[:, 1:].flatten(1)


@_of_tips
def tip_force(x: ObservationInput, *, scale: NonNegativeFloat) -> Tensor:
    """[N, 3 E] fingertip forces times ``scale`` [1/N], limited to [-1, 1]."""
    return (scale * x.tip_force).clamp(-1.0, 1.0).flatten(1)


# Which robot it is, for policies of several robots --------------------------------------------------------------------


@_of_joints
def joint_mask(x: ObservationInput) -> Tensor:
    """[N, J] 1 for every joint. In a policy for several robots, 0 in the slots that its robot does not fill."""
    return torch.ones_like(x.joint_target)


@_of_joints
def joint_pos_limits(x: ObservationInput) -> Tensor:
    """[N, 2 J] lower and upper limit of each joint [rad, m]. Slots of arm and fingers tell the kinds of joints."""
    limits = torch.stack((x.joint_lower, x.joint_upper), dim=-1)
    return (limits + torch.zeros_like(x.joint_target)[..., None]).flatten(1)


@_of_tips
def tip_mask(x: ObservationInput) -> Tensor:
    """[N, E] 1 for every fingertip. In a policy for several robots, 0 for fingers that its robot does not have."""
    return torch.ones_like(x.tip_force[..., 0])


# Surface points -------------------------------------------------------------------------------------------------------


@TERMS.add
def cloud(
    x: ObservationInput, *, frames: PositiveInt, noise: NonNegativeFloat, scale: PositiveFloat
) -> Tensor:
    """[N, H, P, 3] positions of the object's points in the last frames, oldest first (the draft of the paper). These
    are those of a new episode, all equal; the environment keeps the frames of the steps before.

    Args:
        x: the step.
        frames: H.
        noise: standard deviation [m], per point.
        scale: factor on the coordinates [1/m].
    """
    frame = scale * x.noisy(x.world_points, noise)
    return frame[:, None].expand(-1, frames, -1, -1)


@TERMS.add
def paired_cloud(x: ObservationInput, *, noise: NonNegativeFloat, scale: PositiveFloat) -> Tensor:
    """[N, 1, P, 9] present position of every point, its position at the goal, and the goal's minus the present one (the
    published paper): the pose error point by point.

    Args:
        x: the step.
        noise: standard deviation of the points [m].
        scale: factor on all coordinates [1/m].
    """
    here = x.noisy(x.world_points, noise)
    goal = x.goal_points
    return scale * torch.cat((here, goal, goal - here), dim=-1)[:, None]


@TERMS.add
def palm_cloud(x: ObservationInput, *, noise: NonNegativeFloat, scale: PositiveFloat) -> Tensor:
    """[N, 1, P, 12] present position of every point, its position in the palm's frame, the way to its position at the
    goal, and the surface's normal there in the palm's frame.

    Args:
        x: the step.
        noise: standard deviation of the points [m].
        scale: factor on all coordinates but the normals' [1/m].
    """
    here = x.noisy(x.world_points, noise)
    palm = x.links.quat[:, :1]
    of_palm = quat_rotate_inverse(palm, here - x.links.pos[:, :1])
    normals = quat_rotate_inverse(palm, quat_rotate(x.observed_quat[:, None], x.normals))
    points = scale * torch.cat((here, of_palm, x.goal_points - here), dim=-1)
    return torch.cat((points, normals), dim=-1)[:, None]


# For the critic -------------------------------------------------------------------------------------------------------


@TERMS.add
def object_linvel(x: ObservationInput) -> Tensor:
    """[N, 3] true velocity of the object [m/s]."""
    return x.state.object_linvel


@TERMS.add
def object_angvel(x: ObservationInput) -> Tensor:
    """[N, 3] true angular velocity of the object [rad/s]."""
    return x.state.object_angvel


@TERMS.add
def goal_offset(x: ObservationInput) -> Tensor:
    """[N, 3] true vector from the object to its goal [m]."""
    return x.goal_pos - x.state.object_pos


@TERMS.add
def goal_turn(x: ObservationInput) -> Tensor:
    """[N, 3] true rotation vector from the object to its goal [rad]."""
    return quat_to_axis_angle(quat_multiply(x.goal_quat, quat_conjugate(x.state.object_quat)))


@TERMS.add
def least_tip_distance(x: ObservationInput) -> Tensor:
    """[N, 1] least distance of a fingertip to the object [m]."""
    return x.tip_distance.min(dim=-1, keepdim=True).values


@TERMS.add
def reward(x: ObservationInput) -> Tensor:
    """[N, 1] reward of the last step."""
    return x.reward[:, None]


@_of_joints
def true_joint_vel(x: ObservationInput, *, scale: NonNegativeFloat) -> Tensor:
    """[N, J] joint velocities without noise, times ``scale`` [s/rad]."""
    return scale * x.state.joint_vel


# Groups ---------------------------------------------------------------------------------------------------------------


class Observer:
    """The observations of a configuration."""

    def __init__(self, config: ObservationConfig, slots: Slots | None = None) -> None:
        """Find the functions; errors as for :meth:`xreset.task.terms.Functions.bound`.

        Args:
            config: the terms.
            slots: those of the robot, in a policy for several robots.
        """
        self._groups = {}
        for group in GROUPS:
            functions = TERMS.bound(f"task.observation.{group}", getattr(config, group))
            if slots is not None:
                functions = {name: _in_slots(each, slots) for name, each in functions.items()}
            self._groups[group] = functions

    def functions(self, group: str) -> dict[str, Callable[[ObservationInput], Tensor]]:
        """Return a group's terms as functions, by name."""
        return self._groups[group]

    def terms(self, group: str, x: ObservationInput) -> dict[str, Tensor]:
        """Return the values [N, ...] of a group's terms, by name."""
        return {name: function(x) for name, function in self._groups[group].items()}

    def group(self, group: str, x: ObservationInput) -> Tensor:
        """[N, ...] the values of a group's terms, next to each other."""
        return torch.cat(list(self.terms(group, x).values()), dim=-1)


def _in_slots(function: partial[Tensor], slots: Slots) -> Callable[[ObservationInput], Tensor]:
    """Return a term whose values of joints and fingertips are in slots."""
    name = function.func.__name__
    if name in _OF_JOINTS:
        return lambda x: slots.joints(function(x))
    if name in _OF_TIPS:
        return lambda x: slots.tips(function(x))
    return function


def layout(
    num_joints: int, num_tips: int, c: ObservationConfig, vision: VisionConfig | None = None
) -> dict[str, dict[str, int]]:
    """Return the number of values of every term, by group, in order. A policy fits a task only if its layout is equal.

    In a policy for several robots, joints and fingertips are slots (``TaskConfig.sizes``). ``perception`` has H * P * K
    values. With cameras the groups are ``goal``, ``proprio`` and ``view``.

    Raises:
        WrongValueError: as for :class:`Observer`; surface points are not in ``perception``, or something else is; a
            group has no terms.
    """
    observer = Observer(c)
    x = _example(num_joints, num_tips, c.cloud_points)
    cameras = None if vision is None else vision.cameras
    widths: dict[str, dict[str, int]] = {}
    for group in GROUPS:
        if group == "goal" and not cameras:
            continue
        widths[group] = {}
        if not getattr(c, group):
            raise WrongValueError(f"task.observation.{group} has no terms. Add one.")
        for name, value in observer.terms(group, x).items():
            if (value.dim() == 4) != (group == "perception"):
                raise WrongValueError(
                    f"task.observation.{group} has {name!r}. Surface points, and nothing else, belong into perception."
                )
            widths[group][name] = value[0].numel()
    if vision is None or not cameras:
        return {group: widths[group] for group in ("policy", "proprio", "perception")}
    view = {"points": prod(vision.view_shape)}
    return {"goal": widths["goal"], "proprio": widths["proprio"], "view": view}


def cloud_shape(c: ObservationConfig) -> tuple[int, ...]:
    """Return the shape of one world's points: frames (H), points (P), numbers per point (K)."""
    x = _example(1, 1, c.cloud_points)
    return tuple(Observer(c).group("perception", x)[0].shape)


def _example(num_joints: int, num_tips: int, num_points: int) -> ObservationInput:
    """Return an input with N = 1, whose numbers mean nothing."""

    def zeros(*shape: int) -> Tensor:
        return torch.zeros(1, *shape)

    joints = zeros(num_joints)
    link = zeros(1 + num_tips, 3)
    return ObservationInput(
        state=State.at_rest(joints, zeros(3), zeros(4)),
        links=Links(pos=link, quat=zeros(1 + num_tips, 4), linvel=link, angvel=link),
        joint_target=joints,
        joint_lower=joints[0],
        joint_upper=joints[0],
        points=zeros(num_points, 3),
        normals=zeros(num_points, 3),
        observed_pos=zeros(3),
        observed_quat=zeros(4),
        goal_pos=zeros(3),
        goal_quat=zeros(4),
        start_quat=zeros(4),
        gravity_fraction=zeros(),
        previous_action=joints,
        tip_force=zeros(num_tips, 3),
        tip_distance=zeros(num_tips),
        reward=zeros(),
        generator=torch.Generator(),  # torch's own random numbers stay as they are
    )


def _positive(quat: Tensor) -> Tensor:
    """[..., 4] the quaternion of the same rotation with w >= 0."""
    return torch.where(quat[..., :1] < 0, -quat, quat)


def _columns(quat: Tensor) -> Tensor:
    """[..., 6] first two columns of a rotation's matrix."""
    return quat_to_matrix(quat)[..., :2].mT.flatten(-2)
