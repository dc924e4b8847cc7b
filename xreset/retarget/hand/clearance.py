"""Distances of a hand's balls that are too near to the object, the table or each other, and of a jaw's pads from the
object.

Shape letters: B frames, G links with balls, A distances that count, H frames with a held object, N balls of pads, n
variables.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from xreset.files.checks import frozen
from xreset.geometry.balls import STAND_IN, members
from xreset.geometry.collision import height_above_table
from xreset.geometry.fields import DistanceFields
from xreset.geometry.rotations import matvec
from xreset.physics.tensors import Tensors
from xreset.retarget.hand.model import Bodies, HandModel


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


def too_near(
    model: HandModel,
    bodies: Bodies,
    objects: Objects,
    considered: Tensor,
    object_clearance: float,
    self_depth: float,
) -> Distances:
    """Find balls too near to the object, below the table's top, or too deep in each other.

    Boxes around the links exclude most links at once.

    Args:
        model: the hand.
        bodies: its B configurations.
        objects: objects of the same frames.
        considered: [B] bool: the frames to look at.
        object_clearance: distance that balls keep from the object [m].
        self_depth: allowed depth of balls in other links [m].
    """
    together = Distances.cat(
        (
            _below_table(model, bodies, considered),
            _at_object(model, bodies, objects, considered, object_clearance),
            _in_each_other(model, bodies, considered, self_depth),
        )
    )
    order = together.number.argsort(stable=True)
    return together[order[together.frame[order].argsort(stable=True)]]


def contact_distance(model: HandModel, bodies: Bodies, points: Tensor) -> Tensor:
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
            gaps.append(model.solids.signed_distance(local, index)[0])
        distance[:, keypoint] = torch.stack(gaps).amin(dim=0).abs()
    return distance


def _below_table(model: HandModel, bodies: Bodies, considered: Tensor) -> Distances:
    """Return the heights of balls that are below the table's top."""
    balls = model.balls
    rot = bodies.rot[:, model.group_body]
    middle = (bodies.pos[:, model.group_body] + matvec(rot, balls.middles))[..., 2]
    reach = (rot[:, :, 2].abs() * balls.half_sizes).sum(-1)
    frame, link = (considered[:, None] & (middle < reach)).nonzero(as_tuple=True)
    owner, ball = members(balls.first[link], balls.count[link])
    centers = model.ball_centers(bodies, frame[owner], ball)
    height = height_above_table(centers, balls.radii[ball], model.table)
    low = height < 0
    frame = frame[owner[low]]
    ball = ball[low]
    up = centers.new_tensor([0.0, 0.0, 1.0]).expand(len(ball), 3)
    body = model.group_body[balls.link[ball]]
    slope = bodies.slope(frame, centers[low], up, body)
    return Distances(frame=frame, value=height[low], slope=slope, number=ball)


def _at_object(
    model: HandModel, bodies: Bodies, objects: Objects, considered: Tensor, clearance: float
) -> Distances:
    """Return the distances of balls that are nearer to the object than ``clearance`` [m]."""
    balls = model.balls
    fields = objects.fields
    frame, link = considered[:, None].expand(-1, len(balls.links)).nonzero(as_tuple=True)
    body = model.group_body[link]
    inverse = objects.rot[frame].mT
    turn = inverse @ bodies.rot[frame, body]
    shift = matvec(inverse, bodies.pos[frame, body] - objects.pos[frame])
    meet = _boxes_meet(model, turn, shift, link, fields, objects.object_index[frame], clearance)
    frame = frame[meet]
    owner, ball = members(balls.first[link[meet]], balls.count[link[meet]])
    local = _placed(turn[meet], shift[meet], owner, balls.centers[ball])
    frame = frame[owner]
    near, distance, away = fields.nearer(
        local, objects.object_index[frame], balls.radii[ball] + clearance
    )
    frame = frame[near]
    ball = ball[near]
    direction = matvec(objects.rot[frame], away)
    centers = model.ball_centers(bodies, frame, ball)
    return Distances(
        frame=frame,
        value=distance - balls.radii[ball] - clearance,
        slope=bodies.slope(frame, centers, direction, model.group_body[balls.link[ball]]),
        number=len(balls.radii) + ball,
    )


def _in_each_other(
    model: HandModel, bodies: Bodies, considered: Tensor, self_depth: float
) -> Distances:
    """Return the distances of guards from the links that they must not enter."""
    balls = model.balls
    margin = STAND_IN - self_depth
    a, b = balls.link_pairs.unbind(1)
    middles = bodies.pos[:, model.group_body] + matvec(
        bodies.rot[:, model.group_body], balls.middles
    )
    reach = balls.half_sizes.norm(dim=-1)
    apart = (middles[:, a] - middles[:, b]).norm(dim=-1)
    near = apart < reach[a] + reach[b] + max(margin, 0.0) + model.solids.spacing[b]
    frame, pair = (near & considered[:, None]).nonzero(as_tuple=True)
    # The guards of the first link of a pair are looked at in the frame of the second.
    first = model.group_body[a]
    second = model.group_body[b]
    inverse = bodies.rot[frame, second[pair]].mT
    turn = inverse @ bodies.rot[frame, first[pair]]
    shift = matvec(inverse, bodies.pos[frame, first[pair]] - bodies.pos[frame, second[pair]])
    meet = _boxes_meet(model, turn, shift, a[pair], model.solids, b[pair], margin)
    frame = frame[meet]
    pair = pair[meet]
    owner, guard = members(balls.first_guard[a[pair]], balls.guard_count[a[pair]])
    ball = balls.guards[guard]
    local = _placed(turn[meet], shift[meet], owner, balls.centers[ball])
    near, distance, away = model.solids.nearer(
        local, b[pair[owner]], balls.guard_radii[guard] - self_depth
    )
    frame = frame[owner[near]]
    pair = pair[owner[near]]
    guard = guard[near]
    direction = matvec(bodies.rot[frame, second[pair]], away)
    centers = model.ball_centers(bodies, frame, ball[near])
    return Distances(
        frame=frame,
        value=distance - balls.guard_radii[guard] + self_depth,
        slope=bodies.slope(frame, centers, direction, first[pair], second[pair]),
        number=2 * len(balls.radii) + pair * len(balls.guards) + guard,
    )


def _placed(turn: Tensor, shift: Tensor, owner: Tensor, points: Tensor) -> Tensor:
    """[N, 3] points [N, 3] of frames ``owner`` [N], with rotations [K, 3, 3] and origins [K, 3]."""
    return matvec(turn.index_select(0, owner), points) + shift.index_select(0, owner)


def _boxes_meet(
    model: HandModel,
    turn: Tensor,
    shift: Tensor,
    link: Tensor,
    fields: DistanceFields,
    index: Tensor,
    margin: float,
) -> Tensor:
    """[K] whether the box around a link's balls may be nearer to the bounding box of a field than a margin.

    They are not if one of the six directions of their sides separates them (Gottschalk et al. 1996, OBBTree).

    Args:
        model: the hand.
        turn: [K, 3, 3] rotation of the link in the field's frame.
        shift: [K, 3] origin of the link in the field's frame.
        link: [K]
        fields: the fields.
        index: [K] the field.
        margin: distance [m].
    """
    half = model.balls.half_sizes[link] + max(margin, 0.0) + fields.spacing[index][:, None]
    low = fields.low[index]
    high = fields.high[index]
    field_half = (high - low) / 2
    between = matvec(turn, model.balls.middles[link]) + shift - (low + high) / 2
    extent = turn.abs()
    in_field = (between.abs() <= field_half + matvec(extent, half)).all(-1)
    in_link = (matvec(turn.mT, between).abs() <= half + matvec(extent.mT, field_half)).all(-1)
    return in_field & in_link


def pad_distances(
    model: HandModel, bodies: Bodies, objects: Objects, frame: Tensor
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
    slope = bodies.slope(frame, centers, direction, model.group_body[model.balls.link[ball]])
    value = distance - model.balls.radii[ball]
    return value.view(-1, count), slope.view(-1, count, slope.shape[-1])
