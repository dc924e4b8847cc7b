"""Writes URDFs: those of the built-in robots, from published figures, and those of imported robots.

Both become a :class:`~xreset.geometry.urdf.RobotTree`, the same plain data that a URDF is read into, so writing and
reading are inverse.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np
import trimesh
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from xreset.geometry.shapes import pose_matrix, roll_pitch_yaw, transform
from xreset.geometry.urdf import Joint, Link, RobotTree

FRAME_MASS = 1e-4
"""Mass of a link that is only a frame [kg]; some engines invent a mass of 1 kg for a link that has none."""
FRAME_INERTIA = 1e-7
"""Moment of inertia of such a link about every axis [kg m^2]."""
_DECIMALS = 12


def pose(
    xyz: ArrayLike = (0, 0, 0),
    *,
    rpy: Sequence[float] = (0, 0, 0),
    quat: ArrayLike | None = None,
) -> np.ndarray:
    """[4, 4] pose from a position [m] and roll, pitch, yaw about fixed axes [rad], or a quaternion (w, x, y, z) of any
    length."""
    if quat is not None:
        return pose_matrix(xyz, quat)
    return transform(Rotation.from_euler("xyz", rpy).as_matrix(), xyz)


def axes(*, x: Sequence[float] | np.ndarray, z: Sequence[float] | np.ndarray) -> np.ndarray:
    """[4, 4] rotation whose first and third columns are the unit vectors ``x`` and ``z``."""
    return transform(np.stack((x, np.cross(z, x), z), axis=1), np.zeros(3))


def frame(name: str) -> Link:
    """Make a link that is only a frame: no shape, and a mass too small to matter."""
    return Link(
        name=name,
        mass=FRAME_MASS,
        com=np.zeros(3),
        inertia=np.eye(3) * FRAME_INERTIA,
        collisions=(),
    )


def fixed(parent: str, child: str, T_parent_child: np.ndarray) -> Joint:
    """Make a fixed joint."""
    return Joint(
        name=f"{child}_fixed",
        type="fixed",
        parent=parent,
        child=child,
        T_parent_joint=T_parent_child,
    )


def urdf_text(tree: RobotTree, comment: str) -> str:
    """Return the text of a tree's URDF.

    Args:
        tree: links and joints.
        comment: source of the figures, written at the top.

    Returns:
        The file's text. Numbers have nine significant digits, so the same figures give the same text.
    """
    robot = Element("robot", name=tree.name)
    for link in tree.links:
        _add_link(robot, link)
    for joint in tree.joints:
        element = SubElement(robot, "joint", name=joint.name, type=joint.type)
        _add_origin(element, joint.T_parent_joint)
        _add(element, "parent", link=joint.parent)
        _add(element, "child", link=joint.child)
        if joint.type == "fixed":
            continue
        _add(element, "axis", xyz=joint.axis)
        _add(
            element,
            "limit",
            lower=joint.lower,
            upper=joint.upper,
            effort=joint.effort,
            velocity=joint.velocity,
        )
        if mimic := joint.mimic:
            _add(
                element,
                "mimic",
                joint=mimic.source,
                multiplier=mimic.multiplier,
                offset=mimic.offset,
            )
    ElementTree.indent(robot)
    comment = comment.replace("--", "- -")  # XML allows no -- in a comment
    head = "".join(f"  {line}\n" for line in comment.splitlines())
    return f'<?xml version="1.0"?>\n<!--\n{head}-->\n{ElementTree.tostring(robot, encoding="unicode")}\n'


def write_meshes(tree: RobotTree, folder: Path) -> None:
    """Write the hulls that :func:`urdf_text` names, as OBJ, into the folder of the URDF."""
    for link in tree.links:
        for number, shape in enumerate(link.collisions):
            geometry = shape.geometry
            if geometry.vertices is None or geometry.faces is None:
                continue
            file = folder / _mesh_name(link.name, number)
            file.parent.mkdir(parents=True, exist_ok=True)
            mesh = trimesh.Trimesh(geometry.vertices, geometry.faces, process=False)
            mesh.export(file, digits=9, include_normals=False, header="")


def _mesh_name(link: str, number: int) -> str:
    file = link.replace("%", "%25").replace("/", "%2F")  # two links never share a file
    return f"meshes/{file}_{number}.obj"


def _add_link(robot: Element, link: Link) -> None:
    element = SubElement(robot, "link", name=link.name)
    inertial = SubElement(element, "inertial")
    _add(inertial, "origin", xyz=link.com)
    _add(inertial, "mass", value=link.mass)
    moments = dict(
        zip(
            ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"),
            link.inertia[np.triu_indices(3)],
            strict=True,
        )
    )
    least = np.linalg.eigvalsh(link.inertia)[0]
    decimals = _DECIMALS
    if least > 0:  # small moments keep four digits
        decimals = max(decimals, 4 - int(np.floor(np.log10(least))))
    _add(inertial, "inertia", decimals, **moments)
    for number, shape in enumerate(link.collisions):
        collision = SubElement(element, "collision")
        _add_origin(collision, shape.T_body_shape)
        geometry = SubElement(collision, "geometry")
        kind = shape.geometry.kind
        size = shape.geometry.size
        if kind == "box":
            _add(geometry, "box", size=2 * np.array(size))
        elif kind == "sphere":
            _add(geometry, "sphere", radius=size[0])
        elif kind == "hull":
            _add(geometry, "mesh", filename=_mesh_name(link.name, number))
        else:
            _add(geometry, kind, radius=size[0], length=2 * size[1])


def _add_origin(element: Element, T: np.ndarray) -> None:
    _add(element, "origin", xyz=T[:3, 3], rpy=roll_pitch_yaw(T[:3, :3]))


def _add(
    parent: Element, tag: str, decimals: int = _DECIMALS, **attributes: str | ArrayLike
) -> None:
    """Add an element whose attributes are texts, or numbers or vectors, rounded to some decimals."""
    texts = {}
    for name, value in attributes.items():
        texts[name] = value if isinstance(value, str) else _text(value, decimals)
    SubElement(parent, tag, texts)


def _text(values: ArrayLike, decimals: int) -> str:
    """Return numbers, separated by spaces, with nine significant digits at most."""
    numbers = [f"{round(float(value), decimals):.9g}" for value in np.ravel(values)]
    return " ".join("0" if number == "-0" else number for number in numbers)
