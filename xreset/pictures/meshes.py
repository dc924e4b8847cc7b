"""Triangles of a scene: meshes of its shapes, a color for each part, and normals for light.

Shape letters: F triangles. Colors are red, green, blue in 0..1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import trimesh

from xreset.geometry.shapes import transformed
from xreset.geometry.urdf import robot_tree
from xreset.spec import ObjectSpec, RobotSpec, TableSpec

Color = tuple[float, float, float]

ARM_COLOR: Color = (0.74, 0.77, 0.82)
HAND_COLOR: Color = (0.45, 0.53, 0.68)
PALM_COLOR: Color = (0.34, 0.40, 0.54)
TIP_COLOR: Color = (0.16, 0.68, 0.62)
OBJECT_COLOR: Color = (0.95, 0.58, 0.22)
INVALID_COLOR: Color = (0.86, 0.13, 0.13)
GOAL_COLOR: Color = (0.35, 0.78, 0.35)
TABLE_COLORS: tuple[Color, Color] = ((0.84, 0.80, 0.74), (0.80, 0.76, 0.70))

_CREASE = math.radians(40.0)
"""Faces that meet at a smaller angle are shaded as one round surface."""
_TABLE_CELL = 0.1
"""Side of a square of the table's chequerboard [m]."""


class Triangles(NamedTuple):
    """Triangles in the world, ready to be drawn: arrays of float32."""

    corners: np.ndarray
    """[F, 3, 3] counter-clockwise seen from outside [m]."""
    normals: np.ndarray
    """[F, 3, 3] unit normal at each corner."""
    colors: np.ndarray
    """[F, 3]"""


def placed(mesh: trimesh.Trimesh, color: Color, pose: np.ndarray) -> Triangles:
    """Return the triangles of a mesh at a pose [4, 4], in one color."""
    vertices = np.float32(transformed(mesh.vertices, pose))
    normals = np.float32(mesh.vertex_normals @ pose[:3, :3].T)
    faces = np.asarray(mesh.faces)
    return Triangles(vertices[faces], normals[faces], np.full((len(faces), 3), color, np.float32))


def joined(parts: Sequence[Triangles]) -> Triangles:
    """Return all triangles of several sets as one set."""
    return Triangles(*map(np.concatenate, zip(*parts, strict=True)))


def shade_smoothly(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return the mesh with its faces separated along sharp edges, so that its vertex normals suit round and flat
    parts."""
    return trimesh.graph.smooth_shade(mesh, angle=_CREASE, facet_minarea=None)


def object_mesh(obj: ObjectSpec) -> trimesh.Trimesh:
    """Return the surface of an object in its own frame."""
    return trimesh.Trimesh(obj.vertices, obj.faces, process=False)


def link_colors(robot: RobotSpec) -> dict[str, Color]:
    """Return the color of each link of the robot's URDF: arm, palm, fingers and fingertips differ."""
    tree = robot_tree(robot)
    tips: set[str] = set()
    for tip in robot.fingertips:
        tips.update(tip.contact_links)
    hand = tree.below(robot.hand_root)
    palm_body = tree.moving_ancestor(robot.hand_root)
    colors = {}
    for name in tree.link_names:
        if name in tips:
            colors[name] = TIP_COLOR
        elif name not in hand:
            colors[name] = ARM_COLOR
        elif tree.moving_ancestor(name) == palm_body:
            colors[name] = PALM_COLOR
        else:
            colors[name] = HAND_COLOR
    return colors


def tint(color: Color, other: Color | None) -> Color:
    """Mix more than half of another color, if there is one, into a color: parts of different colors still differ."""
    if other is None:
        return color
    red, green, blue = 0.4 * np.array(color) + 0.6 * np.array(other)
    return red, green, blue


def rgb(color: Color) -> tuple[int, int, int]:
    """Return red, green, blue in 0..255."""
    red, green, blue = (round(255 * part) for part in color)
    return red, green, blue


def table_top(table: TableSpec) -> Triangles:
    """Return the table as a chequerboard of boxes with sides of about 0.1 m."""
    size = 2 * np.array(table.half_size)
    cells = np.maximum(1, np.round(size[:2] / _TABLE_CELL)).astype(int)
    cell = np.append(size[:2] / cells, size[2])
    overlap = (1e-4, 1e-4, 0.0)  # no ray passes between two squares
    square = shade_smoothly(trimesh.creation.box(cell + overlap))
    pose = np.eye(4)
    pose[2, 3] = -size[2] / 2
    squares = []
    for index in np.ndindex(*cells):
        corner = np.array(table.center) - size[:2] / 2
        pose[:2, 3] = corner + (np.array(index) + 0.5) * cell[:2]
        squares.append(placed(square, TABLE_COLORS[sum(index) % 2], pose))
    return joined(squares)
