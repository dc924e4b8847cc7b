"""Distances of a hand's balls that are too near to the object, the table or each other, and of a jaw's pads from the
object.

Shape letters: B frames, G links with balls, A distances that count, H frames with a held object, N balls of pads, n
variables.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from xreset.files.checks import frozen
from xreset.geometry.balls import STAND_IN
from xreset.geometry.collision import height_above_table
from xreset.geometry.fields import DistanceFields
from xreset.geometry.kinematics import PointJacobian
from xreset.geometry.rotations import matvec
from xreset.physics.tensors import Tensors
from xreset.retarget.hand.model import HandModel


@frozen
class Distances(Tensors):
    """Signed distances and how they change with the variables."""

    frame: Tensor
    """[A] frame of each distance."""
    value: Tensor
    """[A] distance less the allowed one [m]."""
    slope: Tensor
    """[A, n] derivative."""
    number: Tensor
    """[A] rank within the frame. It fixes the order of sums, and so their last digits."""


class Objects(NamedTuple):
    """The object of every frame."""

    pos: Tensor
    """[B, 3]"""
    rot: Tensor
    """[B, 3, 3]"""
    object_index: Tensor
    """[B] index into the objects of ``fields``."""
    fields: DistanceFields

    def local(self, points: Tensor, frame: Tensor) -> Tensor:
        """[..., 3] points in the mesh frame of the object of their frame [...]."""
        return matvec(self.rot[frame].mT, points - self.pos[frame])

    def signed_distance(self, points: Tensor, frame: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`DistanceFields.signed_distance`; points [N, 3] of frames [N] and gradients [N, 3] in the world."""
        distance, slope = self.fields.signed_distance(
            self.local(points, frame), self.object_index[frame]
        )
        return distance, matvec(self.rot[frame], slope)

    def nearer(self, points: Tensor, frame: Tensor, limit: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """See :meth:`DistanceFields.nearer`; points [N, 3] of frames [N] and gradients [A, 3] in the world."""
        near, distance, slope = self.fields.nearer(
            self.local(points, frame), self.object_index[frame], limit
        )
        return near, distance, matvec(self.rot[frame[near]], slope)


def too_near(
    model: HandModel,
    bodies: PointJacobian,
    objects: Objects,
    considered: Tensor,
    object_clearance: float,
    self_depth: float,
) -> Distances:
    """Find balls too near to the object, below the table's top, or too deep in each other.

    A bounding ball around each link excludes most links at once.

    Args:
        model: the hand.
        bodies: its B configurations.
        objects: objects of the same frames.
        considered: [B] bool: the frames to look at.
        object_clearance: distance that balls keep from the object [m].
        self_depth: allowed depth of balls in other links [m].
    """
    balls = model.balls
    bounds = bodies.pos[:, model.group_body] + matvec(
        bodies.rot[:, model.group_body], balls.bound_centers
    )

    def below_table(centers: Tensor, frame: Tensor, radii: Tensor) -> tuple[Tensor, ...]:
        height = height_above_table(centers, radii, model.table)
        near = (height < 0).nonzero()[:, 0]
        up = centers.new_tensor([0.0, 0.0, 1.0]).expand(len(near), 3)
        return near, height[near], up

    over_table = considered[:, None] & (bounds[..., 2] < balls.bound_radii)
    found = (
        *_outside(model, bodies, over_table, below_table, 0),
        *_at_object(model, bodies, objects, considered, object_clearance),
        *_in_each_other(model, bodies, bounds, considered, self_depth),
    )
    together = Distances.cat(found)
    order = together.number.argsort(stable=True)
    return together[order[together.frame[order].argsort(stable=True)]]


def object_depth(model: HandModel, bodies: PointJacobian, objects: Objects) -> Tensor:
    """[B] largest depth of the hand's balls in the object [m], 0 outside it; arguments as of :func:`too_near`."""
    every = torch.ones(len(bodies.pos), dtype=torch.bool, device=bodies.pos.device)
    depth = bodies.pos.new_zeros(len(every))
    for found in _at_object(model, bodies, objects, every, 0.0):
        depth = depth.scatter_reduce(0, found.frame, -found.value, "amax")
    return depth


def contact_distance(model: HandModel, bodies: PointJacobian, points: Tensor) -> Tensor:
    """Return the distances between the hand and points that its keypoints should touch.

    Args:
        model: the hand.
        bodies: its B configurations.
        points: [B, P, 3] a point for each mapped keypoint.

    Returns:
        [B, P] distance of the surface of the keypoint's link, with the links fixed to it, from the point [m], on either
        side of the surface. Of the link's origin where the link has no shapes.
    """
    origins = bodies.pos[:, model.keypoint_body]
    distance = (points - origins).norm(dim=-1)
    for keypoint, links in enumerate(model.keypoint_groups):
        if not links:
            continue
        gaps = []
        for link in links:
            body = model.group_body[link]
            local = matvec(bodies.rot[:, body].mT, points[:, keypoint] - bodies.pos[:, body])
            index = torch.full((len(local),), link, device=local.device)
            gaps.append(model.balls.fields.signed_distance(local, index)[0])
        distance[:, keypoint] = torch.stack(gaps).amin(dim=0).abs()
    return distance


def _at_object(
    model: HandModel,
    bodies: PointJacobian,
    objects: Objects,
    considered: Tensor,
    clearance: float,
) -> Iterator[Distances]:
    """Yield the distances of each link's balls that are nearer to the object than ``clearance`` [m]."""
    balls = model.balls
    bounds = bodies.pos[:, model.group_body] + matvec(
        bodies.rot[:, model.group_body], balls.bound_centers
    )
    every = torch.arange(len(bounds), device=bounds.device)[:, None].expand(bounds.shape[:2])
    from_box = objects.fields.box_distance(
        objects.local(bounds, every), objects.object_index[every]
    )

    def in_object(centers: Tensor, frame: Tensor, radii: Tensor) -> tuple[Tensor, ...]:
        near, distance, direction = objects.nearer(centers, frame, radii + clearance)
        return near, distance - radii[near] - clearance, direction

    candidates = considered[:, None] & (from_box < balls.bound_radii + clearance)
    yield from _outside(model, bodies, candidates, in_object, len(balls.radii))


def _moved(rot: Tensor, pos: Tensor, points: Tensor) -> Tensor:
    """[B N, 3] points [N, 3] in each of the poses rot [B, 3, 3], pos [B, 3]."""
    return (points @ rot.mT + pos[:, None]).flatten(0, 1)


def _outside(
    model: HandModel,
    bodies: PointJacobian,
    candidates: Tensor,
    measure: Callable[[Tensor, Tensor, Tensor], tuple[Tensor, ...]],
    first: int,
) -> Iterator[Distances]:
    """Yield the distances of each link's balls from something outside the hand.

    Args:
        model: the hand.
        bodies: its B configurations.
        candidates: [B, G] the links that may be too near.
        measure: returns the indices of the balls that are too near, their distances, and the directions away from the
            other body, given centers [N, 3], frames [N] and radii [N] of balls.
        first: number of the first ball.
    """
    balls = model.balls
    for link, own in enumerate(balls.slices):
        frames = candidates[:, link].nonzero()[:, 0]
        body = model.group_body[link]
        radii = balls.radii[own]
        centers = _moved(bodies.rot[frames, body], bodies.pos[frames, body], balls.centers[own])
        frame = frames.repeat_interleave(len(radii))
        near, value, direction = measure(centers, frame, radii.repeat(len(frames)))
        frame = frame[near]
        slope = model.point_slope(bodies, frame, body, centers[near], direction)
        number = first + own.start + near % len(radii)
        yield Distances(frame=frame, value=value, slope=slope, number=number)


def _in_each_other(
    model: HandModel,
    bodies: PointJacobian,
    bounds: Tensor,
    considered: Tensor,
    self_depth: float,
) -> Iterator[Distances]:
    """Yield the distances of each link's guards from the links that they must not enter."""
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

    for link, own in enumerate(balls.guard_slices):
        mine = (a[pair] == link).nonzero()[:, 0]
        body = model.group_body[link]
        guards = balls.guards[own]
        radii = balls.guard_radii[own]
        centers = _moved(turn[mine], shift[mine], balls.centers[guards])
        limit = (radii - self_depth).repeat(len(mine))
        deep, distance, away = fields.nearer(
            centers, b[pair[mine]].repeat_interleave(len(radii)), limit
        )
        mine = mine[deep.div(len(radii), rounding_mode="floor")]
        guard = deep % len(radii)
        solid = model.group_body[b[pair[mine]]]
        row = frame[mine]
        direction = matvec(bodies.rot[row, solid], away)
        centers = model.ball_centers(bodies, row, guards[guard])
        slope = model.point_slope(bodies, row, body, centers, direction)
        slope = slope - model.point_slope(bodies, row, solid, centers, direction)
        value = distance - radii[guard] + self_depth
        number = 2 * len(balls.radii) + pair[mine] * len(balls.guards) + own.start + guard
        yield Distances(frame=row, value=value, slope=slope, number=number)


def pad_distances(
    model: HandModel, bodies: PointJacobian, objects: Objects, frame: Tensor
) -> tuple[Tensor, Tensor]:
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
    slope = model.point_slope(
        bodies, frame, model.group_body[model.balls.link[ball]], centers, direction
    )
    value = distance - model.balls.radii[ball]
    return value.view(-1, count), slope.view(-1, count, slope.shape[-1])
