"""What a hand meets: which of its balls come too near to the object, the table or each other.

Shape letters: B frames, G links with balls, A things found, n variables.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from xreset.geometry.balls import STAND_IN
from xreset.geometry.collision import height_above_table
from xreset.geometry.fields import DistanceFields
from xreset.geometry.rotations import quat_to_matrix
from xreset.retarget.hand.model import Bodies, HandModel
from xreset.tensors import Tensors


@dataclass(frozen=True, kw_only=True)
class Distances(Tensors):
    """Signed distances and how they change with the variables."""

    frame: Tensor
    """[A] the frame of each."""
    value: Tensor
    """[A] less what is allowed [m]."""
    slope: Tensor
    """[A, n] derivative."""
    number: Tensor
    """[A] place among those of its frame: the order of a sum shows in its last digits."""


@dataclass(frozen=True, kw_only=True)
class Objects:
    """The object of every frame."""

    pos: Tensor
    """[B, 3]"""
    rot: Tensor
    """[B, 3, 3]"""
    index: Tensor
    """[B] among the objects of ``fields``."""
    fields: DistanceFields

    @staticmethod
    def at(pos: Tensor, quat: Tensor, index: Tensor, fields: DistanceFields) -> Objects:
        """Objects at positions [B, 3] and orientations [B, 4]."""
        return Objects(pos=pos, rot=quat_to_matrix(quat), index=index, fields=fields)

    def local(self, points: Tensor, frame: Tensor) -> Tensor:
        """[..., 3] points in the mesh frame of the object of their frame [...]."""
        return (self.rot[frame].mT @ (points - self.pos[frame])[..., None])[..., 0]

    def signed_distance(self, points: Tensor, frame: Tensor) -> tuple[Tensor, Tensor]:
        """As :meth:`DistanceFields.signed_distance`, of points [N, 3] in frames [N] and with gradients [N, 3] in the world."""
        distance, slope = self.fields.signed_distance(self.local(points, frame), self.index[frame])
        return distance, (self.rot[frame] @ slope[..., None])[..., 0]

    def nearer(self, points: Tensor, frame: Tensor, than: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """As :meth:`DistanceFields.nearer`, of points [N, 3] and with gradients [A, 3] in the world."""
        near, distance, slope = self.fields.nearer(self.local(points, frame), self.index[frame], than)
        return near, distance, (self.rot[frame[near]] @ slope[..., None])[..., 0]


def too_near(
    model: HandModel, bodies: Bodies, objects: Objects, considered: Tensor, object_clearance: float, self_depth: float
) -> Distances:
    """Balls nearer to the object than ``object_clearance``, below the table's top, or deeper in each other than ``self_depth`` [m].

    Links are told apart by one ball about each, then by one about each cluster of their balls, before those are looked at.

    Args:
        bodies: its B configurations.
        objects: of the same frames.
        considered: [B] bool: other frames are left out.
        object_clearance: [m]
        self_depth: [m]
    """
    bounds = (
        bodies.pos[:, model.group_body]
        + (bodies.rot[:, model.group_body] @ model.balls.bound_centers[..., None])[..., 0]
    )  # [B, G, 3]
    found = (
        *_below_table(model, bodies, bounds, considered),
        *_in_object(model, bodies, bounds, objects, considered, object_clearance),
        *_in_each_other(model, bodies, bounds, considered, self_depth),
    )
    if not found:
        none = bounds.new_zeros(0, len(model.home) + 6)
        return Distances(frame=none[:, 0].long(), value=none[:, 0], slope=none, number=none[:, 0].long())
    together = Distances.cat(found)
    order = together.number.argsort(stable=True)
    return together[order[together.frame[order].argsort(stable=True)]]


def _below_table(model: HandModel, bodies: Bodies, bounds: Tensor, considered: Tensor) -> Iterator[Distances]:
    candidate, group = ((bounds[..., 2] < model.balls.bound_radii) & considered[:, None]).nonzero(as_tuple=True)
    for frame, ball in _near_balls(
        model, bodies, candidate, group, lambda centers, _, than: (centers[:, 2] < than).nonzero()[:, 0], 0.0
    ):
        centers = model.ball_centers(bodies, frame, ball)
        value = height_above_table(centers, model.balls.radii[ball], model.table)
        low = value < 0
        up = torch.tensor([0.0, 0.0, 1.0], dtype=centers.dtype, device=centers.device).expand(int(low.sum()), 3)
        slope = model.point_slope(bodies, frame[low], model.balls.link[ball[low]], centers[low], up)
        yield Distances(frame=frame[low], value=value[low], slope=slope, number=ball[low])


def _in_object(
    model: HandModel, bodies: Bodies, bounds: Tensor, objects: Objects, considered: Tensor, object_clearance: float
) -> Iterator[Distances]:
    every = torch.arange(len(bounds), device=bounds.device)[:, None].expand(bounds.shape[:2])
    beside = objects.fields.box_distance(objects.local(bounds, every), objects.index[every])
    candidate, group = ((beside < model.balls.bound_radii + object_clearance) & considered[:, None]).nonzero(
        as_tuple=True
    )
    margin = object_clearance + objects.fields.spacing
    for frame, ball in _near_balls(
        model, bodies, candidate, group, lambda *cluster: objects.nearer(*cluster)[0], margin
    ):
        centers = model.ball_centers(bodies, frame, ball)
        near, distance, direction = objects.nearer(centers, frame, model.balls.radii[ball] + object_clearance)
        frame, ball, centers = frame[near], ball[near], centers[near]
        slope = model.point_slope(bodies, frame, model.balls.link[ball], centers, direction)
        value = distance - model.balls.radii[ball] - object_clearance
        yield Distances(frame=frame, value=value, slope=slope, number=len(model.balls.radii) + ball)


def _near_balls(
    model: HandModel,
    bodies: Bodies,
    frame: Tensor,
    group: Tensor,
    nearer: Callable[[Tensor, Tensor, Tensor], Tensor],
    margin: float,
) -> Iterator[tuple[Tensor, Tensor]]:
    """Frames [A] and balls [A] of links [C] in frames [C] whose cluster is nearer to something than ``margin`` [m].

    Args:
        frame: [C]
        group: [C] among the links with balls.
        nearer: which of points [K, 3] in frames [K] are nearer to it than [K]: their indices.
        margin: [m]; for distances from a grid one step of it more, which is as far as they may be wrong beside an edge.
    """
    clusters = model.balls.clusters
    for asking, cluster in clusters.of_link.members(group):
        row, body = frame[asking], model.group_body[group[asking]]
        centers = bodies.pos[row, body] + (bodies.rot[row, body] @ clusters.centers[cluster][..., None])[..., 0]
        near = nearer(centers, row, clusters.radii[cluster] + margin)
        for within, ball in clusters.members(cluster[near]):
            yield row[near][within], ball


def _in_each_other(
    model: HandModel, bodies: Bodies, bounds: Tensor, considered: Tensor, self_depth: float
) -> Iterator[Distances]:
    balls, fields, clusters = model.balls, model.balls.fields, model.balls.guard_clusters
    a, b = balls.link_pairs.unbind(1)
    first, second, reach = model.group_body[a], model.group_body[b], balls.bound_radii + STAND_IN - self_depth
    near = (bounds[:, a] - bounds[:, b]).norm(dim=-1) < reach[a] + balls.bound_radii[b]
    candidate, pair = (near & considered[:, None]).nonzero(as_tuple=True)
    inverse = bodies.rot[candidate, second[pair]].mT
    middle = (inverse @ (bounds[candidate, a[pair]] - bodies.pos[candidate, second[pair]])[..., None])[..., 0]
    near = fields.box_distance(middle, b[pair]) < reach[a[pair]]
    candidate, pair, inverse = candidate[near], pair[near], inverse[near]
    turn = inverse @ bodies.rot[candidate, first[pair]]
    shift = (inverse @ (bodies.pos[candidate, first[pair]] - bodies.pos[candidate, second[pair]])[..., None])[..., 0]

    def local(asking: Tensor, points: Tensor) -> Tensor:
        return (turn[asking] @ points[..., None])[..., 0] + shift[asking]

    for asking, cluster in clusters.of_link.members(a[pair]):
        centers, solid = local(asking, clusters.centers[cluster]), b[pair[asking]]
        margin = clusters.radii[cluster] - self_depth + fields.spacing
        close, *_ = fields.nearer(centers, solid, margin)
        asking, cluster = asking[close], cluster[close]
        for within, guard in clusters.members(cluster):
            owner = asking[within]
            ball, radius, solid = balls.guards[guard], balls.guard_radii[guard], b[pair[owner]]
            deep, distance, away = fields.nearer(local(owner, balls.centers[ball]), solid, radius - self_depth)
            owner, ball, solid, guard = owner[deep], ball[deep], solid[deep], guard[deep]
            value = distance - radius[deep] + self_depth
            frame = candidate[owner]
            direction = (bodies.rot[frame, model.group_body[solid]] @ away[..., None])[..., 0]
            centers = model.ball_centers(bodies, frame, ball)
            slope = model.point_slope(bodies, frame, balls.link[ball], centers, direction)
            slope = slope - model.point_slope(bodies, frame, solid, centers, direction)
            number = 2 * len(balls.radii) + pair[owner] * len(balls.guards) + guard
            yield Distances(frame=frame, value=value, slope=slope, number=number)
