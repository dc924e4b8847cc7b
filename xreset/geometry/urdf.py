"""A URDF as plain data: the kinematic tree that every part of xreset builds from.

Every engine's own URDF reader has habits (invented masses, fused fixed links, joint order, effort as a force range). So
a URDF is read once, here, and the backends build their models from a :class:`RobotTree`.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Literal
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from xreset.errors import ObjectError, RobotError
from xreset.files import max_bytes
from xreset.geometry.shapes import hull, load_mesh, shape_mesh
from xreset.spec import Geometry, MimicSpec, RobotSpec, Shape
from xreset.text import is_plain, shown

if TYPE_CHECKING:
    import trimesh

JointType = Literal["revolute", "prismatic", "fixed"]

HULL_TOLERANCE = 5e-4
"""How far points of a mesh may stand out of its hull [m]: makers' meshes have thousands of points, engines accept
hundreds."""
_LARGEST = 1e6
"""Largest number in a URDF, limits excepted: masses [kg], positions [m], inertias [kg m^2]. No robot comes near."""
_SMALLEST = 1e-6
"""[m] Smallest size of a shape."""
_SHORTEST_AXIS = 1e-9
_LIMITS = {"lower": "0", "upper": "0", "effort": "0", "velocity": "inf"}
"""What a URDF's limits are where it does not state them."""
_FOLDERS_ABOVE = 3
"""Folders above the URDF's own in which meshes may lie: those of a ROS package and of its workspace, never the root."""


@dataclass(frozen=True, kw_only=True)
class Link:
    """A link, its inertia and its shapes."""

    name: str
    mass: float
    """[kg]; 0 where the URDF gives none."""
    com: np.ndarray
    """[3] center of mass in the link frame [m]."""
    inertia: np.ndarray
    """[3, 3] about the center of mass, along the link frame's axes [kg m^2]."""
    collisions: tuple[Shape, ...]
    """Convex collision shapes in the link frame; a mesh is its convex hull, within :data:`HULL_TOLERANCE`."""


@dataclass(frozen=True, kw_only=True)
class Joint:
    """A joint between two links."""

    name: str
    type: JointType
    parent: str
    child: str
    T_parent_joint: np.ndarray
    """[4, 4] pose of the child's frame in the parent's at position 0."""
    axis: np.ndarray = field(default_factory=lambda: np.array([1.0, 0, 0]))
    """[3] unit axis in the joint (child) frame."""
    lower: float = -math.inf
    """Lower position limit [rad or m]; -inf for a continuous joint."""
    upper: float = math.inf
    """Upper position limit [rad or m]; inf for a continuous joint."""
    velocity: float = math.inf
    """Largest speed [rad/s or m/s]; inf where the URDF gives none."""
    effort: float = 0.0
    """Largest torque [N m] or force [N]; 0 where the URDF gives none."""
    mimic: MimicSpec | None = None
    """How it follows another joint, as the URDF has it."""
    stiffness: float = 0.0
    """Stiffness of its drive [N m/rad or N/m]; 0 where none is given, as in a URDF."""
    rotor: float = 0.0
    """Inertia of its drive's rotor [kg m^2 or kg]; 0 where none is given, as in a URDF."""


@dataclass(frozen=True, kw_only=True)
class RobotTree:
    """The links and joints of a URDF, parents before children."""

    name: str
    root: str
    links: tuple[Link, ...]
    joints: tuple[Joint, ...]
    """Joint i's child is link i + 1."""

    @property
    def link_names(self) -> tuple[str, ...]:
        """Names of all links, root first."""
        return tuple(link.name for link in self.links)

    @property
    def mimics(self) -> tuple[MimicSpec, ...]:
        """How joints follow others, as the URDF has it."""
        return tuple(joint.mimic for joint in self.joints if joint.mimic is not None)

    def link(self, name: str) -> Link:
        """Return the link of that name, or raise ``RobotError``."""
        return self._named("link", self.links, name)

    def joint(self, name: str) -> Joint:
        """Return the joint of that name, or raise ``RobotError``."""
        return self._named("joint", self.joints, name)

    def _named(self, kind: str, parts, name: str):
        by_name = {part.name: part for part in parts}
        if name not in by_name:
            raise RobotError(f"robot {self.name!r} has no {kind} {name!r}. Choose from: {', '.join(by_name)}.")
        return by_name[name]

    def below(self, root: str) -> list[str]:
        """Return the link ``root`` and all links that it carries."""
        found = [root]
        for joint in self.joints:
            if joint.parent in found:
                found.append(joint.child)
        return found

    def moving_ancestor(self, name: str) -> str:
        """Return the link of the rigid body of a link: itself, or the nearest ancestor that a joint moves (or the
        root)."""
        by_child = {joint.child: joint for joint in self.joints}
        while name in by_child and by_child[name].type == "fixed":
            name = by_child[name].parent
        return name


def robot_tree(robot: RobotSpec) -> RobotTree:
    """Return the tree of a robot's URDF; the file is read again only after a change."""
    return load_urdf(robot.urdf)


def link_meshes(robot: RobotSpec) -> list[trimesh.Trimesh | None]:
    """Return the collision shapes of each link of the robot's URDF as one mesh in the link's frame; None for no
    shape."""
    import trimesh

    meshes = []
    for link in robot_tree(robot).links:
        shapes = [shape_mesh(shape, coarse=True) for shape in link.collisions]
        meshes.append(trimesh.util.concatenate(shapes) if shapes else None)
    return meshes


def load_urdf(path: str | Path) -> RobotTree:
    """Read a URDF; it is read again only after a change of the file or of a mesh.

    ``<capsule radius length/>`` is accepted in addition to the standard shapes. Mesh files are searched next to the
    URDF (``package://NAME/`` also in the three folders above it).

    Raises:
        RobotError: the file is missing or damaged, a mesh is missing, the links form no tree, or a joint type is not
            supported.
    """
    if not os.path.isfile(path):  # Path.is_file() raises OSError for a name that is too long
        raise RobotError(f"{shown(str(path))} is not a file. Expected a URDF there.")
    path = Path(path).resolve()
    if path.stat().st_size > max_bytes() // 16:
        raise RobotError(f"{path} has {path.stat().st_size >> 20} MB, which is too large for a URDF.")
    files = (path, *mesh_files(path))
    return _load(path, tuple(file.stat().st_mtime_ns for file in files))


def parse_xml(path: Path) -> Element:
    """Return the root element of a file, or raise ``RobotError``."""
    try:
        return ElementTree.parse(path).getroot()
    except (OSError, ElementTree.ParseError, ValueError, LookupError) as error:  # the last two: encodings
        raise RobotError(f"{path} cannot be read as XML: {shown(str(error))}") from error


def mesh_files(urdf: Path) -> list[Path]:
    """Return the mesh files of a URDF's collision shapes, as far as they exist."""
    meshes = parse_xml(urdf).iterfind("link/collision/geometry/mesh")
    files = [find_mesh(mesh.get("filename", ""), urdf) for mesh in meshes]
    return [file for file in files if file is not None]


@lru_cache(maxsize=16)
def _load(path: Path, changed: tuple[int, ...]) -> RobotTree:
    """Read a URDF that was last changed then, and its meshes [ns]."""
    xml = parse_xml(path)
    if xml.tag == "mujoco":
        raise RobotError(f"{path} is MJCF, not URDF; `xreset robots import` makes a robot of it.")
    if xml.tag != "robot":
        raise RobotError(f"{path} starts with <{shown(xml.tag)[1:-1]}>, which is not a URDF. Expected <robot>.")
    try:
        with np.errstate(invalid="ignore"):  # check_tree refuses what is not finite
            links = [_link(element, path) for element in xml.iterfind("link")]
            joints = [_joint(element) for element in xml.iterfind("joint")]
            tree = _ordered(xml.get("name") or path.stem, links, joints)
            check_tree(tree)
    except RobotError as error:
        raise RobotError(f"{path} cannot be read as a URDF: {error}") from error
    return tree


def _ordered(name: str, links: list[Link], joints: list[Joint]) -> RobotTree:
    """Return the tree, parents before children."""
    link_by_name = {link.name: link for link in links}
    joint_above = {joint.child: joint for joint in joints}
    if len(link_by_name) < len(links):
        raise RobotError("a link name occurs twice.")
    if len(joint_above) < len(joints):
        raise RobotError("a link is the child of two joints, expected one.")
    for joint in joints:
        for end in (joint.parent, joint.child):
            if end not in link_by_name:
                raise RobotError(f"joint {joint.name!r} names link {end!r}, which the file does not define.")
    roots = [link for link in link_by_name if link not in joint_above]
    if len(roots) != 1:
        raise RobotError(f"expected one root link, found {len(roots)} ({', '.join(roots) or 'none'}).")
    order: list[str] = []
    stack = list(roots)
    while stack:
        parent = stack.pop()
        order.append(parent)
        children = [joint.child for joint in joints if joint.parent == parent]
        stack.extend(reversed(children))
    if len(order) != len(links):
        raise RobotError(f"links {sorted(set(link_by_name) - set(order))} are not connected to the root {roots[0]!r}.")
    return RobotTree(
        name=name,
        root=roots[0],
        links=tuple(link_by_name[link] for link in order),
        joints=tuple(joint_above[link] for link in order[1:]),
    )


def check_tree(tree: RobotTree) -> None:
    """Raise ``RobotError`` for numbers that are not finite or too large; limits of continuous joints may be
    infinite."""
    for link in tree.links:
        parts = [link.com, link.inertia, link.mass]
        for shape in link.collisions:
            geometry = shape.geometry
            parts += [shape.T_body_shape, geometry.size]
            if geometry.vertices is not None:
                parts.append(geometry.vertices)
            positive = geometry.size[:1] if geometry.kind == "capsule" else geometry.size  # a capsule may be a ball
            if min(positive, default=math.inf) < _SMALLEST:
                raise RobotError(
                    f"link {link.name!r} has a shape of size {min(positive):g} m. Expected at least {_SMALLEST:g} m."
                )
        if link.mass < 0 or not all((np.abs(part) < _LARGEST).all() for part in parts):
            raise RobotError(
                f"link {link.name!r} has a negative mass, or a number that is not finite or far too large."
            )
    for joint in tree.joints:
        numbers = [*joint.axis, joint.effort, joint.stiffness, joint.rotor]
        if not ((np.abs(joint.T_parent_joint) < _LARGEST).all() and np.isfinite(numbers).all()):
            raise RobotError(f"joint {joint.name!r} has a number that is not finite, or far too large.")
        if math.isnan(joint.velocity) or not joint.lower <= joint.upper:
            raise RobotError(
                f"joint {joint.name!r} has the limits {joint.lower} to {joint.upper}. Expected the lower one first."
            )


def _name(element: Element) -> str:
    name = element.get("name")
    if not name or not is_plain(name):
        raise RobotError(f"the name {shown(name)} is empty or contains control characters.")
    return name


def _numbers(element: Element | None, attribute: str, default: str) -> list[float]:
    """Return the numbers of an attribute, as many as the default has, which stands for an absent element."""
    text = default if element is None else element.get(attribute, default)
    expected = len(default.split())
    try:
        numbers = [float(number) for number in text.replace(",", " ").split()]
    except ValueError:
        numbers = []
    if len(numbers) != expected:
        raise RobotError(f"{attribute} is {shown(text)}, expected {expected} numbers.")
    return numbers


def _number(element: Element | None, attribute: str, default: str = "0") -> float:
    return _numbers(element, attribute, default)[0]


def _pose(element: Element) -> np.ndarray:
    """[4, 4] the origin of a joint, of an inertia or of a shape."""
    from trimesh.transformations import compose_matrix

    origin = element.find("origin")
    return compose_matrix(translate=_numbers(origin, "xyz", "0 0 0"), angles=_numbers(origin, "rpy", "0 0 0"))


def _link(element: Element, path: Path) -> Link:
    name = _name(element)
    mass = 0.0
    com = np.zeros(3)
    inertia = np.zeros((3, 3))
    inertial = element.find("inertial")
    if inertial is not None:
        mass = _number(inertial.find("mass"), "value")
    if inertial is not None and mass:
        T = _pose(inertial)
        com = T[:3, 3]
        stated = inertial.find("inertia")
        moments = np.array([_number(stated, key) for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")])
        inertia = T[:3, :3] @ moments[[[0, 1, 2], [1, 3, 4], [2, 4, 5]]] @ T[:3, :3].T
    shapes = []
    for collision in element.iterfind("collision"):
        geometry = collision.find("geometry/*")
        if geometry is None:
            raise RobotError(f"link {name!r} has a collision without a geometry.")
        shapes.append(Shape(geometry=_geometry(geometry, name, path), T_body_shape=_pose(collision)))
    return Link(name=name, mass=mass, com=com, inertia=inertia, collisions=tuple(shapes))


def _geometry(element: Element, link: str, path: Path) -> Geometry:
    kind = element.tag
    if kind == "box":
        return Geometry(kind=kind, size=tuple(side / 2 for side in _numbers(element, "size", "0 0 0")))
    if kind == "sphere":
        return Geometry(kind=kind, size=(_number(element, "radius"),))
    if kind == "cylinder" or kind == "capsule":
        return Geometry(kind=kind, size=(_number(element, "radius"), _number(element, "length") / 2))
    if kind == "mesh":
        return _mesh_hull(element, link, path)
    raise RobotError(f"link {link!r} has a {shown(kind)}. Expected a box, sphere, cylinder, capsule or mesh.")


def _mesh_hull(element: Element, link: str, path: Path) -> Geometry:
    name = element.get("filename", "")
    file = find_mesh(name, path)
    if file is None:
        raise RobotError(f"link {link!r} uses the mesh {shown(name)}, which is not in its folders. Put it there.")
    try:
        vertices = np.asarray(load_mesh(file).vertices)
        if not (np.abs(vertices) < _LARGEST).all():
            raise ObjectError("a vertex is not finite, or too far away")
        scale = np.array(element.get("scale", "1").replace(",", " ").split(), dtype=float)
        return hull(vertices * np.broadcast_to(scale, 3), HULL_TOLERANCE).geometry
    except (ObjectError, ValueError) as error:
        raise RobotError(f"link {link!r} uses the mesh {name!r}, which cannot be read: {shown(str(error))}") from error


def find_mesh(name: str, urdf: Path) -> Path | None:
    """Return the file that a URDF's mesh name means, or None; a name cannot lead out of the robot's folders."""
    relative = Path(name.split("://", 1)[-1])
    folders = [folder for folder in urdf.parents[: _FOLDERS_ABOVE + 1] if folder != folder.parent]
    names = [relative]
    if name.startswith("package://"):  # the package's own folder may be above
        names.append(Path(*relative.parts[1:]))
    try:
        for each in names:
            for folder in folders:
                file = Path(os.path.normpath(folder / each))
                if file.is_relative_to(folders[-1]) and os.path.isfile(file):
                    return file
    except (OSError, ValueError):  # a name that is too long, or contains a zero
        pass
    return None


def _joint(element: Element) -> Joint:
    name = _name(element)
    kind = element.get("type")
    if kind not in ("revolute", "continuous", "prismatic", "fixed"):
        raise RobotError(f"joint {name!r} has type {kind!r}; supported are revolute, continuous, prismatic and fixed.")
    axis = np.array(_numbers(element.find("axis"), "xyz", "1 0 0"))
    length = float(np.linalg.norm(axis))
    if kind != "fixed" and not length > _SHORTEST_AXIS:
        raise RobotError(f"joint {name!r} has the axis {axis}, expected a direction.")
    limits = {}
    limit = element.find("limit")
    if limit is not None:
        limits = {key: _number(limit, key, default) for key, default in _LIMITS.items()}
        if not 0 < limits["effort"] < math.inf:
            limits["effort"] = 0.0
    if kind == "continuous":
        limits |= {"lower": -math.inf, "upper": math.inf}
    follows = None
    mimic = element.find("mimic")
    if mimic is not None:
        multiplier = _number(mimic, "multiplier", "1")
        offset = _number(mimic, "offset")
        if not math.isfinite(multiplier + offset):
            raise RobotError(f"joint {name!r} follows another by a number that is not finite.")
        follows = MimicSpec(joint=name, source=mimic.get("joint", ""), multiplier=multiplier, offset=offset)
    return Joint(
        name=name,
        type="revolute" if kind == "continuous" else kind,
        parent=_end(element, "parent"),
        child=_end(element, "child"),
        T_parent_joint=_pose(element),
        axis=axis / max(length, _SHORTEST_AXIS),
        mimic=follows,
        **limits,
    )


def _end(joint: Element, end: str) -> str:
    link = joint.find(end)
    return "" if link is None else link.get("link", "")
