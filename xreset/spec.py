"""Describes a scene: frozen data that holds everything a physics engine needs, and nothing about any engine.

SI units and radians. Quaternions are (w, x, y, z). ``T_a_b`` is the pose of b in a, a 4x4 matrix. The world frame has z
up and the table's top at z = 0. Shape letters: J actuated joints, E fingertips.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import field, fields, replace
from itertools import zip_longest
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from xreset.errors import DemoError, FileFormatError, XResetError
from xreset.files.checks import (
    Checked,
    NotNegative,
    Number,
    Positive,
    PositiveFloat,
    PositiveInt,
    Rule,
    Text,
    frozen,
)
from xreset.files.text import Brief, shown

GRAVITY = 9.81
"""Magnitude of gravity in m/s^2; it points along -z."""

FINGERS = ("thumb", "index", "middle", "ring", "little")
"""Fingers of the human hand, in the order of the keypoints."""

KEYPOINTS = ("wrist", *(f"{finger}{i}" for finger in FINGERS for i in range(1, 5)))  # noqa: XR002
"""The 21 human hand keypoints in the order of the demonstrations: the wrist, then each finger from base (1) to tip
(4)."""
Keypoint = Annotated[str, Rule(f"one of {', '.join(KEYPOINTS)}", KEYPOINTS.__contains__)]
"""One of :data:`KEYPOINTS`."""


@frozen
class Geometry:
    """A convex shape in its own frame."""

    kind: Literal["box", "sphere", "cylinder", "capsule", "hull"]
    """``hull`` is the convex hull of ``vertices``; cylinders and capsules lie along z."""
    size: tuple[float, ...] = ()
    """box: the three half extents. sphere: radius. cylinder, capsule: radius, half length (of a capsule's cylindrical
    part)."""
    vertices: np.ndarray | None = None
    """[V, 3] hull vertices (``hull`` only)."""
    faces: np.ndarray | None = None
    """[F, 3] triangles over ``vertices``, outward (``hull`` only)."""


@frozen
class Shape:
    """A geometry placed in the frame of a link or of an object."""

    geometry: Geometry
    T_body_shape: np.ndarray = field(default_factory=lambda: np.eye(4))
    """[4, 4] pose of the shape in the body's frame."""


@frozen
class DriveSpec:
    """An implicit PD position drive: torque = kp (target - q) - kd qd, limited to the effort limit."""

    kp: Positive[Number]
    """Stiffness [N m/rad] (prismatic: N/m)."""
    kd: NotNegative[Number]
    """Damping [N m s/rad] (prismatic: N s/m)."""
    effort: Positive[Number]
    """Largest torque [N m] (force [N]) of the drive."""
    armature: NotNegative[Number] = 0.0
    """Rotor inertia as seen at the joint [kg m^2] (mass [kg])."""
    friction_loss: NotNegative[Number] = 0.0
    """Dry friction [N m] ([N])."""


@frozen
class JointSpec:
    """One actuated joint."""

    name: Text
    """Its name in the URDF."""
    group: Literal["arm", "hand"]
    """Arm and hand turn actions into targets in different ways: :class:`xreset.task.config.ActionConfig`."""
    drive: DriveSpec
    home: Number
    """Home position [rad or m]."""


@frozen
class MimicSpec:
    """A joint that follows an actuated one: q = multiplier * q_source + offset."""

    joint: Text
    """URDF joint that follows."""
    source: Text
    """The actuated joint."""
    multiplier: Annotated[Number, Rule("a number other than 0", bool)] = 1.0
    offset: Number = 0.0
    """[rad or m]"""


@frozen
class FingertipSpec:
    """A fingertip: a frame at the pad, and the links whose contact counts as this finger's."""

    name: Text
    """``thumb`` must exist; the other names are free."""
    link: Text
    """URDF link (a fixed frame) at the tip."""
    contact_links: tuple[Text, ...]
    """URDF links whose contact with the object counts as this finger's contact; they have the fingertip's friction."""
    keypoint: Keypoint
    """The human keypoint that it follows."""


@frozen
class KeypointSpec:
    """Which robot link follows a human keypoint during retargeting."""

    keypoint: Keypoint
    link: Text
    """URDF link whose origin follows it."""


@frozen
class RobotSpec:
    """A robot: a URDF and one small typed description. See :func:`xreset.load_robot`."""

    name: Text
    """Such as ``ur7e-sharpa``."""
    urdf: Path
    """The URDF file: the one source of kinematics, inertias and collision shapes for every engine."""
    joints: tuple[JointSpec, ...]
    """Actuated joints. This order is the joint order everywhere (length J)."""
    mimics: tuple[MimicSpec, ...] = ()
    """Joints that follow an actuated one."""
    base_pos: tuple[Number, Number, Number]
    """Position of the URDF's root link in the world [m]."""
    base_quat: tuple[Number, Number, Number, Number]
    """Orientation of the URDF's root link in the world (w, x, y, z)."""
    palm: Text
    """Link whose frame is the hand's: origin near the palm's centre, x towards the fingers, z out of the palm's inner
    side."""
    fingertips: tuple[FingertipSpec, ...]
    """Fingertips, thumb first (length E)."""
    keypoints: tuple[KeypointSpec, ...]
    """Links that follow human keypoints during retargeting."""
    hand_root: Text
    """Link that carries the whole hand: the arm's inverse kinematics aims at its pose."""
    self_collision_links: tuple[Text, ...] = ()
    """Links that collide with each other in physics (retargeting checks every link). Neighbours never do."""
    collision_exclude: tuple[tuple[Text, Text], ...] = ()
    """Further pairs of links that never collide, in physics and in retargeting."""
    table_exclude: tuple[Text, ...] = ()
    """Links that never collide with the table (the base stands on it)."""
    gravity_compensated: bool = True
    """Whether the robot's own weight is taken off (as an arm's controller does); the object's load stays."""
    home_std: tuple[Number, Number] = (0.075, 0.10)
    """Standard deviation of arm and hand joints around home where episodes begin [rad]: the paper's Table IX."""
    meshes: tuple[Path, ...] = field(default=(), repr=False, compare=False)
    """Mesh files of the URDF's collision shapes."""
    like: str = field(default="", repr=False)
    """Fingerprint of a robot that differs in shapes only: its policies play here. It is no part of this robot's
    fingerprint."""

    def __repr__(self) -> str:
        arm = len(self.arm_indices)
        hand = len(self.hand_indices)
        tips = ", ".join(self.fingertip_names)
        return f"RobotSpec({self.name!r}, {arm} joints of the arm, {hand} of the hand, fingertips {tips})"

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the actuated joints, in joint order."""
        return tuple(joint.name for joint in self.joints)

    @property
    def fingertip_names(self) -> tuple[str, ...]:
        """Names of the fingertips, thumb first."""
        return tuple(tip.name for tip in self.fingertips)

    @property
    def home(self) -> np.ndarray:
        """[J] home configuration."""
        return np.array([joint.home for joint in self.joints])

    @property
    def is_arm(self) -> np.ndarray:
        """[J] bool: whether a joint is one of the arm's; the others are the hand's."""
        return np.array([joint.group == "arm" for joint in self.joints], dtype=bool)

    @property
    def arm_indices(self) -> np.ndarray:
        """Indices of the arm's joints in joint order."""
        return np.flatnonzero(self.is_arm)

    @property
    def hand_indices(self) -> np.ndarray:
        """Indices of the hand's joints in joint order."""
        return np.flatnonzero(~self.is_arm)

    @property
    def tracked_links(self) -> tuple[str, ...]:
        """Links whose pose a backend reports: the palm, then the fingertips (length 1 + E)."""
        return (self.palm, *(tip.link for tip in self.fingertips))

    @property
    def fingerprint(self) -> str:
        """SHA-256 over the description, the URDF and its meshes: equal where the robot is the same, wherever its files
        are. Files hold it, so the text of the description must not change (:data:`_DESCRIBED`)."""
        description = _description(replace(self, urdf=Path(self.urdf.name)))
        digest = hashlib.sha256(description.encode() + self.urdf.read_bytes())
        for mesh in self.meshes:
            digest.update(mesh.read_bytes())
        return digest.hexdigest()

    def has_fingerprint(self, fingerprint: str) -> bool:
        """Return whether a file's fingerprint is this robot's. Files of xreset 0.1.0 do not know its meshes."""
        return fingerprint in (self.fingerprint, replace(self, meshes=()).fingerprint)


_DESCRIBED: dict[type, tuple[str, ...]] = {
    DriveSpec: ("kp", "kd", "effort", "armature", "friction_loss"),
    JointSpec: ("name", "group", "drive", "home"),
    MimicSpec: ("joint", "source", "multiplier", "offset"),
    FingertipSpec: ("name", "link", "contact_links", "keypoint"),
    KeypointSpec: ("keypoint", "link"),
    RobotSpec: (
        "name", "urdf", "joints", "mimics", "base_pos", "base_quat", "palm", "fingertips", "keypoints", "hand_root",
        "self_collision_links", "collision_exclude", "table_exclude", "gravity_compensated", "home_std",
    ),
}  # fmt: skip
"""The fields that a robot's fingerprint is made of, in the order of the text. A field that is added to a class enters
the text only where it differs from its default, so that the fingerprints of earlier files stay."""


def _description(value: Any) -> str:
    """Return a value as the text that a fingerprint is made of: Python's notation, with numpy's numbers as Python's."""
    if type(value) in _DESCRIBED:
        known = _DESCRIBED[type(value)]
        names = [*known]
        for each in fields(value):
            is_told = each.repr and each.name not in known
            if is_told and getattr(value, each.name) != each.default:
                names.append(each.name)
        inside = [f"{name}={_description(getattr(value, name))}" for name in names]
        return f"{type(value).__name__}({', '.join(inside)})"
    if isinstance(value, tuple | list):
        inside = [_description(each) for each in value]
        return f"({', '.join(inside)}{',' * (len(inside) == 1)})"
    if isinstance(value, Path):
        return f"PosixPath({value.as_posix()!r})"
    return repr(value.item() if isinstance(value, np.generic) else value)


@frozen
class ObjectSpec(Brief):
    """A rigid object in the frame of its mesh, which is the frame of the demonstrations' object poses."""

    name: str
    """Such as ``005_tomato_soup_can``."""
    pieces: tuple[Shape, ...]
    """Convex collision pieces."""
    mass: float
    """[kg]"""
    com: np.ndarray
    """[3] centre of mass [m]."""
    inertia: np.ndarray
    """[3, 3] about the centre of mass, along the mesh frame's axes [kg m^2]."""
    vertices: np.ndarray
    """[V, 3] surface mesh, for point clouds, distances and pictures."""
    faces: np.ndarray
    """[F, 3] triangles, outward."""
    source: str = "stand-in"
    """Where the geometry comes from: ``stand-in``, or the mesh file's SHA-256 and the stated tolerance of its pieces
    [m], ``hull`` without one."""
    friction: float | None = None
    """Coefficient of its material, around which the task draws. None: the task's own range."""


@frozen
class TableSpec:
    """A fixed box whose top is at z = 0."""

    center: tuple[float, float] = (0.57, 0.30)
    """Centre of the top [m]."""
    half_size: tuple[float, float, float] = (0.70, 0.50, 0.02)
    """Half extents [m]."""


@frozen
class PairFriction:
    """Coulomb friction of the *pairs* that touch the object; each engine solves for its own per-body coefficients.

    Parts that touch without the object, the robot and the table or two links of the robot, have the larger one of their
    two frictions against the object: a fingertip on the table ``max(tip, table)``, two other links ``link``.
    """

    tip: float = 0.8
    """Object against fingertip links."""
    link: float = 0.5
    """Object against any other robot link."""
    table: float = 0.6
    """Object against the table."""
    torsional: float = 0.002
    """Torsional friction of the object's pairs, as a length [m]: torque <= torsional * normal force."""


@frozen
class SceneSpec(Checked):
    """Everything that a backend may read."""

    robot: RobotSpec
    objects: tuple[ObjectSpec, ...]
    """The objects of the scene; each world holds exactly one of them."""
    table: TableSpec = TableSpec()
    friction: PairFriction = PairFriction()
    """Friction until a world's is set."""
    timestep: PositiveFloat = 1.0 / 240.0
    """Physics timestep [s]."""
    substeps: PositiveInt = 4
    """Physics steps per control step (60 Hz)."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "objects", checked_objects(self.robot, self.objects))
        super().__post_init__()

    @property
    def control_dt(self) -> float:
        """Duration of a control step [s]."""
        return self.timestep * self.substeps


def checked_objects(robot: Any, objects: Any) -> tuple[ObjectSpec, ...]:
    """Return one or several objects as a tuple.

    Raises:
        XResetError: names are given in place of the robot or the objects.
    """
    if not isinstance(robot, RobotSpec):
        raise XResetError(
            f"robot is {shown(robot)}, expected a RobotSpec: xreset.load_robot(NAME)."
        )
    found: tuple[Any, ...] = (objects,)
    if isinstance(objects, Iterable) and not isinstance(objects, str):
        found = tuple(objects)
    for obj in found:
        if not isinstance(obj, ObjectSpec):
            raise XResetError(
                f"objects has {shown(obj)}, expected an ObjectSpec: xreset.load_object(NAME)."
            )
    return found


def check_robot(path: str | Path, what: str, data: Any, robot: RobotSpec) -> None:
    """Refuse data that were made for another robot, or for another version of this robot.

    Args:
        path: file of the data, for messages.
        what: what messages call the data.
        data: anything with ``robot``, ``robot_fingerprint`` and ``joint_names``.
        robot: the robot that the data must fit.

    Raises:
        FileFormatError: the data do not fit.
    """
    if data.robot != robot.name:
        raise FileFormatError(
            f"{path} is a {what} for the robot {data.robot!r}, not for {robot.name!r}. Make it again for "
            f"{robot.name!r}, or use the robot {data.robot!r}."
        )
    changed = first_difference(data.joint_names, robot.joint_names)
    if not changed and not robot.has_fingerprint(data.robot_fingerprint):
        changed = "its URDF, a mesh or robot.toml has changed"
    if changed:
        raise FileFormatError(
            f"{path} is a {what} for another version of {data.robot!r}: {changed}. Make it again."
        )


def first_difference(found: Sequence[str], needed: Sequence[str]) -> str:
    """Return where the joints of a file first differ from those of a robot, as a text; empty if they are equal."""
    for i, (one, other) in enumerate(zip_longest(found, needed, fillvalue="")):
        if one != other:
            values = [shown(name) if name else "missing" for name in (one, other)]
            return f"joint_names[{i}] is {values[0]}, here {values[1]}"
    return ""


def objects_named(objects: Sequence[ObjectSpec], names: Iterable[str]) -> dict[str, ObjectSpec]:
    """Return the objects with these names, sorted by name; ``DemoError`` lists the missing ones."""
    given = {spec.name: spec for spec in objects}
    needed = sorted(set(names))
    if missing := [name for name in needed if name not in given]:
        raise DemoError(
            f"The demonstrations contain objects that were not given: {', '.join(missing)}. Given: {', '.join(given)}."
        )
    return {name: given[name] for name in needed}


def lowest_point(shapes: Sequence[Shape], turn: np.ndarray | None = None) -> float:
    """Return the height of the lowest point of the shapes above the origin of their body [m].

    Args:
        shapes: shapes in the body's frame.
        turn: [3, 3] rotation of the body; None: none.
    """
    up = np.array([0.0, 0.0, 1.0]) if turn is None else turn[2]
    return min(_lowest(shape, up) for shape in shapes)


def _lowest(shape: Shape, up: np.ndarray) -> float:
    geometry = shape.geometry
    z = up @ shape.T_body_shape[:3, 3]
    # height of a point p of the shape's own frame: z + row . p
    row = up @ shape.T_body_shape[:3, :3]
    if geometry.kind == "hull":
        return float(z + (geometry.vertices @ row).min())
    if geometry.kind == "box":
        return float(z - np.abs(row) @ geometry.size)
    if geometry.kind == "sphere":
        return float(z - geometry.size[0])
    radius, half = geometry.size
    tilt = 1.0 if geometry.kind == "capsule" else np.hypot(row[0], row[1])
    return float(z - abs(row[2]) * half - radius * tilt)
