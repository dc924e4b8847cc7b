"""Signed distances to several objects, on a grid each, looked up in one go on any device."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from xreset.tensors import Tensors


@dataclass(frozen=True, kw_only=True)
class DistanceFields(Tensors):
    """Signed distances to M objects' surfaces at the nodes of one grid per object, in the objects' mesh frames [m]."""

    values: Tensor
    """All grids' nodes behind one another, z fastest; negative inside."""
    start: Tensor
    """[M] index of each grid's first node."""
    counts: Tensor
    """[M, 3] nodes of each grid along x, y and z."""
    origin: Tensor
    """[M, 3] corner of each grid."""
    low: Tensor
    """[M, 3] lower corner of the object's bounding box."""
    high: Tensor
    """[M, 3] upper corner."""
    spacing: float
    """Between neighbouring nodes [m]."""

    @staticmethod
    def join(parts: Sequence[DistanceFields]) -> DistanceFields:
        """Those of several objects, behind one another; all must have one spacing and lie on one device."""
        if len({part.spacing for part in parts}) != 1:
            raise ValueError(f"grids must have one spacing, found {sorted({part.spacing for part in parts})}")
        sizes = torch.tensor([len(part.values) for part in parts], device=parts[0].start.device)
        shift = sizes.cumsum(0) - sizes
        return replace(
            DistanceFields.cat(parts), start=torch.cat([part.start + shift[i] for i, part in enumerate(parts)])
        )

    def beside(self, points: Tensor, which: Tensor) -> Tensor:
        """[...] distance of points [..., 3] from the bounding box of their object [...]; 0 inside."""
        return (points - torch.minimum(torch.maximum(points, self.low[which]), self.high[which])).norm(dim=-1)

    def nearer(self, points: Tensor, which: Tensor, than: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Which of some points [N, 3] are nearer than [N] to their object [N]: indices [A], signed distances [A], gradients [A, 3].

        Most are ruled out by the bounding box; one step of the grid more is as far as distances from it may be wrong beside an edge.
        """
        some = (self.beside(points, which) <= (than + self.spacing).clamp_min(0.0)).nonzero()[:, 0]
        distance, gradient = self.signed_distance(points[some], which[some])
        near = distance < than[some]
        return some[near], distance[near], gradient[near]

    def signed_distance(self, points: Tensor, which: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance [N] and its gradient [N, 3] by trilinear interpolation.

        Beyond the grid, the distance to the grid is added to the value of the nearest point in it.

        Args:
            points: [N, 3] in the mesh frame of their object.
            which: [N] index of the object.
        """
        counts = self.counts[which]
        unclamped = (points - self.origin[which]) / self.spacing
        x = torch.minimum(unclamped.clamp_min(0.0), counts - 1.0001)
        beyond = unclamped - x
        excess = beyond.norm(dim=-1)
        cell = x.floor().long()
        f = x - cell
        step_x, step_y = counts[:, 1] * counts[:, 2], counts[:, 2]
        node = self.start[which] + cell[:, 0] * step_x + cell[:, 1] * step_y + cell[:, 2]
        corner = torch.stack((node, node + step_y, node + step_x, node + step_x + step_y), dim=-1)
        v = self.values[torch.stack((corner, corner + 1), dim=-1)].view(-1, 2, 2, 2)
        fx, fy, fz = (f[:, i].view(-1, *[1] * (2 - i)) for i in range(3))
        slope_x = v[:, 1] - v[:, 0]
        along_x = v[:, 0] + fx * slope_x  # [N, 2, 2]
        slope_y = along_x[:, 1] - along_x[:, 0]
        along_y = along_x[:, 0] + fy * slope_y  # [N, 2]
        slope_z = along_y[:, 1] - along_y[:, 0]
        slope_x = slope_x[:, 0] + fy * (slope_x[:, 1] - slope_x[:, 0])
        gradient = torch.stack(
            (
                slope_x[:, 0] + fz * (slope_x[:, 1] - slope_x[:, 0]),
                slope_y[:, 0] + fz * (slope_y[:, 1] - slope_y[:, 0]),
                slope_z,
            ),
            dim=-1,
        )
        gradient = torch.where(beyond == 0, gradient / self.spacing, beyond / excess[:, None].clamp_min(1e-12))
        return along_y[:, 0] + fz * slope_z + excess * self.spacing, gradient
