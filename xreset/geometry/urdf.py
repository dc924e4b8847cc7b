"""A URDF as plain data: the kinematic tree that every part of xreset builds from.

Each engine's own URDF reader has habits of its own (invented masses, fused fixed links, joint order, effort as a force range). So a URDF is
read once, here, and the backends build their models from a :class:`RobotTree`.
"""

from __future__ import annotations

import io
import math
import os
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal
from xml.etree import ElementTree

import numpy as np

from xreset.errors import RobotError
from xreset.files import max_bytes
from xreset.geometry.shapes import hull
from xreset.spec import Geometry, RobotSpec, Shape
from xreset.text import is_plain, shown

JointType = Literal["revolute", "prismatic", "fixed"]

HULL_TOLERANCE = 5e-4
"""[m] How far the hull of a mesh with many points may stand back behind them: makers' meshes have thousands, engines bear hundreds."""
_MASSLESS = 1e-9


@dataclass(frozen=True, kw_only=True)
class Link:
    """A link, its inertia and its shapes."""

    name: str
    mass: float
    """[kg]; 0 where the URDF gives none."""
    com: np.ndarray
    """[3] centre of mass in the link frame [m]."""
    inertia: np.ndarray
    """[3, 3] about the centre of mass, along the link frame's axes [kg m^2]."""
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
    axis: np.ndarray
    """[3] unit axis in the joint (child) frame."""
    lower: float
    """Lower position limit [rad or m]; -inf for a continuous joint."""
    upper: float
    velocity: float
    """Largest speed [rad/s or m/s]; inf where the URDF gives none."""


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

    def link(self, name: str) -> Link:
        """The link of that name; ``RobotError`` if there is none."""
        for link in self.links:
            if link.name == name:
                return link
        raise RobotError(f"robot {self.name!r} has no link {name!r}; it has {', '.join(self.link_names)}.")

    def joint(self, name: str) -> Joint:
        """The joint of that name; ``RobotError`` if there is none."""
        for joint in self.joints:
            if joint.name == name:
                return joint
        raise RobotError(f"robot {self.name!r} has no joint {name!r}; it has {', '.join(j.name for j in self.joints)}.")

    def moving_ancestor(self, name: str) -> str:
        """The link of the rigid body that ``name`` belongs to: itself, or the nearest ancestor that a joint moves (or the root)."""
        by_child = {joint.child: joint for joint in self.joints}
        while name in by_child and by_child[name].type == "fixed":
            name = by_child[name].parent
        return name


def robot_tree(robot: RobotSpec) -> RobotTree:
    """The tree of a robot's URDF (read once per file and modification)."""
    return load_urdf(robot.urdf)


def load_urdf(path: str | Path) -> RobotTree:
    """Read a URDF.

    ``<capsule radius length/>`` is understood in addition to the standard shapes. Mesh files are looked for beside the URDF
    (``package://NAME/`` is tried there and in the three folders above it).

    Raises:
        RobotError: the file is missing or damaged, a mesh is missing, the links form no tree, or a joint type is not supported.
    """
    path = Path(path).resolve()
    if not path.is_file():
        raise RobotError(f"there is no URDF at {path}.")
    if path.stat().st_size > max_bytes() // 16:
        raise RobotError(f"{path} has {path.stat().st_size >> 20} MB, too many for a URDF.")
    return _load(path, path.stat().st_mtime_ns)


def parse_xml(path: Path) -> ElementTree.Element:
    """The root of a file.

    Raises:
        RobotError: it cannot be read.
    """
    try:
        return ElementTree.parse(path).getroot()
    except (OSError, ElementTree.ParseError, ValueError, LookupError) as error:  # the last two: encodings
        raise RobotError(f"{path} cannot be read as XML: {shown(str(error))}") from error


@lru_cache(maxsize=16)
def _load(path: Path, _modified: int) -> RobotTree:
    import yourdfpy

    xml = parse_xml(path)
    try:
        if xml.tag == "mujoco":
            raise RobotError(f"{path} is MJCF, not URDF; `xreset robots import` makes a robot of it.")
        for element in xml.iter("geometry"):  # yourdfpy knows no capsules: they travel as negative cylinders
            for capsule in element.findall("capsule"):
                capsule.tag = "cylinder"
                capsule.set("radius", f"-{capsule.get('radius')}")
        with np.errstate(invalid="ignore"):
            robot = yourdfpy.URDF.load(
                io.BytesIO(ElementTree.tostring(xml)),
                build_scene_graph=False,
                load_meshes=False,
                filename_handler=lambda name: name,
            ).robot
    except RobotError:
        raise
    except Exception as error:  # yourdfpy raises whatever its parsing meets
        raise RobotError(f"{path} cannot be read as a URDF: {shown(str(error))}") from error

    joints = {joint.child: joint for joint in robot.joints}
    names = [link.name for link in robot.links]
    if len(set(names)) != len(names):
        raise RobotError(f"{path}: a link name occurs twice.")
    roots = [name for name in names if name not in joints]
    if len(roots) != 1:
        raise RobotError(f"{path}: expected one root link, found {len(roots)} ({', '.join(roots) or 'none'}).")
    children: dict[str, list[str]] = {}
    for joint in robot.joints:
        for end in (joint.parent, joint.child):
            if end not in names:
                raise RobotError(f"{path}: joint {joint.name!r} names link {end!r}, which the file does not define.")
        children.setdefault(joint.parent, []).append(joint.child)
    order: list[str] = []
    stack = [roots[0]]
    while stack:
        name = stack.pop()
        order.append(name)
        stack.extend(reversed(children.get(name, [])))
    if len(order) != len(names):
        raise RobotError(f"{path}: links {sorted(set(names) - set(order))} are not connected to the root {roots[0]!r}.")

    by_name = {link.name: link for link in robot.links}
    for name in (*names, *(joint.name for joint in robot.joints)):
        if not isinstance(name, str) or not is_plain(name):
            raise RobotError(f"{path}: the name {shown(name)} holds characters that control a terminal, or is none.")
    try:
        with np.errstate(invalid="ignore"):  # what is not finite is refused below
            tree = RobotTree(
                name=robot.name or path.stem,
                root=roots[0],
                links=tuple(_link(by_name[name], path) for name in order),
                joints=tuple(_joint(joints[name], path) for name in order[1:]),
            )
    except (ValueError, TypeError, IndexError) as error:  # vectors of two numbers, texts for numbers
        raise RobotError(f"{path} has numbers that make no sense: {shown(str(error))}") from error
    check_tree(tree, path)
    return tree


_LARGEST = 1e6
"""Of any number of a URDF but limits: masses [kg], positions [m], inertias [kg m^2]. No robot comes near."""


def check_tree(tree: RobotTree, path: Path) -> None:
    """Refuse numbers that are not finite or beyond anything real (``RobotError``); continuous joints' limits are infinite on purpose."""
    for link in tree.links:
        parts = [link.com, link.inertia, np.array([link.mass])]
        for shape in link.collisions:
            parts += [shape.T_body_shape, np.asarray(shape.geometry.size or 0.0)]
            parts += [] if shape.geometry.vertices is None else [shape.geometry.vertices]
        if not all((np.abs(part) < _LARGEST).all() for part in parts):
            raise RobotError(f"{path}: link {link.name!r} has a number that is not finite, or far too large.")
        if link.mass < 0:
            raise RobotError(f"{path}: link {link.name!r} has the mass {link.mass} kg, expected 0 or more.")
    for joint in tree.joints:
        if not ((np.abs(joint.T_parent_joint) < _LARGEST).all() and np.isfinite(joint.axis).all()):
            raise RobotError(f"{path}: joint {joint.name!r} has a number that is not finite, or far too large.")
        if math.isnan(joint.velocity) or not joint.lower <= joint.upper:
            raise RobotError(
                f"{path}: joint {joint.name!r} has the limits {joint.lower} to {joint.upper}, expected the lower one first."
            )


def _link(link, path: Path) -> Link:
    inertial = link.inertial
    if inertial is None or not inertial.mass:
        mass, com, inertia = 0.0, np.zeros(3), np.zeros((3, 3))
    else:
        origin = np.eye(4) if inertial.origin is None else np.asarray(inertial.origin, dtype=float)
        about = np.zeros((3, 3)) if inertial.inertia is None else np.asarray(inertial.inertia, dtype=float)
        mass, com, inertia = float(inertial.mass), origin[:3, 3], origin[:3, :3] @ about @ origin[:3, :3].T
    shapes = []
    for collision in link.collisions:
        T = np.eye(4) if collision.origin is None else np.asarray(collision.origin, dtype=float)
        geometry = collision.geometry
        if geometry.box is not None:
            size = tuple(float(s) / 2 for s in geometry.box.size)
            if len(size) != 3:
                raise ValueError(f"link {link.name!r} has a box of {len(size)} numbers")
            shape = Geometry(kind="box", size=size)
        elif geometry.sphere is not None:
            shape = Geometry(kind="sphere", size=(float(geometry.sphere.radius),))
        elif geometry.cylinder is not None:
            radius, half = float(geometry.cylinder.radius), float(geometry.cylinder.length) / 2
            shape = Geometry(kind="capsule" if radius < 0 else "cylinder", size=(abs(radius), half))
        elif geometry.mesh is not None:
            shape = _hull(geometry.mesh, link.name, path)
        else:
            raise RobotError(f"{path}: link {link.name!r} has a collision without a geometry.")
        shapes.append(Shape(geometry=shape, T_body_shape=T))
    return Link(name=link.name, mass=mass, com=com, inertia=inertia, collisions=tuple(shapes))


def _hull(mesh, link: str, path: Path) -> Geometry:
    import trimesh

    file = find_mesh(mesh.filename, path)
    if file is None:
        raise RobotError(
            f"{path}: link {link!r} uses the mesh {shown(mesh.filename)}, which is not in its folders. Put it there."
        )
    try:
        if file.stat().st_size > max_bytes():
            raise ValueError(f"it has {file.stat().st_size >> 20} MB, more than XRESET_MAX_FILE_MB allows")
        loaded = trimesh.load(file, force="mesh", process=False)
        if not isinstance(loaded, trimesh.Trimesh) or not len(loaded.vertices):
            raise ValueError("it holds no triangles")
        if not (np.abs(loaded.vertices) < _LARGEST).all():
            raise ValueError("it has a vertex that is not finite, or far away")
        scale = np.ones(3) if mesh.scale is None else np.broadcast_to(np.asarray(mesh.scale, dtype=float), 3)
        return hull(np.asarray(loaded.vertices) * scale, HULL_TOLERANCE).geometry
    except Exception as error:  # trimesh and qhull raise whatever they meet
        raise RobotError(
            f"{path}: link {link!r} uses the mesh {mesh.filename!r}, which cannot be read: {shown(str(error))}"
        ) from error


_ABOVE = 3
"""Folders above a URDF's own in which its meshes may lie: those of a ROS package and of its workspace, never the root."""


def find_mesh(name: str, urdf: Path) -> Path | None:
    """The file that a URDF's mesh name means, or None: a name cannot lead out of the robot's folders."""
    relative = Path(name.split("://", 1)[1]) if "://" in name else Path(name)
    folders = [folder for folder in urdf.parents[: _ABOVE + 1] if folder != folder.parent]
    names = (
        [relative, Path(*relative.parts[1:])] if name.startswith("package://") else [relative]
    )  # a package's own folder may be above
    candidates = (Path(os.path.normpath(folder / each)) for each in names for folder in folders)
    try:
        return next((file for file in candidates if file.is_relative_to(folders[-1]) and file.is_file()), None)
    except (OSError, ValueError):  # a name too long, or with a zero in it
        return None


def _joint(joint, path: Path) -> Joint:
    if joint.type not in ("revolute", "continuous", "prismatic", "fixed"):
        raise RobotError(
            f"{path}: joint {joint.name!r} has type {joint.type!r}; supported are revolute, continuous, prismatic and fixed."
        )
    axis = np.array([1.0, 0, 0]) if joint.axis is None else np.asarray(joint.axis, dtype=float)
    if joint.type != "fixed" and not np.linalg.norm(axis) > _MASSLESS:
        raise RobotError(f"{path}: joint {joint.name!r} has the axis {axis}, expected a direction.")
    lower, upper, velocity = -math.inf, math.inf, math.inf
    if joint.limit is not None:
        if joint.type != "continuous":
            lower = 0.0 if joint.limit.lower is None else float(joint.limit.lower)
            upper = 0.0 if joint.limit.upper is None else float(joint.limit.upper)
        velocity = math.inf if joint.limit.velocity is None else float(joint.limit.velocity)
    return Joint(
        name=joint.name,
        type="revolute" if joint.type == "continuous" else joint.type,
        parent=joint.parent,
        child=joint.child,
        T_parent_joint=np.eye(4) if joint.origin is None else np.asarray(joint.origin, dtype=float),
        axis=axis / max(float(np.linalg.norm(axis)), _MASSLESS),
        lower=lower,
        upper=upper,
        velocity=velocity,
    )
