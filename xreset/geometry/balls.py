"""A hand as balls, which keep it out of the object, the table and itself while it is retargeted.

Balls make distances and their derivatives cheap over whole trajectories. They are exact for capsules and spheres, and
inscribed in other shapes. Smaller balls lie under the surface that those do not reach, and balls of radius 0 stand for
edges and corners. What the balls miss, the exact checks that follow find (coal, then physics).

Shape letters: Q balls, G links with balls, R guards, H pairs of links.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import product

import numpy as np
import torch
from scipy.spatial import ConvexHull
from torch import Tensor

from xreset.errors import RobotError
from xreset.files.checks import frozen
from xreset.geometry.collision import SelfCollision, bounding_ball, support_points
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.shapes import half_spaces, plane_heights, shape_mesh, surface_of, transformed
from xreset.physics.tensors import Tensors
from xreset.spec import Geometry, Shape

SPACING = 4e-3
"""Balls need not be closer than this, however thin the shape [m]. From a radius of 2.8 mm on they leave no hole;
thinner shapes lack no more than their own thickness."""
BARE = 2.5e-3
"""Smaller balls are added where the surface of a shape is farther than this from the balls that fill it [m]. Without
them a box of 5 x 14 x 4 cm would be bare up to 8 mm deep near its edges, enough for a banana to sink in."""
APART = 6e-3
"""Smallest distance between the balls of one link that keep out of other links [m]."""
STAND_IN = 3.5e-3
"""How much larger such a ball is where it represents others nearby [m]. Where edges cross between two balls they are
deeper in each other than any ball, and the exact test measures how far two shapes must move to separate. With this
value the LEAP hand loses 1 % of its frames to that test, without it 90 %."""

_LARGEST_LINK = 0.7
"""[m] Length of a link of a hand."""
_INWARD_STEPS = 8
"""Steps that move a point of a surface inwards from one face after the other."""


@frozen
class Balls(Tensors):
    """Balls fixed to the links of a hand."""

    links: tuple[str, ...]
    """Links that carry balls (length G)."""
    first: Tensor
    """[G] first ball of each link."""
    count: Tensor
    """[G] number of balls of each link."""
    link: Tensor
    """[Q] link of each ball, as an index of ``links``: ascending."""
    centers: Tensor
    """[Q, 3] in the link's frame."""
    radii: Tensor
    """[Q] [m]; 0 for edges and corners."""
    middles: Tensor
    """[G, 3] middle of a box around all balls of the link, in its frame."""
    half_sizes: Tensor
    """[G, 3] half the sides of this box [m]."""
    guards: Tensor
    """[R] balls that keep out of other links; two of one link are at least :data:`APART` apart."""
    guard_radii: Tensor
    """[R] their radii against other links [m]: larger where they represent other balls."""
    first_guard: Tensor
    """[G] first guard of each link."""
    guard_count: Tensor
    """[G] number of guards of each link."""
    link_pairs: Tensor
    """[H, 2] pairs of links, as indices of ``links``: the guards of the first keep out of the second. Each pair occurs
    both ways."""


def hand_balls(hand: Kinematics, collision: SelfCollision) -> Balls:
    """Fill a hand with balls; ``collision`` decides which of its links must not overlap."""
    solids = {}
    for name in hand.link_names:
        if shapes := hand.tree.link(name).collisions:
            solids[name] = shapes
            size = float(np.ptp(surface_of(shapes)[0], axis=0).max())
            if size > _LARGEST_LINK:
                raise RobotError(
                    f"link {name!r} of the hand measures {size:.3g} m, expected {_LARGEST_LINK:g} m at most. Are its "
                    'shapes in other units? State the scale of a mesh, such as scale="0.001 0.001 0.001".'
                )
    links = tuple(solids)
    balls = [link_balls(shapes) for shapes in solids.values()]
    centers = [own for own, _ in balls]
    radii = [own for _, own in balls]
    first, count = _ranges(radii)
    guards = []
    guard_radii = []
    lows = []
    highs = []
    for own_centers, own_radii, own in zip(centers, radii, first.tolist(), strict=True):
        lows.append((own_centers - own_radii[:, None]).min(axis=0))
        highs.append((own_centers + own_radii[:, None]).max(axis=0))
        chosen = _apart(own_centers, own_radii, APART)
        gaps = np.linalg.norm(own_centers[chosen][:, None] - own_centers, axis=-1)
        has_neighbor = (gaps <= APART).sum(axis=1) > 1
        guards.append(chosen + own)
        guard_radii.append(own_radii[chosen] + STAND_IN * has_neighbor)
    pairs = [(links.index(a), links.index(b)) for a, b in collision.link_pairs]
    both_ways = np.array([*pairs, *(pair[::-1] for pair in pairs)], dtype=np.int64)
    low = torch.as_tensor(np.array(lows).reshape(-1, 3))
    high = torch.as_tensor(np.array(highs).reshape(-1, 3))
    first_guard, guard_count = _ranges(guard_radii)
    return Balls(
        links=links,
        first=first,
        count=count,
        link=torch.arange(len(links)).repeat_interleave(count),
        centers=joined(centers, 3),
        radii=joined(radii),
        middles=(low + high) / 2,
        half_sizes=(high - low) / 2,
        guards=joined(guards).long(),
        guard_radii=joined(guard_radii),
        first_guard=first_guard,
        guard_count=guard_count,
        link_pairs=torch.as_tensor(both_ways.reshape(-1, 2)),
    )


def _ranges(parts: Sequence[np.ndarray]) -> tuple[Tensor, Tensor]:
    """Return where each part begins among the rows of all parts, and its number of rows."""
    count = torch.tensor([len(part) for part in parts], dtype=torch.long)
    return count.cumsum(0) - count, count


def members(first: Tensor, count: Tensor) -> tuple[Tensor, Tensor]:
    """List the elements of ranges.

    Args:
        first: [K] first element of each range.
        count: [K] number of its elements.

    Returns:
        [N] range of each element, ascending, and [N] the element.
    """
    owner = torch.arange(len(count), device=count.device).repeat_interleave(count)
    skipped = first - (count.cumsum(0) - count)
    return owner, torch.arange(len(owner), device=count.device) + skipped[owner]


def joined(parts: Sequence[np.ndarray], *shape: int) -> Tensor:
    """[n, *shape] all parts in one tensor, even if there is none."""
    return torch.as_tensor(np.concatenate([np.zeros((0, *shape)), *parts]))


def bounding_balls(
    centers: Sequence[np.ndarray], radii: Sequence[np.ndarray]
) -> tuple[Tensor, Tensor]:
    """Return centers [G, 3] and radii [G] of one ball around each of G groups of balls, centers [n, 3] and radii
    [n]."""
    balls = [bounding_ball(*group) for group in zip(centers, radii, strict=True)]
    middles = np.array([middle for middle, _ in balls]).reshape(-1, 3)
    reaches = torch.tensor([reach for _, reach in balls], dtype=torch.float64)
    return torch.as_tensor(middles), reaches


def _apart(centers: np.ndarray, radii: np.ndarray, spacing: float) -> np.ndarray:
    """Choose balls that are farther from each other than ``spacing`` [m], larger ones first; return their rows,
    ascending."""
    kept = []
    is_apart = np.ones(len(centers), dtype=bool)
    for ball in np.argsort(-radii, kind="stable").tolist():
        if is_apart[ball]:
            kept.append(ball)
            is_apart &= np.linalg.norm(centers - centers[ball], axis=1) > spacing
    return np.sort(np.array(kept, dtype=np.int64))


def inscribed_balls(geometry: Geometry) -> tuple[np.ndarray, float]:
    """Fill a shape with balls: centers [n, 3] in the shape's frame and their radius [m].

    A capsule or a long cylinder gets a row along its axis, a sphere itself. A box gets layers of balls as thick as its
    thinnest side, at distances of their radius or :data:`SPACING`. A flat cylinder is filled like the box through the
    square in its rim, a hull like the box around it, shrunk to the hull's volume.
    """
    size = np.array(geometry.size)
    center = np.zeros(3)
    if geometry.kind == "sphere":
        return center[None], geometry.size[0]
    if geometry.kind == "hull":
        points = np.asarray(geometry.vertices)
        low = points.min(axis=0)
        high = points.max(axis=0)
        center = (low + high) / 2
        sides = (high - low) / 2 * (ConvexHull(points).volume / np.prod(high - low)) ** (1 / 3)
    elif geometry.kind == "box":
        sides = size
    else:
        radius, half = geometry.size
        if geometry.kind == "capsule":
            return _grid((0.0, 0.0, half), radius), radius
        if half >= radius:
            return _grid((0.0, 0.0, half - radius), radius), radius
        sides = np.array((radius * 0.5**0.5, radius * 0.5**0.5, half))
    radius = float(sides.min())
    return center + _grid(sides - radius, radius), radius


def _grid(half: Iterable[float], radius: float) -> np.ndarray:
    """[n, 3] an even grid over [-half, half] with steps of at most the radius or :data:`SPACING`."""
    step = max(radius, SPACING)
    rows = [
        np.linspace(-h, h, int(np.ceil(2 * h / step - 1e-9)) + 1) if h > 0 else [0.0] for h in half
    ]
    return np.array(list(product(*rows)))


def sharp_points(geometry: Geometry, spacing: float) -> np.ndarray:
    """[n, 3] points where a shape reaches beyond the balls in it: on a box's edges at most ``spacing`` [m] apart, on a
    cylinder's rims, and a hull's vertices."""
    points, radius = support_points(Shape(geometry=geometry))
    if radius > 0:
        return np.zeros((0, 3))
    if geometry.kind != "box":
        return points
    edges = []
    for axis, half in enumerate(geometry.size):
        sides = [np.array((-end, end)) for end in geometry.size]
        sides[axis] = np.linspace(-half, half, int(np.ceil(2 * half / spacing)) + 1)
        edges += product(*sides)
    return np.unique(np.array(edges), axis=0)


def shell_balls(geometry: Geometry, centers: np.ndarray, radius: float) -> tuple[np.ndarray, float]:
    """Add small balls under the surface of a shape where it is farther than :data:`BARE` from the balls that fill it.

    Args:
        geometry: the shape.
        centers: [m, 3] centers of the balls that fill the shape.
        radius: radius of the balls that fill the shape.

    Returns:
        Centers [n, 3] of the small balls, and their radius [m], with which they come within :data:`BARE` of a
        right-angled edge.
    """
    from trimesh.remesh import subdivide_to_size

    small = BARE / (2**0.5 - 1)
    if geometry.kind in ("sphere", "capsule") or radius <= small:
        return np.zeros((0, 3)), small
    shape = Shape(geometry=geometry)
    mesh = shape_mesh(shape)
    planes = half_spaces(shape)
    vertices = subdivide_to_size(mesh.vertices, mesh.faces, SPACING)[0]
    surface = np.unique(vertices.round(9), axis=0)
    bare = surface[np.linalg.norm(surface[:, None] - centers, axis=-1).min(axis=-1) > radius + BARE]
    for _ in range(_INWARD_STEPS):
        beyond = np.maximum(plane_heights(bare, planes) + small, 0.0)
        bare = bare - beyond.max(axis=1)[:, None] * planes[beyond.argmax(axis=1), :3]
    inside = plane_heights(bare, planes).max(axis=1) < -0.9 * small
    bare = np.unique(bare[inside].round(6), axis=0)
    return bare[_apart(bare, np.zeros(len(bare)), small)], small


def link_balls(shapes: Sequence[Shape]) -> tuple[np.ndarray, np.ndarray]:
    """Fill the shapes of a link with balls: centers [n, 3] in the link's frame and radii [n] [m]."""
    centers = []
    radii = []
    for shape in shapes:
        inner, radius = inscribed_balls(shape.geometry)
        shell, small = shell_balls(shape.geometry, inner, radius)
        sharp = sharp_points(shape.geometry, max(min(radius, small), SPACING))
        points = np.concatenate((inner, shell, sharp))
        centers.append(transformed(points, shape.T_body_shape))
        radii.append(np.repeat([radius, small, 0.0], [len(inner), len(shell), len(sharp)]))
    return np.concatenate(centers), np.concatenate(radii)
