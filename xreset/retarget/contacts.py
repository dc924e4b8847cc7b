"""Distance from points to an object's surface, and the contacts of human keypoints that follow from it."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

_SPACING = 0.003
"""Typical distance of the samples that narrow the search for the nearest triangle [m]."""
_CANDIDATES = 6


class Surface:
    """An object's triangle mesh, prepared for nearest-point queries."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        import trimesh

        self.mesh = trimesh.Trimesh(vertices, faces, process=False)
        count = int(np.clip(self.mesh.area / _SPACING**2, 2_000, 40_000))
        samples, owners = trimesh.sample.sample_surface(self.mesh, count, seed=0)
        corners = self.mesh.triangles.mean(axis=1)  # so that no small triangle goes without a sample
        self._owners = np.concatenate((owners, np.arange(len(corners))))
        self._tree = cKDTree(np.concatenate((samples, corners)))

    def nearest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Nearest surface points.

        Args:
            points: [N, 3] in the mesh frame; finite.

        Returns:
            [N, 3] nearest points of the surface (to within the sampling: exact on the triangles near the nearest samples), and [N] the
            distances to them [m].
        """
        import trimesh

        _, near = self._tree.query(points, k=_CANDIDATES)
        faces = self._owners[near].reshape(-1)
        candidates = trimesh.triangles.closest_point(self.mesh.triangles[faces], np.repeat(points, _CANDIDATES, axis=0))
        candidates = candidates.reshape(-1, _CANDIDATES, 3)
        distances = np.linalg.norm(candidates - points[:, None], axis=-1)
        best = distances.argmin(axis=1)
        rows = np.arange(len(points))
        return candidates[rows, best], distances[rows, best]


def keypoint_contacts(
    surface: Surface, keypoints: np.ndarray, object_pos: np.ndarray, object_quat: np.ndarray, distance: float
) -> tuple[np.ndarray, np.ndarray]:
    """Contacts of keypoints with an object: a keypoint nearer to the surface than ``distance`` touches its nearest surface point.

    Args:
        surface: the object's.
        keypoints: [F, K, 3] world frame; NaN where not annotated.
        object_pos: [F, 3]
        object_quat: [F, 4]
        distance: [m]

    Returns:
        [F, K, 3] nearest surface points in the world (zero where a keypoint is far away or not annotated) and [F, K] bool contact.
    """
    rotation = Rotation.from_quat(object_quat, scalar_first=True).as_matrix()
    local = np.einsum("fij,fki->fkj", rotation, keypoints - object_pos[:, None])
    low, high = surface.mesh.bounds
    with np.errstate(invalid="ignore"):
        close = ((local > low - distance) & (local < high + distance)).all(axis=-1)  # False where NaN
    points, contact = np.zeros_like(local), np.zeros(local.shape[:2], dtype=bool)
    if close.any():
        nearest, gap = surface.nearest(local[close])
        contact[close] = gap < distance
        world = np.einsum("fij,fkj->fki", rotation, _scatter(nearest, close)) + object_pos[:, None]
        points[contact] = world[contact]
    return points, contact


def _scatter(values: np.ndarray, where: np.ndarray) -> np.ndarray:
    out = np.zeros((*where.shape, 3))
    out[where] = values
    return out
