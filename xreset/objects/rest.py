"""Resting poses of an object on a table."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from xreset.geometry.shapes import quat_of
from xreset.spec import ObjectSpec


def rest_height(obj: ObjectSpec, quat: np.ndarray) -> np.ndarray | float:
    """Height of the mesh frame's origin at which the lowest vertex touches z = 0 [m].

    Args:
        quat: [..., 4] orientations (w, x, y, z).

    Returns:
        [...] heights; a float for one orientation.
    """
    w, x, y, z = np.moveaxis(np.asarray(quat, dtype=float), -1, 0)
    norm = w * w + x * x + y * y + z * z
    # last row of the rotation matrix: the world's z axis in the mesh frame
    last_row = (2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z)
    up = np.stack(last_row, axis=-1) / norm[..., None]
    height = -(up @ obj.vertices.T).min(axis=-1)
    return float(height) if np.ndim(height) == 0 else height


def resting_faces(obj: ObjectSpec) -> tuple[np.ndarray, np.ndarray]:
    """Return the mesh directions [N, 3] that point up where an object rests on a plane, and the heights [N] of its
    center of mass there [m].

    An object rests on a face of its convex hull if its center of mass projects into that face.
    """
    from trimesh.triangles import points_to_barycentric  # slow to import

    convex = ConvexHull(obj.vertices)
    corners = obj.vertices[convex.simplices]
    normals = convex.equations[:, :3]
    # barycentric coordinates of the point below the center of mass, in each face
    coordinates = points_to_barycentric(corners, np.broadcast_to(obj.com, normals.shape))
    stable = (coordinates >= -1e-9).all(axis=1)
    heights = -(normals @ obj.com + convex.equations[:, 3])
    return -normals[stable], heights[stable]


def resting_orientation(obj: ObjectSpec, up: np.ndarray) -> np.ndarray:
    """[4] orientation of a stable pose on a plane: the one in which the mesh direction ``up`` [3] points up the
    most."""
    tops, _ = resting_faces(obj)
    top = tops[np.argmax(tops @ up)]
    axis = np.cross(top, (0.0, 0.0, 1.0))
    sine = np.linalg.norm(axis)
    if sine < 1e-12:  # no turn, or half a turn about any horizontal axis
        return np.array([1.0, 0.0, 0.0, 0.0]) if top[2] > 0 else np.array([0.0, 1.0, 0.0, 0.0])
    return quat_of(Rotation.from_rotvec(axis / sine * np.arctan2(sine, top[2])))
