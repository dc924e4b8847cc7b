"""Human-like grasps of an object on a table: where thumb and fingers oppose each other, and the hand pose that puts
them there.

A grasp is planned in two steps. :func:`plan_contacts` looks for lines through the object along which the thumb on one
side and the fingers on the other can press against it. :func:`fit_hand` then finds the wrist pose and joint angles
whose fingertips are there, by nonlinear least squares: fingertips on their contacts, no bone inside object or table,
near a natural posture.

Everything is in a frame with z up and the table at z = 0; the object is its convex pieces, moved there.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import null_space
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from xreset.demos import hand
from xreset.files.checks import frozen
from xreset.geometry.shapes import half_spaces, plane_heights, shape_mesh
from xreset.spec import ObjectSpec

TIPS = (4, 8, 12, 16, 20)
"""Keypoints of the fingertips, thumb first."""
SKIN = 0.002
"""Distance of a fingertip keypoint from the surface it touches [m]."""
MAX_OPENING = 0.095
"""Widest object part that the hand takes between thumb and fingers [m]."""
MIN_WIDTH = 0.002
"""Thinnest part: the wall of a cup, with the thumb or the fingers inside [m]."""

# thumb, then index to little, along the knuckles [m]
_STACK = np.array([0.0, -0.004, -0.026, -0.043, -0.059])
_FINGER_ROOM = 0.022  # free space that a finger needs next to the object [m]
_LEANS = (0.6, 1.0)  # first guesses: lean of the back of the hand to the fingers' side [rad]
_POSTURE = hand.RELAXED + np.array([0.0, 0.25, 0.25] * 4 + [0.0] * 5)  # of a grasping hand
_AZIMUTHS = np.radians(np.arange(0.0, 360.0, 20.0))  # from the fingers' side to the thumb's [rad]
_GRID = 0.012  # spacing of the centers that are tried [m]
# steepness of a hand that comes from the side [rad]: the first is the most natural
_SIDE_TILTS = (0.6, 0.4, 0.15)
_TILT_COST = 2.0  # of being less steep [1/rad]
_LOW_OBJECT = 0.07  # objects up to this height are grasped from above [m]
_ABOVE_TABLE = 0.007  # least height of a contact [m]
_FACING_FINGERS = 0.6  # least cosine between the fingers' way and the surface's normal
_FACING_THUMB = 0.75  # the same for the thumb
_IN_LINE = 0.025  # how far a finger's way may differ from that of the middle fingers [m]
_DEPTH = (0.004, 0.055)  # range of how deep the hand reaches over the object [m]
_TOUCH = 1e-4  # pieces of an object that are this close are one part [m]


@frozen
class Solid:
    """An object's convex pieces at a pose."""

    planes: tuple[np.ndarray, ...]
    """[P, 4] per piece: outward unit normal and offset."""
    corners: tuple[np.ndarray, ...]
    """[C, 3] per piece: its vertices."""
    vertices: np.ndarray
    """[V, 3]"""
    com: np.ndarray
    """[3]"""
    pos: np.ndarray
    """[3] origin of the mesh frame."""
    rotation: Rotation

    @classmethod
    def of(cls, obj: ObjectSpec, pos: np.ndarray, rotation: Rotation) -> Solid:
        """Place an object at a pose."""
        planes = []
        corners = []
        for piece in obj.pieces:
            own = half_spaces(piece)
            normals = rotation.apply(own[:, :3])
            planes.append(np.column_stack((normals, own[:, 3] - normals @ pos)))
            corners.append(rotation.apply(shape_mesh(piece).vertices) + pos)
        vertices = rotation.apply(obj.vertices) + pos
        com = rotation.apply(obj.com) + pos
        return cls(
            planes=tuple(planes),
            corners=tuple(corners),
            vertices=vertices,
            com=com,
            pos=pos,
            rotation=rotation,
        )

    def distance(self, points: np.ndarray) -> np.ndarray:
        """[...] signed distance of points [..., 3] to the surface [m], negative inside; a lower bound outside, near
        edges."""
        distances = [plane_heights(points, planes).max(axis=-1) for planes in self.planes]
        return np.min(distances, axis=0)

    def crossings(
        self, origins: np.ndarray, direction: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Intersect lines through origins [..., 3] along a direction [3] with each piece.

        Returns:
            Line parameters of entry and exit [pieces, ...] (entry > exit where the piece is missed), and the normals
            there [pieces, ..., 3], zero far from the piece.
        """
        enter = np.full((len(self.planes), *origins.shape[:-1]), np.inf)
        leave = -enter
        normal_in = np.zeros((*enter.shape, 3))
        normal_out = np.zeros_like(normal_in)
        across = null_space(direction[None])
        shadow = origins @ across
        for i, (planes, corners) in enumerate(zip(self.planes, self.corners, strict=True)):
            outline = corners @ across
            near = (shadow >= outline.min(axis=0)) & (shadow <= outline.max(axis=0))
            lines = np.nonzero(near.all(axis=-1))
            along, against = np.array([direction, -direction]) @ planes[:, :3].T
            entries = against > 1e-12
            exits = along > 1e-12
            height = plane_heights(origins[lines], planes)
            outside = (height[..., ~entries & ~exits] > 0).any(axis=-1)
            into = height[..., entries] / against[entries]
            out = -height[..., exits] / along[exits]
            enter[i][lines] = np.where(outside, np.inf, into.max(axis=-1))
            leave[i][lines] = np.where(outside, -np.inf, out.min(axis=-1))
            normal_in[i][lines] = planes[entries, :3][into.argmax(axis=-1)]
            normal_out[i][lines] = planes[exits, :3][out.argmin(axis=-1)]
        return enter, leave, normal_in, normal_out


@frozen
class Contacts:
    """Planned contacts of the fingertips with the object."""

    points: np.ndarray
    """[5, 3] fingertip targets, thumb first; NaN for a finger without a contact."""
    approach: np.ndarray
    """[3] unit direction from the hand into the object."""
    closing: np.ndarray
    """[3] unit direction from the fingers' side to the thumb's, orthogonal to ``approach``."""
    cost: float
    """Smaller is better."""


@frozen
class Grasp:
    """A hand that grasps."""

    solid: Solid
    """What it grasps."""
    side: str
    """``right`` or ``left``."""
    wrist_pos: np.ndarray
    """[3]"""
    wrist_rot: Rotation
    angles: np.ndarray
    """[17] joint angles, see :mod:`xreset.demos.hand`."""
    tip_error: float
    """Largest distance of a fingertip from its contact [m]."""
    penetration: float
    """Deepest keypoint or bone inside object or table [m]."""


def plan_contacts(solid: Solid, side: str) -> list[Contacts]:
    """Return all contacts that a hand could use, best first."""
    low = solid.vertices.min(axis=0)
    high = solid.vertices.max(axis=0)
    from_above = high[2] <= _LOW_OBJECT
    found = []
    for azimuth in _AZIMUTHS:
        closing = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        # horizontal, away from the hand
        away = np.array([closing[1], -closing[0], 0.0]) * handedness(side)
        centers = _centers(low, high, closing, away, from_above)
        for tilt in (np.pi / 2,) if from_above else _SIDE_TILTS:
            approach = away * np.cos(tilt) - np.array([0.0, 0.0, np.sin(tilt)])
            effort = 0.0 if from_above else _TILT_COST * (_SIDE_TILTS[0] - tilt)
            found += _contacts_at(solid, centers, approach, closing, side, effort)
    return sorted(found, key=lambda contacts: contacts.cost)


def handedness(side: str) -> float:
    """Return 1 for a right hand, -1 for a left one."""
    return 1.0 if side == "right" else -1.0


def _centers(
    low: np.ndarray, high: np.ndarray, closing: np.ndarray, away: np.ndarray, from_above: bool
) -> np.ndarray:
    """[n, 3] a grid of points that the thumb and the fingers may close upon."""
    half = (high - low) / 2
    grids = []
    for direction in (closing, away):
        reach = float(np.abs(direction) @ half)
        grids.append(np.arange(-reach, reach + 1e-9, _GRID))
    if from_above:
        heights = np.array([max(0.008, high[2] - 0.035, high[2] / 2)])
    else:
        height = high[2] - low[2]
        heights = np.arange(max(0.05, low[2] + 0.3 * height), low[2] + 0.75 * height, _GRID)
    c, a, z = (grid.reshape(-1, 1) for grid in np.meshgrid(*grids, heights, indexing="ij"))
    flat = np.array([1.0, 1.0, 0.0])
    return (low + high) / 2 * flat + c * closing + a * away + z * (0.0, 0.0, 1.0)


def _part_around(solid: Solid, origins: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Find the part of the object around points, along lines through them: the pieces that hold a point, and those that
    overlap these pieces on the line.

    Args:
        solid: the object.
        origins: [n, 5, 3] points.
        direction: [3] unit vector along all lines.

    Returns:
        [6, n, 5] where the part starts and ends on the line, inf and -inf where no piece holds the point [m]; the free
        room before the start and after the end [m]; the cosines of the angles between line and surface normal there.
    """
    enter, leave, normal_in, normal_out = solid.crossings(origins, direction)
    touches = (enter <= 0) & (leave >= 0)
    while True:
        start = np.where(touches, enter, np.inf).min(axis=0)
        end = np.where(touches, leave, -np.inf).max(axis=0)
        grown = (enter <= end + _TOUCH) & (leave >= start - _TOUCH) & (enter <= leave)
        if (grown == touches).all():
            break
        touches = grown
    other = (enter <= leave) & ((leave < start - _TOUCH) | (enter > end + _TOUCH))
    room_before = start - np.where(other & (leave < start), leave, -np.inf).max(axis=0)
    room_after = np.where(other & (enter > end), enter, np.inf).min(axis=0) - end
    first = (enter == start).argmax(axis=0)[None, ..., None]
    last = (leave == end).argmax(axis=0)[None, ..., None]
    facing_start = -(np.take_along_axis(normal_in, first, axis=0)[0] @ direction)
    facing_end = np.take_along_axis(normal_out, last, axis=0)[0] @ direction
    return np.stack((start, end, room_before, room_after, facing_start, facing_end))


def _contacts_at(
    solid: Solid,
    centers: np.ndarray,
    approach: np.ndarray,
    closing: np.ndarray,
    side: str,
    effort: float,
) -> list[Contacts]:
    """Return the contacts of a hand that closes upon centers [n, 3]; ``effort`` is added to their cost."""
    # from the little finger to the thumb's side of the hand
    up_hand = np.cross(approach, closing) * handedness(side)
    # [n, 5, 3]: the lines of the thumb and the fingers
    origins = centers[:, None] + _STACK[:, None] * up_hand
    start, end, room_before, room_after, facing_fingers, facing_thumb = _part_around(
        solid, origins, closing
    )
    above_table = origins[..., 2] > _ABOVE_TABLE
    fits = (
        np.isfinite(start)
        & (room_before > _FINGER_ROOM)
        & (facing_fingers > _FACING_FINGERS)
        & above_table
    )
    middle_start = np.median(np.where(fits, start, 0.0)[:, 1:3], axis=1, keepdims=True)
    finger = fits & (np.abs(start - middle_start) < _IN_LINE)
    thumb = (
        np.isfinite(end)
        & (room_after > _FINGER_ROOM)
        & (facing_thumb > _FACING_THUMB)
        & above_table
    )
    width = (end - start)[:, 0]
    # length of the object before each center, along the approach: how deep the hand must reach
    into, out, *_ = solid.crossings(centers, approach)
    depth = -np.where((into <= out) & (into < 0), into, 0.0).min(axis=0)
    good = thumb[:, 0] & finger[:, 1:3].all(axis=1)
    good &= (width > MIN_WIDTH) & (width < MAX_OPENING) & (depth > _DEPTH[0]) & (depth < _DEPTH[1])

    rows = np.flatnonzero(good)
    touching = finger[rows]
    place = np.where(touching, start[rows] - SKIN, np.nan)
    place[:, 0] = end[rows, 0] + SKIN
    points = origins[rows] + place[..., None] * closing
    fingers = touching[:, 1:].sum(axis=1)
    middle = (points[:, 0] + np.nansum(points[:, 1:], axis=1) / fingers[:, None]) / 2
    from_com = middle - solid.com
    # of the object's weight about the grasp
    lever = np.cross(from_com, approach)
    facing = facing_fingers[rows, 1:3].mean(axis=1)
    # each term is divided by what makes a plan worse by 1
    cost = (
        effort
        + np.linalg.norm(lever, axis=1) / 0.03
        + np.linalg.norm(from_com, axis=1) / 0.06
        + 0.5 * (4 - fingers)
        + 3.0 * (2 - facing_thumb[rows, 0] - facing)
        + np.abs(np.minimum(depth[rows], 0.03) - 0.03) / 0.02
        + np.maximum(width[rows] - 0.07, 0.0) / 0.01
    )
    return [
        Contacts(points=own, approach=approach, closing=closing, cost=float(own_cost))
        for own, own_cost in zip(points, cost, strict=True)
    ]


def fit_hand(solid: Solid, contacts: Contacts, side: str) -> Grasp:
    """Find the hand whose fingertips are on their contacts, without a bone inside object or table."""
    fits = [_fit_from(solid, contacts, lean, side) for lean in _LEANS]
    return min(fits, key=lambda fit: fit[1])[0]


def _fit_from(solid: Solid, contacts: Contacts, lean: float, side: str) -> tuple[Grasp, float]:
    """Return the best hand near a first guess whose back leans to the fingers' side, and its cost."""
    touching = np.flatnonzero(np.isfinite(contacts.points[:, 0]))
    targets = contacts.points[touching]
    tips = np.array(TIPS)[touching]
    direction = np.cos(lean) * contacts.approach - np.sin(lean) * contacts.closing
    palm = np.sin(lean) * contacts.approach + np.cos(lean) * contacts.closing
    pose = Rotation.from_matrix(hand.hand_axes(direction, palm, side))
    # Begin with the mean fingertip where the mean contact is.
    wrist = targets.mean(axis=0) - pose.apply(hand.keypoints(_POSTURE, side)[tips]).mean(axis=0)

    def points_of(x: np.ndarray) -> np.ndarray:
        """[n, 21, 3] for parameters [n, 23]: wrist position, rotation away from ``pose``, joint angles."""
        return hand.placed(x[:, :3], pose * Rotation.from_rotvec(x[:, 3:6]), x[:, 6:], side)

    def residuals(x: np.ndarray) -> np.ndarray:
        """[n, R], each in units of what is tolerable."""
        points = points_of(x)
        flesh = hand.flesh(points)
        terms = (
            ((points[:, tips] - targets) / 0.002).reshape(len(x), -1),
            np.maximum(hand.FLESH - solid.distance(flesh), 0.0) / 0.003,
            np.maximum(hand.FLESH + 0.002 - flesh[..., 2], 0.0) / 0.003,
            x[:, 3:6] / 0.2,
            (x[:, 6:] - _POSTURE) / 0.7,
        )
        return np.concatenate(terms, axis=1)

    def jacobian(x: np.ndarray) -> np.ndarray:
        """[R, 23] central differences, all at once."""
        steps = 1e-6 * np.eye(len(x))
        ahead, behind = np.split(residuals(np.concatenate((x + steps, x - steps))), 2)
        return ((ahead - behind) / 2e-6).T

    free = np.full(6, np.inf)
    fit = least_squares(
        lambda x: residuals(x[None])[0],
        np.concatenate((wrist, np.zeros(3), _POSTURE)),
        jac=jacobian,  # pyright: ignore[reportArgumentType]
        bounds=(np.concatenate((-free, hand.LOWER)), np.concatenate((free, hand.UPPER))),
        max_nfev=60,
    )
    points = points_of(fit.x[None])
    flesh = hand.flesh(points)
    grasp = Grasp(
        solid=solid,
        side=side,
        wrist_pos=fit.x[:3],
        wrist_rot=pose * Rotation.from_rotvec(fit.x[3:6]),
        angles=fit.x[6:],
        tip_error=float(np.linalg.norm(points[0, tips] - targets, axis=1).max()),
        penetration=float(max(0.0, -solid.distance(flesh).min(), -flesh[..., 2].min())),
    )
    return grasp, float(fit.cost)
