"""The reset distribution: home resets and bank resets, mixed (the paper's sections IV-B and appendix D.c, D.e).

A home reset puts the robot near its home configuration and the object near a demonstration's first pose. A bank reset
restores a demonstrated hand-object state. The goal is the last object pose of the same demonstration.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Self

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from xreset.errors import DemoError
from xreset.files.checks import frozen
from xreset.geometry.rotations import (
    quat_conjugate,
    quat_from_axis_angle,
    quat_multiply,
    quat_rotate,
)
from xreset.geometry.urdf import joint_limits
from xreset.objects.sampling import center
from xreset.physics.tensors import Tensors, where
from xreset.resets.bank import ResetBank
from xreset.spec import GRAVITY, ObjectSpec, RobotSpec
from xreset.task.config import ResetConfig, TaskConfig


@frozen
class Reset(Tensors):
    """Start of M episodes; poses of the mesh frame in the world frame, quaternions (w, x, y, z)."""

    joint_pos: Tensor
    """[M, J] rad or m"""
    joint_target: Tensor
    """[M, J] drive targets."""
    object_pos: Tensor
    """[M, 3] m"""
    object_quat: Tensor
    """[M, 4]"""
    goal_pos: Tensor
    """[M, 3] m"""
    goal_quat: Tensor
    """[M, 4]"""
    gravity_fraction: Tensor
    """[M] share of the object's weight that acts."""
    state: Tensor
    """[M] which of the distribution's bank states, -1 for home."""
    sequence: Tensor
    """[M] index of the demonstration."""


@frozen
class _Demonstrations(Tensors):
    """Starts and goals of demonstrations [S]."""

    start_pos: Tensor
    start_quat: Tensor
    goal_pos: Tensor
    goal_quat: Tensor
    pivot: Tensor
    """[S, 3] point of the object, in its mesh frame, about which starts and goals are turned."""


def _tensor(array: np.ndarray, device: torch.device | str = "cpu") -> Tensor:
    """Return a tensor in single precision, or of 64-bit integers."""
    dtype = torch.float32 if array.dtype.kind == "f" else torch.long
    return torch.as_tensor(np.ascontiguousarray(array), dtype=dtype, device=device)


def bank_starts(bank: ResetBank) -> Reset:
    """Return starts from the states of a bank at full gravity."""
    sequence = bank.sequence_index
    return Reset(
        joint_pos=_tensor(bank.joint_pos),
        joint_target=_tensor(bank.targets),
        object_pos=_tensor(bank.object_pos),
        object_quat=_tensor(bank.object_quat_wxyz),
        goal_pos=_tensor(bank.goal_pos[sequence]),
        goal_quat=_tensor(bank.goal_quat_wxyz[sequence]),
        gravity_fraction=torch.ones(bank.num_states),
        state=torch.arange(bank.num_states),
        sequence=_tensor(sequence),
    )


class _Grouped:
    """Rows of a table sorted by the group that each belongs to, to be drawn by group."""

    def __init__(self, owners: np.ndarray, groups: Iterable, device: torch.device | str) -> None:
        """Sort; ``owners`` names each row's group. Rows of groups that are not in ``groups`` are left out."""
        rows = [np.flatnonzero(owners == group) for group in groups]
        self.rows = _tensor(np.concatenate(rows), device)
        """Rows of the table, group after group."""
        count = np.array([len(own) for own in rows])
        self.count = _tensor(count, device)
        """Number of rows of each group."""
        self._first = _tensor(np.cumsum(count) - count, device)

    def draw(self, group: Tensor, uniform: Tensor) -> Tensor:
        """Return rows of given groups [M], drawn evenly by numbers [M] in [0, 1); any row where a group is empty."""
        count = self.count[group]
        place = torch.minimum((uniform * count).long(), (count - 1).clamp_min(0))
        return self.rows[(self._first[group] + place).clamp_max(len(self.rows) - 1)]

    def draw_by_weight(self, group: Tensor, uniform: Tensor, weight: Tensor) -> Tensor:
        """Return rows of given groups [M], drawn in proportion to the weight [R] > 0 of each row of the table."""
        until = pad(weight[self.rows].double().cumsum(dim=0), (1, 0))
        first = self._first[group]
        last = first + self.count[group] - 1
        begin = until[first]
        end = until[last + 1]
        place = torch.searchsorted(until, begin + uniform * (end - begin), right=True) - 1
        return self.rows[torch.minimum(torch.maximum(place, first), last)]  # against rounding


GRAVITY_CLIP = 0.3
"""Home resets: the gravity fraction is clipped to 1 +- this. The paper does not state its limits."""
_MEMORY = 0.05
"""Weight of an episode in its demonstration's rate of success, which is thus over the last twenty episodes or so."""
_LEAST_FAILURE = 0.05
"""Demonstrations that always succeed are drawn as if one in twenty of their episodes failed."""


class ResetDistribution:
    """Draws resets for worlds of given objects from a bank. All tensors live on one device; a draw copies nothing to
    it.

    Attributes:
        success_rate: [S] share of the last episodes from home that succeeded, for each demonstration of the bank
            (:meth:`record`).
    """

    def __init__(
        self,
        bank: ResetBank,
        robot: RobotSpec,
        object_names: tuple[str, ...],
        config: ResetConfig,
        device: torch.device | str = "cpu",
        pivots: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        """Prepare the tables.

        Args:
            bank: states, starts and goals.
            robot: its home configuration and joint limits.
            object_names: objects of the scene, in the scene's order.
            config: how resets are drawn.
            device: where the tensors live.
            pivots: point [3] of each object, by name, about which starts and goals are turned, and whose height decides
                how low a goal may be; in its mesh frame [m]. None: the origin of that frame.

        Raises:
            DemoError: an object of the scene has no demonstration in the bank.
        """
        self.config = config
        missing = [name for name in object_names if name not in bank.sequence_object]
        if missing:
            raise DemoError(
                f"The reset bank has no demonstration of {', '.join(missing)}; it has {', '.join(bank.object_names)}."
            )
        if config.pre_contact_only:
            bank = bank.with_states(~bank.post_contact)
        self._states = bank_starts(bank).to(device)
        self._states_of_object = _Grouped(bank.object_name, object_names, device)
        self._sequences_of_object = _Grouped(bank.sequence_object, object_names, device)
        pivots = pivots or {}
        of_sequence = [pivots.get(name, np.zeros(3)) for name in bank.sequence_object]
        self._demos = _Demonstrations(
            start_pos=_tensor(bank.start_pos),
            start_quat=_tensor(bank.start_quat_wxyz),
            goal_pos=_tensor(bank.goal_pos),
            goal_quat=_tensor(bank.goal_quat_wxyz),
            pivot=_tensor(np.array(of_sequence)),
        ).to(device)
        self.success_rate = torch.zeros(len(bank.sequence_object), device=device)
        if config.adaptive_share:
            sequences = range(len(bank.sequence_object))
            self._states_of_sequence = _Grouped(bank.sequence_index, sequences, device)
        self._lower, self._upper = _tensor(joint_limits(robot), device)
        self._goal_shift = torch.tensor(
            [config.goal_xy, config.goal_xy, config.goal_z, config.goal_yaw], device=device
        )
        self._home = _tensor(robot.home, device)
        self._home_std = _tensor(np.where(robot.is_arm, *robot.home_std), device)

    @classmethod
    def of(
        cls,
        bank: ResetBank,
        robot: RobotSpec,
        objects: Sequence[ObjectSpec],
        task: TaskConfig,
        device: torch.device | str = "cpu",
    ) -> Self:
        """Return the resets of a task: objects turn about the origin of the frame that ``TaskConfig.object_frame``
        names."""
        names = tuple(o.name for o in objects)
        pivots = {o.name: center(o) for o in objects} if task.object_frame == "center" else None
        return cls(bank, robot, names, task.reset, device, pivots)

    def start_pose(self, sequence: Tensor) -> tuple[Tensor, Tensor]:
        """Return the object's pose at the start of given demonstrations [M]: position [M, 3] and quaternion [M, 4]."""
        return self._demos.start_pos[sequence], self._demos.start_quat[sequence]

    def sample(self, object_index: Tensor, generator: torch.Generator) -> Reset:
        """Draw one reset for each world.

        Args:
            object_index: [M] object of each world.
            generator: random numbers, on this distribution's device.
        """
        uniform = torch.rand(len(object_index), 6, generator=generator, device=generator.device)
        sequence = self._sequences_of_object.draw(object_index, uniform[:, 2])
        adaptive = self.config.adaptive_share
        if adaptive:
            failure = (1.0 - self.success_rate).clamp_min(_LEAST_FAILURE)
            weak = self._sequences_of_object.draw_by_weight(object_index, uniform[:, 2], failure)
            sequence = torch.where(uniform[:, 4] < adaptive, weak, sequence)
        reset = self._home_or_bank(object_index, sequence, uniform, generator)
        crossed = self.config.crossed_goals
        if not crossed:
            return reset
        others = self._sequences_of_object.draw(object_index, uniform[:, 5] / crossed)
        goal_pos, goal_quat = self._crossed_goal(reset.sequence, others)
        with_other = replace(reset, goal_pos=goal_pos, goal_quat=goal_quat)
        return where(uniform[:, 5] < crossed, with_other, reset)

    def _home_or_bank(
        self,
        object_index: Tensor,
        sequence: Tensor,
        uniform: Tensor,
        generator: torch.Generator,
    ) -> Reset:
        """Return a reset of each world from home, for given demonstrations [M], or from the bank; by the uniform
        numbers [M, 6] of :meth:`sample`."""
        adaptive = self.config.adaptive_share
        home = self.home(sequence, generator)
        states = self._states_of_object
        if not len(states.rows):
            return home
        from_bank = (uniform[:, 0] < self.config.demo_probability) & (
            states.count[object_index] > 0
        )
        row = states.draw(object_index, uniform[:, 1])
        if adaptive:
            own = self._states_of_sequence
            has_own = (uniform[:, 4] < adaptive) & (own.count[sequence] > 0)
            row = torch.where(has_own, own.draw(sequence, uniform[:, 1]), row)
        gravity = uniform[:, 3] if self.config.random_gravity else torch.ones_like(uniform[:, 3])
        return where(
            from_bank, replace(self._states[row], state=row, gravity_fraction=gravity), home
        )

    def record(self, sequence: Tensor, success: Tensor, ended: Tensor) -> None:
        """Update the rates of success with the episodes from home that end now.

        Args:
            sequence: [N] demonstration of each world.
            success: [N] bool, whether the object is at its goal now.
            ended: [N] bool, worlds whose episode from home ends now.
        """
        none = torch.zeros_like(self.success_rate)
        count = none.index_add(0, sequence, ended.float())
        succeeded = none.index_add(0, sequence, (ended & success).float())
        change = succeeded / count.clamp_min(1.0) - self.success_rate
        self.success_rate += (_MEMORY * count).clamp_max(1.0) * change

    def home(self, sequence: Tensor, generator: torch.Generator) -> Reset:
        """Return home resets for given demonstrations [M], perturbed as configured."""
        m = len(sequence)
        c = self.config
        device = generator.device
        noise = torch.randn(m, len(self._home), generator=generator, device=device)
        noise = noise * self._home_std
        joint_pos = (self._home + noise).clamp(self._lower, self._upper)
        shift = 2.0 * torch.rand(m, 3, generator=generator, device=device) - 1.0
        spawn_xy = c.spawn_xy if c.training_xy is None else c.training_xy
        demos = self._demos[sequence]
        object_pos, object_quat = _turned_about_z(
            demos.start_pos, demos.start_quat, demos.pivot, shift[:, 2] * c.spawn_yaw
        )
        gravity = (
            1.0 + torch.randn(m, generator=generator, device=device) * c.home_gravity_std / GRAVITY
        )
        goal_pos, goal_quat = self._moved_goal(demos, generator)
        return Reset(
            joint_pos=joint_pos,
            joint_target=joint_pos,
            object_pos=object_pos + pad(shift[:, :2] * spawn_xy, (0, 1)),
            object_quat=object_quat,
            goal_pos=goal_pos,
            goal_quat=goal_quat,
            gravity_fraction=gravity.clamp(1.0 - GRAVITY_CLIP, 1.0 + GRAVITY_CLIP),
            state=torch.full((m,), -1, device=device),
            sequence=sequence,
        )

    def _crossed_goal(self, sequence: Tensor, other: Tensor) -> tuple[Tensor, Tensor]:
        """Return goals [M, 3], [M, 4] of demonstrations [M], with the place, lift and turn of others [M]."""
        own = self._demos[sequence]
        given = self._demos[other]
        own_start = _place(own.start_pos, own.start_quat, own.pivot)
        start = _place(given.start_pos, given.start_quat, given.pivot)
        goal = _place(given.goal_pos, given.goal_quat, given.pivot)
        lift = (goal - start)[:, 2].clamp_min(0.0)
        goal[:, 2] = own_start[:, 2] + lift
        turn = quat_multiply(given.goal_quat, quat_conjugate(given.start_quat))
        quat = quat_multiply(turn, own.start_quat)
        return goal - quat_rotate(quat, own.pivot), quat

    def _moved_goal(
        self, demos: _Demonstrations, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Return goals [M, 3], [M, 4] of demonstrations [M], perturbed as configured."""
        c = self.config
        pos = demos.goal_pos
        quat = demos.goal_quat
        if not (c.goal_xy or c.goal_z or c.goal_yaw):
            return pos, quat
        uniform = torch.rand(len(pos), 4, generator=generator, device=generator.device)
        shift = (2.0 * uniform - 1.0) * self._goal_shift
        # the shift lowers no pivot below its height at the start
        at_start = _turned(pos, quat, demos.start_quat, demos.pivot)
        above_start = (at_start - demos.start_pos)[:, 2]
        shift[:, 2] = torch.maximum(shift[:, 2], -above_start.clamp_min(0.0))
        new_pos, new_quat = _turned_about_z(pos, quat, demos.pivot, shift[:, 3])
        return new_pos + shift[:, :3], new_quat


def _turned_about_z(
    pos: Tensor, quat: Tensor, pivot: Tensor, angle: Tensor
) -> tuple[Tensor, Tensor]:
    """Return poses [M, 3], [M, 4] of objects that turn about the vertical through their pivots by angles [M]."""
    turn = quat_from_axis_angle(pad(angle[:, None], (2, 0)))
    new_quat = quat_multiply(turn, quat)
    return _turned(pos, quat, new_quat, pivot), new_quat


def _turned(pos: Tensor, quat: Tensor, new_quat: Tensor, pivot: Tensor) -> Tensor:
    """Return positions [M, 3] of objects that turn about their pivots, from orientations [M, 4] to new ones."""
    return _place(pos, quat, pivot) - quat_rotate(new_quat, pivot)


def _place(pos: Tensor, quat: Tensor, pivot: Tensor) -> Tensor:
    """Return the places [M, 3] of the pivots of objects with poses [M, 3], [M, 4] in the world [m]."""
    return pos + quat_rotate(quat, pivot)
