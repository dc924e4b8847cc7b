"""A hand as balls: what keeps it out of the object, the table and itself while it is being retargeted.

Balls make distances and their derivatives cheap over whole trajectories. They are exact for capsules and spheres, and inscribed in other
shapes, whose edges and corners balls of radius 0 stand for; what they miss is for the exact checks that follow (coal, then physics).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
from torch import Tensor

from xreset.kinematics import Kinematics
from xreset.retarget.collision import SelfCollision, support_points
from xreset.spec import Geometry, RobotSpec


@dataclass(frozen=True, kw_only=True)
class Balls:
    """Balls fixed to the links of a hand (Q in number)."""

    links: tuple[str, ...]
    """Link of each ball."""
    centers: Tensor
    """[Q, 3] in the link's frame."""
    radii: Tensor
    """[Q]"""
    pairs: Tensor
    """[R, 2] balls, of a radius above 0, that must not overlap each other."""


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
    for name in hand.link_names:
        for shape in hand.tree.link(name).collisions:
            inner, radius = inscribed_balls(shape.geometry)
            points = np.concatenate((inner, sharp_points(shape.geometry, radius)))
            centers.append(points @ shape.T_body_shape[:3, :3].T + shape.T_body_shape[:3, 3])
            links += [name] * len(points)
            radii.append(np.where(np.arange(len(points)) < len(inner), radius, 0.0))
    radius = np.concatenate(radii) if radii else np.zeros(0)
    index = np.where(radius > 0, np.array([hand.link_index(name) for name in links], dtype=np.int64), -1)
    pairs = [
        np.stack(np.meshgrid(np.flatnonzero(index == a), np.flatnonzero(index == b)), -1).reshape(-1, 2) for a, b in collision.link_pairs
    ]
    return Balls(
        links=tuple(links),
        centers=torch.as_tensor(np.concatenate(centers) if centers else np.zeros((0, 3))),
        radii=torch.as_tensor(radius),
        pairs=torch.as_tensor(np.concatenate(pairs) if pairs else np.zeros((0, 2), dtype=np.int64)),
    )


def inscribed_balls(geometry: Geometry) -> tuple[np.ndarray, float]:
    """Balls inside a shape that fill it well: centres [n, 3] in the shape's frame and their radius.

    A capsule or a long cylinder gets a row along its axis, a sphere itself. A box gets layers of balls as thick as its thinnest side; so
    does a flat cylinder, through the square in its rim, and a hull, through the box about it shrunk to the hull's volume.
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
        from scipy.spatial import ConvexHull

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


def _grid(half: tuple[float, ...], radius: float) -> np.ndarray:
    """[n, 3] an even grid over [-half, half] with steps of at most the radius."""
    rows = [np.linspace(-h, h, int(np.ceil(2 * h / radius - 1e-9)) + 1) if h > 0 else np.zeros(1) for h in half]
    return np.array(list(product(*rows)))
