"""A URDF as plain data: the kinematic tree that every part of xreset builds from.

Every engine's own URDF reader has habits (invented masses, fused fixed links, joint order, effort as a force range). So
a URDF is read once, here, and the backends build their models from a :class:`RobotTree`.
"""

from __future__ import annotations

import io
import math
import os
from collections import Counter
from collections.abc import Iterable
from dataclasses import field, replace
from functools import cached_property, lru_cache
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal
from xml.etree import ElementTree
from xml.etree.ElementTree import Element
from xml.parsers import expat

import numpy as np

from xreset.errors import ObjectError, RobotError
from xreset.files.checks import frozen
from xreset.files.storage import max_bytes
from xreset.files.text import is_plain, shown
from xreset.geometry.shapes import hull, load_mesh, refuse_pointer, shape_mesh, surface_of
from xreset.spec import Geometry, MimicSpec, RobotSpec, Shape

if TYPE_CHECKING:
    import trimesh
    import yourdfpy

JointType = Literal["revolute", "prismatic", "fixed"]

HULL_TOLERANCE = 5e-4
"""How far points of a mesh may be outside its hull [m]: makers' meshes have thousands of points, engines accept
hundreds."""
_LARGEST = 1e6
"""Larger numbers in a URDF are errors: masses [kg], positions [m], inertias [kg m^2], but not limits."""
_SMALLEST = 1e-6
"""[m] Smallest size of a shape."""
_LINK_SIZES = (5e-4, 10.0)
"""[m] Lengths of the shapes of a link; meshes that are smaller or larger are in other units."""
_FAR = 10.0
"""[m] Largest distance of a joint from its parent link, and of a shape from its link."""
_LONGEST_NAME = 200
"""Most characters of the name of a link or joint."""
_SHORTEST_AXIS = 1e-9
"""Length of a vector that still states a direction."""
_FOLDERS_ABOVE = 3
"""Folders above the URDF's own that may hold meshes: those of a ROS package and of its workspace, never the root."""


@frozen
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


@frozen
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


@frozen
class RobotTree:
    """The links and joints of a URDF, parents before children."""

    name: str
    root: str
    links: tuple[Link, ...]
    joints: tuple[Joint, ...]
    """Joint i's child is link i + 1."""
    exclude: tuple[tuple[str, str], ...] = ()
    """Pairs of links that never collide, as an MJCF has them."""

    @property
    def link_names(self) -> tuple[str, ...]:
        """Names of all links, root first."""
        return tuple(link.name for link in self.links)

    @property
    def mimics(self) -> tuple[MimicSpec, ...]:
        """How joints follow others, as the URDF has it."""
        return tuple(joint.mimic for joint in self.joints if joint.mimic is not None)

    @cached_property
    def above(self) -> dict[str, Joint]:
        """Link -> the joint between its parent and it; the root has none."""
        return {joint.child: joint for joint in self.joints}

    @cached_property
    def moved_by(self) -> dict[str, Joint]:
        """Link -> the joint that moves it; links that are fixed to their parents have none."""
        return {link: joint for link, joint in self.above.items() if joint.type != "fixed"}

    def link(self, name: str) -> Link:
        """Return the link of that name, or raise ``RobotError``."""
        return self._named("link", self.links, name)

    def joint(self, name: str) -> Joint:
        """Return the joint of that name, or raise ``RobotError``."""
        return self._named("joint", self.joints, name)

    def _named(self, kind: str, parts, name: str):
        by_name = {part.name: part for part in parts}
        if name not in by_name:
            raise RobotError(
                f"robot {self.name!r} has no {kind} {name!r}. Choose from: {', '.join(by_name)}."
            )
        return by_name[name]

    def with_joints(self, joints: Iterable[Joint]) -> RobotTree:
        """Return the tree with these joints in place of those that have the same children."""
        changed = {joint.child: joint for joint in joints}
        return replace(self, joints=tuple((self.above | changed).values()))

    def below(self, root: str) -> list[str]:
        """Return the link ``root`` and all links that it carries, parents before children."""
        found = [root]
        for joint in self.joints:
            if joint.parent in found:
                found.append(joint.child)
        return found

    def moving_ancestor(self, name: str) -> str:
        """Return the link of the rigid body of a link: itself, or the nearest ancestor that a joint moves (or the
        root)."""
        while name != self.root and name not in self.moved_by:
            name = self.above[name].parent
        return name

    def may_meet(self, a: str, b: str) -> bool:
        """Return whether two links are of different rigid bodies that no joint connects."""
        bodies = {self.moving_ancestor(a), self.moving_ancestor(b)}
        joints = [self.moved_by[body] for body in bodies if body in self.moved_by]
        parents = {self.moving_ancestor(joint.parent) for joint in joints}
        return len(bodies) == 2 and not bodies & parents

    def pose_in(self, link: str, name: str) -> np.ndarray:
        """[4, 4] pose of a link in the frame of another one that carries it, with all joints at 0."""
        T = np.eye(4)
        while name != link:
            T = self.above[name].T_parent_joint @ T
            name = self.above[name].parent
        return T


def robot_tree(robot: RobotSpec) -> RobotTree:
    """Return the tree of a robot's URDF; the file is read again only after a change.

    Raises:
        RobotError: the URDF cannot be read, or it contradicts the robot's description.
    """
    tree = load_urdf(robot.urdf)
    for problem in chain(*mismatches(robot, tree).values()):
        raise RobotError(f"robot {robot.name!r}: {problem}")
    return tree


def mismatches(robot: RobotSpec, tree: RobotTree) -> dict[str, list[str]]:
    """Compare a description with the tree of its URDF.

    Returns:
        A sentence for each contradiction, under ``joints`` and ``links``.
    """
    moving = [joint.name for joint in tree.moved_by.values()]
    fixed = {joint.name for joint in tree.joints if joint.type == "fixed"}
    described = [*robot.joint_names, *(mimic.joint for mimic in robot.mimics)]
    joints = []
    for name in described:
        if name not in moving:
            where = "fixed in" if name in fixed else "not in"
            joints.append(
                f"{name!r} is {where} the URDF, whose moving joints are {', '.join(moving)}."
            )
    for name in moving:
        if name not in described:
            joints.append(
                f"the URDF's joint {name!r} moves, but the description neither actuates it nor makes it a mimic "
                "joint. Add it to either, or make it fixed in the URDF."
            )
    for mimic in robot.mimics:
        if mimic.source not in robot.joint_names:
            joints.append(
                f"mimic joints follow {mimic.source}, which the description does not actuate. Let them follow an "
                "actuated joint."
            )
    named = {
        "hand.root": [robot.hand_root],
        "hand.palm": [robot.palm],
        "keypoints": [point.link for point in robot.keypoints],
        "collision.self": robot.self_collision_links,
        "collision.exclude": chain(*robot.collision_exclude),
        "collision.table_exclude": robot.table_exclude,
    }
    for tip in robot.fingertips:
        named[f"fingertip {tip.name!r}"] = [tip.link, *tip.contact_links]
    known = tree.link_names
    links = []
    for entry, names in named.items():
        absent = [repr(link) for link in dict.fromkeys(names) if link not in known]
        if absent:
            links.append(
                f"{entry}: the URDF has no link {', '.join(absent)}. Choose from: {', '.join(known)}."
            )
    return {"joints": joints, "links": links}


def joint_limits(robot: RobotSpec) -> np.ndarray:
    """[2, J] lower and upper limits of a robot's joints [rad or m]."""
    tree = robot_tree(robot)
    joints = [tree.joint(name) for name in robot.joint_names]
    return np.array([(joint.lower, joint.upper) for joint in joints]).T


def prismatic_joints(robot: RobotSpec) -> np.ndarray:
    """[J] bool: which of a robot's joints slide."""
    tree = robot_tree(robot)
    return np.array([tree.joint(name).type == "prismatic" for name in robot.joint_names])


def link_meshes(robot: RobotSpec) -> dict[str, trimesh.Trimesh]:
    """Return the collision shapes of each link of the robot's URDF that has some, as one mesh in the link's frame."""
    import trimesh

    meshes = {}
    for link in robot_tree(robot).links:
        if link.collisions:
            shapes = [shape_mesh(shape, coarse=True) for shape in link.collisions]
            meshes[link.name] = trimesh.util.concatenate(shapes)
    return meshes


def load_urdf(path: str | Path, *, visuals: bool = False) -> RobotTree:
    """Read a URDF; it is read again only after a change of the file or of a mesh.

    ``<capsule radius length/>`` is accepted in addition to the standard shapes. Mesh files are searched next to the
    URDF (``package://NAME/`` also in the three folders above it).

    Args:
        path: the file.
        visuals: visual shapes are used for links that have no collision shape, and are fixed to none that has one.

    Raises:
        RobotError: the file is missing or damaged, a mesh is missing, the links form no tree, or a joint type is not
            supported.
    """
    path = Path(path).resolve()
    files = (path, *mesh_files(path, "*" if visuals else "collision"))
    return _load(path, tuple(file.stat().st_mtime_ns for file in files), visuals)


def parse_xml(path: Path) -> Element:
    """Return the root element of a file, or raise ``RobotError``; expat refuses entities that grow to any size.

    Attributes and elements of other namespaces, such as ``drake:acceleration``, are left out.
    """
    if not os.path.isfile(path):  # Path.is_file() raises OSError for a name that is too long
        raise RobotError(
            f"{shown(str(path))} is not a file. Expected a robot's URDF or MJCF there."
        )
    builder = ElementTree.TreeBuilder()
    parser = expat.ParserCreate()  # does not ask for the declaration of a prefix
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    try:
        if path.stat().st_size > max_bytes() // 16:
            raise ValueError("it is too large to describe a robot")
        refuse_pointer(path, RobotError)
        parser.Parse(path.read_bytes(), True)
        root = builder.close()
    except (OSError, expat.ExpatError, ValueError, LookupError) as error:
        raise RobotError(f"{path} cannot be read as XML: {shown(str(error))}") from error
    _refuse_xacro(path, root)
    for element in root.iter():
        for name in [*element.keys()]:
            if ":" in name or name == "xmlns":
                del element.attrib[name]
        for child in [*element]:
            if ":" in child.tag:
                element.remove(child)
    return root


def _refuse_xacro(path: Path, root: Element) -> None:
    for element in root.iter():
        found = [text for text in element.attrib.values() if "${" in text or "$(" in text]
        if element.tag.startswith("xacro:"):
            found.append(f"<{element.tag}>")
        if found:
            raise RobotError(
                f"{path} is xacro, from which a URDF is still to be made: it has {shown(found[0])}. Run xacro first: "
                "`xacro FILE > robot.urdf`."
            )


def mesh_files(urdf: Path, kind: str = "collision") -> list[Path]:
    """Return the mesh files of a URDF's shapes of a kind, as far as they exist."""
    changed = urdf.stat().st_mtime_ns if os.path.isfile(urdf) else 0
    files = [find_mesh(name, urdf) for name in _mesh_names(urdf, changed, kind)]
    return [file for file in files if file is not None]


@lru_cache(maxsize=16)
def _mesh_names(urdf: Path, changed: int, kind: str) -> list[str]:
    """Return the names of a URDF's mesh files; its time of change [ns] makes the cache read a changed file again."""
    meshes = parse_xml(urdf).iterfind(f"link/{kind}/geometry/mesh")
    return [mesh.get("filename", "") for mesh in meshes]


@lru_cache(maxsize=16)
def _load(path: Path, changed: tuple[int, ...], visuals: bool) -> RobotTree:
    """Read a URDF and its meshes; their times of change [ns] make the cache read changed files again."""
    xml = parse_xml(path)
    if xml.tag == "mujoco":
        raise RobotError(f"{path} is MJCF, not URDF; `xreset robots import` makes a robot of it.")
    if xml.tag != "robot":
        raise RobotError(
            f"{path} starts with <{shown(xml.tag)[1:-1]}>, which is not a URDF. Expected <robot>."
        )
    try:
        with np.errstate(invalid="ignore"):  # check_tree refuses what is not finite
            xml.set("name", xml.get("name") or path.stem)
            robot = _parsed(xml)
            if visuals:
                _use_visuals(robot, path)
            links = [_link(link, path) for link in robot.links]
            joints = [_joint(joint) for joint in robot.joints]
        tree = _ordered(robot.name, links, joints)
        check_tree(tree)
    except RobotError as error:
        raise RobotError(f"{path} cannot be read as a URDF: {error}") from error
    except Exception as error:  # yourdfpy raises whatever its parsing meets
        raise RobotError(
            f"{path} cannot be read as a URDF: {shown(f'{type(error).__name__}: {error}')}"
        ) from error
    return tree


def _parsed(xml: Element) -> yourdfpy.Robot:
    """Return what yourdfpy reads from a URDF; capsules, which it does not know, become cylinders of negative radius."""
    import yourdfpy

    for shape in xml.iterfind("link/*/geometry/*"):
        if shape.get("radius", "").strip().startswith("-"):
            raise RobotError(f"a {shown(shape.tag)} has a negative radius.")
        if shape.tag == "capsule":
            shape.tag = "cylinder"
            shape.set("radius", f"-{shape.get('radius', '').strip()}")
    for kind in ("link", "joint"):
        for part in xml.iterfind(kind):
            if part.get("name") is None:
                raise RobotError(f"a {kind} has no name.")
    for joint in xml.iterfind("joint"):
        for end in ("parent", "child"):
            if joint.find(end) is None:
                raise RobotError(f"joint {shown(joint.get('name', ''))} has no {end} link.")
    file = io.BytesIO(ElementTree.tostring(xml))
    return yourdfpy.URDF.load(
        file, build_scene_graph=False, load_meshes=False, filename_handler=lambda name: name
    ).robot


def _use_visuals(robot: yourdfpy.Robot, path: Path) -> None:
    """Make collision shapes of the visual ones in all bodies that have no collision shape, if the last body of a chain
    is such a one: then the file's collision shapes are not complete."""
    carriers = {joint.child: joint.parent for joint in robot.joints if joint.type == "fixed"}
    carrying = {_body(joint.parent, carriers) for joint in robot.joints if joint.type != "fixed"}
    solid = {_body(link.name, carriers) for link in robot.links if link.collisions}
    shown_only: dict[str, list[tuple[yourdfpy.Link, Any]]] = {}
    for link in robot.links:
        body = _body(link.name, carriers)
        if body in solid:
            continue
        for visual in link.visuals:
            shown_only.setdefault(body, []).append((link, visual))
    if shown_only.keys() <= carrying:
        return
    for body, found in shown_only.items():
        there = [(link, visual) for link, visual in found if _is_there(visual.geometry.mesh, path)]
        # the end of a chain needs a shape: without its meshes, reading them says which file is missing
        for link, visual in there if there or body in carrying else found:
            link.collisions.append(visual)


def _body(link: str, carriers: dict[str, str]) -> str:
    """Return the link that carries a link by fixed joints; ``carriers``: link -> the link that it is fixed to."""
    for _ in carriers:
        link = carriers.get(link, link)
    return link


def _is_there(mesh: yourdfpy.Mesh | None, path: Path) -> bool:
    """Return whether a shape needs no mesh, or its mesh can be found."""
    return mesh is None or find_mesh(mesh.filename, path) is not None


def _ordered(name: str, links: list[Link], joints: list[Joint]) -> RobotTree:
    """Return the tree, parents before children."""
    link_by_name = {link.name: link for link in links}
    joint_above = {joint.child: joint for joint in joints}
    if len(link_by_name) < len(links):
        raise RobotError("a link name occurs twice.")
    if len(joint_above) < len(joints):
        raise RobotError("a link is the child of two joints, expected one.")
    names = Counter(joint.name for joint in joints)
    for joint in joints:
        if names[joint.name] > 1 and joint.type != "fixed":
            raise RobotError(
                f"the joint name {joint.name!r} occurs twice. Rename one of the joints."
            )
        for end in (joint.parent, joint.child):
            if end not in link_by_name:
                raise RobotError(
                    f"joint {joint.name!r} names link {end!r}, which the file does not define."
                )
    roots = [link for link in link_by_name if link not in joint_above]
    if len(roots) != 1:
        raise RobotError(
            f"expected one root link, found {len(roots)} ({', '.join(roots) or 'none'})."
        )
    order = []
    stack = list(roots)
    while stack:
        parent = stack.pop()
        order.append(parent)
        children = [joint.child for joint in joints if joint.parent == parent]
        stack.extend(reversed(children))
    if len(order) != len(links):
        raise RobotError(
            f"links {sorted(set(link_by_name) - set(order))} are not connected to the root {roots[0]!r}."
        )
    return RobotTree(
        name=name,
        root=roots[0],
        links=tuple(link_by_name[link] for link in order),
        joints=tuple(joint_above[link] for link in order[1:]),
    )


def check_tree(tree: RobotTree) -> None:
    """Raise ``RobotError`` for numbers that are not finite or too large, for sizes that no robot has, and for names
    that are too long for messages; limits of continuous joints may be infinite."""
    for part in (*tree.links, *tree.joints):
        if len(part.name) > _LONGEST_NAME:
            raise RobotError(
                f"the name {shown(part.name)} has {len(part.name)} characters, expected {_LONGEST_NAME} at most."
            )
    for link in tree.links:
        parts = [link.com, link.inertia, link.mass]
        for shape in link.collisions:
            geometry = shape.geometry
            parts += [shape.T_body_shape, geometry.size]
            if geometry.vertices is not None:
                parts.append(geometry.vertices)
            # a capsule may be a ball
            positive = geometry.size[:1] if geometry.kind == "capsule" else geometry.size
            least = min(positive, default=math.inf)
            if least < _SMALLEST:
                raise RobotError(
                    f"link {link.name!r} has a shape of size {least:g} m, expected {_SMALLEST:g} m or more."
                )
        if link.mass < 0 or not all((np.abs(part) < _LARGEST).all() for part in parts):
            raise RobotError(
                f"link {link.name!r} has a negative mass, or a number that is not finite or far too large."
            )
        _check_size(link)
    for joint in tree.joints:
        numbers = [*joint.axis, joint.effort, joint.stiffness, joint.rotor]
        if not ((np.abs(joint.T_parent_joint) < _LARGEST).all() and np.isfinite(numbers).all()):
            raise RobotError(
                f"joint {joint.name!r} has a number that is not finite, or far too large."
            )
        distance = np.linalg.norm(joint.T_parent_joint[:3, 3])
        if distance > _FAR:
            raise RobotError(
                f"joint {joint.name!r} is {distance:.3g} m from its parent link, far too much for a robot. Are these "
                "millimetres? State metres."
            )
        if math.isnan(joint.velocity) or not joint.lower <= joint.upper:
            raise RobotError(
                f"joint {joint.name!r} has the limits {joint.lower} to {joint.upper}. Expected the lower one first."
            )


def _check_size(link: Link) -> None:
    if not link.collisions:
        return
    vertices, _ = surface_of(link.collisions)
    size = float(np.ptp(vertices, axis=0).max())
    is_mesh = all(shape.geometry.kind == "hull" for shape in link.collisions)
    least, most = _LINK_SIZES
    if size > most or (is_mesh and size < least):
        raise RobotError(
            f"link {link.name!r} has shapes of {size:.3g} m, expected {least:g} to {most:g} m. If a mesh is in other "
            'units, state its scale: scale="0.001 0.001 0.001" for millimetres, "1 1 1" for metres.'
        )
    distance = float(np.abs(vertices).max())
    if distance > _FAR:
        raise RobotError(
            f"link {link.name!r} has a shape {distance:.3g} m away from it, far too much. Are these millimetres? "
            "State metres."
        )


def _checked_name(name: str | None) -> str:
    if not name or not is_plain(name):
        raise RobotError(f"the name {shown(name)} is empty or contains control characters.")
    return name


def _pose(origin: np.ndarray | None) -> np.ndarray:
    """[4, 4]"""
    return np.eye(4) if origin is None else np.asarray(origin, dtype=float)


def _link(link: yourdfpy.Link, path: Path) -> Link:
    name = _checked_name(link.name)
    mass = 0.0
    com = np.zeros(3)
    inertia = np.zeros((3, 3))
    if link.inertial is not None and link.inertial.mass:
        mass = float(link.inertial.mass)
        origin = _pose(link.inertial.origin)
        com = origin[:3, 3]
        if link.inertial.inertia is not None:
            inertia = np.asarray(link.inertial.inertia, dtype=float)
        inertia = origin[:3, :3] @ inertia @ origin[:3, :3].T
    shapes = []
    for collision in link.collisions:
        geometry = _geometry(collision.geometry, name, path)
        shapes.append(Shape(geometry=geometry, T_body_shape=_pose(collision.origin)))
    return Link(name=name, mass=mass, com=com, inertia=inertia, collisions=tuple(shapes))


def _geometry(geometry: yourdfpy.Geometry, link: str, path: Path) -> Geometry:
    if geometry.box is not None:
        size = tuple(float(number) / 2 for number in geometry.box.size)
        if len(size) != 3:
            raise ValueError(f"link {link!r} has a box of {len(size)} numbers")
        return Geometry(kind="box", size=size)
    if geometry.sphere is not None:
        return Geometry(kind="sphere", size=(float(geometry.sphere.radius),))
    if geometry.cylinder is not None:
        radius = float(geometry.cylinder.radius)
        size = (abs(radius), float(geometry.cylinder.length) / 2)
        return Geometry(kind="capsule" if radius < 0 else "cylinder", size=size)
    assert geometry.mesh is not None, "yourdfpy refuses other shapes"
    return _mesh_hull(geometry.mesh, link, path)


def _mesh_hull(mesh: yourdfpy.Mesh, link: str, path: Path) -> Geometry:
    name = mesh.filename
    file = find_mesh(name, path)
    if file is None:
        raise RobotError(
            f"link {link!r} uses the mesh {shown(name)}, which is not in its folders. Put it there."
        )
    try:
        solid = load_mesh(file)
        # Collada states its unit, and ROS reads it
        if file.suffix.lower() == ".dae" and solid.units:
            solid.convert_units("meters")
        vertices = np.asarray(solid.vertices)
        if not (np.abs(vertices) < _LARGEST).all():
            raise ObjectError("a vertex is not finite, or too far away")
        scale = 1.0 if mesh.scale is None else np.asarray(mesh.scale, dtype=float)
        return hull(vertices * np.broadcast_to(scale, 3), HULL_TOLERANCE).geometry
    except (ObjectError, ValueError) as error:
        raise RobotError(f"link {link!r} uses the mesh {shown(name)}: {error}") from error


def find_mesh(name: str, urdf: Path) -> Path | None:
    """Return the file that a URDF's mesh name means, or None; a name cannot lead out of the robot's folders."""
    relative = Path(name.split("://", 1)[-1])
    folders = [folder for folder in urdf.parents[: _FOLDERS_ABOVE + 1] if folder != folder.parent]
    names = [relative]
    if "://" in name or relative.is_absolute():  # the first folders are those of another machine
        names += [Path(*relative.parts[begin:]) for begin in range(1, len(relative.parts))]
    try:
        for each in names:
            for folder in folders:
                file = Path(os.path.normpath(folder / each))
                if file.is_relative_to(folders[-1]) and os.path.isfile(file):
                    return file
    except (OSError, ValueError):  # a name that is too long, or contains a zero
        pass
    return None


def _joint(joint: yourdfpy.Joint) -> Joint:
    name = _checked_name(joint.name)
    kind = joint.type
    if kind not in ("revolute", "continuous", "prismatic", "fixed"):
        raise RobotError(
            f"joint {name!r} has type {kind!r}, expected revolute, continuous, prismatic or fixed. Make it fixed, or "
            "replace it by joints of these types."
        )
    axis = np.asarray(joint.axis, dtype=float)
    if axis.shape != (3,):
        raise ValueError(f"joint {name!r} has an axis of {axis.size} numbers, expected 3 numbers")
    length = float(np.linalg.norm(axis))
    if kind != "fixed" and not length > _SHORTEST_AXIS:
        raise RobotError(f"joint {name!r} has the axis {axis}, expected a direction.")
    limits = {}
    if limit := joint.limit:
        if limit.effort is not None and 0 < limit.effort < math.inf:
            limits["effort"] = float(limit.effort)
        if limit.velocity is not None and limit.velocity != 0:
            limits["velocity"] = float(limit.velocity)
        if kind != "continuous":
            limits["lower"] = float(limit.lower or 0)
            limits["upper"] = float(limit.upper or 0)
    mimic = None
    if joint.mimic is not None:
        multiplier = joint.mimic.multiplier or 0.0
        offset = joint.mimic.offset or 0.0
        if not math.isfinite(multiplier + offset):
            raise RobotError(f"joint {name!r} follows another by a number that is not finite.")
        mimic = MimicSpec(
            joint=name, source=joint.mimic.joint, multiplier=multiplier, offset=offset
        )
    return Joint(
        name=name,
        type="revolute" if kind == "continuous" else kind,
        parent=joint.parent,
        child=joint.child,
        T_parent_joint=_pose(joint.origin),
        axis=axis / max(length, _SHORTEST_AXIS),
        mimic=mimic,
        **limits,
    )
