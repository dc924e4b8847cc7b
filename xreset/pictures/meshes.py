"""What pictures are made of: meshes of a scene's shapes, with a colour for each part and normals for light.

Shape letters: F triangles, V vertices, B bodies (the robot's links, then the object).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from xreset.geometry.shapes import shape_mesh
from xreset.geometry.urdf import robot_tree
from xreset.spec import Geometry, RobotSpec, Shape, TableSpec

Color = tuple[float, float, float]
"""Red, green, blue in 0..1."""

ARM_COLOR: Color = (0.74, 0.77, 0.82)
HAND_COLOR: Color = (0.45, 0.53, 0.68)
PALM_COLOR: Color = (0.34, 0.40, 0.54)
TIP_COLOR: Color = (0.16, 0.68, 0.62)
OBJECT_COLOR: Color = (0.95, 0.58, 0.22)
INVALID_COLOR: Color = (0.86, 0.13, 0.13)
GOAL_COLOR: Color = (0.35, 0.78, 0.35)
TABLE_COLORS: tuple[Color, Color] = ((0.84, 0.80, 0.74), (0.80, 0.76, 0.70))
SKY_COLORS: tuple[Color, Color] = ((0.90, 0.93, 0.97), (0.98, 0.98, 0.98))
AXIS_COLORS: tuple[Color, Color, Color] = ((0.90, 0.15, 0.15), (0.15, 0.70, 0.20), (0.15, 0.35, 0.95))

_CREASE = math.cos(math.radians(40.0))
"""Faces that meet at a smaller angle than this are shaded as one round surface."""
_TABLE_CELL = 0.1


@dataclass(frozen=True)
class Mesh:
    """Triangles of one body."""

    vertices: np.ndarray
    """[V, 3]"""
    faces: np.ndarray
    """[F, 3] outward"""
    normals: np.ndarray = field(repr=False)
    """[F, 3, 3] unit normal at each corner of each face"""


def tinted(color: np.ndarray, tint: Color) -> np.ndarray:
    """Colours [..., 3] with more than half of another one mixed in: parts can still be told apart."""
    return 0.4 * np.asarray(color, dtype=float) + 0.6 * np.asarray(tint)


def link_meshes(robot: RobotSpec) -> list[Mesh | None]:
    """The collision shapes of each link of the robot's URDF as one mesh in the link's frame; None for a link without shape."""
    tree = robot_tree(robot)
    return [_merge([_shape_mesh(shape) for shape in tree.link(name).collisions]) for name in tree.link_names]


def link_colors(robot: RobotSpec) -> list[Color]:
    """The colour of each link of the robot's URDF: arm, palm, fingers and fingertips are told apart."""
    tree = robot_tree(robot)
    parent = {joint.child: joint.parent for joint in tree.joints}
    tips = {link for tip in robot.fingertips for link in tip.contact_links}
    body = tree.moving_ancestor(robot.hand_root)
    colors = []
    for name in tree.link_names:
        below, ancestor = False, name
        while ancestor in parent and not below:
            ancestor = parent[ancestor]
            below = ancestor == robot.hand_root
        palm = name == robot.hand_root or (tree.moving_ancestor(name) == body and below)
        colors.append(TIP_COLOR if name in tips else PALM_COLOR if palm else HAND_COLOR if below else ARM_COLOR)
    return colors


@dataclass(frozen=True)
class Placed:
    """Triangles in the world."""

    corners: np.ndarray
    """[F, 3, 3]"""
    normals: np.ndarray
    """[F, 3, 3]"""
    colors: np.ndarray
    """[F, 3]"""


class Bodies:
    """Rigid meshes that are placed together."""

    def __init__(self, meshes: Sequence[Mesh | None], colors: Sequence[Color]) -> None:
        drawn = [(index, mesh) for index, mesh in enumerate(meshes) if mesh is not None]
        self._body = np.concatenate([np.full(len(mesh.faces), index) for index, mesh in drawn])
        self._corners = np.concatenate([mesh.vertices[mesh.faces] for _, mesh in drawn])
        self._normals = np.concatenate([mesh.normals for _, mesh in drawn])
        self._colors = np.array(colors, dtype=float)[self._body]

    def placed(self, poses: np.ndarray, color: Color | None = None) -> Placed:
        """The triangles with body i at ``poses[i]``."""
        T = poses[self._body]
        turned = T[:, None, :3, :3].swapaxes(-1, -2)
        corners = (self._corners[:, :, None, :] @ turned)[:, :, 0] + T[:, None, :3, 3]
        normals = (self._normals[:, :, None, :] @ turned)[:, :, 0]
        colors = self._colors if color is None else np.broadcast_to(np.array(color), self._colors.shape)
        return Placed(corners, normals, colors)


def joined(parts: Sequence[Placed]) -> Placed:
    """All triangles of several."""
    return Placed(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in ("corners", "normals", "colors"))
    )


def shaded_mesh(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    """A mesh with a normal at each corner: the mean over the faces around the vertex that meet this one at less than the crease angle."""
    vertices, faces = np.asarray(vertices, dtype=float), np.asarray(faces, dtype=np.int64)
    edges = vertices[faces]
    cross = np.cross(
        edges[:, 1] - edges[:, 0], edges[:, 2] - edges[:, 0]
    )  # its length is twice the area: the weight in the mean
    length = np.linalg.norm(cross, axis=1)
    keep = length > 0
    faces, cross, length = faces[keep], cross[keep], length[keep]
    unit = cross / length[:, None]

    corner_vertex = faces.ravel()
    order = np.argsort(corner_vertex, kind="stable")
    start = np.searchsorted(corner_vertex[order], np.arange(len(vertices)))
    count = np.bincount(corner_vertex, minlength=len(vertices))
    repeats = count[corner_vertex]
    corner, step = spread(repeats)
    other = order[start[corner_vertex[corner]] + step] // 3
    together = np.einsum("ij,ij->i", unit[corner // 3], unit[other]) >= _CREASE
    total = np.zeros((len(corner_vertex), 3))
    np.add.at(total, corner[together], cross[other[together]])
    total /= np.linalg.norm(total, axis=1, keepdims=True)
    return Mesh(vertices, faces, total.reshape(-1, 3, 3))


def _merge(meshes: Sequence[Mesh]) -> Mesh | None:
    if not meshes:
        return None
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + offset for mesh, offset in zip(meshes, offsets, strict=True)]),
        np.concatenate([mesh.normals for mesh in meshes]),
    )


def _shape_mesh(shape: Shape) -> Mesh:
    mesh = shape_mesh(shape, coarse=True)
    return shaded_mesh(mesh.vertices, mesh.faces)


def table_top(table: TableSpec) -> Placed:
    """The table's top as a chequerboard of 0.1 m, and its sides. Small cells can be dropped one by one where they lie behind the camera."""
    (cx, cy), (hx, hy, hz) = table.center, table.half_size
    nx, ny = max(1, round(2 * hx / _TABLE_CELL)), max(1, round(2 * hy / _TABLE_CELL))
    x, y = np.linspace(cx - hx, cx + hx, nx + 1), np.linspace(cy - hy, cy + hy, ny + 1)
    i, j = (index.ravel() for index in np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij"))

    def at(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.stack((x[a], y[b], np.zeros(len(a))), axis=1)

    a, b, c, d = at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)
    top = np.concatenate((np.stack((a, b, c), axis=1), np.stack((a, c, d), axis=1)))
    colors = np.array(TABLE_COLORS)[np.tile((i + j) % 2, 2)]
    T = np.eye(4)
    T[:3, 3] = (cx, cy, -hz)
    body = _shape_mesh(Shape(geometry=Geometry(kind="box", size=table.half_size), T_body_shape=T))
    sides = ~(body.normals[:, 0, 2] > 0.5)
    return Placed(
        np.concatenate((top, body.vertices[body.faces[sides]])),
        np.concatenate((np.broadcast_to(np.array([0, 0, 1.0]), top.shape), body.normals[sides])),
        np.concatenate((colors, np.broadcast_to(np.array(TABLE_COLORS[1]) * 0.8, (int(sides.sum()), 3)))),
    )


def spread(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For counts (2, 3): owners (0, 0, 1, 1, 1) and steps (0, 1, 0, 1, 2)."""
    owner = np.repeat(np.arange(len(counts)), counts)
    first = np.cumsum(counts) - counts
    return owner, np.arange(len(owner)) - first[owner]
