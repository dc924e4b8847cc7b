"""Human-like grasps of an object on a table: where thumb and fingers oppose each other, and the hand pose that puts them there.

A grasp is planned in two steps. :func:`plan_contacts` looks for lines through the object along which the thumb on one side and the fingers
on the other can press against it. :func:`fit_hand` then finds the wrist pose and joint angles whose fingertips are there, by nonlinear
least squares: fingertips on their contacts, no bone inside object or table, near a natural posture.

Everything is in a frame with z up and the table at z = 0; the object is its convex pieces, moved there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from xreset.demos import hand
from xreset.geometry.shapes import half_spaces
from xreset.spec import KEYPOINTS, ObjectSpec

TIPS = tuple(KEYPOINTS.index(f"{finger}4") for finger in ("thumb", "index", "middle", "ring", "little"))

SKIN = 0.002
"""Distance of a fingertip keypoint from the surface it touches [m]."""
MAX_OPENING = 0.095
"""Widest object part that the hand takes between thumb and fingers [m]."""
MIN_WIDTH = 0.002
"""Thinnest part: the wall of a cup, with the thumb or the fingers inside [m]."""

_STACK = np.array([-0.004, -0.026, -0.043, -0.059])  # index to little along the knuckles, the thumb at 0 [m]
_FINGER_ROOM = 0.022  # free space that a finger needs beside the object [m]
_LEANS = (0.6, 1.0)  # first guesses: how far the back of the hand leans to the fingers' side [rad]
_CURL = np.array([0.0, 0.25, 0.25] * 4 + [0.0] * 5)  # of a grasping hand, beyond a relaxed one
_GRID = 0.012  # spacing of the centres that are tried [m]
_SIDE_TILTS = (0.6, 0.4, 0.15)  # how steeply a hand comes down from the side [rad]: the first is the most natural
_TILT_COST = 2.0  # of being less steep [1/rad]
_LOW_OBJECT = 0.07  # objects up to this height are grasped from above [m]


@dataclass(frozen=True, kw_only=True)
class Solid:
    """An object's convex pieces at a pose."""

    planes: tuple[np.ndarray, ...]
    """[P, 4] per piece: outward unit normal and offset."""
    vertices: np.ndarray
    """[V, 3]"""
    com: np.ndarray
    """[3]"""

    @classmethod
    def of(cls, obj: ObjectSpec, pos: np.ndarray, rotation: Rotation) -> Solid:
        """The object at a pose."""
        planes = []
        for piece in obj.pieces:
            own = half_spaces(piece)
            normals = rotation.apply(own[:, :3])
            planes.append(np.column_stack((normals, own[:, 3] - normals @ pos)))
        return cls(planes=tuple(planes), vertices=rotation.apply(obj.vertices) + pos, com=rotation.apply(obj.com) + pos)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """[...] signed distance of points [..., 3] to the surface, negative inside; outside it is a lower bound near edges."""
        return np.min([(points @ plane[:, :3].T + plane[:, 3]).max(axis=-1) for plane in self.planes], axis=0)

    def crossings(
        self, origins: np.ndarray, directions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Where lines [L, 3] cross each piece.

        Returns:
            Line parameters of entry and exit [pieces, L] (entry > exit where the piece is missed), and the normals there [pieces, L, 3].
        """
        enter, leave, normal_in, normal_out = [], [], [], []
        index = np.arange(len(origins))
        for plane in self.planes:
            slope = directions @ plane[:, :3].T
            height = origins @ plane[:, :3].T + plane[:, 3]
            with np.errstate(divide="ignore", invalid="ignore"):
                hit = -height / slope
            outside = (np.abs(slope) < 1e-12) & (height > 0)
            into = np.where(slope < -1e-12, hit, -np.inf)
            out = np.where(slope > 1e-12, hit, np.inf)
            a, b = into.argmax(axis=1), out.argmin(axis=1)
            enter.append(np.where(outside.any(axis=1), np.inf, into[index, a]))
            leave.append(np.where(outside.any(axis=1), -np.inf, out[index, b]))
            normal_in.append(plane[a, :3])
            normal_out.append(plane[b, :3])
        return np.array(enter), np.array(leave), np.array(normal_in), np.array(normal_out)


@dataclass(frozen=True, kw_only=True)
class Contacts:
    """Where the fingertips are to touch the object."""

    points: np.ndarray
    """[5, 3] fingertip targets, thumb first; NaN for a finger that finds nothing to touch."""
    approach: np.ndarray
    """[3] unit direction from the hand into the object."""
    closing: np.ndarray
    """[3] unit direction from the fingers' side to the thumb's, orthogonal to ``approach``."""
    cost: float
    """Smaller is better."""


@dataclass(frozen=True, kw_only=True)
class Grasp:
    """A hand that grasps."""

    wrist_pos: np.ndarray
    """[3]"""
    wrist_rot: Rotation
    angles: np.ndarray
    """[17] joint angles, see :mod:`xreset.demos.hand`."""
    tip_error: float
    """Largest distance of a fingertip from its contact [m]."""
    penetration: float
    """Deepest keypoint or bone inside object or table [m]."""


def plan_contacts(solid: Solid, azimuths: np.ndarray, side: str = "right") -> list[Contacts]:
    """All contacts that a hand could use, best first.

    Args:
        azimuths: [A] directions to try from the fingers' side to the thumb's, as angles about z [rad].
    """
    low, high = solid.vertices.min(axis=0), solid.vertices.max(axis=0)
    from_above = high[2] <= _LOW_OBJECT
    found: list[Contacts] = []
    for azimuth in azimuths:
        closing = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        across = np.array([closing[1], -closing[0], 0.0]) * (
            1.0 if side == "right" else -1.0
        )  # horizontal, away from the hand
        centers = _centers(low, high, closing, across, from_above)
        for tilt in (np.pi / 2,) if from_above else _SIDE_TILTS:
            approach = across * np.cos(tilt) - np.array([0.0, 0.0, np.sin(tilt)])
            effort = 0.0 if from_above else _TILT_COST * (_SIDE_TILTS[0] - tilt)
            found += _contacts_at(solid, centers, approach, closing, side, effort)
    return sorted(found, key=lambda contacts: contacts.cost)


def _centers(
    low: np.ndarray, high: np.ndarray, closing: np.ndarray, across: np.ndarray, from_above: bool
) -> np.ndarray:
    """[n, 3] a grid of points that the thumb and the fingers may close upon."""
    middle, half = (low + high) / 2, (high - low) / 2
    reach_c, reach_a = float(np.abs(closing) @ half), float(np.abs(across) @ half)
    along_c = np.arange(-reach_c, reach_c + 1e-9, _GRID)
    along_a = np.arange(-reach_a, reach_a + 1e-9, _GRID)
    if from_above:
        heights = np.array([max(0.008, high[2] - 0.035, high[2] / 2)])
    else:
        heights = np.arange(max(0.05, low[2] + 0.3 * (high[2] - low[2])), low[2] + 0.75 * (high[2] - low[2]), _GRID)
    c, a, z = (grid.reshape(-1, 1) for grid in np.meshgrid(along_c, along_a, heights, indexing="ij"))
    flat = np.array([1.0, 1.0, 0.0])
    return middle * flat + c * closing + a * across + z * (0.0, 0.0, 1.0)


def _contacts_at(
    solid: Solid, centers: np.ndarray, approach: np.ndarray, closing: np.ndarray, side: str, effort: float
) -> list[Contacts]:
    up_hand = np.cross(approach, closing) * (
        1.0 if side == "right" else -1.0
    )  # from the little finger to the thumb's side of the hand
    offsets = np.concatenate(([0.0], _STACK))
    origins = centers[:, None] + offsets[:, None] * up_hand  # [n, 5, 3]: the thumb's line, then the fingers'
    lines = origins.reshape(-1, 3)
    enter, leave, normal_in, normal_out = solid.crossings(lines, np.broadcast_to(closing, lines.shape))
    # The part of the object around each origin: merge the pieces whose intervals overlap the one that holds it.
    holds = (enter <= 0) & (leave >= 0)
    start = np.where(holds, enter, np.inf).min(axis=0)
    end = np.where(holds, leave, -np.inf).max(axis=0)
    for _ in range(len(solid.planes)):
        touches = (enter <= end + 1e-4) & (leave >= start - 1e-4) & (enter <= leave)
        start = np.minimum(start, np.where(touches, enter, np.inf).min(axis=0))
        end = np.maximum(end, np.where(touches, leave, -np.inf).max(axis=0))
    other = (enter <= leave) & ((leave < start - 1e-4) | (enter > end + 1e-4))
    room_before = start - np.where(other & (leave < start), leave, -np.inf).max(axis=0)
    room_after = np.where(other & (enter > end), enter, np.inf).min(axis=0) - end
    count = np.arange(len(lines))
    facing_fingers = -(normal_in[(enter == start).argmax(axis=0), count] @ closing)
    facing_thumb = normal_out[(leave == end).argmax(axis=0), count] @ closing

    start, end, room_before, room_after, facing_fingers, facing_thumb = (
        array.reshape(-1, 5) for array in (start, end, room_before, room_after, facing_fingers, facing_thumb)
    )
    height = origins[..., 2]
    finger = np.isfinite(start) & (room_before > _FINGER_ROOM) & (facing_fingers > 0.6) & (height > 0.007)
    finger &= np.abs(start - np.median(np.where(finger, start, 0.0)[:, 1:3], axis=1, keepdims=True)) < 0.025
    thumb = (
        np.isfinite(end[:, 0])
        & (room_after[:, 0] > _FINGER_ROOM)
        & (facing_thumb[:, 0] > 0.75)
        & (height[:, 0] > 0.007)
    )
    width = end[:, 0] - start[:, 0]
    with np.errstate(invalid="ignore"):
        good = thumb & finger[:, 1] & finger[:, 2] & (width < MAX_OPENING) & (width > MIN_WIDTH)

    depth = _depth(solid, centers, approach)
    good &= (depth > 0.004) & (depth < 0.055)
    found = []
    for i in np.flatnonzero(good):
        points = np.full((5, 3), np.nan)
        points[0] = origins[i, 0] + (end[i, 0] + SKIN) * closing
        fingers = np.flatnonzero(finger[i, 1:]) + 1
        points[fingers] = origins[i, fingers] + (start[i, fingers] - SKIN)[:, None] * closing
        middle = (points[0] + points[fingers].mean(axis=0)) / 2
        arm = np.linalg.norm(np.cross(middle - solid.com, approach))  # lever of the weight about the grasp
        cost = (
            effort
            + arm / 0.03
            + np.linalg.norm(middle - solid.com) / 0.06
            + 0.5 * (4 - len(fingers))
            + 3.0 * (2 - facing_thumb[i, 0] - facing_fingers[i, 1:3].mean())
            + abs(min(depth[i], 0.03) - 0.03) / 0.02
            + max(0.0, width[i] - 0.07) / 0.01
        )
        found.append(Contacts(points=points, approach=approach, closing=closing, cost=float(cost)))
    return found


def _depth(solid: Solid, points: np.ndarray, approach: np.ndarray) -> np.ndarray:
    """[n] how much of the object lies before each point, seen along the approach: how deep the hand must reach."""
    enter, leave, _, _ = solid.crossings(points, np.broadcast_to(approach, points.shape))
    before = (enter <= leave) & (enter < 0)
    return -np.where(before, enter, 0.0).min(axis=0)


def fit_hand(solid: Solid, contacts: Contacts, side: str = "right") -> Grasp:
    """The hand whose fingertips are on their contacts, without a bone inside object or table."""
    fits = [_fit_from(solid, contacts, lean, side) for lean in _LEANS]
    return min(fits, key=lambda fit: fit[1])[0]


def _fit_from(solid: Solid, contacts: Contacts, lean: float, side: str) -> tuple[Grasp, float]:
    """The best hand near a first guess whose back leans to the fingers' side by ``lean``, and its cost."""
    touching = np.flatnonzero(np.isfinite(contacts.points[:, 0]))
    targets = contacts.points[touching]
    tips = np.array(TIPS)[touching]
    pose = Rotation.from_matrix(_hand_over(contacts, lean, side))
    posture = hand.RELAXED + _CURL
    # Begin with the mean fingertip where the mean contact is.
    wrist = targets.mean(axis=0) - pose.apply(hand.keypoints(posture, side)[tips]).mean(axis=0)

    def points_of(x: np.ndarray) -> np.ndarray:
        """[n, 21, 3] for parameters [n, 23]: wrist position, rotation away from ``pose``, joint angles."""
        matrix = (pose * Rotation.from_rotvec(x[:, 3:6])).as_matrix()
        return np.einsum("nij,nkj->nki", matrix, hand.keypoints(x[:, 6:], side)) + x[:, None, :3]

    def residuals(x: np.ndarray) -> np.ndarray:
        """[n, R], each in units of what is tolerable."""
        points = points_of(x)
        flesh, radius = _flesh(points)
        return np.concatenate(
            (
                ((points[:, tips] - targets) / 0.002).reshape(len(x), -1),
                np.maximum(radius - solid.distance(flesh), 0.0) / 0.003,
                np.maximum(radius + 0.002 - flesh[..., 2], 0.0) / 0.003,
                x[:, 3:6] / 0.2,
                (x[:, 6:] - posture) / 0.7,
            ),
            axis=1,
        )

    def jacobian(x: np.ndarray) -> np.ndarray:  # central differences, all at once
        steps = 1e-6 * np.eye(len(x))
        ahead, behind = np.split(residuals(np.concatenate((x + steps, x - steps))), 2)
        return ((ahead - behind) / 2e-6).T

    bounds = (np.concatenate((np.full(6, -np.inf), hand.LOWER)), np.concatenate((np.full(6, np.inf), hand.UPPER)))
    fit = least_squares(
        lambda x: residuals(x[None])[0],
        np.concatenate((wrist, np.zeros(3), posture)),
        jac=jacobian,  # pyright: ignore[reportArgumentType]
        bounds=bounds,
        max_nfev=60,
    )
    points = points_of(fit.x[None])
    flesh, _ = _flesh(points)
    grasp = Grasp(
        wrist_pos=fit.x[:3],
        wrist_rot=pose * Rotation.from_rotvec(fit.x[3:6]),
        angles=fit.x[6:],
        tip_error=float(np.linalg.norm(points[0, tips] - targets, axis=1).max()),
        penetration=float(max(0.0, -solid.distance(flesh).min(), -flesh[..., 2].min())),
    )
    return grasp, float(fit.cost)


def _hand_over(contacts: Contacts, lean: float, side: str) -> np.ndarray:
    a, c = contacts.approach, contacts.closing
    return hand.hand_axes(np.cos(lean) * a - np.sin(lean) * c, np.sin(lean) * a + np.cos(lean) * c, side)


def _flesh(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points that stand for the hand's flesh [n, 40, 3], joints and middles of bones, and their radii [40]."""
    middles = (points[:, 1:] + points[:, hand.PARENTS]) / 2
    radius = np.full(40, 0.007)
    radius[np.array(TIPS) - 1] = 0.001
    return np.concatenate((points[:, 1:], middles), axis=1), radius
