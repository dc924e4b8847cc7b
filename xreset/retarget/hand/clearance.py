"""Contacts of a hand: which of its balls come too near to the object, the table or each other, and how far a jaw's pads
are from the object.

Shape letters: B frames, G links with balls, A distances that count, H frames with a held object, N balls of pads, n
variables.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from xreset.geometry.balls import STAND_IN
from xreset.geometry.collision import height_above_table
from xreset.geometry.fields import DistanceFields
from xreset.geometry.rotations import matvec, quat_to_matrix
from xreset.retarget.hand.model import Bodies, HandModel
from xreset.tensors import Tensors


@dataclass(frozen=True, kw_only=True)
class Distances(Tensors):
    """Signed distances and how they change with the variables."""

    frame: Tensor
    """[A] frame of each distance."""
    value: Tensor
    """[A] distance less the allowed one [m]."""
    slope: Tensor
    """[A, n] derivative."""
    number: Tensor
    """[A] position within the frame; it fixes the order of sums, which shows in their last digits."""


class Objects(NamedTuple):
    """The object of every frame."""

    pos: Tensor
    """[B, 3]"""
    rot: Tensor
    """[B, 3, 3]"""
    which: Tensor
    """[B] index into the objects of ``fields``."""
    fields: DistanceFields

    @staticmethod
    def at(pos: Tensor, quat: Tensor, which: Tensor, fields: DistanceFields) -> Objects:
        """Return objects at positions [B, 3] and orientations [B, 4]."""
        return Objects(pos, quat_to_matrix(quat), which, fields)

    def local(self, points: Tensor, frame: Tensor) -> Tensor:
        """[..., 3] points in the mesh frame of the object of their frame [...]."""
        return matvec(self.rot[frame].mT, points - self.pos[frame])

    def signed_distance(self, points: Tensor, frame: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`DistanceFields.signed_distance`; points [N, 3] of frames [N] and gradients [N, 3] in the world."""
        distance, slope = self.fields.signed_distance(self.local(points, frame), self.which[frame])
        return distance, matvec(self.rot[frame], slope)

    def nearer(self, points: Tensor, frame: Tensor, limit: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """See :meth:`DistanceFields.nearer`; points [N, 3] of frames [N] and gradients [A, 3] in the world."""
        near, distance, slope = self.fields.nearer(self.local(points, frame), self.which[frame], limit)
        return near, distance, matvec(self.rot[frame[near]], slope)


def too_near(
    model: HandModel,
    bodies: Bodies,
    objects: Objects,
    considered: Tensor,
    object_clearance: float,
    self_depth: float,
) -> Distances:
    """Find balls too near to the object, below the table's top, or too deep in each other.

    One ball around each link rules most of them out.

    Args:
        model: the hand.
        bodies: its B configurations.
        objects: objects of the same frames.
        considered: [B] bool: the frames to look at.
        object_clearance: distance that balls keep from the object [m].
        self_depth: allowed depth of balls in other links [m].
    """
    bounds = bodies.pos[:, model.group_body] + matvec(bodies.rot[:, model.group_body], model.balls.bound_centers)
    found = (
        *_below_table(model, bodies, bounds, considered),
        *_in_object(model, bodies, bounds, objects, considered, object_clearance),
        *_in_each_other(model, bodies, bounds, considered, self_depth),
    )
    if not found:
        none = bounds.new_zeros(0, len(model.home) + 6)
        rows = none[:, 0].long()
        return Distances(frame=rows, value=none[:, 0], slope=none, number=rows)
    together = Distances.cat(found)
    order = together.number.argsort(stable=True)
    return together[order[together.frame[order].argsort(stable=True)]]


def _below_table(model: HandModel, bodies: Bodies, bounds: Tensor, considered: Tensor) -> Iterator[Distances]:
    balls = model.balls
    frames, links = ((bounds[..., 2] < balls.bound_radii) & considered[:, None]).nonzero(as_tuple=True)
    for position, ball in balls.spans.members(links):
        frame = frames[position]
        centers = model.ball_centers(bodies, frame, ball)
        height = height_above_table(centers, balls.radii[ball], model.table)
        below = height < 0
        frame = frame[below]
        ball = ball[below]
        centers = centers[below]
        up = centers.new_tensor([0.0, 0.0, 1.0]).expand_as(centers)
        slope = model.point_slope(bodies, frame, balls.link[ball], centers, up)
        yield Distances(frame=frame, value=height[below], slope=slope, number=ball)


def _in_object(
    model: HandModel,
    bodies: Bodies,
    bounds: Tensor,
    objects: Objects,
    considered: Tensor,
    object_clearance: float,
) -> Iterator[Distances]:
    balls = model.balls
    every = torch.arange(len(bounds), device=bounds.device)[:, None].expand(bounds.shape[:2])
    distance = objects.fields.box_distance(objects.local(bounds, every), objects.which[every])
    candidates = (distance < balls.bound_radii + object_clearance) & considered[:, None]
    frames, links = candidates.nonzero(as_tuple=True)
    for position, ball in balls.spans.members(links):
        frame = frames[position]
        centers = model.ball_centers(bodies, frame, ball)
        near, distance, direction = objects.nearer(centers, frame, balls.radii[ball] + object_clearance)
        frame = frame[near]
        ball = ball[near]
        slope = model.point_slope(bodies, frame, balls.link[ball], centers[near], direction)
        value = distance - balls.radii[ball] - object_clearance
        yield Distances(frame=frame, value=value, slope=slope, number=len(balls.radii) + ball)


def _in_each_other(
    model: HandModel,
    bodies: Bodies,
    bounds: Tensor,
    considered: Tensor,
    self_depth: float,
) -> Iterator[Distances]:
    balls = model.balls
    fields = balls.fields
    a, b = balls.link_pairs.unbind(1)
    reach = balls.bound_radii + STAND_IN - self_depth
    near = (bounds[:, a] - bounds[:, b]).norm(dim=-1) < reach[a] + balls.bound_radii[b]
    frame, pair = (near & considered[:, None]).nonzero(as_tuple=True)
    # The guards of the first link of a pair are looked at in the frame of the second.
    inverse = bodies.rot[frame, model.group_body[b[pair]]].mT
    origin = bodies.pos[frame, model.group_body[b[pair]]]
    middle = matvec(inverse, bounds[frame, a[pair]] - origin)
    near = fields.box_distance(middle, b[pair]) < reach[a[pair]]
    frame = frame[near]
    pair = pair[near]
    inverse = inverse[near]
    first = model.group_body[a[pair]]
    turn = inverse @ bodies.rot[frame, first]
    shift = matvec(inverse, bodies.pos[frame, first] - origin[near])

    for position, guard in balls.guard_spans.members(a[pair]):
        centers = matvec(turn[position], balls.centers[balls.guards[guard]]) + shift[position]
        limit = balls.guard_radii[guard] - self_depth
        deep, distance, away = fields.nearer(centers, b[pair[position]], limit)
        position = position[deep]
        guard = guard[deep]
        solid = b[pair[position]]
        ball = balls.guards[guard]
        row = frame[position]
        direction = matvec(bodies.rot[row, model.group_body[solid]], away)
        centers = model.ball_centers(bodies, row, ball)
        slope = model.point_slope(bodies, row, balls.link[ball], centers, direction)
        slope = slope - model.point_slope(bodies, row, solid, centers, direction)
        value = distance - balls.guard_radii[guard] + self_depth
        number = 2 * len(balls.radii) + pair[position] * len(balls.guards) + guard
        yield Distances(frame=row, value=value, slope=slope, number=number)


def pad_distances(model: HandModel, bodies: Bodies, objects: Objects, frame: Tensor) -> tuple[Tensor, Tensor]:
    """Compute how far a jaw's pads are from the object.

    Args:
        model: the hand.
        bodies: its configurations.
        objects: objects of the same frames.
        frame: [H] the frames to look at.

    Returns:
        Signed distances of the pads' balls [H, N] in m, and their derivatives [H, N, n].
    """
    count = len(model.pad_balls)
    ball = model.pad_balls.repeat(len(frame))
    frame = frame.repeat_interleave(count)
    centers = model.ball_centers(bodies, frame, ball)
    distance, direction = objects.signed_distance(centers, frame)
    slope = model.point_slope(bodies, frame, model.balls.link[ball], centers, direction)
    value = distance - model.balls.radii[ball]
    return value.view(-1, count), slope.view(-1, count, slope.shape[-1])
