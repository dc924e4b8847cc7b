"""A hand as balls: what keeps it out of the object, the table and itself while it is being retargeted.

Balls make distances and their derivatives cheap over whole trajectories. They are exact for capsules and spheres, and inscribed in other
shapes; smaller ones lie under the surface that those do not reach, and balls of radius 0 stand for edges and corners. What they miss is
for the exact checks that follow (coal, then physics).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence, Sized
from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
from scipy.spatial import ConvexHull
from torch import Tensor

from xreset.geometry.collision import SelfCollision, support_points
from xreset.geometry.fields import DistanceFields
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.shapes import half_spaces, shape_mesh
from xreset.geometry.solids import link_field
from xreset.spec import Geometry, RobotSpec, Shape
from xreset.tensors import Tensors

SPACING = 4e-3
"""[m] Balls need not be closer to each other than this, however thin the shape: from 2.8 mm on they leave no hole, and thinner ones lack no
more than their own thickness."""
BARE = 2.5e-3
"""[m] Where a shape's surface is farther than this from the balls that fill it, smaller ones lie under it. A box of 5 x 14 x 4 cm is bare
up to 8 mm deep near its edges: enough for a banana."""
APART = 6e-3
"""[m] Balls of one link that keep out of others are no nearer to each other."""
STAND_IN = 3.5e-3
"""[m] Such a ball is that much larger where others are left out for it. Edges that cross between two balls are deeper in each other than
any ball, and the exact test takes how far two shapes must be moved to part: with this the LEAP hand loses 1 % of its frames to that test,
without it 90 %."""

_CLUSTER = 16
"""Most balls that are ruled out together, by a ball about them."""
_INWARD = 8
"""Steps by which a point of a surface moves inwards from one face after the other."""
_ROWS = {"cpu": 200_000, "cuda": 8_000_000}
"""Balls looked at in one go: on a CPU what fits its caches."""


@dataclass(frozen=True, kw_only=True)
class Spans(Tensors):
    """Groups of consecutive rows of a table (G in number)."""

    start: Tensor
    """[G] first row of each group."""
    count: Tensor
    """[G] number of its rows."""

    @staticmethod
    def of(parts: Sequence[Sized]) -> Spans:
        """Of groups whose members follow one another."""
        counts = torch.tensor([len(part) for part in parts], dtype=torch.long)
        return Spans(start=counts.cumsum(0) - counts, count=counts)

    def members(self, groups: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """All rows of some groups [C], in pieces that bound the memory: for each row, the place [A] in ``groups`` that asks for it,
        ascending, and the row [A] itself."""
        counts = self.count[groups]
        ends = counts.cumsum(0)
        piece = (ends - 1).div(_ROWS[groups.device.type], rounding_mode="floor")
        for places in torch.arange(len(groups), device=groups.device).split(
            torch.unique_consecutive(piece, return_counts=True)[1].tolist()
        ):
            asking = torch.repeat_interleave(places, counts[places])
            within = (
                torch.arange(len(asking), device=groups.device) - (ends - counts)[asking] + (ends - counts)[places[0]]
            )
            yield asking, self.start[groups][asking] + within


@dataclass(frozen=True, kw_only=True)
class Clusters(Tensors):
    """Rows of a table that lie near each other, with a ball about each such cluster (K in number): what is far from it is far from all."""

    centers: Tensor
    """[K, 3] in the link's frame."""
    radii: Tensor
    """[K]"""
    of_link: Spans
    """[G] the clusters of each link."""
    spans: Spans
    """[K] the places of each cluster's rows in ``rows``."""
    rows: Tensor
    """Rows of the table, cluster after cluster."""

    @staticmethod
    def of(centers: Sequence[np.ndarray], radii: Sequence[np.ndarray]) -> Clusters:
        """Clusters of balls, given by link: centres [n, 3] in its frame and radii [n] of rows that follow one another."""
        parts = [_halved(own) for own in centers]
        first = np.cumsum([0, *map(len, radii)])
        rows = [part + start for own, start in zip(parts, first, strict=False) for part in own]
        balls = [
            bounding_ball(c[part], r[part]) for c, r, own in zip(centers, radii, parts, strict=True) for part in own
        ]
        return Clusters(
            centers=torch.as_tensor(np.array([middle for middle, _ in balls]).reshape(-1, 3)),
            radii=torch.as_tensor(np.array([radius for _, radius in balls])),
            of_link=Spans.of(parts),
            spans=Spans.of(rows),
            rows=torch.as_tensor(np.concatenate([np.zeros(0, dtype=np.int64), *rows])),
        )

    def members(self, clusters: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """All rows of some clusters [C], as :meth:`Spans.members` has them."""
        for asking, place in self.spans.members(clusters):
            yield asking, self.rows[place]


@dataclass(frozen=True, kw_only=True)
class Balls(Tensors):
    """Balls fixed to the links of a hand, and those links as solids that the balls of others stay out of: Q balls on G links."""

    links: tuple[str, ...]
    """The links that carry balls (length G)."""
    clusters: Clusters
    """Of the balls."""
    link: Tensor
    """[Q] each ball's link, as an index of ``links``: ascending."""
    centers: Tensor
    """[Q, 3] in the link's frame."""
    radii: Tensor
    """[Q]"""
    bound_centers: Tensor
    """[G, 3] centre, in the link's frame, of a ball about all of the link's balls."""
    bound_radii: Tensor
    """[G]"""
    guards: Tensor
    """[R] the balls that keep out of other links, none nearer than :data:`APART` to another of its link."""
    guard_radii: Tensor
    """[R] their radii there: larger where they stand for others."""
    guard_clusters: Clusters
    """Of the guards."""
    fields: DistanceFields
    """Signed distances to the G links, in their frames."""
    link_pairs: Tensor
    """[H, 2] pairs of links, as indices of ``links``: the guards of the first keep out of the second. Each pair is there both ways."""


def hand_balls(robot: RobotSpec, hand: Kinematics, collision: SelfCollision) -> Balls:
    """The balls of a hand.

    Args:
        robot: the robot.
        hand: kinematics of its hand.
        collision: decides which links must not overlap.
    """
    links = [name for name in hand.link_names if hand.tree.link(name).collisions]
    balls = [
        [np.concatenate(part) for part in zip(*map(shape_balls, hand.tree.link(name).collisions), strict=True)]
        for name in links
    ]
    centers, radii = [part[0] for part in balls], [part[1] for part in balls]
    guards = [_apart(c, r, APART) for c, r in zip(centers, radii, strict=True)]
    stand_in = [_near_others(c, g) for c, g in zip(centers, guards, strict=True)]
    guard_radii = [r[g] + STAND_IN * s for r, g, s in zip(radii, guards, stand_in, strict=True)]
    first = np.cumsum([0, *map(len, radii)])
    bounds = [bounding_ball(c, r) for c, r in zip(centers, radii, strict=True)]
    named = [(hand.link_names[a], hand.link_names[b]) for a, b in collision.link_pairs]
    link_pairs = [(links.index(a), links.index(b)) for a, b in named if {a, b} <= set(links)]
    return Balls(
        links=tuple(links),
        clusters=Clusters.of(centers, radii),
        link=torch.repeat_interleave(
            torch.arange(len(links)), torch.tensor([len(part) for part in radii], dtype=torch.long)
        ),
        centers=torch.as_tensor(np.concatenate([np.zeros((0, 3)), *centers])),
        radii=torch.as_tensor(np.concatenate([np.zeros(0), *radii])),
        bound_centers=torch.as_tensor(np.array([middle for middle, _ in bounds]).reshape(-1, 3)),
        bound_radii=torch.as_tensor(np.array([radius for _, radius in bounds])),
        guards=torch.as_tensor(
            np.concatenate([np.zeros(0, dtype=np.int64), *(g + f for g, f in zip(guards, first, strict=False))])
        ),
        guard_radii=torch.as_tensor(np.concatenate([np.zeros(0), *guard_radii])),
        guard_clusters=Clusters.of([c[g] for c, g in zip(centers, guards, strict=True)], guard_radii),
        fields=DistanceFields.join([link_field(hand.tree.link(name).collisions) for name in links]),
        link_pairs=torch.as_tensor(
            np.array([*link_pairs, *((b, a) for a, b in link_pairs)], dtype=np.int64).reshape(-1, 2)
        ),
    )


def bounding_ball(centers: np.ndarray, radii: np.ndarray) -> tuple[np.ndarray, float]:
    """A ball about balls at centres [n, 3] of radii [n]: its centre, the middle of the box about theirs, and its radius."""
    middle = (centers.max(axis=0) + centers.min(axis=0)) / 2
    return middle, float((np.linalg.norm(centers - middle, axis=1) + radii).max())


def _halved(centers: np.ndarray) -> list[np.ndarray]:
    """Some points [n, 3], halved across their longest side until no part has more than :data:`_CLUSTER`: those of each part, ascending."""
    parts, todo = [], [np.arange(len(centers))] if len(centers) else []
    while todo:
        part = todo.pop()
        if len(part) <= _CLUSTER:
            parts.append(part)
            continue
        along = centers[part][:, np.ptp(centers[part], axis=0).argmax()].argsort(kind="stable")
        todo += [np.sort(part[along[len(part) // 2 :]]), np.sort(part[along[: len(part) // 2]])]
    return parts


def _apart(centers: np.ndarray, radii: np.ndarray, spacing: float) -> np.ndarray:
    """Which of some balls, the largest first, are farther from each other than ``spacing``; ascending."""
    kept: list[int] = []
    for ball in np.argsort(-radii, kind="stable").tolist():
        if not kept or np.linalg.norm(centers[kept] - centers[ball], axis=1).min() > spacing:
            kept.append(ball)
    return np.sort(np.array(kept, dtype=np.int64))


def _near_others(centers: np.ndarray, guards: np.ndarray) -> np.ndarray:
    """[R] whether another of the balls at centres [n, 3] is nearer than :data:`APART` to each of some of them."""
    return np.array(
        [(np.linalg.norm(centers - centers[ball], axis=1) <= APART).sum() > 1 for ball in guards], dtype=bool
    )


def inscribed_balls(geometry: Geometry) -> tuple[np.ndarray, float]:
    """Balls inside a shape that fill it well: centres [n, 3] in the shape's frame and their radius.

    A capsule or a long cylinder gets a row along its axis, a sphere itself. A box gets layers of balls as thick as its thinnest side, as
    far apart as their radius or :data:`SPACING`; so does a flat cylinder, through the square in its rim, and a hull, through the box about
    it shrunk to the hull's volume.
    """
    if geometry.kind == "sphere":
        return np.zeros((1, 3)), geometry.size[0]
    if geometry.kind == "capsule" or (geometry.kind == "cylinder" and geometry.size[1] >= geometry.size[0]):
        radius, half = geometry.size
        return _grid((0.0, 0.0, half if geometry.kind == "capsule" else half - radius), radius), radius
    if geometry.kind == "cylinder":
        radius, half = geometry.size
        center, sides = np.zeros(3), np.array((radius * 0.5**0.5, radius * 0.5**0.5, half))
    elif geometry.kind == "box":
        center, sides = np.zeros(3), np.array(geometry.size)
    else:
        points, _ = support_points(geometry)
        low, high = points.min(axis=0), points.max(axis=0)
        center, sides = (
            (low + high) / 2,
            (high - low) / 2 * (ConvexHull(points).volume / np.prod(high - low)) ** (1 / 3),
        )
    radius = float(sides.min())
    return center + _grid(tuple(sides - radius), radius), radius


def sharp_points(geometry: Geometry, spacing: float) -> np.ndarray:
    """[n, 3] points where a shape stands out of balls in it: a box's edges, a cylinder's rims, a hull's vertices; none for round shapes."""
    points, radius = support_points(geometry)
    if radius > 0:
        return np.zeros((0, 3))
    if geometry.kind != "box":
        return points
    edges = []
    for axis, half in enumerate(geometry.size):
        along = np.linspace(-half, half, int(np.ceil(2 * half / spacing)) + 1)
        for corner in points[points[:, axis] > 0]:
            edge = np.repeat(corner[None], len(along), axis=0)
            edge[:, axis] = along
            edges.append(edge)
    return np.unique(np.concatenate(edges), axis=0)


def shell_balls(geometry: Geometry, centers: np.ndarray, radius: float) -> tuple[np.ndarray, float]:
    """Balls under the surface of a shape where it is farther than :data:`BARE` from those of a radius about given centres [m, 3]: centres
    [n, 3] and their radius, with which they come that near to a right-angled edge."""
    from trimesh.remesh import subdivide_to_size

    small = BARE / (2**0.5 - 1)
    if geometry.kind in ("sphere", "capsule") or radius <= small:
        return np.zeros((0, 3)), small
    shape = Shape(geometry=geometry)
    mesh, planes = shape_mesh(shape), half_spaces(shape)
    surface = np.unique(subdivide_to_size(mesh.vertices, mesh.faces, SPACING)[0].round(9), axis=0)
    bare = surface[np.linalg.norm(surface[:, None] - centers, axis=-1).min(axis=-1) > radius + BARE]
    for _ in range(_INWARD):  # from the surface to where the ball lies inside
        beyond = np.maximum(bare @ planes[:, :3].T + planes[:, 3] + small, 0.0)
        worst = beyond.argmax(axis=1)
        bare = bare - beyond.max(axis=1)[:, None] * planes[worst, :3]
    bare = np.unique(bare[(bare @ planes[:, :3].T + planes[:, 3]).max(axis=1) < -0.9 * small].round(6), axis=0)
    return bare[_apart(bare, np.zeros(len(bare)), small)], small


def shape_balls(shape: Shape) -> tuple[np.ndarray, np.ndarray]:
    """Balls of one shape: centres [n, 3] in the link's frame and radii [n]."""
    inner, radius = inscribed_balls(shape.geometry)
    shell, small = shell_balls(shape.geometry, inner, radius)
    sharp = sharp_points(shape.geometry, max(min(radius, small), SPACING))
    points = np.concatenate((inner, shell, sharp)) @ shape.T_body_shape[:3, :3].T + shape.T_body_shape[:3, 3]
    return points, np.concatenate(
        [np.full(len(part), r) for part, r in ((inner, radius), (shell, small), (sharp, 0.0))]
    )


def _grid(half: tuple[float, ...], radius: float) -> np.ndarray:
    """[n, 3] an even grid over [-half, half] with steps of at most the radius or :data:`SPACING`."""
    step = max(radius, SPACING)
    rows = [np.linspace(-h, h, int(np.ceil(2 * h / step - 1e-9)) + 1) if h > 0 else np.zeros(1) for h in half]
    return np.array(list(product(*rows)))
