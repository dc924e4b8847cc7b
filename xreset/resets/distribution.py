"""The reset distribution: home resets and bank resets, mixed (the paper's sections IV-B and appendix D.c, D.e).

Home: robot near its home configuration, object at a demonstration's first pose, perturbed. Bank: a demonstrated hand-object state.
The goal is the last object pose of the same demonstration.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from xreset.errors import DemoError
from xreset.geometry.rotations import quat_from_axis_angle, quat_multiply
from xreset.geometry.urdf import robot_tree
from xreset.resets.bank import ResetBank
from xreset.spec import GRAVITY, RobotSpec
from xreset.task.config import ResetConfig
from xreset.tensors import Tensors


@dataclass(frozen=True, kw_only=True)
class Reset(Tensors):
    """Start of M episodes."""

    joint_pos: Tensor
    """[M, J]"""
    joint_target: Tensor
    """[M, J] drive targets."""
    object_pos: Tensor
    object_quat: Tensor
    goal_pos: Tensor
    goal_quat: Tensor
    gravity_fraction: Tensor
    """[M]"""
    state: Tensor
    """[M] which of the distribution's bank states, -1 for home."""
    sequence: Tensor
    """[M] index of the demonstration."""

    @property
    def from_bank(self) -> Tensor:
        """[M] bool"""
        return self.state >= 0


def _tensor(array: np.ndarray, device: torch.device | str = "cpu") -> Tensor:
    """Numbers in single precision, or 64-bit integers."""
    return torch.as_tensor(
        np.ascontiguousarray(array), dtype=torch.float32 if array.dtype.kind == "f" else torch.long, device=device
    )


def bank_starts(bank: ResetBank, rows: np.ndarray) -> Reset:
    """Given states [M] of a bank, as they are, at full gravity; ``state`` counts the bank's own rows."""
    sequence = bank.sequence_index[rows]
    return Reset(
        joint_pos=_tensor(bank.joint_pos[rows]),
        joint_target=_tensor(bank.targets[rows]),
        object_pos=_tensor(bank.object_pos[rows]),
        object_quat=_tensor(bank.object_quat_wxyz[rows]),
        goal_pos=_tensor(bank.goal_pos[sequence]),
        goal_quat=_tensor(bank.goal_quat_wxyz[sequence]),
        gravity_fraction=torch.ones(len(rows)),
        state=_tensor(rows),
        sequence=_tensor(sequence),
    )


class ResetDistribution:
    """Draws resets for worlds of given objects from a bank; all tensors live on one device, nothing is copied per draw.

    Attributes:
        joint_pos: [L, J] robot states of the bank.
        demo_probability: [] share of resets from the bank; a training's schedule writes into it.
    """

    def __init__(
        self,
        bank: ResetBank,
        robot: RobotSpec,
        object_names: tuple[str, ...],
        config: ResetConfig,
        device: torch.device | str = "cpu",
    ) -> None:
        """Prepare the tables.

        Args:
            robot: its home configuration and joint limits.
            object_names: objects of the scene, in the scene's order.

        Raises:
            DemoError: an object of the scene has no demonstration in the bank.
        """
        self.config = config
        self.demo_probability = torch.tensor(float(config.demo_probability), device=device)
        if config.pre_contact_only:
            bank = bank.select(pre_contact_only=True)
        missing = [name for name in object_names if name not in bank.sequence_object]
        if missing:
            raise DemoError(
                f"the reset bank has no demonstration of {', '.join(missing)}; it has {', '.join(bank.object_names)}."
            )

        tensor = partial(_tensor, device=device)

        # States and sequences sorted by object: object o owns the rows first[o] : first[o] + count[o].
        number = {name: i for i, name in enumerate(object_names)}
        state_object = np.array([number.get(name, -1) for name in bank.object_name], dtype=np.int64)
        state_rows = np.flatnonzero(state_object >= 0)[np.argsort(state_object[state_object >= 0], kind="stable")]
        sequence_object = np.array([number.get(name, -1) for name in bank.sequence_object], dtype=np.int64)
        sequence_rows = np.flatnonzero(sequence_object >= 0)[
            np.argsort(sequence_object[sequence_object >= 0], kind="stable")
        ]

        def ranges(owner: np.ndarray) -> tuple[Tensor, Tensor]:
            count = np.bincount(owner, minlength=len(object_names))
            return tensor(np.cumsum(count) - count), tensor(count)

        self._state_first, self._state_count = ranges(state_object[state_rows])
        self._sequence_first, self._sequence_count = ranges(sequence_object[sequence_rows])
        self.joint_pos = tensor(bank.joint_pos[state_rows])
        self._joint_target = tensor(bank.targets[state_rows])
        self._object_pos = tensor(bank.object_pos[state_rows])
        self._object_quat = tensor(bank.object_quat_wxyz[state_rows])
        self._state_sequence = tensor(bank.sequence_index[state_rows])
        self._sequence_rows = tensor(sequence_rows)
        self._start_pos, self._start_quat = tensor(bank.start_pos), tensor(bank.start_quat_wxyz)
        self._goal_pos, self._goal_quat = tensor(bank.goal_pos), tensor(bank.goal_quat_wxyz)
        tree = robot_tree(robot)
        limits = np.array([(tree.joint(name).lower, tree.joint(name).upper) for name in robot.joint_names])
        self._lower, self._upper = tensor(limits[:, 0]), tensor(limits[:, 1])
        self._home = tensor(robot.home)
        self._home_std = tensor(np.array([robot.home_std[joint.group == "hand"] for joint in robot.joints]))

    def start_pose(self, sequence: Tensor) -> tuple[Tensor, Tensor]:
        """Where the object is at the start of given demonstrations [M]: position [M, 3] and quaternion [M, 4]."""
        return self._start_pos[sequence], self._start_quat[sequence]

    def sample(self, object_index: Tensor, generator: torch.Generator) -> Reset:
        """Draw one reset for each world.

        Args:
            object_index: [M] object of each world.
            generator: random numbers, on this distribution's device.
        """
        m, c = len(object_index), self.config
        uniform = torch.rand(m, 6, generator=generator, device=generator.device)  # six, so that seeds keep their draws
        states, sequences = (
            (first[object_index], count[object_index])
            for first, count in ((self._state_first, self._state_count), (self._sequence_first, self._sequence_count))
        )
        row, pick = _evenly(*states, uniform[:, 1]), _evenly(*sequences, uniform[:, 2])
        from_bank = (uniform[:, 0] < self.demo_probability) & (states[1] > 0)
        row = torch.where(from_bank, row, 0)  # a valid row for home worlds; its values are not used
        home = self.home(self._sequence_rows[pick], generator)
        if not len(self.joint_pos):
            return home
        sequence = torch.where(from_bank, self._state_sequence[row], home.sequence)

        def mix(bank_value: Tensor, home_value: Tensor) -> Tensor:
            return torch.where(from_bank.view(-1, *[1] * (home_value.ndim - 1)), bank_value, home_value)

        gravity = uniform[:, 3] if c.random_gravity else torch.ones_like(uniform[:, 3])
        return Reset(
            joint_pos=mix(self.joint_pos[row], home.joint_pos),
            joint_target=mix(self._joint_target[row], home.joint_target),
            object_pos=mix(self._object_pos[row], home.object_pos),
            object_quat=mix(self._object_quat[row], home.object_quat),
            goal_pos=self._goal_pos[sequence],
            goal_quat=self._goal_quat[sequence],
            gravity_fraction=mix(gravity, home.gravity_fraction),
            state=torch.where(from_bank, row, -1),
            sequence=sequence,
        )

    def home(self, sequence: Tensor, generator: torch.Generator) -> Reset:
        """Home resets for given demonstrations [M], perturbed as configured."""
        m, c, device = len(sequence), self.config, generator.device
        noise = (
            torch.randn(m, len(self._home), generator=generator, device=device) * self._home_std * float(c.home_noise)
        )
        joint_pos = torch.minimum(torch.maximum(self._home + noise, self._lower), self._upper)
        shift = 2.0 * torch.rand(m, 3, generator=generator, device=device) - 1.0
        offset = torch.cat((shift[:, :2] * c.spawn_xy, torch.zeros(m, 1, device=device)), dim=-1)
        yaw = torch.cat((torch.zeros(m, 2, device=device), shift[:, 2:] * c.spawn_yaw), dim=-1)
        start_pos, start_quat = self.start_pose(sequence)
        gravity = 1.0 + torch.randn(m, generator=generator, device=device) * c.home_gravity_std / GRAVITY
        return Reset(
            joint_pos=joint_pos,
            joint_target=joint_pos,
            object_pos=start_pos + offset,
            object_quat=quat_multiply(quat_from_axis_angle(yaw), start_quat),
            goal_pos=self._goal_pos[sequence],
            goal_quat=self._goal_quat[sequence],
            gravity_fraction=gravity.clamp(1.0 - c.home_gravity_clip, 1.0 + c.home_gravity_clip),
            state=torch.full((m,), -1, device=device),
            sequence=sequence,
        )


def _evenly(first: Tensor, count: Tensor, uniform: Tensor) -> Tensor:
    """[M] indices drawn from ``first : first + count`` by uniform numbers in [0, 1)."""
    return first + torch.minimum((uniform * count).long(), (count - 1).clamp_min(0))
