"""A link as one solid: signed distances to all of its shapes, the gaps between them closed.

Makers model links as thin walls about a motor. Seen one by one, walls neither keep another link from coming in between nor drive it out.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy.spatial import cKDTree

from xreset.geometry.collision import support_points
from xreset.geometry.fields import DistanceFields
from xreset.geometry.shapes import half_spaces, shape_mesh
from xreset.spec import Shape

GAP = 0.02
"""[m] Gaps between the shapes of one link that are narrower count as solid: no finger goes in there."""
_SPACING = 2.5e-3
"""[m] Of the grid."""
_SAMPLES = 2e-3
"""[m] Of the samples on a hull's surface that tell how far a point outside is from its edges."""


def link_field(shapes: Sequence[Shape]) -> DistanceFields:
    """Signed distances to a link's shapes as one solid, in the link's frame.

    Gaps are closed as in mathematical morphology: what a ball of diameter :data:`GAP` that stays outside cannot reach is inside. Flat and
    convex surfaces stay where they are.
    """
    points = np.concatenate([_extremes(shape) for shape in shapes])
    low, high = points.min(axis=0), points.max(axis=0)
    reach = GAP / 2
    origin = low - reach - 2 * _SPACING
    counts = np.ceil((high - origin + reach + 2 * _SPACING) / _SPACING).astype(int) + 1
    nodes = origin + _SPACING * np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), axis=-1)
    values = np.min([signed_distance(shape, nodes.reshape(-1, 3)) for shape in shapes], axis=0).reshape(counts)
    if len(shapes) > 1:
        slope = np.stack(np.gradient(values, _SPACING), axis=-1)
        steep = np.linalg.norm(slope, axis=-1)
        # where a ridge between two shapes is flat, others are near
        rim = (values > reach) & (values <= reach + 2 * _SPACING) & (steep > 0.5)
        beyond = (values[rim] - reach) / steep[rim]
        grown = cKDTree(nodes[rim] - beyond[:, None] * slope[rim])  # the surface at that distance from all shapes
        inside = values <= reach
        values[inside] = np.minimum(values[inside], reach - grown.query(nodes[inside])[0])
    return DistanceFields(
        values=torch.as_tensor(values.reshape(-1)),
        start=torch.zeros(1, dtype=torch.long),
        counts=torch.as_tensor(counts)[None],
        origin=torch.as_tensor(origin)[None],
        low=torch.as_tensor(low)[None],
        high=torch.as_tensor(high)[None],
        spacing=_SPACING,
    )


def signed_distance(shape: Shape, points: np.ndarray) -> np.ndarray:
    """[n] signed distance of points [n, 3] from a shape, both in the link's frame; outside hulls it is up to 0.3 mm too large."""
    local = (points - shape.T_body_shape[:3, 3]) @ shape.T_body_shape[:3, :3]
    kind, size = shape.geometry.kind, np.array(shape.geometry.size)
    if kind == "sphere":
        return np.linalg.norm(local, axis=1) - size[0]
    if kind == "capsule":
        local[:, 2] -= np.clip(local[:, 2], -size[1], size[1])
        return np.linalg.norm(local, axis=1) - size[0]
    if kind == "hull":
        return _from_hull(shape, points)
    beyond = (
        np.abs(local) - size
        if kind == "box"
        else np.column_stack((np.hypot(*local[:, :2].T), np.abs(local[:, 2]))) - size
    )
    return np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)


def _from_hull(shape: Shape, points: np.ndarray) -> np.ndarray:
    from trimesh.remesh import subdivide_to_size

    planes, mesh = half_spaces(shape), shape_mesh(shape)
    beyond = (points @ planes[:, :3].T + planes[:, 3]).max(axis=1)  # exact inside, and where a face is nearest
    outside = beyond > _SAMPLES / 2
    samples = cKDTree(subdivide_to_size(mesh.vertices, mesh.faces, _SAMPLES)[0])
    beyond[outside] = np.maximum(beyond[outside], samples.query(points[outside])[0] - 3e-4)
    return beyond


def _extremes(shape: Shape) -> np.ndarray:
    """[n, 3] corners of the shape's bounding box along the axes of the link."""
    points, radius = support_points(shape.geometry)
    points = points @ shape.T_body_shape[:3, :3].T + shape.T_body_shape[:3, 3]
    return np.stack((points.min(axis=0) - radius, points.max(axis=0) + radius))
