"""Convex shapes: constructors, meshes, half spaces; mass properties and inside of triangle meshes.

Lengths in meters, coordinates in the object's mesh frame.
"""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from xreset.errors import ObjectError, XResetError
from xreset.files.storage import max_bytes
from xreset.files.text import shown
from xreset.spec import Geometry, Shape

if TYPE_CHECKING:
    import trimesh

_MOST_HULL_POINTS = 300
"""Number of points in a hull that every engine accepts."""
MANY_POINTS = 400_000
"""Points of a mesh from which its exact hull takes too long."""
_SAMPLE = 20_000
"""Points from which the hull of very many starts."""
_HEIGHTS = 200_000
"""Heights of points above planes that are computed together: as many as fit a processor's cache."""
_ARCHIVES = (".zip", ".tar", ".gz", ".tgz", ".bz2", ".xz")
_PER_VERTEX_BYTE = 8
"""Bytes of memory of a mesh per byte of its vertices: faces, and copies on the way."""
_POINTER = b"version https://git-lfs"
"""Beginning of the small text that Git has in place of a large file."""
_GLTF_NUMBERS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
CYLINDER_SECTIONS = 48
"""Sides of the prism that stands for a cylinder in a surface mesh."""
_PAIRS = 16_000
"""Pairs of a point and a triangle that are handled at once: as many as fit a processor's cache."""


def transform(R: ArrayLike, position: ArrayLike) -> np.ndarray:
    """[4, 4] pose of a rotation, 3 x 3 or its nine numbers, and a position [3]."""
    T = np.eye(4)
    T[:3, :3] = np.reshape(R, (3, 3))
    T[:3, 3] = position
    return T


def pose_matrix(position: ArrayLike, quat: ArrayLike) -> np.ndarray:
    """[4, 4] pose of a position [3] and a quaternion [4] (w, x, y, z) of any length."""
    return transform(turn_of(np.array(quat, dtype=float)).as_matrix(), position)


def look_at(eye: tuple[float, ...], target: tuple[float, ...]) -> np.ndarray:
    """Return [3, 3] unit vectors of a camera to the right, down and forward, as rows; z is up."""
    forward = np.array(target, dtype=float) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    if np.linalg.norm(right) < 1e-6:  # straight up or down
        right = np.array([1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    return np.stack((right, np.cross(forward, right), forward))


def turn_of(quats: ArrayLike) -> Rotation:
    """Return the rotations of quaternions [..., 4], (w, x, y, z)."""
    return Rotation.from_quat(quats, scalar_first=True)


def quat_of(turn: Rotation) -> np.ndarray:
    """[..., 4] quaternions (w, x, y, z) of rotations, w not below 0."""
    return turn.as_quat(canonical=True, scalar_first=True)


def roll_pitch_yaw(R: np.ndarray, level: float = 1e-5) -> tuple[float, float, float]:
    """Return the angles of R = Rz(yaw) Ry(pitch) Rx(roll) [rad].

    Where pitch is +-90 degrees, only the sum of roll and yaw is defined; yaw is 0 there. ``level`` is the cosine of the
    pitch below which this holds.
    """
    cosine = np.hypot(R[0, 0], R[1, 0])
    pitch = np.arctan2(-R[2, 0], cosine)
    if cosine <= level:
        return np.arctan2(-R[1, 2], R[1, 1]), pitch, 0.0
    return np.arctan2(R[2, 1], R[2, 2]), pitch, np.arctan2(R[1, 0], R[0, 0])


def transformed(points: np.ndarray, T: np.ndarray) -> np.ndarray:
    """[n, 3] points [n, 3] of a frame, in the frame in which the first one has the pose T [4, 4]."""
    return points @ T[:3, :3].T + T[:3, 3]


def perpendicular(direction: np.ndarray) -> np.ndarray:
    """[3] unit vector at right angles to a direction [3]."""
    across = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
    return across / np.linalg.norm(across)


def box(center: ArrayLike, size: Sequence[float]) -> Shape:
    """Make an axis-aligned box of edge lengths ``size``."""
    half = tuple(float(edge) / 2 for edge in size)
    return Shape(
        geometry=Geometry(kind="box", size=half), T_body_shape=transform(np.eye(3), center)
    )


def cylinder(center: ArrayLike, radius: float, height: float) -> Shape:
    """Make a cylinder along z."""
    geometry = Geometry(kind="cylinder", size=(float(radius), float(height) / 2))
    return Shape(geometry=geometry, T_body_shape=transform(np.eye(3), center))


def hull(points: np.ndarray, tolerance: float = 0.0) -> Shape:
    """Make the convex hull of points.

    Args:
        points: [V, 3]
        tolerance: with more than 300 points, a hull of fewer is made; other points lie at most this far beyond it [m].
            0 keeps all points.

    Raises:
        ObjectError: the points span no volume.
    """
    points = np.asarray(points, dtype=float)
    try:
        if tolerance > 0 and len(points) > _MOST_HULL_POINTS:
            points = outermost(points, tolerance)
        convex = ConvexHull(points)
    except (QhullError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise ObjectError(
            f"{len(points)} points span no volume, so they have no convex hull: {reason}"
        ) from error
    index = np.full(len(points), -1)
    index[convex.vertices] = np.arange(len(convex.vertices))
    normals = triangle_normals(points[convex.simplices])
    # qhull's triangles have no consistent winding
    inward = (normals * convex.equations[:, :3]).sum(axis=1) < 0
    faces = convex.simplices.copy()
    faces[inward] = faces[inward][:, ::-1]
    triangles = index[faces].astype(np.int64)
    return Shape(geometry=Geometry(kind="hull", vertices=points[convex.vertices], faces=triangles))


def outermost(points: np.ndarray, tolerance: float) -> np.ndarray:
    """Select points [n, 3] of a hull that no other point exceeds by more than the tolerance.

    The points farthest beyond the faces of the hull so far are added until the hull is good enough.
    """
    if len(points) <= MANY_POINTS:
        points = points[ConvexHull(points).vertices]
        directions = np.array([d for d in np.ndindex(3, 3, 3) if d != (1, 1, 1)]) - 1.0
        chosen = np.unique((points @ directions.T).argmax(axis=0))
    else:
        first = outermost(points[:: len(points) // _SAMPLE + 1], tolerance)
        points = np.concatenate((first, points))
        chosen = np.arange(len(first))
    beyond_hull = np.arange(len(points))
    while True:
        planes = ConvexHull(points[chosen]).equations
        number = np.arange(len(planes))
        farthest = np.zeros(len(planes), dtype=np.int64)
        worst = np.full(len(planes), -np.inf)
        still = []
        for part in np.array_split(beyond_hull, len(beyond_hull) * len(planes) // _HEIGHTS + 1):
            # planes first: the points of each plane are next to each other in memory
            beyond = planes[:, :3] @ points[part].T + planes[:, 3:]
            rows = beyond.argmax(axis=1)
            heights = beyond[number, rows]
            better = heights > worst
            worst[better] = heights[better]
            farthest[better] = part[rows[better]]
            still.append(part[beyond.max(axis=0) > tolerance])
        beyond_hull = np.concatenate(still)
        if not len(beyond_hull):
            return points[chosen]
        chosen = np.union1d(chosen, farthest[worst > max(tolerance, worst.max() / 2)])


def load_mesh(path: Path) -> trimesh.Trimesh:
    """Read the triangles of a file as they are, in the file's units.

    Args:
        path: file of any format that trimesh reads, but not an archive.

    Raises:
        ObjectError: the file is missing, damaged, too large, or has no triangles.
    """
    import trimesh

    if not os.path.isfile(path):
        raise ObjectError(f"There is no mesh at {shown(str(path))}.")
    if path.suffix.lower() in _ARCHIVES or zipfile.is_zipfile(path):
        raise ObjectError(f"{path} is an archive. Unpack it, and give the mesh.")
    refuse_pointer(path)
    try:
        size = path.stat().st_size
        if path.suffix.lower() in (".gltf", ".glb"):
            size = max(size, _gltf_size(path))
        _check_memory(path, size)
        # Processing would drop damaged vertices silently.
        scene = trimesh.load_scene(path, skip_materials=True, process=False)
        sizes = [
            scene.geometry[scene.graph[node][1]].vertices.nbytes
            for node in scene.graph.nodes_geometry
        ]
        # a scene may show a mesh any number of times
        _check_memory(path, _PER_VERTEX_BYTE * sum(sizes))
        mesh = scene.to_mesh()
    except ObjectError:
        raise
    except Exception as error:  # trimesh's parsers raise any kind of error
        raise ObjectError(f"{path} cannot be read as a mesh: {shown(str(error))}") from error
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces) or not len(mesh.vertices):
        raise ObjectError(f"{path} contains no triangles. It is empty or damaged.")
    return mesh


def refuse_pointer(path: Path, error: type[XResetError] = ObjectError) -> None:
    """Raise an error for the text that Git LFS has in place of a file which it has not fetched."""
    with open(path, "rb") as file:
        if file.read(len(_POINTER)) == _POINTER:
            raise error(
                f"{path} is a Git LFS pointer, not the file itself. Run `git lfs pull` in its repository."
            )


def _check_memory(path: Path, size: int) -> None:
    if size > max_bytes():
        raise ObjectError(f"{path} takes {size >> 20} MB, more than XRESET_MAX_FILE_MB allows.")


def _gltf_size(path: Path) -> int:
    """Return the memory that the arrays of a glTF file take [bytes]: they may share data, or have none."""
    content = path.read_bytes()
    if content[:4] == b"glTF":  # binary: the JSON text comes first
        length = int.from_bytes(content[12:16], "little")
        content = content[20 : 20 + length]
    accessors = json.loads(content).get("accessors", [])
    return sum(_GLTF_NUMBERS[accessor["type"]] * 8 * accessor["count"] for accessor in accessors)


def loft(sections: Iterable[np.ndarray]) -> Shape:
    """Make the convex hull of cross sections, each [n, 3]."""
    return hull(np.concatenate(list(sections)))


def section(
    center: ArrayLike,
    half_u: ArrayLike,
    half_v: ArrayLike,
    *,
    power: float = 2.0,
    count: int,
) -> np.ndarray:
    """[count, 3] points of a superellipse |u|^power + |v|^power = 1 with half axes ``half_u`` and ``half_v`` (vectors).

    A power of 2 is an ellipse; larger ones approach a rectangle.
    """
    angle = (np.arange(count) + 0.5) * 2 * np.pi / count
    c = np.cos(angle)
    s = np.sin(angle)
    radius = (np.abs(c) ** power + np.abs(s) ** power) ** (-1 / power)
    along_u = np.outer(radius * c, np.asarray(half_u, dtype=float))
    along_v = np.outer(radius * s, np.asarray(half_v, dtype=float))
    return np.asarray(center, dtype=float) + along_u + along_v


def prism(outline: ArrayLike, bottom: float, top: float) -> Shape:
    """Make the convex hull of a polygon in x and y between two heights."""
    xy = np.asarray(outline, dtype=float)
    return loft([np.column_stack([xy, np.full(len(xy), z)]) for z in (bottom, top)])


def shape_mesh(shape: Shape, *, coarse: bool = False) -> trimesh.Trimesh:
    """Make the closed triangle mesh of a convex shape, in its body's frame.

    Args:
        shape: the shape.
        coarse: use few triangles for round shapes; enough for a picture, not for a distance.
    """
    import trimesh

    geometry = shape.geometry
    size = geometry.size
    if geometry.kind == "box":
        mesh = trimesh.creation.box(2 * np.array(size))
    elif geometry.kind == "sphere":
        mesh = trimesh.creation.icosphere(2 if coarse else 3, size[0])
    elif geometry.kind == "cylinder":
        mesh = trimesh.creation.cylinder(
            size[0], 2 * size[1], sections=24 if coarse else CYLINDER_SECTIONS
        )
    elif geometry.kind == "capsule":
        count = (10, 14) if coarse else (32, 32)
        mesh = trimesh.creation.capsule(radius=size[0], height=2 * size[1], count=count)
        # The origin is at one end or in the middle, depending on trimesh's version.
        mesh.apply_translation([0, 0, -mesh.bounds.mean(axis=0)[2]])
    else:
        mesh = trimesh.Trimesh(geometry.vertices, geometry.faces, process=False)
    mesh.apply_transform(shape.T_body_shape)
    return mesh


def surface_of(pieces: Sequence[Shape]) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices [V, 3] and triangles [F, 3] of all pieces; where pieces overlap, triangles lie inside the
    solid."""
    import trimesh

    return mesh_arrays(trimesh.util.concatenate([shape_mesh(piece) for piece in pieces]))


def mesh_arrays(mesh: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices [V, 3] and triangles [F, 3] of a trimesh as plain arrays, without the hooks of trimesh."""
    return np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces, dtype=np.int64)


def half_spaces(shape: Shape) -> np.ndarray:
    """[P, 4] planes of a convex shape, (outward unit normal, offset): x is inside where normal . x + offset <= 0 for
    all."""
    vertices = np.asarray(shape_mesh(shape).vertices, dtype=float)
    # coplanar triangles share a plane
    return np.unique(ConvexHull(vertices).equations.round(9), axis=0)


def plane_heights(points: np.ndarray, planes: np.ndarray) -> np.ndarray:
    """[..., P] heights of points [..., 3] above planes [P, 4] of :func:`half_spaces`, negative inside."""
    return points @ planes[:, :3].T + planes[:, 3]


def mass_properties(
    vertices: np.ndarray, faces: np.ndarray, mass: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return center of mass [3] and inertia [3, 3] about it of a closed mesh of uniform density and the given mass.

    In a mesh of several closed parts each part counts in full, so a volume where two parts overlap counts twice.
    """
    import trimesh

    solid = trimesh.Trimesh(vertices, faces, process=False).mass_properties
    return np.asarray(solid.center_mass), np.asarray(solid.inertia) * (mass / solid.mass)


def shell_properties(
    vertices: np.ndarray, faces: np.ndarray, mass: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return center of mass [3] and inertia [3, 3] about it of a thin wall of constant thickness along the triangles.

    The second moment of a triangle, the mean of x x^T, is (the sum over its corners + that of the corners' sum) / 12.
    """
    corners = vertices[faces]
    area = np.linalg.norm(triangle_normals(corners), axis=1)
    weight = mass * area / area.sum()
    com = np.einsum("f,fi->i", weight, corners.mean(axis=1)) / mass
    local = corners - com
    total = local.sum(axis=1)
    second = np.einsum("f,fki,fkj->ij", weight, local, local) + np.einsum(
        "f,fi,fj->ij", weight, total, total
    )
    second /= 12
    return com, np.trace(second) * np.eye(3) - second


def triangle_normals(corners: np.ndarray) -> np.ndarray:
    """[F, 3] normals of triangles [F, 3, 3], twice as long as the area."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def winding_number(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """[n] how often the triangles enclose each of the points [n, 3]: about 0 outside, 1 inside, 2 where two closed
    parts overlap.

    The sum of the triangles' solid angles over 4 pi (Jacobson et al. 2013), each by the formula of Van Oosterom and
    Strackee (1983). Holes in the mesh change it smoothly, so 0.5 still separates in from out.
    """
    corners = np.moveaxis(vertices[faces], 0, 2)[:, :, None]  # [3, 3, 1, F]
    block = max(1, _PAIRS // len(faces))
    numbers = [np.empty(0)]
    for begin in range(0, len(points), block):
        a, b, c = corners - points[begin : begin + block].T[..., None]  # [3, n, F] each
        la, lb, lc = (np.sqrt(_dot(v, v)) for v in (a, b, c))
        volume = _dot(a, np.cross(b, c, axis=0))
        angle = np.arctan2(
            volume, la * lb * lc + _dot(a, b) * lc + _dot(b, c) * la + _dot(c, a) * lb
        )
        numbers.append(angle.sum(axis=1) / (2 * np.pi))
    return np.concatenate(numbers)


def _dot(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """[...] scalar products of vectors [3, ...]."""
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]
