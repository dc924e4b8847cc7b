"""Pictures of a scene without any engine, display or GPU: a small rasteriser in numpy.

What is drawn is what collides: the robot's collision shapes and the object's surface mesh, lit, with the shadows of both.
Shape letters: F triangles, V vertices, B bodies (the robot's links, then the object), H x W pixels.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from xreset.files import atomic_write
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.shapes import shape_mesh
from xreset.geometry.urdf import robot_tree
from xreset.spec import Geometry, RobotSpec, SceneSpec, Shape, TableSpec

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

_LIGHT = np.array([0.15, -0.35, 0.92]) / np.linalg.norm([0.15, -0.35, 0.92])
"""Direction to the light, world frame."""
_SHADOW_SIZE = 512
_SHADOW_BIAS = 0.0005
"""[m] by which a surface may lie behind the one that the light sees and still be lit."""
_CREASE = math.cos(math.radians(40.0))
"""Faces that meet at a smaller angle than this are shaded as one round surface."""
_NEAR = 0.02
"""[m] nothing nearer to the camera is drawn."""
_TABLE_CELL = 0.1


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A pinhole camera."""

    eye: tuple[float, float, float] = (1.28, -0.50, 0.90)
    """Where it stands, world frame [m]."""
    target: tuple[float, float, float] = (0.55, 0.42, 0.24)
    """What it looks at; z is up in the picture."""
    fov: float = math.radians(42.0)
    """Vertical field of view [rad]."""


@dataclass(frozen=True, kw_only=True)
class Points:
    """Dots drawn over the picture, visible through everything."""

    pos: np.ndarray
    """[P, 3] world frame; rows that are not finite are left out."""
    color: Color = (0.85, 0.10, 0.45)
    radius: float = 0.004
    """[m]"""


@dataclass(frozen=True, kw_only=True)
class Frames:
    """Coordinate axes drawn over the picture (x red, y green, z blue)."""

    poses: np.ndarray
    """[P, 4, 4] world frame."""
    length: float = 0.03
    """[m]"""


@dataclass(frozen=True)
class Mesh:
    """Triangles of one body."""

    vertices: np.ndarray
    """[V, 3]"""
    faces: np.ndarray
    """[F, 3] outward"""
    normals: np.ndarray = field(repr=False)
    """[F, 3, 3] unit normal at each corner of each face"""


class Renderer:
    """Draws one scene again and again. Meshes are prepared once; a picture of 480 x 360 pixels then takes some tens of milliseconds."""

    def __init__(self, scene: SceneSpec, *, size: tuple[int, int] = (480, 360), camera: Camera | None = None, smooth: bool = False) -> None:
        """Prepare the meshes.

        Args:
            scene: robot, objects and table; an empty tuple of objects is allowed.
            size: width and height in pixels.
            camera: default: from the front right, over the table.
            smooth: draw at twice the size and average: better edges, four times the work.
        """
        self.scene = scene
        self.size = size
        self.camera = camera or Camera()
        self._scale = 2 if smooth else 1
        self._kinematics = Kinematics(scene.robot)
        self._robot = _Bodies(link_meshes(scene.robot), link_colors(scene.robot))
        self._objects = [_Bodies([_mesh(spec.vertices, spec.faces)], [OBJECT_COLOR]) for spec in scene.objects]
        self._table = _table(scene.table)

    def draw(
        self,
        joint_pos: np.ndarray | None,
        object_pose: np.ndarray | None = None,
        *,
        goal_pose: np.ndarray | None = None,
        object_index: int = 0,
        robot_tint: Color | None = None,
        points: Sequence[Points] = (),
        frames: Sequence[Frames] = (),
        camera: Camera | None = None,
    ) -> np.ndarray:
        """Draw one state.

        Args:
            joint_pos: [J] rad (m), in the robot's joint order; None leaves the robot out.
            object_pose: [4, 4] pose of the object in the world; None leaves it out.
            goal_pose: [4, 4] pose at which the object is drawn once more, translucent.
            object_index: which of the scene's objects.
            robot_tint: colour to mix into the robot's own (:func:`tinted`).
            points: dots on top.
            frames: axes on top.
            camera: for this picture instead of the renderer's.

        Returns:
            [H, W, 3] uint8 picture.
        """
        casters = []
        if joint_pos is not None:
            q = torch.as_tensor(np.asarray(joint_pos), dtype=torch.float64)
            robot = self._robot.placed(self._kinematics.link_poses(q).numpy())
            casters.append(robot if robot_tint is None else replace(robot, colors=tinted(robot.colors, robot_tint)))
        if object_pose is not None:
            casters.append(self._objects[object_index].placed(np.asarray(object_pose, dtype=float)[None]))
        view = _View(camera or self.camera, (self.size[0] * self._scale, self.size[1] * self._scale))
        picture, nearness = _shade(view, _join([*casters, self._table]), _Shadow(_join(casters)) if casters else None)
        if goal_pose is not None:
            ghost = self._objects[object_index].placed(np.asarray(goal_pose, dtype=float)[None], color=GOAL_COLOR)
            over, ghost_nearness = _shade(view, ghost, None)
            seen = ghost_nearness > nearness
            picture[seen] = 0.5 * picture[seen] + 0.5 * over[seen]
        for some in points:
            _draw_points(picture, view, some)
        for some in frames:
            _draw_frames(picture, view, some, 1.5 * self._scale)
        if self._scale == 2:
            picture = picture.reshape(self.size[1], 2, self.size[0], 2, 3).mean(axis=(1, 3))
        return (picture.clip(0, 1) * 255 + 0.5).astype(np.uint8)

    def link_frames(self, joint_pos: np.ndarray, links: Sequence[str], *, length: float = 0.03) -> Frames:
        """The axes of links, for :meth:`draw`; ``RobotError`` if there is no such link."""
        q = torch.as_tensor(np.asarray(joint_pos), dtype=torch.float64)
        return Frames(poses=self._kinematics.link_poses(q, links).numpy(), length=length)


def draw_bodies(
    meshes: Sequence[tuple[np.ndarray, np.ndarray]], colors: Sequence[Color], camera: Camera, size: tuple[int, int]
) -> np.ndarray:
    """[H, W, 3] uint8 picture of meshes (vertices [V, 3], outward triangles [F, 3]), each in its colour, without table."""
    bodies = _Bodies([_mesh(vertices, faces) for vertices, faces in meshes], colors).placed(np.tile(np.eye(4), (len(meshes), 1, 1)))
    width, height = size
    picture, _ = _shade(_View(camera, (2 * width, 2 * height)), bodies, _Shadow(bodies))
    return (picture.reshape(height, 2, width, 2, 3).mean(axis=(1, 3)).clip(0, 1) * 255 + 0.5).astype(np.uint8)


def pose_matrix(pos: np.ndarray, quat: np.ndarray) -> np.ndarray:
    """[4, 4] pose from a position [3] and a quaternion [4] (w, x, y, z)."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(np.asarray(quat, dtype=float), scalar_first=True).as_matrix()
    T[:3, 3] = pos
    return T


def write_png(path: str | Path, picture: np.ndarray) -> None:
    """Write an [H, W, 3] uint8 picture as PNG; ``XResetError`` if it cannot be written."""
    with atomic_write(path) as file:
        file.write(encode_png(picture))


def encode_png(picture: np.ndarray) -> bytes:
    """An [H, W, 3] uint8 picture as PNG."""
    height, width, _ = picture.shape

    def chunk(kind: bytes, data: bytes) -> bytes:
        return len(data).to_bytes(4, "big") + kind + data + zlib.crc32(kind + data).to_bytes(4, "big")

    rows = np.concatenate((np.zeros((height, 1), np.uint8), picture.reshape(height, width * 3)), axis=1)  # 0: no filter
    header = width.to_bytes(4, "big") + height.to_bytes(4, "big") + bytes((8, 2, 0, 0, 0))  # 8 bits, RGB
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows.tobytes(), 6)) + chunk(b"IEND", b"")


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


# Meshes ------------------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Placed:
    """Triangles in the world."""

    corners: np.ndarray
    """[F, 3, 3]"""
    normals: np.ndarray
    """[F, 3, 3]"""
    colors: np.ndarray
    """[F, 3]"""


class _Bodies:
    """Rigid meshes that are placed together."""

    def __init__(self, meshes: Sequence[Mesh | None], colors: Sequence[Color]) -> None:
        drawn = [(index, mesh) for index, mesh in enumerate(meshes) if mesh is not None]
        self._body = np.concatenate([np.full(len(mesh.faces), index) for index, mesh in drawn])
        self._corners = np.concatenate([mesh.vertices[mesh.faces] for _, mesh in drawn])
        self._normals = np.concatenate([mesh.normals for _, mesh in drawn])
        self._colors = np.array(colors, dtype=float)[self._body]

    def placed(self, poses: np.ndarray, color: Color | None = None) -> _Placed:
        """The triangles with body i at ``poses[i]``."""
        T = poses[self._body]
        turned = T[:, None, :3, :3].swapaxes(-1, -2)
        corners = (self._corners[:, :, None, :] @ turned)[:, :, 0] + T[:, None, :3, 3]
        normals = (self._normals[:, :, None, :] @ turned)[:, :, 0]
        colors = self._colors if color is None else np.broadcast_to(np.array(color), self._colors.shape)
        return _Placed(corners, normals, colors)


def _join(parts: Sequence[_Placed]) -> _Placed:
    return _Placed(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("corners", "normals", "colors")))


def _mesh(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    """A mesh with a normal at each corner: the mean over the faces around the vertex that meet this one at less than the crease angle."""
    vertices, faces = np.asarray(vertices, dtype=float), np.asarray(faces, dtype=np.int64)
    edges = vertices[faces]
    cross = np.cross(edges[:, 1] - edges[:, 0], edges[:, 2] - edges[:, 0])  # its length is twice the area: the weight in the mean
    length = np.linalg.norm(cross, axis=1)
    keep = length > 0
    faces, cross, length = faces[keep], cross[keep], length[keep]
    unit = cross / length[:, None]

    corner_vertex = faces.ravel()
    order = np.argsort(corner_vertex, kind="stable")
    start = np.searchsorted(corner_vertex[order], np.arange(len(vertices)))
    count = np.bincount(corner_vertex, minlength=len(vertices))
    repeats = count[corner_vertex]
    corner, step = _spread(repeats)
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
    return _mesh(mesh.vertices, mesh.faces)


def _table(table: TableSpec) -> _Placed:
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
    return _Placed(
        np.concatenate((top, body.vertices[body.faces[sides]])),
        np.concatenate((np.broadcast_to(np.array([0, 0, 1.0]), top.shape), body.normals[sides])),
        np.concatenate((colors, np.broadcast_to(np.array(TABLE_COLORS[1]) * 0.8, (int(sides.sum()), 3)))),
    )


# Projection and rasterisation --------------------------------------------------------------------------------------------------------


class _View:
    """World to pixels. Pixel (0, 0) is the picture's top left; its centre is at (0.5, 0.5)."""

    def __init__(self, camera: Camera, size: tuple[int, int]) -> None:
        self.size = size
        self.eye = np.array(camera.eye, dtype=float)
        forward = np.array(camera.target, dtype=float) - self.eye
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0, 0, 1.0])
        if np.linalg.norm(right) < 1e-6:  # looking straight up or down
            right = np.array([1.0, 0, 0])
        right /= np.linalg.norm(right)
        self.R = np.stack((right, np.cross(forward, right), forward))
        """Rows: right, down, forward."""
        self.focal = size[1] / 2 / math.tan(camera.fov / 2)

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels [..., 2] and distance along the view axis [...] of world points [..., 3]."""
        local = (points - self.eye) @ self.R.T
        depth = local[..., 2]
        safe = np.where(np.abs(depth) < 1e-9, 1e-9, depth)
        return self.focal * local[..., :2] / safe[..., None] + np.array(self.size) / 2, depth

    def unproject(self, x: np.ndarray, y: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """World points [..., 3] of pixels at a distance along the view axis."""
        local = np.stack(((x - self.size[0] / 2) / self.focal, (y - self.size[1] / 2) / self.focal, np.ones_like(x)), axis=-1)
        return self.eye + (local * depth[..., None]) @ self.R


class _Shadow:
    """What the light sees: an orthographic depth map around the shapes that cast shadows."""

    def __init__(self, casters: _Placed) -> None:
        x = np.cross([0, 0, 1.0], _LIGHT)
        x /= np.linalg.norm(x)
        self.R = np.stack((x, np.cross(_LIGHT, x), _LIGHT))
        local = casters.corners @ self.R.T
        flat = local.reshape(-1, 3)
        self.low = flat.min(axis=0)
        self.span = float((flat.max(axis=0) - self.low)[:2].max()) + 1e-6
        self.depth = float(flat[:, 2].max() - self.low[2]) + 1e-6
        self.scale = (_SHADOW_SIZE - 2) / self.span
        face, height = _rasterize(
            (local[..., :2] - self.low[:2]) * self.scale + 1, (local[..., 2] - self.low[2]) / self.depth, (_SHADOW_SIZE, _SHADOW_SIZE)
        )
        self.map = np.where(face < 0, -math.inf, height)

    def lit(self, points: np.ndarray) -> np.ndarray:
        """[...] share of light, 0..1, at world points [..., 3]: the mean of four neighbouring texels."""
        local = (points - (self.low @ self.R).astype(points.dtype)) @ self.R.T.astype(points.dtype)
        height = (local[..., 2] + _SHADOW_BIAS) / self.depth
        total = np.zeros(points.shape[:-1], dtype=points.dtype)
        for dx, dy in ((0.5, 0.5), (0.5, 1.5), (1.5, 0.5), (1.5, 1.5)):
            x = (local[..., 0] * self.scale + dx).astype(np.int32).clip(0, _SHADOW_SIZE - 1)
            y = (local[..., 1] * self.scale + dy).astype(np.int32).clip(0, _SHADOW_SIZE - 1)
            total += height >= self.map[y, x]
        return total / 4


def _spread(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For counts (2, 3): owners (0, 0, 1, 1, 1) and steps (0, 1, 0, 1, 2)."""
    owner = np.repeat(np.arange(len(counts)), counts)
    first = np.cumsum(counts) - counts
    return owner, np.arange(len(owner)) - first[owner]


def _least(corners: np.ndarray) -> np.ndarray:
    """[F] minimum over the three corners [F, 3]; numpy's own is slow along so short an axis."""
    return np.minimum(np.minimum(corners[:, 0], corners[:, 1]), corners[:, 2])


def _unit(vectors: np.ndarray) -> np.ndarray:
    """[P, 3] the same directions with length 1."""
    return vectors / np.sqrt(np.einsum("pi,pi->p", vectors, vectors))[:, None]


def _rasterize(pixels: np.ndarray, nearness: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Which triangle each pixel shows.

    Every triangle is cut into rows and every row into pixels, all triangles at once; the nearest wins.

    Args:
        pixels: [F, 3, 2] corners in pixels; only triangles whose signed area is negative are drawn. On a screen with y down those are the
            faces that look at the viewer; on the light's map, with y up, those that look away from it, which keeps surfaces from shading
            themselves.
        nearness: [F, 3] in 0..1 and linear over the screen; larger is nearer.
        size: W, H.

    Returns:
        face [H, W] index of the triangle or -1; nearness [H, W], -1 where there is none.
    """
    width, height = size
    face = np.full(height * width, -1, dtype=np.int64)
    near = np.full(height * width, -1.0)
    x, y = pixels[..., 0], pixels[..., 1]
    area = (x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0]) - (x[:, 2] - x[:, 0]) * (y[:, 1] - y[:, 0])
    top = np.ceil(_least(y) - 0.5).clip(0, height).astype(np.int64)
    bottom = np.ceil(-_least(-y) - 0.5).clip(0, height).astype(np.int64)
    drawn = np.flatnonzero((area < -1e-9) & (bottom > top) & (-_least(-x) > 0) & (_least(x) < width))
    if not len(drawn):
        return face.reshape(height, width), near.reshape(height, width)

    # The plane nearness = n0 + nx x + ny y of each triangle.
    x, y, n, area = x[drawn], y[drawn], nearness[drawn], area[drawn]
    d1, d2 = n[:, 1] - n[:, 0], n[:, 2] - n[:, 0]
    nx = (d1 * (y[:, 2] - y[:, 0]) - d2 * (y[:, 1] - y[:, 0])) / area
    ny = (d2 * (x[:, 1] - x[:, 0]) - d1 * (x[:, 2] - x[:, 0])) / area
    n0 = n[:, 0] - nx * x[:, 0] - ny * y[:, 0]

    # Rows: where the row's centre line crosses the triangle's edges.
    owner, step = _spread(bottom[drawn] - top[drawn])
    row = top[drawn][owner] + step
    line = row + 0.5
    left, right = np.full(len(owner), np.inf), np.full(len(owner), -np.inf)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        xa, ya, xb, yb = x[owner, a], y[owner, a], x[owner, b], y[owner, b]
        crosses = (np.minimum(ya, yb) <= line) & (line < np.maximum(ya, yb))
        with np.errstate(divide="ignore", invalid="ignore"):
            at = xa + (line - ya) * (xb - xa) / (yb - ya)
        left = np.where(crosses, np.minimum(left, at), left)
        right = np.where(crosses, np.maximum(right, at), right)
    some = right >= left
    start = np.ceil(np.where(some, left, 0) - 0.5).clip(0, width).astype(np.int64)
    stop = np.ceil(np.where(some, right, 0) - 0.5).clip(0, width).astype(np.int64)

    # Pixels: nearness in the high bits and the triangle in the low ones make "the nearest wins" one maximum.
    span, step = _spread((stop - start).clip(0))
    column = start[span] + step
    tri = owner[span]
    value = (n0[owner] + ny[owner] * line)[span] + nx[tri] * (column + 0.5)
    key = ((value.clip(0, 1) * (1 << 30)).astype(np.int64) << 32) | drawn[tri]
    best = np.full(height * width, -1, dtype=np.int64)
    np.maximum.at(best, row[span] * width + column, key)
    hit = best >= 0
    face[hit] = best[hit] & 0xFFFFFFFF
    near[hit] = (best[hit] >> 32) / (1 << 30)
    return face.reshape(height, width), near.reshape(height, width)


# Light and overlays ------------------------------------------------------------------------------------------------------------------


def _shade(view: _View, scene: _Placed, shadow: _Shadow | None) -> tuple[np.ndarray, np.ndarray]:
    """The picture [H, W, 3] in 0..1 over a plain sky, and the nearness [H, W] of what it shows (-1: sky)."""
    width, height = view.size
    picture = np.empty((height, width, 3), dtype=np.float32)
    picture[:] = np.linspace(SKY_COLORS[0], SKY_COLORS[1], height)[:, None]
    pixels, depth = view.project(scene.corners)
    front = np.flatnonzero(_least(depth) > _NEAR)
    face, nearness = _rasterize(pixels[front], _NEAR / depth[front], view.size)
    y, x = np.nonzero(face >= 0)
    triangle = front[face[y, x]]
    single = np.float32
    at = np.stack((x, y), axis=1).astype(single) + single(0.5)
    # In perspective, what is linear in space is linear in 1 / depth on the screen.
    weights = _barycentric(pixels.astype(single)[triangle], at) / depth.astype(single)[triangle]
    normal = _unit(np.einsum("pc,pci->pi", weights, scene.normals.astype(single)[triangle]))
    point = view.unproject(at[:, 0], at[:, 1], _NEAR / nearness[y, x].astype(single)).astype(single)
    towards = _unit(view.eye.astype(single) - point)
    light = _LIGHT.astype(single)
    lit = single(1.0) if shadow is None else shadow.lit(point)
    diffuse = (normal @ light).clip(0) * lit
    gloss = np.einsum("pi,pi->p", normal, _unit(towards + light)).clip(0) ** 32 * lit
    fill = np.einsum("pi,pi->p", normal, towards).clip(0)
    brightness = single(0.40) + single(0.06) * normal[:, 2] + single(0.48) * diffuse + single(0.14) * fill
    picture[y, x] = (scene.colors.astype(single)[triangle] * brightness[:, None] + single(0.10) * gloss[:, None]).clip(0, 1)
    return picture, nearness


def _barycentric(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """[P, 3] barycentric coordinates of points [P, 2] in triangles [P, 3, 2]."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]

    def cross(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        return u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]

    area = cross(b - a, c - a)
    second, third = cross(points - a, c - a) / area, cross(b - a, points - a) / area
    return np.stack((1 - second - third, second, third), axis=1)


def _draw_points(picture: np.ndarray, view: _View, points: Points) -> None:
    pos = np.asarray(points.pos, dtype=float).reshape(-1, 3)
    pixels, depth = view.project(pos[np.isfinite(pos).all(axis=1)])
    for centre, distance in zip(pixels, depth, strict=True):
        if distance > _NEAR:
            radius = max(1.5, view.focal * points.radius / distance)
            _stamp(picture, centre, centre, radius + 1.0, (0.05, 0.05, 0.05))
            _stamp(picture, centre, centre, radius, points.color)


def _draw_frames(picture: np.ndarray, view: _View, frames: Frames, radius: float) -> None:
    poses = np.asarray(frames.poses, dtype=float).reshape(-1, 4, 4)
    ends = poses[:, None, :3, 3] + frames.length * poses[:, :3, :3].swapaxes(1, 2)  # [P, axis, 3]
    start, start_depth = view.project(poses[:, :3, 3])
    stop, stop_depth = view.project(ends)
    for frame in np.flatnonzero((start_depth > _NEAR) & (stop_depth.min(axis=1, initial=math.inf) > _NEAR)):
        for axis in np.argsort(-stop_depth[frame]):  # the farthest first
            _stamp(picture, start[frame], stop[frame, axis], radius, AXIS_COLORS[axis])


def _stamp(picture: np.ndarray, a: np.ndarray, b: np.ndarray, radius: float, color: Color) -> None:
    """Draw a line with round ends from a to b [pixels] with soft edges; a dot where they are the same."""
    height, width, _ = picture.shape
    low = np.floor(np.minimum(a, b) - radius - 1).astype(int).clip(0, (width, height))
    high = np.ceil(np.maximum(a, b) + radius + 1).astype(int).clip(0, (width, height))
    x, y = np.meshgrid(np.arange(low[0], high[0]) + 0.5, np.arange(low[1], high[1]) + 0.5)
    along = b - a
    share = (((x - a[0]) * along[0] + (y - a[1]) * along[1]) / max(float(along @ along), 1e-9)).clip(0, 1)
    distance = np.hypot(x - a[0] - share * along[0], y - a[1] - share * along[1])
    cover = (radius + 0.5 - distance).clip(0, 1)[..., None]
    part = picture[low[1] : high[1], low[0] : high[0]]
    part += cover * (np.array(color) - part)
