"""Batched kinematics of any robot in torch: link poses, points and their Jacobians, mimic joints included.

Shape letters: J joints of this kinematics, L links, P points, M moving joints of the URDF (the actuated ones and their mimics).
Poses are 4x4 matrices ``T_a_b`` (b in a). Lengths in m, angles in rad.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from xreset.errors import RobotError
from xreset.geometry.rotations import quat_to_matrix
from xreset.geometry.urdf import Joint, RobotTree, robot_tree
from xreset.spec import MimicSpec, RobotSpec


class PointJacobian(NamedTuple):
    """Points on links, the rotation of those links, and how both change with the joints."""

    pos: Tensor
    """[..., P, 3] position."""
    rot: Tensor
    """[..., P, 3, 3] rotation of the point's link."""
    linear: Tensor
    """[..., P, 3, J] derivative of ``pos``."""
    angular: Tensor
    """[..., P, 3, J] angular velocity of the link per joint velocity, in the frame that ``pos`` is given in."""


@dataclass(frozen=True)
class _Step:
    """How a link's pose follows from its parent's."""

    parent: int
    moving: int
    """Row among the moving joints; -1 if fixed."""
    prismatic: bool
    offset: Tensor
    """[3] origin of the joint in the parent's frame."""
    rotations: Tensor
    """[3, 3] R, or for a revolute joint [3, 9] (R, R K, R K^2) with K the axis' cross-product matrix (Rodrigues' formula)."""
    axis: Tensor
    """[3] joint axis in the parent's frame."""


class Kinematics:
    """Kinematics of a robot, or of the part of it below one link.

    Every method takes joint positions ``q`` [..., J] with any leading dimensions and returns tensors with the same ones. There is no
    loop over the batch; the loop over links is short because only the links that are asked for, and their ancestors, are computed.
    """

    def __init__(
        self,
        robot: RobotSpec,
        *,
        root: str | None = None,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
    ) -> None:
        """Prepare the tree.

        Args:
            robot: the robot.
            root: link to start from; default: the URDF's root.
            dtype: of all results.
            device: of all results.

        Raises:
            RobotError: a joint or link that the description names is not in the URDF, or a moving joint is neither actuated nor a mimic.
        """
        tree = robot_tree(robot)
        self.robot = robot
        self.tree = tree
        self.root = tree.link(root or tree.root).name
        self.dtype, self.device = dtype, torch.device(device)
        below = _descendants(tree, self.root)
        self.link_names: tuple[str, ...] = tuple(name for name in tree.link_names if name in below)
        """Links from the root down, parents before children (length L)."""
        self._link_index = {name: i for i, name in enumerate(self.link_names)}

        joints = [joint for joint in tree.joints if joint.child in below and joint.child != self.root]
        moving = [joint for joint in joints if joint.type != "fixed"]
        actuated = {joint.name for joint in robot.joints}
        mimics = {mimic.joint: mimic for mimic in robot.mimics}
        for joint in moving:
            if joint.name not in actuated and joint.name not in mimics:
                raise RobotError(
                    f"robot {robot.name!r}: the URDF's joint {joint.name!r} moves, but the description neither actuates it nor lets it "
                    "mimic another. Add it to either, or make it fixed in the URDF."
                )
        for name in [*robot.joint_names, *mimics]:
            tree.joint(name)
        driven = {mimics[joint.name].source if joint.name in mimics else joint.name for joint in moving}
        if unknown := driven - actuated:
            raise RobotError(f"robot {robot.name!r}: mimic joints follow {sorted(unknown)}, which are not actuated.")
        self.joint_indices = np.array([i for i, name in enumerate(robot.joint_names) if name in driven], dtype=np.int64)
        """[J] indices of this kinematics' joints in the robot's joint order; all of them when the root is the URDF's."""
        self.joint_names: tuple[str, ...] = tuple(robot.joint_names[i] for i in self.joint_indices)
        """Names of the joints, in the robot's joint order."""
        self._couple(moving, mimics)
        self._chain(joints, moving)

        from_root = torch.eye(4, dtype=dtype, device=self.device)
        if self.root == tree.root:
            from_root[:3, :3] = quat_to_matrix(self._tensor(robot.base_quat))
            from_root[:3, 3] = self._tensor(robot.base_pos)
        self.base = from_root
        """[4, 4] pose of the root that is used where none is given: the robot's base in the world, or the identity below another root."""

    def _couple(self, moving: Sequence[Joint], mimics: Mapping[str, MimicSpec]) -> None:
        """How the positions of the moving joints follow from those of the actuated ones, and the limits that this leaves them."""
        column = {name: i for i, name in enumerate(self.joint_names)}
        coupling = torch.zeros(len(moving), len(column), dtype=torch.float64)
        constant = torch.zeros(len(moving), dtype=torch.float64)
        lower = np.full(len(column), -np.inf)
        upper = np.full(len(column), np.inf)
        for row, joint in enumerate(moving):
            mimic = mimics.get(joint.name)
            factor, offset = (mimic.multiplier, mimic.offset) if mimic else (1.0, 0.0)
            source = column[mimic.source if mimic else joint.name]
            coupling[row, source], constant[row] = factor, offset
            if factor:
                ends = sorted(((joint.lower - offset) / factor, (joint.upper - offset) / factor))
                lower[source], upper[source] = max(lower[source], ends[0]), min(upper[source], ends[1])
        self._coupling, self._constant = self._tensor(coupling), self._tensor(constant)
        self.lower = self._tensor(lower)
        """[J] lower position limits, mimic joints' limits taken into account; -inf where there is none."""
        self.upper = self._tensor(upper)
        """[J] upper position limits."""

    def _chain(self, joints: Sequence[Joint], moving: Sequence[Joint]) -> None:
        """The steps from each link to the next, and which joints move which link."""
        row = {joint.name: i for i, joint in enumerate(moving)}
        self._turns = [joint.type == "revolute" for joint in moving]
        self._steps: list[_Step] = []
        ancestry = torch.zeros(len(self.link_names), len(moving), dtype=torch.bool)
        for i, joint in enumerate(joints, start=1):
            parent = self._link_index[joint.parent]
            ancestry[i] = ancestry[parent]
            R = joint.T_parent_joint[:3, :3]
            rotations = R
            if joint.type != "fixed":
                ancestry[i, row[joint.name]] = True
            if joint.type == "revolute":
                K = np.cross(np.eye(3), joint.axis)  # K v = axis x v
                rotations = np.concatenate((R, R @ K, R @ K @ K), axis=1)
            self._steps.append(
                _Step(
                    parent=parent,
                    moving=row.get(joint.name, -1),
                    prismatic=joint.type == "prismatic",
                    offset=self._tensor(joint.T_parent_joint[:3, 3]),
                    rotations=self._tensor(rotations),
                    axis=self._tensor(R @ joint.axis),
                )
            )
        self._ancestry = ancestry
        self._moved = cache(self._moved_by_joints)

    def _moved_by_joints(self, links: tuple[int, ...]) -> list[tuple[int, Tensor]]:
        """The moving joints that move any of the links, and which of the links each moves."""
        moves = self._ancestry[list(links)]
        return [(m, moves[:, m].nonzero()[:, 0].to(self.device)) for m in moves.any(dim=0).nonzero()[:, 0].tolist()]

    def link_index(self, name: str) -> int:
        """Index of a link in :attr:`link_names`; ``RobotError`` if there is none of that name below the root."""
        if name not in self._link_index:
            raise RobotError(
                f"robot {self.robot.name!r} has no link {name!r} below {self.root!r}; it has {', '.join(self.link_names)}."
            )
        return self._link_index[name]

    def link_poses(self, q: Tensor, links: Sequence[str] | None = None, *, base: Tensor | None = None) -> Tensor:
        """Poses of links.

        Args:
            q: [..., J] joint positions.
            links: which links; default: all, in the order of :attr:`link_names`.
            base: [..., 4, 4] pose of the root, broadcast against ``q``; default :attr:`base`.

        Returns:
            [..., L, 4, 4] pose of each link in the frame of ``base`` (the world).
        """
        indices = range(len(self.link_names)) if links is None else [self.link_index(name) for name in links]
        rotations, positions, _, _ = self._forward(q, base, indices)
        poses = q.new_zeros(*q.shape[:-1], len(indices), 4, 4)
        for slot, i in enumerate(indices):
            poses[..., slot, :3, :3] = rotations[i].view(*q.shape[:-1], 3, 3)
            poses[..., slot, :3, 3] = positions[i].view(*q.shape[:-1], 3)
        poses[..., 3, 3] = 1.0
        return poses

    def points(
        self, q: Tensor, links: Sequence[str], offsets: Tensor | None = None, *, base: Tensor | None = None
    ) -> Tensor:
        """[..., P, 3] positions of points on links.

        Args:
            q: [..., J] joint positions.
            links: link of each point (length P).
            offsets: [P, 3] or [..., P, 3] points in their links' frames; default: the origins.
            base: [..., 4, 4] pose of the root; default :attr:`base`.
        """
        poses = self.link_poses(q, links, base=base)
        return (
            poses[..., :3, 3]
            if offsets is None
            else poses[..., :3, 3] + (poses[..., :3, :3] @ offsets[..., None])[..., 0]
        )

    def jacobian(
        self, q: Tensor, links: Sequence[str], offsets: Tensor | None = None, *, base: Tensor | None = None
    ) -> PointJacobian:
        """Points on links and their geometric Jacobian; arguments as in :meth:`points`.

        A revolute joint with world axis a through o moves the point p by a x (p - o), a prismatic one by a; mimic joints add to the
        column of their source, times their multiplier (chain rule).
        """
        indices = [self.link_index(name) for name in links]
        batch = q.shape[:-1]
        rotations, positions, axes, origins = self._forward(q, base, indices)
        rot = torch.stack([rotations[i] for i in indices], dim=1)
        pos = torch.stack([positions[i] for i in indices], dim=1)
        if offsets is not None:
            wide = offsets.expand(*batch, len(indices), 3).reshape(-1, len(indices), 3)
            pos = pos + (rot @ wide[..., None])[..., 0]
        moved = self._moved(tuple(indices))
        linear = q.new_zeros(len(pos), len(indices), 3, len(moved))
        angular = torch.zeros_like(linear)
        for column, (m, rows) in enumerate(moved):
            axis, origin = axes[m], origins[m]
            assert axis is not None and origin is not None
            if self._turns[m]:
                linear[..., column][:, rows] = torch.linalg.cross(axis[:, None], pos[:, rows] - origin[:, None])
                angular[..., column][:, rows] = axis[:, None].expand(-1, len(rows), -1)
            else:
                linear[..., column][:, rows] = axis[:, None].expand(-1, len(rows), -1)
        coupling = self._coupling[[m for m, _ in moved]]
        shape = (*batch, len(indices))
        return PointJacobian(
            pos=pos.view(*shape, 3),
            rot=rot.view(*shape, 3, 3),
            linear=(linear @ coupling).view(*shape, 3, coupling.shape[1]),
            angular=(angular @ coupling).view(*shape, 3, coupling.shape[1]),
        )

    def clamp(self, q: Tensor) -> Tensor:
        """[..., J] the nearest joint positions within the limits."""
        return torch.minimum(torch.maximum(q, self.lower), self.upper)

    def _tensor(self, values) -> Tensor:
        return torch.as_tensor(np.asarray(values), dtype=self.dtype).to(self.device)

    def _forward(self, q: Tensor, base: Tensor | None, wanted: Sequence[int]):
        """Rotations [B, 3, 3] and positions [B, 3] of the wanted links and their ancestors; axes and origins of the joints between."""
        if q.shape[-1] != len(self.joint_names):
            raise ValueError(
                f"q has {q.shape[-1]} joints, expected {len(self.joint_names)} ({', '.join(self.joint_names)})"
            )
        values = q.reshape(-1, q.shape[-1]) @ self._coupling.T + self._constant  # [B, M]
        sines, cosines = torch.sin(values), 1.0 - torch.cos(values)
        base = (self.base if base is None else base).expand(*q.shape[:-1], 4, 4).reshape(-1, 4, 4)
        needed = self._needed(wanted)
        rotations: dict[int, Tensor] = {0: base[:, :3, :3]}
        positions: dict[int, Tensor] = {0: base[:, :3, 3]}
        axes: list[Tensor | None] = [None] * values.shape[1]
        origins: list[Tensor | None] = [None] * values.shape[1]
        for i, step in enumerate(self._steps, start=1):
            if i not in needed:
                continue
            parent = rotations[step.parent]
            origin = positions[step.parent] + parent @ step.offset
            rotation = parent @ step.rotations
            if step.moving >= 0:
                axis = parent @ step.axis
                axes[step.moving], origins[step.moving] = axis, origin
                if step.prismatic:
                    origin = origin + axis * values[:, step.moving, None]
                else:
                    still, turn, turn_twice = rotation.split(3, dim=-1)
                    rotation = (
                        still
                        + sines[:, step.moving, None, None] * turn
                        + cosines[:, step.moving, None, None] * turn_twice
                    )
            rotations[i], positions[i] = rotation, origin
        return rotations, positions, axes, origins

    def _needed(self, wanted: Sequence[int]) -> set[int]:
        needed = set(wanted)
        for i in range(len(self._steps), 0, -1):
            if i in needed:
                needed.add(self._steps[i - 1].parent)
        return needed


def _descendants(tree: RobotTree, root: str) -> set[str]:
    below = {root}
    for joint in tree.joints:  # parents come before children
        if joint.parent in below:
            below.add(joint.child)
    return below
