"""A robot as moving rigid bodies: what the backends build that must know masses and frames themselves.

Links that are fixed to one another are fused into one body with their common mass, centre of mass and inertia;
:class:`Mechanism` states where every link is. Also numpy operations on a few quaternions (w, x, y, z), which backends
need every step.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import combinations
from typing import cast

import numpy as np

from xreset.errors import ObjectError, RobotError, WrongValueError, XResetError
from xreset.files.checks import frozen
from xreset.geometry.dynamics import drive_shares, drive_values
from xreset.geometry.kinematics import on_host
from xreset.geometry.shapes import pose_matrix, shape_mesh, transformed
from xreset.geometry.urdf import Joint, Link, RobotTree, robot_tree
from xreset.spec import ObjectSpec, RobotSpec, Shape

StateArrays = Mapping[str, np.ndarray]
"""A value in double precision for each field of :class:`~xreset.physics.State`, of one world."""
LinkArrays = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Of the tracked links: position [K, 3], orientation [K, 4], velocity of the origin [K, 3], angular velocity [K, 3]."""
ContactArrays = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Tip force [E, 3], tip touch [E] bool and table force [3], on the object."""


Frames = dict[str, tuple[int, np.ndarray]]
"""Link -> index of its body, and its pose [4, 4] in that body's frame."""


@frozen
class Inertia:
    """Mass properties along principal axes."""

    mass: float
    """[kg]"""
    com: np.ndarray
    """[3] centre of mass in the body's frame [m]."""
    quat: np.ndarray
    """[4] orientation of the principal axes in the body's frame."""
    moments: np.ndarray
    """[3] principal moments about the centre of mass [kg m^2]."""

    @cached_property
    def axes(self) -> np.ndarray:
        """[3, 3] the principal axes in the body's frame, as rows."""
        return rotate(self.quat, np.eye(3))

    @cached_property
    def matrix(self) -> np.ndarray:
        """[3, 3] inertia about the centre of mass, along the axes of the body's frame [kg m^2]."""
        return self.axes.T @ (self.moments[:, None] * self.axes)

    def changed(
        self, *, mass: float | None = None, scale: float = 1.0, offset: np.ndarray | float = 0.0
    ) -> Inertia:
        """Return the inertia with another mass.

        Args:
            mass: [kg]; the moments scale with it.
            scale: a further factor on the moments.
            offset: [3] by how much the centre of mass moves [m].
        """
        mass = self.mass if mass is None else mass
        return replace(
            self,
            mass=mass,
            com=self.com + offset,
            moments=self.moments * (scale * mass / self.mass),
        )


@frozen
class LinkShape:
    """A collision shape in the frame of the body that its link belongs to."""

    link: str
    """URDF link that it belongs to."""
    shape: Shape


@frozen
class Body:
    """A moving rigid body, or the robot's fixed base."""

    name: str
    """The link whose frame is the body's."""
    parent: int
    """Index of the parent body; -1 for the base."""
    joint: Joint | None
    """The joint that moves it; None for the base."""
    T_parent_body: np.ndarray
    """[4, 4] pose in the parent's frame at joint position 0."""
    inertia: Inertia | None
    """None for the base, which does not move."""
    shapes: tuple[LinkShape, ...]


@frozen
class Mechanism:
    """The bodies of a robot, the base first and parents before children. Joint i moves body i + 1."""

    robot: RobotSpec
    tree: RobotTree
    bodies: tuple[Body, ...]
    frames: Frames

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """Names of all moving joints, mimics included, in the order of the bodies."""
        return tuple(body.joint.name for body in self.bodies if body.joint is not None)

    @cached_property
    def tip_of(self) -> dict[str, int]:
        """Contact link -> index of its fingertip."""
        tips = {}
        for i, tip in enumerate(self.robot.fingertips):
            tips |= dict.fromkeys(tip.contact_links, i)
        return tips

    @cached_property
    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper limits [J] of the actuated joints, within which the joints that follow them keep theirs too;
        infinite where there is none."""
        kinematics = on_host(self.robot)
        return kinematics.lower, kinematics.upper

    @cached_property
    def colliding_links(self) -> tuple[tuple[str, str], ...]:
        """The pairs of links that collide with each other in physics: see :meth:`may_collide`."""
        pairs = combinations(self.robot.self_collision_links, 2)
        return tuple(pair for pair in pairs if self.may_collide(*pair))

    def may_collide(self, a: str, b: str) -> bool:
        """Return whether two links of the robot collide with each other in physics.

        Both must be among ``self_collision_links``; links of one body or of neighbouring bodies never collide, nor do
        excluded pairs.
        """
        robot = self.robot
        listed = {a, b} <= set(robot.self_collision_links)
        excluded = {(a, b), (b, a)} & set(robot.collision_exclude)
        return listed and not excluded and self.tree.may_meet(a, b)


def vertices(shape: Shape) -> np.ndarray:
    """Return the corners [V, 3] of any convex shape in its body's frame; a round shape is a polyhedron of many."""
    geometry = shape.geometry
    corners = shape_mesh(shape).vertices if geometry.vertices is None else None
    if corners is None:
        corners = transformed(np.asarray(geometry.vertices), shape.T_body_shape)
    return np.asarray(corners, dtype=float)


def mechanism(robot: RobotSpec) -> Mechanism:
    """Fuse the fixed links of a robot.

    Raises:
        RobotError: see :func:`~xreset.geometry.urdf.robot_tree`; or a moving body has impossible mass properties.
    """
    tree = robot_tree(robot)
    frames: Frames = {}
    members: list[list[Link]] = []
    """Links of each body."""
    placed: list[tuple[Joint | None, int, np.ndarray]] = []
    """Joint, parent and pose of each body."""
    for link, joint in zip(tree.links, (None, *tree.joints), strict=True):
        parent = -1
        T = np.eye(4)
        if joint is not None:
            parent, T_parent = frames[joint.parent]
            T = T_parent @ joint.T_parent_joint
        if joint is not None and joint.type == "fixed":
            frames[link.name] = (parent, T)
            members[parent].append(link)
        else:
            frames[link.name] = (len(members), np.eye(4))
            members.append([link])
            placed.append((joint, parent, T))
    bodies = []
    for links, (joint, parent, T) in zip(members, placed, strict=True):
        shapes = []
        for link in links:
            T_body_link = frames[link.name][1]
            for shape in link.collisions:
                moved = replace(shape, T_body_shape=T_body_link @ shape.T_body_shape)
                shapes.append(LinkShape(link=link.name, shape=moved))
        inertia = None if joint is None else _fused_inertia(robot, links, frames)
        body = Body(
            name=links[0].name,
            parent=parent,
            joint=joint,
            T_parent_body=T,
            inertia=inertia,
            shapes=tuple(shapes),
        )
        bodies.append(body)
    return Mechanism(robot=robot, tree=tree, bodies=tuple(bodies), frames=frames)


class TrackedFrames:
    """The tracked links of a robot as frames on its bodies."""

    def __init__(self, robot: Mechanism) -> None:
        places = [robot.frames[link] for link in robot.robot.tracked_links]
        self.bodies = [body for body, _ in places]
        """[K] index of the body of each tracked link."""
        self.pos = np.array([T[:3, 3] for _, T in places])
        """[K, 3] position of each tracked link in that body's frame."""
        self.quat = matrix_to_quat(np.array([T[:3, :3] for _, T in places]))
        """[K, 4]"""
        inertias = [robot.bodies[body].inertia for body in self.bodies]
        com = [np.zeros(3) if inertia is None else inertia.com for inertia in inertias]
        self.lever = self.pos - np.array(com)
        """[K, 3] the same from that body's centre of mass."""

    def locate(
        self, pos: np.ndarray, quat: np.ndarray, com_velocity: np.ndarray, angvel: np.ndarray
    ) -> LinkArrays:
        """Return position, orientation, velocity and angular velocity of the tracked links.

        Args:
            pos: [K, 3] position of their bodies' frames.
            quat: [K, 4] orientation of their bodies' frames.
            com_velocity: [K, 3] velocity of their bodies' centres of mass.
            angvel: [K, 3] angular velocity of their bodies.
        """
        velocity = com_velocity + cross(angvel, rotate(quat, self.lever))
        return pos + rotate(quat, self.pos), multiply(quat, self.quat), velocity, angvel


class TrackedLinks:
    """The tracked links of a robot, computed from the positions and velocities of its moving joints."""

    def __init__(self, robot: Mechanism) -> None:
        moving = robot.bodies[1:]
        joints = [body.joint for body in moving]
        frames = TrackedFrames(robot)
        self._bodies = frames.bodies
        self._pos = frames.pos[..., None]
        self._quat = frames.quat
        base = pose_matrix(robot.robot.base_pos, robot.robot.base_quat)
        self._base = base @ robot.bodies[0].T_parent_body
        self._parents = [body.parent for body in moving]
        self._T = np.array([body.T_parent_body for body in moving])
        """[D, 4, 4] pose of each moving body in its parent's frame at joint position 0."""
        self._axis = np.array([joint.axis for joint in joints])[..., None]
        self._turns = np.array([joint.type == "revolute" for joint in joints], dtype=float)
        R = self._T[:, :3, :3]
        K = np.cross(np.eye(3), self._axis[:, None, :, 0])  # K v = axis x v
        self._RK = R @ K
        self._RKK = self._RK @ K
        self._along = (R @ self._axis)[..., 0] * (1.0 - self._turns[:, None])
        """[D, 3] by how much a sliding joint shifts its body per position."""
        moved = np.eye(len(robot.bodies))
        """[D + 1, D + 1] 1 where the second body is the first, or carries it."""
        for i, body in enumerate(moving, start=1):
            moved[i] += moved[body.parent]
        self._moved = moved[frames.bodies, 1:]

    def locate(self, position: np.ndarray, velocity: np.ndarray) -> LinkArrays:
        """Return position, orientation, velocity and angular velocity of the tracked links.

        Args:
            position: [D] of all moving joints, in the order of the bodies.
            velocity: [D]
        """
        angle = (self._turns * position)[:, None, None]
        local = self._T.copy()
        local[:, :3, :3] += np.sin(angle) * self._RK + (1.0 - np.cos(angle)) * self._RKK
        local[:, :3, 3] += self._along * position[:, None]
        world = np.empty((len(local) + 1, 4, 4))
        world[0] = self._base
        for i, parent in enumerate(self._parents):
            np.dot(world[parent], local[i], out=world[i + 1])
        carriers = world[self._bodies]
        R = carriers[:, :3, :3]
        pos = carriers[:, :3, 3] + (R @ self._pos)[..., 0]
        # A joint moves what it carries along its axis a, or turns it about a: v = w x (p - o).
        rate = velocity[:, None] * (world[1:, :3, :3] @ self._axis)[..., 0]
        spin = self._turns[:, None] * rate
        angvel = self._moved @ spin
        linvel = self._moved @ (rate - spin - cross(spin, world[1:, :3, 3]))
        quat = multiply(matrix_to_quat(R), self._quat)
        return pos, quat, linvel + cross(angvel, pos), angvel


class MovingJoints:
    """The actuated and the mimic joints among all that an engine moves, and the robot's drives.

    Letters: D moving joints, J actuated, Q mimics.
    """

    def __init__(self, robot: RobotSpec, names: Sequence[str]) -> None:
        """Take a robot and the names [D] of the moving joints in the engine's order."""
        at = {name: i for i, name in enumerate(names)}
        self.count = len(at)
        """D"""
        names = robot.joint_names
        mimics = robot.mimics
        self.driven = np.array([at[name] for name in names])
        """[J] where each actuated joint is."""
        self.mimic = np.array([at[mimic.joint] for mimic in mimics], dtype=int)
        """[Q] where each mimic joint is."""
        self.source = np.array([names.index(mimic.source) for mimic in mimics], dtype=int)
        """[Q] the actuated joint that it follows."""
        self.multiplier = np.array([mimic.multiplier for mimic in mimics])
        self.offset = np.array([mimic.offset for mimic in mimics])
        self.shares = np.zeros((len(robot.joints), self.count))
        """[J, D] how each drive's torque is shared by its joint and those that follow it, so that the couplings have
        nothing to do. An engine in reduced coordinates, without couplings, does not need it."""
        self.shares[:, [*self.driven, *self.mimic]] = drive_shares(robot)
        self.nominal = np.stack([drive_values(robot, name) for name in ("kp", "kd", "effort")])
        """[3, J] stiffness, damping and effort limit."""
        self.armature = drive_values(robot, "armature")
        self.friction_loss = drive_values(robot, "friction_loss")
        self.has_dry_friction = bool(self.friction_loss.any())

    @cached_property
    def couplings(self) -> tuple[np.ndarray, np.ndarray]:
        """[D, J] and [D]: positions of all moving joints are the first, times those of the actuated ones, plus the
        second; velocities are the first times theirs."""
        count = len(self.driven)
        matrix = np.zeros((self.count, count))
        matrix[self.driven, range(count)] = 1.0
        matrix[self.mimic, self.source] = self.multiplier
        offset = np.zeros(self.count)
        offset[self.mimic] = self.offset
        return matrix, offset

    def spread(self, position: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return positions and velocities [D] of all moving joints, given those [J] of the actuated joints."""
        matrix, offset = self.couplings
        return matrix @ position + offset, matrix @ velocity


def object_inertia(spec: ObjectSpec) -> Inertia:
    """Return the mass properties of an object; ``ObjectError`` if no body can have them."""
    return principal(spec.mass, spec.com, spec.inertia, ObjectError, f"the object {spec.name!r}")


def principal(
    mass: float, com: np.ndarray, inertia: np.ndarray, error: type[XResetError], what: str
) -> Inertia:
    """Return the principal moments and axes of an inertia matrix [3, 3] about the centre of mass.

    Raises:
        error: no body can have these mass properties; ``what`` names the body.
    """
    if not mass > 0:
        raise error(
            f"{what} has the mass {mass} kg, expected a positive mass. Give it an <inertial> in the URDF, or a mass."
        )
    moments, axes = np.linalg.eigh(inertia)
    if not (moments[0] > 0 and moments[0] + moments[1] >= moments[2] * (1 - 1e-6)):
        shown = ", ".join(f"{m:.3g}" for m in moments)
        raise error(
            f"{what} has principal moments of inertia ({shown}) kg m^2, expected positive moments, "
            "none above the sum of the others."
        )
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    return Inertia(
        mass=float(mass),
        com=np.asarray(com, dtype=float),
        quat=matrix_to_quat(axes),
        moments=moments,
    )


def _fused_inertia(robot: RobotSpec, links: list[Link], frames: Frames) -> Inertia:
    """Return the common mass properties of links in the frame of their body."""
    mass = sum(link.mass for link in links)
    com = np.zeros(3)
    inertia = np.zeros((3, 3))
    if mass > 0:
        poses = [frames[link.name][1] for link in links]
        points = [T[:3, :3] @ link.com + T[:3, 3] for T, link in zip(poses, links, strict=True)]
        for link, point in zip(links, points, strict=True):
            com = com + link.mass * point
        com = com / mass
        for T, link, point in zip(poses, links, points, strict=True):
            R = T[:3, :3]
            r = point - com  # parallel axes
            inertia += R @ link.inertia @ R.T + link.mass * (r @ r * np.eye(3) - np.outer(r, r))
    return principal(
        mass, com, inertia, RobotError, f"robot {robot.name!r}: the link {links[0].name!r}"
    )


# Contacts -------------------------------------------------------------------------------------------------------------

TABLE = -1
OTHER_LINK = -2
"""What touches the object: these, or the index of a fingertip."""


def sum_contacts(
    tips: int, contacts: Iterable[tuple[int, np.ndarray]] | ContactArrays
) -> ContactArrays:
    """Return tip force [E, 3], tip touch [E] and table force [3], given what touches the object and with which
    force [3], or the sums themselves. A contact without force is no touch."""
    if isinstance(contacts, tuple):
        return cast("ContactArrays", contacts)
    tip_force = np.zeros((tips, 3))
    tip_touch = np.zeros(tips, dtype=bool)
    table_force = np.zeros(3)
    for owner, force in contacts:
        if np.shape(force) != (3,):
            raise WrongValueError(
                f"the force of a contact has shape {np.shape(force)}, expected (3,)"
            )
        if owner == TABLE:
            table_force += force
        elif 0 <= owner < tips:
            tip_force[owner] += force
            tip_touch[owner] |= np.any(force)
        elif owner != OTHER_LINK:
            raise WrongValueError(
                f"a contact has the owner {owner}, expected TABLE ({TABLE}), OTHER_LINK ({OTHER_LINK}) or the index of "
                f"a fingertip, below {tips}"
            )
    return tip_force, tip_touch, table_force


# Quaternions ----------------------------------------------------------------------------------------------------------
# For one or a handful of vectors [3] or [n, 3], where numpy's and scipy's own functions cost more than the arithmetic.


def multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[..., 4] Hamilton product: rotation b first, then a."""
    aw, ax, ay, az = a.T
    bw, bx, by, bz = b.T
    w = aw * bw - ax * bx - ay * by - az * bz
    x = aw * bx + ax * bw + ay * bz - az * by
    y = aw * by - ax * bz + ay * bw + az * bx
    z = aw * bz + ax * by - ay * bx + az * bw
    return np.array((w, x, y, z)).T


_CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])


def conjugate(q: np.ndarray) -> np.ndarray:
    """[..., 4] inverse of a unit quaternion."""
    return q * _CONJUGATE


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[..., 3] vector product."""
    products = a[..., :, None] * b[..., None, :]
    return products.reshape(*products.shape[:-2], 9) @ _CROSS


_CROSS = np.zeros((9, 3))
"""Which products a_i b_j, row after row, make up each component of the vector product."""
_CROSS[[5, 6, 1], [0, 1, 2]] = 1.0
_CROSS[[7, 2, 3], [0, 1, 2]] = -1.0


def rotate(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """[..., 3] vector v turned by the unit quaternion q."""
    u = q[..., 1:]
    t = 2.0 * cross(u, v)
    return v + q[..., :1] * t + cross(u, t)


def matrix_to_quat(R: np.ndarray) -> np.ndarray:
    """[..., 4] unit quaternions of rotation matrices [..., 3, 3], in a tenth of scipy's time for a few.

    4 q q^T is linear in the matrix; its row with the largest diagonal element is a multiple of q.
    """
    flat = R.reshape(-1, 9)
    products = (flat @ _QUAT_PRODUCTS + _EYE_4).reshape(-1, 4, 4)
    best = products.diagonal(axis1=1, axis2=2).argmax(axis=1)
    q = products[np.arange(len(flat)), best]
    q /= np.sqrt((q * q).sum(axis=1, keepdims=True))
    return q.reshape(*R.shape[:-2], 4)


def _quat_products() -> np.ndarray:
    """[9, 16] 4 q q^T - 1 of a rotation matrix [9], row after row."""
    linear = np.zeros((3, 3, 4, 4))
    for i in range(3):
        linear[i, i] = -np.eye(4)
        linear[i, i, 0, 0] = 1.0
        linear[i, i, 1 + i, 1 + i] = 1.0
        j = (i + 1) % 3
        k = (i + 2) % 3
        linear[k, j, 0, 1 + i] = linear[k, j, 1 + i, 0] = 1.0
        linear[j, k, 0, 1 + i] = linear[j, k, 1 + i, 0] = -1.0
        for a, b in ((j, k), (k, j)):
            linear[a, b, 1 + j, 1 + k] = linear[a, b, 1 + k, 1 + j] = 1.0
    return linear.reshape(9, 16)


_QUAT_PRODUCTS = _quat_products()
_EYE_4 = np.eye(4).ravel()
EYE = np.eye(3)
"""[3, 3] Unit matrix. It is made once, because making it takes longer than adding it."""


def nearer(q: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """[4] q or -q, whichever is nearer to the reference: engines flip the sign as they please."""
    return -q if q @ reference < 0 else q


def friction_forces(
    arms: np.ndarray,
    normal_forces: np.ndarray,
    coefficients: np.ndarray,
    force: np.ndarray,
    torque: np.ndarray,
) -> np.ndarray:
    """Friction forces [n, 3] that explain a force and torque [3] on a body, given its contacts.

    Of all tangential forces that add up to the wrench (in the sense of least squares) these have the smallest sum of
    (f / (mu N))^2: each contact carries what it can. When a single surface touches the object, their sum is exact.
    A torque of 1 N m counts as much as a force of 1 N: objects are smaller than 1 m, so forces are explained first.

    Args:
        arms: [n, 3] contact points from the centre of mass [m].
        normal_forces: [n, 3] N.
        coefficients: [n] friction coefficients mu.
        force: [3] N.
        torque: [3] N m, about the centre of mass.
    """
    limits = np.sqrt((normal_forces * normal_forces).sum(axis=1))
    normals = normal_forces / limits[:, None]
    # Row j of contact i: its force if its share is 1 along j, without the part along the normal.
    tangential = EYE - normals[:, :, None] * normals[:, None, :]
    forces = (limits * coefficients)[:, None, None] * tangential
    wrenches = np.concatenate([forces, cross(arms[:, None], forces)], axis=2).reshape(-1, 6)
    shares, *_ = np.linalg.lstsq(wrenches.T, np.concatenate([force, torque]), rcond=1e-6)
    return (shares.reshape(-1, 1, 3) @ forces)[:, 0]
