"""Points of an object: surface clouds, pose keypoints, extents. All in the object's mesh frame, in metres."""

from __future__ import annotations

from collections.abc import Iterable
from hashlib import blake2b
from typing import Literal

import numpy as np

from xreset.errors import ObjectError
from xreset.geometry.shapes import turn_of, winding_number
from xreset.spec import ObjectSpec

Frame = Literal["mesh", "center"]
"""``object_frame`` of a task."""
METRIC_POINTS = 64
"""Points of the published success (the published paper, section V)."""
_CANDIDATES_PER_POINT = (8, 64, 512)
"""Samples of the surface that each wanted point is chosen from; more where most of the surface is inside."""
_PROBE = 2e-4
"""Distance from the surface at which a sample is tested [m]: above rounding, below any feature."""


def surface_points(obj: ObjectSpec, count: int = 64) -> np.ndarray:
    """[count, 3] well spread points of the object's outer surface, always the same.

    Uniform samples by area, without those inside the solid (where pieces of a stand-in overlap), thinned by
    farthest-point selection. Found once for each surface in a process.
    """
    return _surface(obj, count)[:, :3].copy()


def surface_normals(obj: ObjectSpec, count: int = 64) -> np.ndarray:
    """[count, 3] outward unit normals of the surface at :func:`surface_points`."""
    return _surface(obj, count)[:, 3:].copy()


_SURFACES: dict[tuple[bytes, int], np.ndarray] = {}
"""Points and normals [count, 6] that were found, by surface and count."""


def _surface(obj: ObjectSpec, count: int) -> np.ndarray:
    """[count, 6] points of the outer surface, and the normals there."""
    key = (blake2b(obj.vertices.tobytes() + obj.faces.tobytes()).digest(), count)
    if key not in _SURFACES:
        _SURFACES[key] = _spread_points(obj, count)
    return _SURFACES[key]


def _spread_points(obj: ObjectSpec, count: int) -> np.ndarray:
    found = np.empty((0, 6))
    for each in _CANDIDATES_PER_POINT:
        if len(found) < count:
            points, _, normals = sample_surface(obj.vertices, obj.faces, max(each * count, 256))
            outside = winding_number(points + _PROBE * normals, obj.vertices, obj.faces) < 0.5
            found = np.hstack((points, normals))[outside]
    return found[farthest_points(found[:, :3], count)]


def metric_points(obj: ObjectSpec, frame: Frame = "mesh") -> np.ndarray:
    """[64, 3] the ordered surface points whose mean distance to the goal decides the published success; with the frame
    ``center`` relative to :func:`center`."""
    points = surface_points(obj, METRIC_POINTS)
    return points - center(obj) if frame == "center" else points


def sample_surface(
    vertices: np.ndarray, faces: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points [count, 3] uniform over the triangles' area, the triangle of each [count], and the triangles' unit
    normals there [count, 3]; always the same ones."""
    rng = np.random.default_rng(0)
    first, second, third = vertices[faces].swapaxes(0, 1)
    u = second - first
    v = third - first
    cross = np.cross(u, v)
    double_area = np.linalg.norm(cross, axis=1)
    face = rng.choice(len(cross), size=count, p=double_area / double_area.sum())
    a, b = rng.random((2, count, 1))
    fold = a + b > 1  # fold the parallelogram onto the triangle
    a = np.where(fold, 1 - a, a)
    b = np.where(fold, 1 - b, b)
    return first[face] + a * u[face] + b * v[face], face, cross[face] / double_area[face, None]


def farthest_points(points: np.ndarray, count: int) -> np.ndarray:
    """[count] indices of points [N, 3], chosen one after another: the farthest from the mean, then each time the
    farthest from those chosen before."""
    if len(points) < count:
        raise ObjectError(
            f"Only {len(points)} of {count} points are on the outside of the mesh. Repair it, for example in MeshLab."
        )
    chosen = [np.argmax(np.linalg.norm(points - points.mean(axis=0), axis=1))]
    distance = np.full(len(points), np.inf)
    while len(chosen) < count:
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
        chosen.append(np.argmax(distance))
    return np.array(chosen)


def bounding_box(obj: ObjectSpec) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper corner [3], [3] of the axis-aligned bounding box."""
    return obj.vertices.min(axis=0), obj.vertices.max(axis=0)


def center(obj: ObjectSpec) -> np.ndarray:
    """[3] center of volume of the object's convex hull: defined for any mesh, and independent of its origin, axes and
    triangles."""
    from trimesh.convex import convex_hull  # slow to import

    return np.asarray(convex_hull(obj.vertices).center_mass)


def centers_of_mass(
    objects: Iterable[ObjectSpec], names: np.ndarray, pos: np.ndarray, quat: np.ndarray
) -> np.ndarray:
    """[N, 3] centers of mass in the world [m] of objects with names [N] and poses [N, 3], [N, 4]; the origin where an
    object is not given."""
    known = {obj.name: obj.com for obj in objects}
    coms = np.array([known.get(name, np.zeros(3)) for name in names.tolist()])
    return pos + turn_of(quat).apply(coms.reshape(-1, 3))


def keypoints(obj: ObjectSpec, frame: Frame = "mesh") -> np.ndarray:
    """[4, 3] the object-frame keypoints of the pose metric (the paper, appendix A).

    The paper does not define them; here they are four alternating corners of the axis-aligned bounding box: a
    tetrahedron, so that no rotation leaves all four in place, at the object's own scale. A box depends on the axes of
    the mesh: with the frame ``center`` they are the first four of :func:`metric_points`, which are far from each other
    too.
    """
    if frame == "center":
        return metric_points(obj, frame)[:4]
    corners = np.array(bounding_box(obj))
    pick = np.array([[0, 0, 0], [1, 1, 0], [1, 0, 1], [0, 1, 1]])
    return corners[pick, np.arange(3)]
