"""An object's surface: nearest points, signed distances on a grid, and the contacts of human keypoints that follow from them.

Shape letters: F frames, K keypoints, N points.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from xreset.geometry.fields import DistanceFields
from xreset.geometry.shapes import surface_of
from xreset.spec import ObjectSpec

_SAMPLE_SPACING = 0.003
"""Typical distance of the samples that narrow the search for the nearest triangle [m]."""
_CANDIDATES = 6
"""Triangles in which the nearest point is looked for."""
_GRID_SPACING = 0.004
"""Of the grid of signed distances [m]."""
_GRID_MARGIN = 0.032
"""Width of the grid around the object's bounding box [m]."""


class Surface:
    """An object's outer surface, prepared for nearest points and signed distances. Points are in the object's mesh frame.

    It is the surface of the union of the collision pieces: what the robot will touch in physics. An imported mesh's pieces may stand out
    of the mesh by some millimetres, enough for a grasp that fits the mesh to be pushed apart.
    """

    def __init__(self, obj: ObjectSpec) -> None:
        """Sample the surface and fill the grid; takes some 0.1 s to 1 s."""
        import trimesh

        mesh = trimesh.Trimesh(*surface_of(obj.pieces), process=False)
        self._triangles = np.asarray(mesh.triangles)
        corners = self._triangles.reshape(-1, 3)
        self.low, self.high = corners.min(axis=0), corners.max(axis=0)
        """[3] corners of the bounding box."""
        self._origin = self.low - _GRID_MARGIN
        counts = np.ceil((self.high - self.low + 2 * _GRID_MARGIN) / _GRID_SPACING).astype(int) + 1
        axes = [self._origin[i] + _GRID_SPACING * np.arange(counts[i]) for i in range(3)]
        inside = solid_nodes(self._triangles, axes)

        count = int(np.clip(mesh.area / _SAMPLE_SPACING**2, 2_000, 40_000))
        drawn = trimesh.sample.sample_surface(mesh, count, seed=0)
        samples = np.concatenate(
            (drawn[0], self._triangles.mean(axis=1))
        )  # so that no small triangle goes without a sample
        owners = np.concatenate((drawn[1], np.arange(len(self._triangles))))
        outward = _GRID_SPACING * np.asarray(mesh.face_normals)[owners]
        buried = self._at_nodes(inside, samples + outward) & self._at_nodes(
            inside, samples - outward
        )  # where the parts of a mesh overlap
        self._owners, self._tree = owners[~buried], cKDTree(samples[~buried])

        nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        distance, _ = self._tree.query(nodes)
        near = distance < 2 * _GRID_SPACING + _SAMPLE_SPACING  # beyond, the nearest sample is near enough
        distance[near] = self.nearest(nodes[near])[1]
        self.field = DistanceFields(
            values=torch.as_tensor(np.where(inside.reshape(-1), -distance, distance)),
            start=torch.zeros(1, dtype=torch.long),
            counts=torch.as_tensor(counts)[None],
            origin=torch.as_tensor(self._origin)[None],
            low=torch.as_tensor(self.low)[None],
            high=torch.as_tensor(self.high)[None],
            spacing=_GRID_SPACING,
        )
        """Signed distances on the grid."""

    def samples(self, count: int) -> np.ndarray:
        """[N, 3] at most ``count`` points, evenly drawn from the samples of the surface."""
        points = np.asarray(self._tree.data)
        return points[:: -(-len(points) // count)]

    def nearest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Nearest surface points [N, 3] of points [N, 3], exact on the triangles of the nearest samples, and the distances [N] to them."""
        import trimesh

        _, near = self._tree.query(points, k=_CANDIDATES)
        faces = self._owners[near].reshape(-1)
        candidates = trimesh.triangles.closest_point(self._triangles[faces], np.repeat(points, _CANDIDATES, axis=0))
        candidates = candidates.reshape(-1, _CANDIDATES, 3)
        distances = np.linalg.norm(candidates - points[:, None], axis=-1)
        rows = np.arange(len(points))
        best = distances.argmin(axis=1)
        return candidates[rows, best], distances[rows, best]

    def signed_distance(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance [N] and its gradient [N, 3] at points [N, 3], by interpolation (``DistanceFields.signed_distance``)."""
        return self.field.signed_distance(points, torch.zeros(len(points), dtype=torch.long))

    def _at_nodes(self, values: np.ndarray, points: np.ndarray) -> np.ndarray:
        index = np.clip(np.rint((points - self._origin) / _GRID_SPACING).astype(int), 0, np.array(values.shape) - 1)
        return values[tuple(index.T)]


def solid_nodes(triangles: np.ndarray, axes: list[np.ndarray]) -> np.ndarray:
    """Which nodes of a grid lie inside closed meshes, overlapping ones included: [X, Y, Z] bool.

    Along every grid line, crossings of the surface are counted with their direction; a node is inside where more lead in than out. The
    three directions vote, so that a small hole does no harm.

    Args:
        triangles: [M, 3, 3] corners, outward.
        axes: coordinates of the nodes along x, y and z, evenly spaced.
    """
    votes = np.zeros(tuple(len(axis) for axis in axes), dtype=int)
    for along in range(3):
        u, v = (along + 1) % 3, (along + 2) % 3
        depth = _crossings(triangles[:, :, [u, v, along]], axes[u], axes[v], axes[along])
        votes += np.moveaxis(np.cumsum(depth, axis=2) > 0, [0, 1, 2], [u, v, along])
    return votes >= 2


def _crossings(triangles: np.ndarray, u: np.ndarray, v: np.ndarray, w: np.ndarray) -> np.ndarray:
    """[U, V, W] crossings between each node and the one before it along w: +1 into a solid, -1 out of it."""
    shift = 1e-7 * np.array([np.sqrt(2), np.sqrt(3)])  # so that no line meets an edge or a corner exactly
    spacing = u[1] - u[0]
    count = np.zeros((len(u), len(v), len(w)), dtype=int)
    for a, b, c in triangles:
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if abs(area) < 1e-16:
            continue  # parallel to the line
        low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
        i = np.arange(max(0, int((low[0] - u[0]) / spacing) - 1), min(len(u), int((high[0] - u[0]) / spacing) + 2))
        j = np.arange(max(0, int((low[1] - v[0]) / spacing) - 1), min(len(v), int((high[1] - v[0]) / spacing) + 2))
        x, y = u[i][:, None] + shift[0], v[j][None, :] + shift[1]
        beta = ((x - a[0]) * (c[1] - a[1]) - (y - a[1]) * (c[0] - a[0])) / area
        gamma = ((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])) / area
        hit_i, hit_j = np.nonzero((beta >= 0) & (gamma >= 0) & (beta + gamma <= 1))
        z = a[2] + beta[hit_i, hit_j] * (b[2] - a[2]) + gamma[hit_i, hit_j] * (c[2] - a[2])
        after = np.ceil((z - w[0]) / spacing).astype(int)
        known = after < len(w)
        np.add.at(count, (i[hit_i[known]], j[hit_j[known]], np.maximum(after[known], 0)), -1 if area > 0 else 1)
    return count


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
    with np.errstate(invalid="ignore"):
        close = ((local > surface.low - distance) & (local < surface.high + distance)).all(axis=-1)  # False where NaN
    points, contact = np.zeros_like(local), np.zeros(local.shape[:2], dtype=bool)
    if close.any():
        nearest, gap = surface.nearest(local[close])
        contact[close] = gap < distance
        touched = np.zeros_like(local)
        touched[close] = nearest
        points[contact] = (np.einsum("fij,fkj->fki", rotation, touched) + object_pos[:, None])[contact]
    return points, contact
