"""A link as one solid: signed distances to all of its shapes, with the gaps between them closed.

Makers model a link as thin walls around a motor. Taken one by one, such walls neither keep another link out nor push it
out.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from xreset.geometry.collision import support_points
from xreset.geometry.fields import DistanceFields
from xreset.geometry.shapes import half_spaces, plane_heights, shape_mesh
from xreset.spec import Shape

GAP = 0.02
"""Narrower gaps between the shapes of a link count as solid, because no finger fits in [m]."""
_SPACING = 2.5e-3
"""Grid spacing [m]."""
_ENTRIES = 4_000_000
"""Distances of points from planes that are computed at once: 32 MB."""
_SAMPLES = 2e-3
"""Spacing of samples on the surface of a hull, for the distance of points outside from its edges [m]."""


def link_field(shapes: Sequence[Shape]) -> DistanceFields:
    """Sample the signed distance to a link's shapes as one solid, in the link's frame.

    The gaps are closed as in mathematical morphology: what a ball of diameter :data:`GAP` outside the shapes cannot
    reach is inside. Flat and convex surfaces stay in place.
    """
    support = [support_points(shape) for shape in shapes]
    low = np.min([points.min(axis=0) - radius for points, radius in support], axis=0)
    high = np.max([points.max(axis=0) + radius for points, radius in support], axis=0)
    reach = GAP / 2
    origin = low - reach - 2 * _SPACING
    counts = np.ceil((high - origin + reach + 2 * _SPACING) / _SPACING).astype(int) + 1
    nodes = origin + _SPACING * np.moveaxis(np.indices(tuple(counts)), 0, -1)
    points = nodes.reshape(-1, 3)
    values = np.min([signed_distance(shape, points) for shape in shapes], axis=0).reshape(counts)
    if len(shapes) > 1:
        slope = np.stack([*np.gradient(values, _SPACING)], axis=-1)
        steepness = np.linalg.norm(slope, axis=-1)
        # On a flat ridge between two shapes the slope has no direction; other nodes are near.
        rim = (values > reach) & (values <= reach + 2 * _SPACING) & (steepness > 0.5)
        beyond = (values[rim] - reach) / steepness[rim]
        # points at ``reach`` from the shapes
        offset_surface = cKDTree(nodes[rim] - beyond[:, None] * slope[rim])
        inside = values <= reach
        depth, _ = offset_surface.query(nodes[inside])
        values[inside] = np.minimum(values[inside], reach - depth)
    return DistanceFields.on_grid(values, origin, _SPACING, low, high)


def signed_distance(shape: Shape, points: np.ndarray) -> np.ndarray:
    """[n] signed distance of points [n, 3] from a shape, both in the link's frame; up to 0.3 mm too large outside a
    hull."""
    geometry = shape.geometry
    if geometry.kind == "hull":
        return _distance_from_hull(shape, points)
    local = (points - shape.T_body_shape[:3, 3]) @ shape.T_body_shape[:3, :3]
    size = np.array(geometry.size)
    if geometry.kind == "capsule":
        local[:, 2] -= np.clip(local[:, 2], -size[1], size[1])
    if geometry.kind in ("sphere", "capsule"):
        return np.linalg.norm(local, axis=1) - size[0]
    if geometry.kind == "cylinder":
        local = np.column_stack((np.hypot(local[:, 0], local[:, 1]), local[:, 2]))
    beyond = np.abs(local) - size
    return np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)


def _distance_from_hull(shape: Shape, points: np.ndarray) -> np.ndarray:
    """See :func:`signed_distance`. Next to edges and corners, the distance is that of samples on the surface."""
    from trimesh.remesh import subdivide_to_size

    planes = half_spaces(shape)
    mesh = shape_mesh(shape)
    parts = []
    for part in np.array_split(points, len(points) * len(planes) // _ENTRIES + 1):
        parts.append(plane_heights(part, planes).max(axis=1))
    distance = np.concatenate(parts)  # exact inside, and where a face is nearest
    outside = distance > _SAMPLES / 2
    vertices = subdivide_to_size(mesh.vertices, mesh.faces, _SAMPLES)[0]
    to_samples, _ = cKDTree(vertices).query(points[outside])
    distance[outside] = np.maximum(distance[outside], to_samples - 3e-4)
    return distance
