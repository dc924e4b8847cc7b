"""Batched kinematics of any robot in torch: link poses, points and their Jacobians, mimic joints included.

The same code computes with numpy, where a few poses are needed and torch need not be installed: :func:`on_host`.

Shape letters: J joints of this kinematics, L links, P points, M moving joints of the URDF (the actuated ones and their
mimics), B configurations. Poses are 4x4 matrices ``T_a_b`` (b in a). Lengths in m, angles in rad.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from xreset.errors import RobotError
from xreset.geometry.shapes import pose_matrix
from xreset.geometry.urdf import Joint, robot_tree
from xreset.spec import MimicSpec, RobotSpec

if TYPE_CHECKING:
    import torch
    from torch import Tensor


class PointJacobian(NamedTuple):
    """Points on links, the rotation of those links, and how both change with the joints."""

    pos: Tensor
    """[..., P, 3] position."""
    rot: Tensor
    """[..., P, 3, 3] rotation of the point's link."""
    linear: Tensor
    """[..., P, 3, J] derivative of ``pos``."""
    angular: Tensor
    """[..., P, 3, J] angular velocity of the link per joint velocity, in the frame of ``pos``."""


class _Step(NamedTuple):
    """How a link's pose follows from its parent's."""

    parent: int
    joint: str
    """Type of the joint between them."""
    offset: Tensor
    """[3] origin of the joint in the parent's frame."""
    rotation: Tensor
    """[3, 3] of the link in the parent's frame, at position 0."""


class Twists(NamedTuple):
    """Links of B configurations, and the velocities that the joints above give them."""

    pos: Tensor
    """[B, P, 3] position of each link's origin."""
    rot: Tensor
    """[B, P, 3, 3] rotation of each link."""
    twists: Tensor
    """[B, 6, m] velocity of the point at the root's origin, and angular velocity, of a body that a moving joint
    carries, per velocity of that joint; along the axes of ``pos``."""
    carried: Tensor
    """[P, m] 1: the joint moves the link; 0: it does not."""
    coupling: Tensor
    """[m, J] speed of each moving joint, by the joints' speeds."""


class _Movers(NamedTuple):
    """The m moving joints that move any of some links."""

    rows: list[int]
    """Rows among the moving joints."""
    rotations: Tensor
    """[3, m, 1, 3, 3] R, R K and R K^2 with R the child's rotation in the parent's frame at position 0, and K the axis'
    cross-product matrix, 0 where a joint slides. At an angle a the rotation is R + sin(a) R K + (1 - cos(a)) R K^2
    (Rodrigues' formula)."""
    axes: Tensor
    """[m, 3, 1] joint axes in the children's frames."""
    carried: Tensor
    """[links, m] 1: the joint moves the link; 0: it does not."""
    turns: Tensor
    """[m, 1] 1: a joint turns; 0: it slides."""
    coupling: Tensor
    """[m, J] speed of each moving joint, by the joints' speeds."""


class _Chain(NamedTuple):
    """Some links and everything above them (n links, m moving joints), for few operations on large tensors."""

    coupling: Tensor
    """[n, J] position of the joint above each link, by the joints' positions; 0 if fixed."""
    constant: Tensor
    """[n] what is added to it."""
    fixed: Tensor
    """[n, 4, 4] pose in the parent's frame at position 0; the root's is the identity."""
    moving: Tensor
    """[n, 3, 16] what the sine, 1 - cosine and value of the position add to it."""
    ancestors: list[Tensor]
    """[n] rows of the parents, of the ancestors at twice the distance, and so on up to the root."""
    links: Tensor
    """Rows of the links."""
    joints: Tensor
    """[m] rows of the moving joints' children."""
    movers: _Movers
    """The moving joints."""


def on_host(robot: RobotSpec) -> Any:
    """Return the :class:`Kinematics` of a robot with numpy arrays in double precision in place of tensors."""
    return Kinematics(robot, numpy=True)


class Kinematics:
    """Kinematics of a robot, or of the part of it below one link.

    Every method takes joint positions ``q`` [..., J] with any leading dimensions, and its results have the same leading
    dimensions. There is no loop over the batch. The loop over links is short, because only the requested links and
    their ancestors are computed.
    """

    def __init__(
        self,
        robot: RobotSpec,
        *,
        root: str | None = None,
        dtype: torch.dtype | None = None,
        device: torch.device | str = "cpu",
        numpy: bool = False,
    ) -> None:
        """Prepare the tree.

        Args:
            robot: the robot.
            root: link to start from; default: the URDF's root.
            dtype: dtype of all results; default: double precision.
            device: device of all results.
            numpy: compute with numpy arrays, on the CPU and in double precision; :meth:`motion` needs torch.

        Raises:
            RobotError: see :func:`~xreset.geometry.urdf.robot_tree`.
        """
        tree = robot_tree(robot)
        self.robot = robot
        self.tree = tree
        self.root = tree.link(root or tree.root).name
        self._library: Any = np
        """numpy or torch: the code uses what both have."""
        self._cross: Any = np.cross
        self.device: Any = "cpu"
        self.dtype: Any = np.float64
        if not numpy:
            import torch

            self._library = torch
            self._cross = torch.linalg.cross
            self.device = torch.device(device)
            self.dtype = dtype or torch.float64
        at_root = self.root == tree.root
        base = pose_matrix(robot.base_pos, robot.base_quat) if at_root else np.eye(4)
        self.base = self.array(base)
        """[4, 4] default pose of the root: the robot's base in the world, or the identity below another root."""
        self.link_names = tuple(tree.below(self.root))
        """Links from the root down, parents before children (length L)."""
        joints = [tree.above[name] for name in self.link_names[1:]]
        self._link_index = {name: i for i, name in enumerate(self.link_names)}

        moving = [joint for joint in joints if joint.type != "fixed"]
        mimics = {mimic.joint: mimic for mimic in robot.mimics}
        driven = {joint.name for joint in moving}
        driven |= {mimic.source for name, mimic in mimics.items() if name in driven}
        indices = [i for i, name in enumerate(robot.joint_names) if name in driven]
        self.joint_indices = np.array(indices, dtype=np.int64)
        """[J] indices of this kinematics' joints in the robot's joint order; all of them when the root is the
        URDF's."""
        self.joint_names = tuple(robot.joint_names[i] for i in indices)
        """Names of the joints, in the robot's joint order."""
        self.home = self.array(robot.home[indices])
        """[J] joint positions at home."""
        self._set_coupling(moving, mimics)
        self._set_steps(joints, moving)

    def _set_coupling(self, moving: Sequence[Joint], mimics: Mapping[str, MimicSpec]) -> None:
        """Set how the moving joints follow from the actuated ones, and the limits that result."""
        coupling = np.zeros((len(moving), len(self.joint_names)))
        constant = np.zeros(len(moving))
        lower = np.full(len(self.joint_names), -np.inf)
        upper = np.full(len(self.joint_names), np.inf)
        for row, joint in enumerate(moving):
            mimic = mimics.get(joint.name, MimicSpec(joint=joint.name, source=joint.name))
            source = self.joint_names.index(mimic.source)
            coupling[row, source] = mimic.multiplier
            constant[row] = mimic.offset
            if mimic.multiplier:
                ends = [
                    (end - mimic.offset) / mimic.multiplier for end in (joint.lower, joint.upper)
                ]
                lower[source] = max(lower[source], min(ends))
                upper[source] = min(upper[source], max(ends))
        self._coupling = self.array(coupling)
        self._constant = self.array(constant)
        self.lower = self.array(lower)
        """[J] lower position limits, mimic joints' limits included; -inf where there is none."""
        self.upper = self.array(upper)
        """[J] upper position limits, mimic joints' limits included; inf where there is none."""

    def _set_steps(self, joints: Sequence[Joint], moving: Sequence[Joint]) -> None:
        """Set the steps from each link to the next, and which joints move which link."""
        self._moving = moving
        self._steps: list[_Step] = []
        self._above = np.eye(len(self.link_names), dtype=bool)
        """[L, L] whether the first link is the second one, or is carried by it."""
        for i, joint in enumerate(joints, start=1):
            parent = self._link_index[joint.parent]
            self._above[i] |= self._above[parent]
            step = _Step(
                parent=parent,
                joint=joint.type,
                offset=self.array(joint.T_parent_joint[:3, 3]),
                rotation=self.array(joint.T_parent_joint[:3, :3]),
            )
            self._steps.append(step)
        self._moved = cache(self._moved_by_joints)
        self._chain = cache(self._chain_of)

    def _moved_by_joints(self, links: tuple[int, ...]) -> _Movers:
        """Return the moving joints that move any of the links."""
        children = [self._link_index[joint.child] for joint in self._moving]
        carried = self._above[np.ix_(links, children)]
        rows = carried.any(axis=0).nonzero()[0].tolist()
        joints = [self._moving[row] for row in rows]
        turns = np.array([joint.type == "revolute" for joint in joints]).reshape(-1, 1)
        axes = np.array([joint.axis for joint in joints]).reshape(-1, 3)
        R = np.array([joint.T_parent_joint[:3, :3] for joint in joints]).reshape(-1, 3, 3)
        K = np.cross(np.eye(3), (turns * axes)[:, None])  # K v = axis x v
        return _Movers(
            rows=rows,
            rotations=self.array(np.stack((R, R @ K, R @ K @ K)))[:, :, None],
            axes=self.array(axes)[..., None],
            carried=self.array(carried[:, rows]),
            turns=self.array(turns),
            coupling=self._coupling[rows],
        )

    def link_index(self, name: str) -> int:
        """Return the index of a link in :attr:`link_names`; ``RobotError`` if no link below the root has that name."""
        if name not in self._link_index:
            known = ", ".join(self.link_names)
            raise RobotError(
                f"robot {self.robot.name!r} has no link {name!r} below {self.root!r}. Choose from: {known}."
            )
        return self._link_index[name]

    def link_poses(
        self,
        q: Tensor,
        links: Sequence[str] | None = None,
        *,
        base: Tensor | None = None,
    ) -> Tensor:
        """Compute poses of links.

        Args:
            q: [..., J] joint positions.
            links: names of the links; default: all, in the order of :attr:`link_names`.
            base: [..., 4, 4] pose of the root, broadcast against ``q``; default :attr:`base`.

        Returns:
            [..., L, 4, 4] pose of each link in the frame of ``base`` (the world).

        Raises:
            RobotError: there is no such link.
            ValueError: ``q`` has another number of joints.
        """
        indices = [self.link_index(name) for name in (self.link_names if links is None else links)]
        rot, pos, _, _ = self._forward(q, base, indices)
        T = self._zeros(*pos.shape[:-1], 4, 4)
        T[..., :3, :3] = rot
        T[..., :3, 3] = pos
        T[..., 3, 3] = 1.0
        return T.reshape(*q.shape[:-1], len(indices), 4, 4)

    def points(
        self,
        q: Tensor,
        links: Sequence[str],
        offsets: Tensor | None = None,
        *,
        base: Tensor | None = None,
    ) -> Tensor:
        """[..., P, 3] positions of points on links.

        Args:
            q: [..., J] joint positions.
            links: link of each point (length P).
            offsets: [P, 3] or [..., P, 3] points in their links' frames; default: the origins.
            base: [..., 4, 4] pose of the root; default :attr:`base`.
        """
        poses = self.link_poses(q, links, base=base)
        points = poses[..., :3, 3]
        if offsets is None:
            return points
        return points + (poses[..., :3, :3] @ offsets[..., None])[..., 0]

    def jacobian(
        self,
        q: Tensor,
        links: Sequence[str],
        offsets: Tensor | None = None,
    ) -> PointJacobian:
        """Compute points on links and their geometric Jacobian; arguments as in :meth:`points`.

        A revolute joint with world axis a through o moves the point p by a x (p - o), a prismatic one by a. A mimic
        joint adds to the column of its source, times its multiplier (chain rule).
        """
        indices = [self.link_index(name) for name in links]
        rot, pos, axes, origins = self._forward(q, None, indices)
        shape = (*q.shape[:-1], len(indices))
        if offsets is not None:
            given: Any = self._library.broadcast_to(offsets, (*shape, 3)).reshape(pos.shape)
            pos = pos + (rot @ given[..., None])[..., 0]
        movers = self._moved(tuple(indices))
        axis = axes[:, None]
        carried = movers.carried[..., None]
        lever = pos[:, :, None] - origins[:, None]  # [B, P, m, 3]
        across = self._cross(self._library.broadcast_to(axis, lever.shape), lever)
        linear = (movers.turns * across + (1.0 - movers.turns) * axis) * carried
        angular = axis * (movers.turns * carried)
        coupling = movers.coupling
        columns = (*shape, 3, coupling.shape[1])
        return PointJacobian(
            pos=pos.reshape(*shape, 3),
            rot=rot.reshape(*shape, 3, 3),
            linear=(linear.swapaxes(-1, -2) @ coupling).reshape(columns),
            angular=(angular.swapaxes(-1, -2) @ coupling).reshape(columns),
        )

    def twists(self, q: Tensor, links: Sequence[str], base: Tensor) -> Twists:
        """Compute links and the twists of the joints above them, at joint positions [B, J] with the root at [B, 4, 4].

        This needs less arithmetic than :meth:`jacobian`: a point p of a link, seen from the root's origin, moves by
        v + w x p.
        """
        indices = [self.link_index(name) for name in links]
        rot, pos, axes, origins = self._forward(q, base, indices)
        movers = self._moved(tuple(indices))
        across = self._cross(origins - base[:, None, :3, 3], axes)
        linear = movers.turns * across + (1.0 - movers.turns) * axes
        both = self._library.concatenate((linear, movers.turns * axes), -1)
        return Twists(pos, rot, both.swapaxes(-1, -2), movers.carried, movers.coupling)

    def motion(
        self, q: Tensor, qd: Tensor, links: Sequence[str]
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Compute poses and velocities of links, for joint positions and velocities [B, J].

        The loop is over doublings of the distance to the root (Hillis and Steele 1986, Data Parallel Algorithms), not
        over links, so that an exported graph has few operations. The other methods need less arithmetic.

        Returns:
            positions [B, n, 3], rotations [B, n, 3, 3], velocities of the links' origins [B, n, 3] and angular
            velocities [B, n, 3], all in the frame of :attr:`base`.
        """
        import torch

        chain = self._chain(tuple(self.link_index(name) for name in links))
        values = q @ chain.coupling.T + chain.constant
        factors = torch.stack((torch.sin(values), 1.0 - torch.cos(values), values), dim=-1)
        T = chain.fixed + (factors[:, :, None] @ chain.moving).view(*values.shape, 4, 4)
        for ancestors in chain.ancestors:
            T = T.index_select(1, ancestors) @ T
        T = self.base @ T
        T_links = T.index_select(1, chain.links)
        pos = T_links[..., :3, 3]
        T_joints = T.index_select(1, chain.joints)
        movers = chain.movers
        rates = qd @ movers.coupling.T
        moved = (T_joints[..., :3, :3] @ movers.axes)[..., 0] * rates[..., None]
        turned = movers.turns * moved
        angular = movers.carried @ turned
        # what each joint gives to the point of its links that is at the origin of the world
        at_origin = torch.linalg.cross(T_joints[..., :3, 3], turned) + moved - turned
        linear = movers.carried @ at_origin + torch.linalg.cross(angular, pos)
        return pos, T_links[..., :3, :3], linear, angular

    def _chain_of(self, links: tuple[int, ...]) -> _Chain:
        """Return the tables of the links and of everything above them."""
        chain = self._above[list(links)].any(axis=0).nonzero()[0].tolist()
        row_of = {link: row for row, link in enumerate(chain)}
        moving = {self._link_index[joint.child]: i for i, joint in enumerate(self._moving)}
        movers = self._moved(links)
        joints = [self._moving[row] for row in movers.rows]
        fixed = np.tile(np.eye(4), (len(chain), 1, 1))
        change = np.zeros((len(chain), 3, 4, 4))
        parents = [0]
        for row, link in enumerate(chain[1:], start=1):
            joint = self.tree.above[self.link_names[link]]
            parents.append(row_of[self._link_index[joint.parent]])
            fixed[row] = joint.T_parent_joint
            if joint.type == "revolute":
                K = np.cross(np.eye(3), joint.axis)  # K v = axis x v
                change[row, 0, :3, :3] = K
                change[row, 1, :3, :3] = K @ K
            elif joint.type == "prismatic":
                change[row, 2, :3, 3] = joint.axis
        ancestors = []
        above = np.array(parents)
        while above.any():
            ancestors.append(self._indices(above))
            above = above[above]
        row_of_joint = [moving.get(link, -1) for link in chain]  # -1: the zeros that are added
        pad = self._library.nn.functional.pad
        return _Chain(
            coupling=pad(self._coupling, (0, 0, 0, 1))[row_of_joint],
            constant=pad(self._constant, (0, 1))[row_of_joint],
            fixed=self.array(fixed),
            moving=self.array((fixed[:, None] @ change).reshape(len(chain), 3, 16)),
            ancestors=ancestors,
            links=self._indices([row_of[link] for link in links]),
            joints=self._indices([row_of[self._link_index[joint.child]] for joint in joints]),
            movers=movers,
        )

    def _indices(self, values) -> Tensor:
        return self._library.as_tensor(values, device=self.device)

    def clamp(self, q: Tensor) -> Tensor:
        """[..., J] the nearest joint positions within the limits."""
        return self._library.minimum(self._library.maximum(q, self.lower), self.upper)

    def array(self, values: ArrayLike) -> Tensor:
        """Return values as an array of the library, dtype and device of all results."""
        array: Any = np.asarray(values)
        if self._library is np:
            return array.astype(self.dtype)
        return self._library.as_tensor(array, dtype=self.dtype).to(self.device)

    def _zeros(self, *shape: int) -> Tensor:
        zeros = self._library.zeros(shape, dtype=self.dtype)
        return zeros if self._library is np else zeros.to(self.device)

    def _forward(self, q: Tensor, base: Tensor | None, wanted: Sequence[int]):
        """Compute the wanted links, and the joints above them.

        Returns:
            Rotations [B, n, 3, 3] and positions [B, n, 3] of the links; axes and origins [B, m, 3] of the moving joints
            above them.
        """
        if q.shape[-1] != len(self.joint_names):
            raise ValueError(
                f"q has {q.shape[-1]} joint positions, expected {len(self.joint_names)}: {self.joint_names}"
            )
        movers = self._moved(tuple(wanted))
        constant = self._constant[movers.rows]
        values = movers.coupling @ q.reshape(-1, q.shape[-1]).T + constant[:, None]  # [m, B]
        R, RK, RKK = movers.rotations
        sines = self._library.sin(values)[..., None, None]
        versines = 1.0 - self._library.cos(values)[..., None, None]
        turned = R + sines * RK + versines * RKK  # [m, B, 3, 3]
        root = self.base if base is None else base
        root: Any = self._library.broadcast_to(root, (*q.shape[:-1], 4, 4)).reshape(-1, 4, 4)
        rotations = {0: root[:, :3, :3]}
        positions = {0: root[:, :3, 3]}
        children = []
        needed = self._above[list(wanted)].any(axis=0)
        for i, step in enumerate(self._steps, start=1):
            if not needed[i]:
                continue
            parent = rotations[step.parent]
            origin = positions[step.parent] + parent @ step.offset
            if step.joint == "fixed":
                rotations[i] = parent @ step.rotation
            else:
                row = len(children)
                children.append(i)
                rotations[i] = parent @ turned[row]
                if step.joint == "prismatic":
                    slid = movers.axes[row] * values[row, :, None, None]
                    origin = origin + (rotations[i] @ slid)[..., 0]
            positions[i] = origin
        stack = self._library.stack
        rot = stack([rotations[i] for i in wanted], axis=1)
        pos = stack([positions[i] for i in wanted], axis=1)
        if not children:
            return rot, pos, pos[:, :0], pos[:, :0]
        axes = (stack([rotations[i] for i in children], axis=1) @ movers.axes)[..., 0]
        return rot, pos, axes, stack([positions[i] for i in children], axis=1)
