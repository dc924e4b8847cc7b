"""Points of an object: surface clouds, pose keypoints, extents. All in the object's mesh frame, in metres."""

from __future__ import annotations

import numpy as np

from xreset.spec import ObjectSpec

_CANDIDATES_PER_POINT = 8
_PROBE = 2e-4  # how far outside the surface a sample is tested [m]: above rounding, below any feature


def surface_points(obj: ObjectSpec, count: int = 64, seed: int = 0) -> np.ndarray:
    """[count, 3] well spread points of the object's outer surface; the same seed gives the same points.

    Uniform samples by area, without those inside the solid (where pieces of a stand-in overlap), thinned by farthest-point selection.
    """
    points, normals = sample_surface(obj, max(_CANDIDATES_PER_POINT * count, 256), seed)
    outside = winding_number(points + _PROBE * normals, obj.vertices, obj.faces) < 0.5
    return farthest_points(points[outside], count)


def sample_surface(obj: ObjectSpec, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points [count, 3] uniform over the triangles' area, and their outward normals [count, 3]."""
    rng = np.random.default_rng(seed)
    corners = obj.vertices[obj.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double_area = np.linalg.norm(cross, axis=1)
    face = rng.choice(len(corners), size=count, p=double_area / double_area.sum())
    a, b = rng.random((2, count, 1))
    fold = a + b > 1  # fold the parallelogram onto the triangle
    a, b = np.where(fold, 1 - a, a), np.where(fold, 1 - b, b)
    origin, u, v = corners[face, 0], corners[face, 1] - corners[face, 0], corners[face, 2] - corners[face, 0]
    return origin + a * u + b * v, cross[face] / double_area[face, None]


def farthest_points(points: np.ndarray, count: int) -> np.ndarray:
    """[count, 3] points chosen one after the other, each the farthest from those chosen before; the first is the farthest from the mean."""
    if len(points) < count:
        raise ValueError(f"{count} points wanted of {len(points)}")
    chosen = np.empty(count, dtype=np.int64)
    chosen[0] = np.argmax(np.linalg.norm(points - points.mean(axis=0), axis=1))
    distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    for i in range(1, count):
        chosen[i] = np.argmax(distance)
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[i]], axis=1))
    return points[chosen]


def winding_number(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """[n] how often the triangles enclose each of the points [n, 3]: about 0 outside, 1 inside, 2 where two closed parts overlap.

    The sum of the triangles' solid angles over 4 pi (Jacobson et al. 2013), each by the formula of Van Oosterom and Strackee
    (1983). Holes in the mesh change it smoothly, so 0.5 still separates in from out.
    """
    corners = vertices[faces]
    block = max(1, 2_000_000 // len(faces))  # bounds memory
    return np.concatenate(
        [_winding(points[i : i + block], corners) for i in range(0, len(points), block)] or [np.empty(0)]
    )


def _winding(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    a, b, c = (corners[None, :, i] - points[:, None] for i in range(3))
    la, lb, lc = (np.sqrt(np.einsum("ijk,ijk->ij", v, v)) for v in (a, b, c))
    volume = np.einsum("ijk,ijk->ij", a, np.cross(b, c))
    ab, bc, ca = (np.einsum("ijk,ijk->ij", u, v) for u, v in ((a, b), (b, c), (c, a)))
    return np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb).sum(axis=1) / (2 * np.pi)


def bounding_box(obj: ObjectSpec) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner [3], [3] of the axis-aligned bounding box."""
    return obj.vertices.min(axis=0), obj.vertices.max(axis=0)


def keypoints(obj: ObjectSpec) -> np.ndarray:
    """[4, 3] the object-frame keypoints of the pose metric (the paper, appendix A).

    The paper does not say which; here they are four alternating corners of the axis-aligned bounding box: a tetrahedron, so that no
    rotation leaves all four in place, at the object's own scale.
    """
    corners = np.array(bounding_box(obj))
    pick = np.array([[0, 0, 0], [1, 1, 0], [1, 0, 1], [0, 1, 1]])
    return corners[pick, np.arange(3)]
