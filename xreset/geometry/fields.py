"""Signed distances to several objects on one grid each, looked up in one batch on any device.

Shape letters: M objects, N points, A points that are near.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from xreset.files.checks import frozen
from xreset.physics.tensors import Tensors


@frozen
class DistanceFields(Tensors):
    """Signed distances to M objects at the nodes of one grid per object, in the objects' mesh frames [m]."""

    values: Tensor
    """Nodes of all grids, grid after grid, z fastest; negative inside."""
    start: Tensor
    """[M] index of the first node of each grid."""
    counts: Tensor
    """[M, 3] number of nodes of each grid along x, y and z."""
    origin: Tensor
    """[M, 3] corner of each grid."""
    low: Tensor
    """[M, 3] lower corner of the object's bounding box."""
    high: Tensor
    """[M, 3] upper corner of the object's bounding box."""
    spacing: Tensor
    """[M] distance of neighboring nodes [m]."""

    @staticmethod
    def on_grid(
        values: np.ndarray,
        origin: np.ndarray,
        spacing: float,
        low: np.ndarray,
        high: np.ndarray,
    ) -> DistanceFields:
        """Return the field of one object from its values [X, Y, Z] and the corners [3] of grid and bounding box."""
        return DistanceFields(
            values=torch.as_tensor(values.reshape(-1)),
            start=torch.zeros(1, dtype=torch.long),
            counts=torch.tensor([values.shape]),
            origin=torch.as_tensor(origin)[None],
            low=torch.as_tensor(low)[None],
            high=torch.as_tensor(high)[None],
            spacing=torch.tensor([spacing], dtype=torch.float64),
        )

    @staticmethod
    def join(parts: Sequence[DistanceFields]) -> DistanceFields:
        """Join the fields of several objects, which must be on the same device."""
        start = []
        nodes = 0
        for part in parts:
            start.append(part.start + nodes)
            nodes += len(part.values)
        return replace(DistanceFields.cat(parts), start=torch.cat(start))

    def nearer(
        self, points: Tensor, object_index: Tensor, limit: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Find the points that are nearer to their object than a limit.

        The bounding box rules most points out. One grid step is added, because next to an edge interpolated distances
        may be too small by that much.

        Args:
            points: [N, 3] in the mesh frame of their object.
            object_index: [N] index of the object.
            limit: [N] distance [m].

        Returns:
            Indices [A] of the near points, their signed distances [A] and gradients [A, 3].
        """
        in_box = points.clamp(self.low[object_index], self.high[object_index])
        reach = (limit + self.spacing[object_index]).clamp_min(0.0)
        reachable = (points - in_box).norm(dim=-1) <= reach
        candidates = reachable.nonzero()[:, 0]
        distance, gradient = self.signed_distance(points[candidates], object_index[candidates])
        near = distance < limit[candidates]
        return candidates[near], distance[near], gradient[near]

    def signed_distance(self, points: Tensor, object_index: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance [N] and its gradient [N, 3] by trilinear interpolation.

        Beyond the grid, the distance to the grid is added to the value of the nearest point in it.

        Args:
            points: [N, 3] in the mesh frame of their object.
            object_index: [N] index of the object.
        """
        counts = self.counts[object_index]
        spacing = self.spacing[object_index]
        unclamped = (points - self.origin[object_index]) / spacing[:, None]
        x = torch.minimum(unclamped.clamp_min(0.0), counts - 1.0001)
        beyond = unclamped - x
        excess = beyond.norm(dim=-1)
        cell = x.floor().long()
        step_y = counts[:, 2]
        step_x = counts[:, 1] * step_y
        node = self.start[object_index] + cell[:, 0] * step_x + cell[:, 1] * step_y + cell[:, 2]
        corner = torch.stack((node, node + step_y, node + step_x, node + step_x + step_y), dim=-1)
        v = self.values[torch.stack((corner, corner + 1), dim=-1)].view(-1, 2, 2, 2)
        fx, fy, fz = (x - cell).unbind(1)
        fy_rows = fy[:, None]
        slope_x = v[:, 1] - v[:, 0]
        along_x = v[:, 0] + fx[:, None, None] * slope_x  # [N, 2, 2]
        slope_y = along_x[:, 1] - along_x[:, 0]
        along_y = along_x[:, 0] + fy_rows * slope_y  # [N, 2]
        slope_z = along_y[:, 1] - along_y[:, 0]
        slope_x = slope_x[:, 0] + fy_rows * (slope_x[:, 1] - slope_x[:, 0])
        slope_xy = torch.stack((slope_x, slope_y), dim=1)  # [N, 2, 2]
        slope_xy = slope_xy[..., 0] + fz[:, None] * (slope_xy[..., 1] - slope_xy[..., 0])
        gradient = torch.cat((slope_xy, slope_z[:, None]), dim=1)
        outward = beyond / excess[:, None].clamp_min(1e-12)
        gradient = torch.where(beyond == 0, gradient / spacing[:, None], outward)
        return along_y[:, 0] + fz * slope_z + excess * spacing, gradient
