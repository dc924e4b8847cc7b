"""Pictures of a scene without any engine, display or GPU: a small rasteriser in numpy.

What is drawn is what collides: the robot's collision shapes and the object's surface mesh, lit, with the shadows of both.
Shape letters: F triangles, V vertices, B bodies (the robot's links, then the object), H x W pixels.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from xreset.files import write_whole
from xreset.geometry.kinematics import Kinematics
from xreset.pictures.meshes import (
    AXIS_COLORS,
    GOAL_COLOR,
    OBJECT_COLOR,
    SKY_COLORS,
    Bodies,
    Color,
    Placed,
    joined,
    link_colors,
    link_meshes,
    shaded_mesh,
    spread,
    table_top,
    tinted,
)
from xreset.spec import SceneSpec

_LIGHT = np.array([0.15, -0.35, 0.92]) / np.linalg.norm([0.15, -0.35, 0.92])
"""Direction to the light, world frame."""
_SHADOW_SIZE = 512
_SHADOW_BIAS = 0.0005
"""[m] by which a surface may lie behind the one that the light sees and still be lit."""
_NEAR = 0.02
"""[m] nothing nearer to the camera is drawn."""


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


class Renderer:
    """Draws one scene again and again. Meshes are prepared once; a picture of 480 x 360 pixels then takes some tens of milliseconds."""

    def __init__(
        self,
        scene: SceneSpec,
        *,
        size: tuple[int, int] = (480, 360),
        camera: Camera | None = None,
        smooth: bool = False,
    ) -> None:
        """Prepare the meshes.

        Args:
            scene: robot, objects and table; an empty tuple of objects is allowed.
            camera: default: from the front right, over the table.
            smooth: draw at twice the size and average: better edges, four times the work.
        """
        self.scene = scene
        self.size = size
        self.camera = camera or Camera()
        self._scale = 2 if smooth else 1
        self._kinematics = Kinematics(scene.robot)
        self._robot = Bodies(link_meshes(scene.robot), link_colors(scene.robot))
        self._objects = [Bodies([shaded_mesh(spec.vertices, spec.faces)], [OBJECT_COLOR]) for spec in scene.objects]
        self._table = table_top(scene.table)

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
        picture, nearness = _shade(view, joined([*casters, self._table]), _Shadow(joined(casters)) if casters else None)
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
    bodies = Bodies([shaded_mesh(vertices, faces) for vertices, faces in meshes], colors).placed(
        np.tile(np.eye(4), (len(meshes), 1, 1))
    )
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
    write_whole(path, encode_png(picture))


def encode_png(picture: np.ndarray) -> bytes:
    """An [H, W, 3] uint8 picture as PNG."""
    height, width, _ = picture.shape

    def chunk(kind: bytes, data: bytes) -> bytes:
        return len(data).to_bytes(4, "big") + kind + data + zlib.crc32(kind + data).to_bytes(4, "big")

    rows = np.concatenate((np.zeros((height, 1), np.uint8), picture.reshape(height, width * 3)), axis=1)  # 0: no filter
    header = width.to_bytes(4, "big") + height.to_bytes(4, "big") + bytes((8, 2, 0, 0, 0))  # 8 bits, RGB
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(rows.tobytes(), 6))
        + chunk(b"IEND", b"")
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
        local = np.stack(
            ((x - self.size[0] / 2) / self.focal, (y - self.size[1] / 2) / self.focal, np.ones_like(x)), axis=-1
        )
        return self.eye + (local * depth[..., None]) @ self.R


class _Shadow:
    """What the light sees: an orthographic depth map around the shapes that cast shadows."""

    def __init__(self, casters: Placed) -> None:
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
            (local[..., :2] - self.low[:2]) * self.scale + 1,
            (local[..., 2] - self.low[2]) / self.depth,
            (_SHADOW_SIZE, _SHADOW_SIZE),
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
    owner, step = spread(bottom[drawn] - top[drawn])
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
    span, step = spread((stop - start).clip(0))
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


def _shade(view: _View, scene: Placed, shadow: _Shadow | None) -> tuple[np.ndarray, np.ndarray]:
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
    picture[y, x] = (scene.colors.astype(single)[triangle] * brightness[:, None] + single(0.10) * gloss[:, None]).clip(
        0, 1
    )
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
