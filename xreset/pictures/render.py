"""Pictures of a scene without any engine, display or GPU: rays are cast with Embree.

A picture shows what collides: the robot's collision shapes and the object's surface, lit, with their shadows.
Shape letters: F triangles, P points, H x W pixels, N rays.
"""

from __future__ import annotations

import io
import math
import tempfile
from collections.abc import Iterable, Sequence
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image, ImageDraw, ImageFont

from xreset.errors import XResetError, needs
from xreset.files.checks import frozen
from xreset.files.storage import write_whole
from xreset.geometry.kinematics import on_host
from xreset.geometry.shapes import look_at, pose_matrix
from xreset.geometry.urdf import link_meshes
from xreset.pictures.meshes import (
    GOAL_COLOR,
    OBJECT_COLOR,
    Color,
    Triangles,
    joined,
    link_colors,
    object_mesh,
    placed,
    rgb,
    shade_smoothly,
    table_top,
    tint,
)
from xreset.spec import SceneSpec

Size = tuple[int, int]
"""Width and height [pixels]."""
Pose = tuple[np.ndarray, np.ndarray]
"""Position [3] and quaternion [4] (w, x, y, z), world frame."""

SKY_COLORS: tuple[Color, Color] = ((0.90, 0.93, 0.97), (0.98, 0.98, 0.98))
"""Background at the upper and lower edge of a picture."""
AXIS_COLORS: tuple[Color, Color, Color] = (
    (0.90, 0.15, 0.15),
    (0.15, 0.70, 0.20),
    (0.15, 0.35, 0.95),
)

_LIGHT = np.array([0.1506, -0.3515, 0.9240], np.float32)
"""Direction to the light, world frame."""
_SHADOW_BIAS = 0.0015
"""Distance from a surface at which a ray to the light starts, so that a surface does not shade itself [m]."""
_NEAR = 0.02
"""Overlays nearer to the camera are not drawn [m]."""
_AXIS_DOTS = 24
"""Dots along an axis of a link."""
_LINE = 16
"""Height of a line of a caption [pixels]."""


@frozen
class Camera:
    """A pinhole camera. Pixel (0, 0) is the picture's top left; its center is at (0.5, 0.5)."""

    eye: tuple[float, float, float] = (1.28, -0.50, 0.90)
    """Position, world frame [m]."""
    target: tuple[float, float, float] = (0.55, 0.42, 0.24)
    """Point in the middle of the picture; z is up."""
    fov: float = math.radians(42.0)
    """Vertical field of view [rad]."""

    def axes(self) -> np.ndarray:
        """[3, 3] unit vectors to the right, down and forward, as rows."""
        return look_at(self.eye, self.target)

    def focal_length(self, height: int) -> float:
        """Focal length in pixels of a picture of this height."""
        return height / 2 / math.tan(self.fov / 2)

    def project(self, points: np.ndarray, size: Size) -> tuple[np.ndarray, np.ndarray]:
        """Return pixels [P, 2] and distances along the view axis [P] of world points [P, 3] that are before the
        camera."""
        local = (points - self.eye) @ self.axes().T
        local = local[local[:, 2] > _NEAR]
        pixels = self.focal_length(size[1]) * local[:, :2] / local[:, 2:] + np.array(size) / 2
        return pixels, local[:, 2]


@frozen
class Points:
    """Dots drawn over the picture, visible through everything."""

    pos: np.ndarray
    """[P, 3] world frame; rows that are not finite are ignored."""
    color: Color = (0.85, 0.10, 0.45)
    radius: float = 0.004
    """[m]"""


class Renderer:
    """Draws one scene again and again. The meshes are prepared once."""

    def __init__(
        self,
        scene: SceneSpec,
        *,
        size: Size = (480, 360),
        camera: Camera | None = None,
        smooth: bool = False,
    ) -> None:
        """Prepare the meshes.

        Args:
            scene: robot, objects and table; an empty tuple of objects is allowed.
            size: width and height in pixels.
            camera: default: from the front right, over the table.
            smooth: cast four rays a pixel: better edges, four times the work.
        """
        self.scene = scene
        self.size = size
        self.camera = camera or Camera()
        self._smooth = smooth
        self._kinematics = on_host(scene.robot)
        meshes = link_meshes(scene.robot)
        self._links = {name: shade_smoothly(mesh) for name, mesh in meshes.items()}
        self._colors = link_colors(scene.robot)
        self._objects = [shade_smoothly(object_mesh(obj)) for obj in scene.objects]
        self._table = table_top(scene.table)

    def draw(
        self,
        joint_pos: np.ndarray | None,
        object_pose: Pose | None = None,
        *,
        goal_pose: Pose | None = None,
        object_index: int = 0,
        robot_tint: Color | None = None,
        points: Sequence[Points] = (),
        camera: Camera | None = None,
    ) -> np.ndarray:
        """Draw one state.

        Args:
            joint_pos: [J] rad (m), in the robot's joint order; None omits the robot.
            object_pose: pose of the object in the world; None omits the object.
            goal_pose: pose at which a translucent copy of the object is drawn.
            object_index: index into the scene's objects.
            robot_tint: color to mix into the robot's own (:func:`tint`).
            points: dots on top.
            camera: for this picture instead of the renderer's.

        Returns:
            [H, W, 3] uint8 picture.
        """
        camera = camera or self.camera
        parts = [self._table]
        if joint_pos is not None:
            parts += self._robot(joint_pos, robot_tint)
        if object_pose is not None:
            parts.append(
                placed(self._objects[object_index], OBJECT_COLOR, pose_matrix(*object_pose))
            )
        goal = None
        if goal_pose is not None:
            goal = placed(self._objects[object_index], GOAL_COLOR, pose_matrix(*goal_pose))
        scene = joined(parts)
        image = _image(scene, goal, camera, self.size, self._smooth)
        _draw_points(image, camera, points)
        return np.asarray(image.reduce(2))

    def link_frames(
        self, joint_pos: np.ndarray, links: Sequence[str], *, length: float = 0.03
    ) -> list[Points]:
        """Return the axes of links as lines of dots (x red, y green, z blue); ``RobotError`` for an unknown link."""
        poses = self._link_poses(joint_pos, links)
        lines = []
        for axis, color in enumerate(AXIS_COLORS):
            tips = poses[:, :3, 3] + length * poses[:, :3, axis]
            lines.append(
                Points(pos=np.linspace(poses[:, :3, 3], tips, _AXIS_DOTS), color=color, radius=0.0)
            )
        return lines

    def _link_poses(self, joint_pos: np.ndarray, links: Sequence[str]) -> np.ndarray:
        return self._kinematics.link_poses(np.asarray(joint_pos, dtype=float), links)

    def _robot(self, joint_pos: np.ndarray, robot_tint: Color | None) -> list[Triangles]:
        poses = self._link_poses(joint_pos, list(self._links))
        parts = []
        for (name, mesh), T in zip(self._links.items(), poses, strict=True):
            parts.append(placed(mesh, tint(self._colors[name], robot_tint), T))
        return parts


def draw_bodies(
    meshes: Sequence[trimesh.Trimesh],
    colors: Sequence[Color],
    camera: Camera,
    size: Size,
) -> np.ndarray:
    """Return a [H, W, 3] uint8 picture of meshes, each in its color, without a table."""
    bodies = []
    for mesh, color in zip(meshes, colors, strict=True):
        bodies.append(placed(shade_smoothly(mesh), color, np.eye(4)))
    return np.asarray(_image(joined(bodies), None, camera, size, smooth=True).reduce(2))


def add_caption(picture: np.ndarray, caption: Sequence[str], lines: int) -> np.ndarray:
    """Return a picture with text below it, on a white band with room for a number of lines."""
    height, width, _ = picture.shape
    image = Image.new("RGB", (width, height + _LINE * lines + _LINE // 2), "white")
    image.paste(Image.fromarray(picture))
    pen = ImageDraw.Draw(image)
    color = "black"
    for number, line in enumerate(caption):
        pen.text(
            (6, height + 3 + number * _LINE), line, fill=color, font=ImageFont.load_default(13)
        )
        color = "dimgray"
    return np.asarray(image)


def write_png(path: str | Path, picture: np.ndarray) -> None:
    """Write an [H, W, 3] uint8 picture as PNG; ``XResetError`` if it cannot be written."""
    write_whole(path, encode_png(picture))


def check_film_size(size: Size) -> None:
    """Refuse, with ``XResetError``, a width and height [pixels] that no film can have."""
    width, height = size
    if min(size) < 16 or width % 2 or height % 2:
        raise XResetError(
            f"films of {width} x {height} pixels cannot be encoded; width and height must be even, from 16 on."
        )


def encode_mp4(frames: Iterable[np.ndarray], fps: float, *, keyframes: int | None = None) -> bytes:
    """Encode a film as H.264 in an mp4 file that every browser plays.

    Args:
        frames: pictures [H, W, 3] uint8 with even H and W, at least one.
        fps: frames per second.
        keyframes: number of frames from one keyframe to the next; None: the encoder's choice.

    Raises:
        XResetError: the encoder is not installed or fails.
    """
    with needs("imageio-ffmpeg", "eval"):
        import imageio_ffmpeg
    settings = "-crf 24 -preset veryfast -movflags +faststart -threads 1 -bitexact"
    if keyframes is not None:
        settings += f" -g {keyframes}"
    rest = iter(frames)
    first = next(rest)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "clip.mp4"
        writer = imageio_ffmpeg.write_frames(  # it accepts more types than its annotations say
            str(path),
            first.shape[1::-1],
            fps=fps,  # pyright: ignore[reportArgumentType]
            codec="libx264",
            macro_block_size=2,
            quality=None,  # pyright: ignore[reportArgumentType]
            output_params=settings.split(),
        )
        try:
            writer.send(None)
            for frame in chain([first], rest):
                writer.send(np.ascontiguousarray(frame))
            writer.close()
            return path.read_bytes()
        except (OSError, RuntimeError) as error:
            raise XResetError(f"the film cannot be encoded: {error}") from error


def encode_png(picture: np.ndarray) -> bytes:
    """Return an [H, W, 3] uint8 picture as PNG."""
    content = io.BytesIO()
    Image.fromarray(picture).save(content, "PNG")
    return content.getvalue()


def _image(
    scene: Triangles, goal: Triangles | None, camera: Camera, size: Size, smooth: bool
) -> Image.Image:
    """Draw at twice the size; without ``smooth``, from one ray for each 2 x 2 pixels."""
    width, height = size
    rays_size = (2 * width, 2 * height) if smooth else (width, height)
    rays = _rays(camera, rays_size)
    sky = np.linspace(*SKY_COLORS, rays_size[1], dtype=np.float32)
    picture = np.repeat(sky, rays_size[0], axis=0)
    depth = _shade(picture, scene, camera, rays, shadows=True)
    if goal is not None:
        over = picture.copy()
        before = _shade(over, goal, camera, rays, shadows=False) < depth
        picture[before] = (picture[before] + over[before]) / 2
    pixels = (picture.clip(0, 1) * 255 + 0.5).astype(np.uint8)
    image = Image.fromarray(pixels.reshape(rays_size[1], rays_size[0], 3))
    return image.resize((2 * width, 2 * height), Image.Resampling.NEAREST)


@lru_cache(maxsize=1)  # all pictures of a film have the same
def _rays(camera: Camera, size: Size) -> np.ndarray:
    """[H * W, 3] float32 directions of the pixels' rays, row by row; their length along the view axis is 1."""
    width, height = size
    y, x = np.mgrid[:height, :width].astype(np.float32) + 0.5
    right = (x - width / 2) / camera.focal_length(height)
    down = (y - height / 2) / camera.focal_length(height)
    directions = np.stack((right, down, np.ones_like(x)), axis=-1).reshape(-1, 3)
    return directions @ np.float32(camera.axes())


def _shade(
    picture: np.ndarray, scene: Triangles, camera: Camera, rays: np.ndarray, *, shadows: bool
) -> np.ndarray:
    """Paint what the rays [N, 3] hit into the picture [N, 3]; return the depths [N], infinite where nothing is hit."""
    tree = _ray_tree(scene)
    eye = np.array(camera.eye, np.float32)
    found = tree.run(np.full_like(rays, eye), rays, query="INTERSECT", output=True)
    hit = found["primID"] >= 0
    triangle = found["primID"][hit]
    first, second, third = scene.normals[triangle].swapaxes(0, 1)
    u = found["u"][hit, None]
    v = found["v"][hit, None]
    normal = _unit((1 - u - v) * first + u * second + v * third)
    depth = np.where(hit, found["tfar"], np.inf)
    point = eye + depth[hit, None] * rays[hit]
    to_eye = _unit(eye - point)
    lit: Any = 1.0
    if shadows:
        start = point + _SHADOW_BIAS * normal
        lit = tree.run(start, np.full_like(start, _LIGHT), query="OCCLUDED") < 0
    diffuse = (normal @ _LIGHT).clip(0) * lit
    gloss = (normal * _unit(to_eye + _LIGHT)).sum(axis=1).clip(0) ** 32 * lit
    fill = (normal * to_eye).sum(axis=1).clip(0)
    brightness = 0.40 + 0.06 * normal[:, 2] + 0.48 * diffuse + 0.14 * fill
    picture[hit] = scene.colors[triangle] * brightness[:, None] + 0.10 * gloss[:, None]
    return depth


def _ray_tree(scene: Triangles) -> Any:
    try:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene
    except ImportError as error:
        raise XResetError(
            f"Pictures need embreex, which cannot be imported: {error}. Install it with: pip install embreex"
            " (it is not available for Linux on ARM)."
        ) from error
    tree = EmbreeScene()
    TriangleMesh(tree, scene.corners)
    return tree


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def _draw_points(image: Image.Image, camera: Camera, points: Sequence[Points]) -> None:
    pen = ImageDraw.Draw(image)
    for some in points:
        pos = np.asarray(some.pos, dtype=float).reshape(-1, 3)
        pixels, depth = camera.project(pos[np.isfinite(pos).all(axis=1)], image.size)
        radii = camera.focal_length(image.height) * some.radius / depth
        for margin, color in ((2, (13, 13, 13)), (0, rgb(some.color))):
            for center, radius in zip(pixels, radii.clip(3.0), strict=True):
                pen.circle(center.tolist(), radius + margin, fill=color)
