"""A hand as balls: what keeps it out of the object, the table and itself while it is being retargeted.

Balls make distances and their derivatives cheap over whole trajectories. They are exact for capsules and spheres, and inscribed in other
shapes; smaller ones lie under the surface that those do not reach, and balls of radius 0 stand for edges and corners. What they miss is
for the exact checks that follow (coal, then physics).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np
import torch
from scipy.spatial import ConvexHull
from torch import Tensor

from xreset.geometry.collision import SelfCollision, support_points
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.shapes import half_spaces, hull, shape_mesh
from xreset.spec import Geometry, RobotSpec, Shape
from xreset.tensors import Tensors

SPACING = 4e-3
"""[m] Balls need not be closer to each other than this, however thin the shape: from 2.8 mm on they leave no hole, and thinner ones lack no
more than their own thickness."""
BARE = 2.5e-3
"""[m] Where a shape's surface is farther than this from the balls that fill it, smaller ones lie under it. A box of 5 x 14 x 4 cm is bare
up to 8 mm deep near its edges: enough for a banana."""
MAX_PAIRS = 6000
"""Pairs of balls of one hand at most. Beyond, balls that fill each link's hull stand for its shapes where the hand is kept out of itself,
and large ones for their neighbours; what that misses is for the exact check that follows."""

_INWARD = 8
"""Steps by which a point of a surface moves inwards from one face after the other."""
_SURFACE_SAMPLES = 8
"""Points on every triangle of a hull."""
_COVERED = 0.9
"""Share of them that balls which stand for the hull cover: the rest are its corners."""


@dataclass(frozen=True, kw_only=True)
class Spans(Tensors):
    """Groups of consecutive rows of a table (G in number)."""

    start: Tensor
    """[G] first row of each group."""
    count: Tensor
    """[G] number of its rows."""

    def members(self, groups: Tensor) -> tuple[Tensor, Tensor]:
        """All rows of some groups [C]: for each row, the place [A] in ``groups`` that asks for it, ascending, and the row [A] itself."""
        counts = self.count[groups]
        asking = torch.repeat_interleave(torch.arange(len(groups), device=groups.device), counts)
        within = torch.arange(len(asking), device=groups.device) - (counts.cumsum(0) - counts)[asking]
        return asking, self.start[groups][asking] + within


@dataclass(frozen=True, kw_only=True)
class Balls(Tensors):
    """Balls fixed to the links of a hand: Q balls on G links, which R pairs of balls on H pairs of links must not overlap."""

    links: tuple[str, ...]
    """The links that carry balls (length G)."""
    spans: Spans
    """[G] the balls of each link."""
    link: Tensor
    """[Q] each ball's link, as an index of ``links``: ascending, and then those of the balls that only stand in pairs."""
    centers: Tensor
    """[Q, 3] in the link's frame."""
    radii: Tensor
    """[Q]"""
    bound_centers: Tensor
    """[G, 3] centre, in the link's frame, of a ball about all of the link's balls."""
    bound_radii: Tensor
    """[G]"""
    link_pairs: Tensor
    """[H, 2] pairs of links, as indices of ``links``."""
    pair_spans: Spans
    """[H] the pairs of balls of each pair of links."""
    pairs: Tensor
    """[R, 2] balls, of a radius above 0, that must not overlap each other."""
    spacing: float
    """[m] Balls that lie so near a larger one are in no pair; 0: all are."""


def hand_balls(robot: RobotSpec, hand: Kinematics, collision: SelfCollision) -> Balls:
    """The balls of a hand.

    Args:
        robot: the robot.
        hand: kinematics of its hand.
        collision: decides which links must not overlap.
    """
    links: list[str] = []
    centers: list[np.ndarray] = []
    radii: list[np.ndarray] = []
    fills: list[np.ndarray] = []
    for name in hand.link_names:
        shapes = hand.tree.link(name).collisions
        if not shapes:
            continue
        links.append(name)
        parts = zip(*(shape_balls(shape) for shape in shapes), strict=True)
        for values, part in zip((centers, radii, fills), parts, strict=True):
            values.append(np.concatenate(part))
    counts = np.array([len(part) for part in radii], dtype=np.int64)
    owner = np.repeat(np.arange(len(links)), counts)
    radius = np.concatenate([np.zeros(0), *radii])
    middles = np.array([(part.max(axis=0) + part.min(axis=0)) / 2 for part in centers]).reshape(-1, 3)
    reach = np.array([(np.linalg.norm(c - m, axis=1) + r).max() for c, m, r in zip(centers, middles, radii, strict=True)])

    named = [(hand.link_names[a], hand.link_names[b]) for a, b in collision.link_pairs]
    candidates = [(links.index(a), links.index(b)) for a, b in named if {a, b} <= set(links)]
    inside = np.concatenate([np.zeros(0, dtype=bool), *fills])
    solid = [np.flatnonzero((owner == g) & inside) for g in range(len(links))]
    spacing, all_centers = 0.0, np.concatenate([np.zeros((0, 3)), *centers])
    standing = solid
    if sum(len(standing[a]) * len(standing[b]) for a, b in candidates) > MAX_PAIRS:
        filled = [filling(hand.tree.link(name).collisions) for name in links]
        first = np.cumsum([len(all_centers), *(len(points) for points, _ in filled)])
        solid = standing = [np.arange(a, b) for a, b in pairwise(first)]
        all_centers = np.concatenate([all_centers, *(points for points, _ in filled)])
        radius = np.concatenate([radius, *(radii for _, radii in filled)])
        owner = np.concatenate([owner, np.repeat(np.arange(len(links)), [len(points) for points, _ in filled])])
    while sum(len(standing[a]) * len(standing[b]) for a, b in candidates) > MAX_PAIRS:
        spacing = max(SPACING, 1.25 * spacing)
        standing = [balls[_apart(all_centers[balls], radius[balls], spacing)] for balls in solid]
    link_pairs = [(a, b) for a, b in candidates if len(standing[a]) and len(standing[b])]
    pairs = [np.stack(np.meshgrid(standing[a], standing[b]), -1).reshape(-1, 2) for a, b in link_pairs]
    return Balls(
        links=tuple(links),
        spans=_spans(counts),
        link=torch.as_tensor(owner),
        centers=torch.as_tensor(all_centers),
        radii=torch.as_tensor(radius),
        bound_centers=torch.as_tensor(middles),
        bound_radii=torch.as_tensor(reach),
        link_pairs=torch.as_tensor(np.array(link_pairs, dtype=np.int64).reshape(-1, 2)),
        pair_spans=_spans(np.array([len(part) for part in pairs], dtype=np.int64)),
        pairs=torch.as_tensor(np.concatenate([np.zeros((0, 2), dtype=np.int64), *pairs])),
        spacing=spacing,
    )


def filling(shapes: Sequence[Shape]) -> tuple[np.ndarray, np.ndarray]:
    """Centres [n, 3] and radii [n] of balls that fill a link as if it were solid: makers model links as thin walls about a motor.

    They fill the hull of all its shapes, and stand out where it has faces, so that most of its surface is covered. Those of thin walls
    would neither keep another link from coming in between, nor drive it out.
    """
    points = []
    for shape in shapes:
        local, radius = support_points(shape.geometry)
        points += [local @ shape.T_body_shape[:3, :3].T + shape.T_body_shape[:3, 3] + radius * d for d in (*np.eye(3), *-np.eye(3))]
    whole = hull(np.concatenate(points)).geometry
    assert whole.vertices is not None and whole.faces is not None
    inner, radius = inscribed_balls(whole)
    corners = whole.vertices[whole.faces]
    share = np.random.default_rng(0).dirichlet((1.0, 1.0, 1.0), (_SURFACE_SAMPLES, len(corners)))
    surface = np.einsum("nfk,fkx->nfx", share, corners)
    outside = np.linalg.norm(surface[:, :, None] - inner, axis=-1).min(axis=-1) - radius
    return inner, np.full(len(inner), radius + max(float(np.quantile(outside, _COVERED)), 0.0))


def _apart(centers: np.ndarray, radii: np.ndarray, spacing: float) -> np.ndarray:
    """Which of some balls, the largest first, are farther from each other than ``spacing``; ascending."""
    kept: list[int] = []
    for ball in np.argsort(-radii, kind="stable").tolist():
        if not kept or np.linalg.norm(centers[kept] - centers[ball], axis=1).min() > spacing:
            kept.append(ball)
    return np.sort(np.array(kept, dtype=np.int64))


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
        center, sides = (low + high) / 2, (high - low) / 2 * (ConvexHull(points).volume / np.prod(high - low)) ** (1 / 3)
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


def shape_balls(shape: Shape) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Balls of one shape: centres [n, 3] in the link's frame, radii [n], and which of them [n] fill it; the others stand at its surface."""
    inner, radius = inscribed_balls(shape.geometry)
    shell, small = shell_balls(shape.geometry, inner, radius)
    sharp = sharp_points(shape.geometry, max(min(radius, small), SPACING))
    points = np.concatenate((inner, shell, sharp)) @ shape.T_body_shape[:3, :3].T + shape.T_body_shape[:3, 3]
    sizes = [np.full(len(part), r) for part, r in ((inner, radius), (shell, small), (sharp, 0.0))]
    return points, np.concatenate(sizes), np.arange(len(points)) < len(inner)


def _spans(counts: np.ndarray) -> Spans:
    return Spans(start=torch.as_tensor(np.cumsum(counts) - counts), count=torch.as_tensor(counts))


def _grid(half: tuple[float, ...], radius: float) -> np.ndarray:
    """[n, 3] an even grid over [-half, half] with steps of at most the radius or :data:`SPACING`."""
    step = max(radius, SPACING)
    rows = [np.linspace(-h, h, int(np.ceil(2 * h / step - 1e-9)) + 1) if h > 0 else np.zeros(1) for h in half]
    return np.array(list(product(*rows)))
