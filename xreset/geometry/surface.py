"""An object's surface: nearest points, signed distances on a grid, and the contacts of human keypoints with it.

Shape letters: F frames, K keypoints, N points.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from xreset.geometry.shapes import half_spaces, plane_heights, shape_mesh, surface_of, turn_of
from xreset.spec import ObjectSpec, Shape

if TYPE_CHECKING:
    from xreset.geometry.fields import DistanceFields

_SAMPLE_SPACING = 0.003
"""Typical distance of the samples that narrow the search for the nearest triangle of a usual object [m]."""
_CANDIDATES = 6
"""Number of triangles that are searched for the nearest point."""
_GRID_SPACING = 0.004
"""Spacing of the grid of signed distances of a usual object [m]."""
_MOST_CELLS = 1e6
"""Cells of the largest usual object, a cube of 34 cm. The grid and the samples of a larger one are coarser."""
_GRID_MARGIN = 0.032
"""Width of the grid around the object's bounding box [m]."""
_NODES_AT_ONCE = 100_000
"""Nodes that are compared with the planes of a piece at once: 0.1 GB with 124 planes."""
_NODE_SHIFT = 1e-7 * np.sqrt([2.0, 3.0, 5.0])
"""Shift of the nodes in the test for inside, so that no node lies exactly in a face [m]."""


class Surface:
    """An object's outer surface, prepared for nearest points and signed distances. Points are in the object's mesh
    frame.

    It is the surface of the union of the collision pieces, which is what the robot touches in physics. The pieces of an
    imported mesh may reach some millimeters beyond the mesh: physics would push a hand that touches the mesh away.
    """

    def __init__(self, obj: ObjectSpec) -> None:
        """Sample the surface and fill the grid, which takes 0.1 s to 1 s."""
        import trimesh

        self.obj = obj
        """The object."""
        mesh = trimesh.Trimesh(*surface_of(obj.pieces), process=False)
        self._triangles = np.asarray(mesh.triangles)
        corners = self._triangles.reshape(-1, 3)
        self.low = corners.min(axis=0)
        """[3] lower corner of the bounding box."""
        self.high = corners.max(axis=0)
        """[3] upper corner of the bounding box."""
        origin = self.low - _GRID_MARGIN
        size = self.high - self.low + 2 * _GRID_MARGIN
        scale = max(1.0, float(np.prod(size / _GRID_SPACING) / _MOST_CELLS) ** (1 / 3))
        spacing = scale * _GRID_SPACING
        sample_spacing = scale * _SAMPLE_SPACING
        counts = np.ceil(size / spacing).astype(int) + 1
        nodes = origin + spacing * np.moveaxis(np.indices(tuple(counts)), 0, -1)
        inside = _nodes_inside(obj.pieces, nodes)

        count = int(np.clip(mesh.area / sample_spacing**2, 2_000, 40_000 * scale**2))
        points, owners = trimesh.sample.sample_surface(mesh, count, seed=0)[:2]
        # The centers of the triangles give even the smallest triangle a sample.
        points = np.concatenate((points, self._triangles.mean(axis=1)))
        owners = np.concatenate((owners, np.arange(len(self._triangles))))

        def is_inside(at: np.ndarray) -> np.ndarray:
            index = np.rint((at - origin) / spacing).astype(int).clip(0, counts - 1)
            return inside[tuple(index.T)]

        self._normals = np.asarray(mesh.face_normals)
        outward = spacing * self._normals[owners]
        # not where pieces overlap
        exposed = ~(is_inside(points + outward) & is_inside(points - outward))
        self._owners = owners[exposed]
        self._tree = cKDTree(points[exposed])

        flat_nodes = nodes.reshape(-1, 3)
        # large leaves are faster far from the surface; on all cores
        tree = cKDTree(self._tree.data, leafsize=64)
        distance, _ = tree.query(flat_nodes, workers=-1)
        # farther nodes keep the distance to the nearest sample
        near = distance < 2 * spacing + sample_spacing
        _, distance[near] = self.nearest(flat_nodes[near])
        self._origin = origin
        self._spacing = spacing
        self._signed = np.where(inside.reshape(-1), -distance, distance).reshape(counts)

    @cached_property
    def field(self) -> DistanceFields:
        """Signed distances on the grid, for torch."""
        from xreset.geometry.fields import DistanceFields

        return DistanceFields.on_grid(
            self._signed, self._origin, self._spacing, self.low, self.high
        )

    def samples(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return at most ``count`` points [N, 3], evenly drawn from the samples of the surface, and the unit normals of
        their triangles [N, 3]."""
        chosen = slice(None, None, -(-len(self._owners) // count))
        return np.asarray(self._tree.data)[chosen], self._normals[self._owners[chosen]]

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        """[...] signed distances of points [..., 3], negative inside, from the grid [m].

        Beyond the grid, the distance to the grid is added.
        """
        nodes = (points.reshape(-1, 3) - self._origin) / self._spacing
        nearest = nodes.clip(0, np.array(self._signed.shape) - 1)
        beyond = self._spacing * np.linalg.norm(nodes - nearest, axis=-1)
        distance = map_coordinates(self._signed, nearest.T, order=1) + beyond
        return distance.reshape(points.shape[:-1])

    def nearest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Nearest surface points [N, 3] of points [N, 3], exact on the triangles of the nearest samples, and distances
        [N]."""
        import trimesh

        _, near = self._tree.query(points, k=_CANDIDATES)
        triangles = self._triangles[self._owners[near].reshape(-1)]
        candidates = trimesh.triangles.closest_point(
            triangles, np.repeat(points, _CANDIDATES, axis=0)
        )
        candidates = candidates.reshape(-1, _CANDIDATES, 3)
        distances = np.linalg.norm(candidates - points[:, None], axis=-1)
        rows = np.arange(len(points))
        best = distances.argmin(axis=1)
        return candidates[rows, best], distances[rows, best]

    def contacts(
        self,
        keypoints: np.ndarray,
        object_pos: np.ndarray,
        object_quat: np.ndarray,
        distance: float,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Find the contacts of keypoints with the object.

        A keypoint nearer to the surface than ``distance`` touches its nearest surface point.

        Args:
            keypoints: [F, K, 3] in the world frame; NaN where not annotated.
            object_pos: [F, 3]
            object_quat: [F, 4]
            distance: [m]

        Returns:
            Nearest surface points in the world frame [F, K, 3], zero where there is no contact, and whether there is
            one [F, K].
        """
        rotation = turn_of(object_quat).as_matrix()
        local = np.einsum("fij,fki->fkj", rotation, keypoints - object_pos[:, None])
        with np.errstate(invalid="ignore"):  # comparisons with NaN are false
            close = ((local > self.low - distance) & (local < self.high + distance)).all(axis=-1)
        points = np.zeros_like(local)
        contact = np.zeros(local.shape[:2], dtype=bool)
        if close.any():
            points[close], gap = self.nearest(local[close])
            contact[close] = gap < distance
        in_world = np.einsum("fij,fkj->fki", rotation, points) + object_pos[:, None]
        return np.where(contact[..., None], in_world, 0.0), contact


_KNOWN: dict[bytes, Surface] = {}
"""Surfaces that were prepared in this process, by the object's shape."""
_MOST_KNOWN = 64


def prepared_surface(obj: ObjectSpec) -> Surface:
    """Return an object's surface, prepared once in a process."""
    shape = hashlib.sha256()
    for array in (obj.vertices, obj.faces, obj.com, *surface_of(obj.pieces)):
        shape.update(np.ascontiguousarray(array).tobytes())
    key = shape.digest()
    if key not in _KNOWN:
        if len(_KNOWN) == _MOST_KNOWN:
            _KNOWN.clear()
        _KNOWN[key] = Surface(obj)
    return _KNOWN[key]


def _nodes_inside(pieces: Sequence[Shape], nodes: np.ndarray) -> np.ndarray:
    """[X, Y, Z] whether nodes [X, Y, Z, 3] of a grid lie inside any of the convex pieces."""
    shifted = (nodes + _NODE_SHIFT).reshape(-1, 3)
    inside = np.zeros(len(shifted), dtype=bool)
    for piece in pieces:
        low, high = shape_mesh(piece).bounds
        in_box = np.flatnonzero(((shifted >= low) & (shifted <= high)).all(axis=1))
        planes = half_spaces(piece)
        for some in np.array_split(in_box, len(in_box) // _NODES_AT_ONCE + 1):
            heights = plane_heights(shifted[some], planes)
            inside[some[(heights <= 0).all(axis=1)]] = True
    return inside.reshape(nodes.shape[:3])
