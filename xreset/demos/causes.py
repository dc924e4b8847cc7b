"""Where hand, object and table are in a recording, what contradicts itself there, and causes that are tried.

A cause is a change of the recording that undoes it, such as the inverse of the camera's matrix. The likeliest cause is
the one whose change leaves no contradiction and the least misfit. If what contradicts itself is only unlikely, the
change must also make the recording much better.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import cached_property
from itertools import chain
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from xreset.files.checks import frozen
from xreset.geometry.shapes import transform, transformed, turn_of
from xreset.geometry.surface import Surface
from xreset.objects.rest import rest_height, resting_faces
from xreset.spec import TableSpec

MOVED = 0.05
"""An object farther from its start than this has moved [m]."""
_SETTLED = 0.013
"""Largest distance of an object's lowest vertex from the table at the start [m]: -0.008 to 0.011 in 591 of 600
sequences of DexYCB; in the other nine the object stands on another one, 0.044 to 0.137 above the table."""
_SUNK = -0.030
"""An object that starts below this cannot be on the table [m]."""
_BELOW = 0.04
"""An object that gets this much deeper into the table than at the start does not move on it [m]."""
_BURIED = -0.08
"""An object whose lowest vertex gets below this in any frame cannot be above the table [m]: -0.024 in DexYCB."""
_LOOKS = 24
"""Frames of a recording in which the height of the object is looked at."""
_STACKED = 0.20
"""An object that starts above this cannot be on another object [m]."""
_ORIGIN = (-0.1, 0.7)
"""Range of heights at which an object's origin may start above the table, if its mesh is unknown [m]."""
_NEAR = 0.015
"""Largest distance of the nearest keypoint from the surface, at the median over frames in which the object has moved
[m]: 0.009 in DexYCB."""
_GRIP = 0.036
"""The same of the thumb's tip and of the nearest other fingertip, whichever is farther [m]: 0.034."""
_DEPTH = 0.045
"""Largest sum of the depths of keypoints in the object, each beyond 5 mm, at the median over the same frames [m]:
0.033."""
_AWAY = 0.10
"""A hand at this distance does not hold the object [m]."""
_ARM = 0.40
"""The same for the distance from the object's origin, if its mesh is unknown [m]."""
_SLIP = 1.6
"""Largest speed of the hand in the object's frame, in speeds of the object: 0.93 in DexYCB."""
_BETTER = 0.7
"""Another lag that reduces the misfit by this factor is better: in DexYCB, none has less than 0.76."""
_BETTER_TURN = 0.77
"""The same of another order of the quaternions' numbers: 0.84. Without a mesh, the slip alone has 0.76."""
_BETTER_INVERSE = 0.46
"""The same of inverse orientations: 0.50."""
_LEAN_WEIGHT = 40.0
"""Weight of the object's height above or below the table at the start, and of its lean, next to the logarithm of the
slip [1/m]. With these weights, 4.5 % of wrong orders of quaternions pass in DexYCB in place of 10, and no right one is
refused."""
_DEPTH_WEIGHT = 8.0
"""The same of the hand's depth in the object."""
_GRIP_WEIGHT = 10.0
"""The same of the distance of thumb or fingers from the surface, beyond what a finger's flesh explains."""
_MOST_LEAN = 0.012
"""A larger lean counts as this [m]."""
_TOGETHER = 0.7
"""Largest slip in another unit with which that unit is believed, where the object hardly moves."""
_MESH_UNITS = (1 / 0.3048, 10.0, 1 / 0.0254)
"""Ratios of units that meshes are mistaken in: feet and metres, steps of ten, inches and metres. The larger ones of
millimetres are refused with the mesh."""
_KNOWN = 0.35
"""Share of steps that must be known."""
_LEAST_LAG = 0.05
"""[s]"""
_LARGEST_LAG = 1.0
"""[s]"""
_BASE = 0.1
"""Time over which speeds are measured, longer than a tracker's noise matters [s]."""
_LEAST_STEP = 0.02
"""Motion of the object in this time that counts [m]."""
_NEXT_FACE = np.cos(np.radians(30.0))
"""Cosine of the largest angle to the face that it would rest on."""
_THICK = 0.020
"""Objects whose center of mass rests lower than this, such as scissors, may lean on anything [m]."""
_BEHIND = -0.10
"""Smallest distance along y from the object to the place where the hand is first seen [m]: 0.05 in DexYCB."""


class Contradiction(NamedTuple):
    """Something about the places of hand, object and table that cannot be, or hardly."""

    clause: str
    wrong: bool
    """Whether it cannot be."""


@frozen
class Recording:
    """One sequence of F frames in double precision."""

    side: str
    fps: float
    points: np.ndarray
    """[F, 21, 3] keypoints; NaN where the hand was not seen."""
    wrist: np.ndarray
    """[F, 4] orientation of the wrist (w, x, y, z); NaN where the hand was not seen."""
    pos: np.ndarray
    """[F, 3] of the object."""
    turn: Rotation
    """F orientations of the object."""
    surface: Surface | None = None
    """Surface of the object; None: unknown."""
    camera: np.ndarray | None = None
    """[4, 4] pose of the camera in the table frame that positions were converted with; None: none, or unknown."""

    @property
    def T_table(self) -> np.ndarray:
        """[4, 4] pose of the frame of the recording's own numbers in the table frame."""
        return np.eye(4) if self.camera is None else self.camera

    @cached_property
    def seen(self) -> np.ndarray:
        """[F] bool: whether the hand was seen."""
        return np.asarray(np.isfinite(self.points).all(axis=(1, 2)))

    @cached_property
    def in_object(self) -> np.ndarray:
        """[F, 21, 3] keypoints in the object's frame."""
        return _in_frame(self.pos, self.matrix, self.points)

    @cached_property
    def places(self) -> np.ndarray:
        """[F, 3] the object's center of mass, or its origin if its mesh is unknown [m]."""
        if self.surface is None:
            return self.pos
        return self.pos + self.turn.apply(self.surface.obj.com)

    @cached_property
    def moved(self) -> np.ndarray:
        """[F] bool: whether the object has moved from its start."""
        return np.linalg.norm(self.places - self.places[0], axis=1) > MOVED

    @cached_property
    def step_turn(self) -> Rotation:
        """F-1 turns of the object from one frame to the next."""
        return self.turn[1:] * self.turn[:-1].inv()

    @cached_property
    def start_height(self) -> float:
        """Height of the object's lowest vertex in the first frame, or of its origin if its mesh is unknown [m]."""
        return float(self._lowest(0))

    @cached_property
    def least_height(self) -> float:
        """The same in any of some frames [m]."""
        frames = slice(None)
        if self.surface is not None:
            frames = np.linspace(0, len(self.pos) - 1, _LOOKS).astype(int)
        return float(np.min(self._lowest(frames)))

    def _lowest(self, frames: int | slice | np.ndarray) -> np.ndarray | float:
        """Return the height of the object's lowest vertex in frames [m], or of its origin."""
        height = self.pos[frames, 2]
        if self.surface is None:
            return height
        quats = self.turn.as_quat(scalar_first=True)
        return height - rest_height(self.surface.obj, quats[frames])

    @cached_property
    def distances(self) -> np.ndarray:
        """[M, 21] distances of the keypoints from the object's surface, negative inside, or from its origin if its mesh
        is unknown, in the M frames with a hand in which the object has moved [m]."""
        return self._distances_of(self.in_object[self.moved & self.seen])

    def _distances_of(self, points: np.ndarray) -> np.ndarray:
        """[..., 21] distances of points [..., 21, 3] in the object's frame from its surface, or from its origin."""
        if self.surface is None:
            return np.linalg.norm(points, axis=2)
        return self.surface.signed_distance(points)

    @cached_property
    def grip(self) -> tuple[float, float, float]:
        """Medians over the frames of :attr:`distances`: the distance of the nearest keypoint; that of the thumb's tip
        or of the nearest other fingertip, whichever is farther; and the sum of the depths, each beyond 5 mm [m]."""
        distance = self.distances
        fingers = distance[:, [8, 12, 16, 20]].min(axis=1)
        values = (
            distance.min(axis=1),
            np.maximum(distance[:, 4], fingers),
            (-distance - 0.005).clip(0.0).sum(axis=1),
        )
        nearest, grip, depth = (float(np.median(each)) for each in values)
        return nearest, grip, depth

    @cached_property
    def misfit(self) -> float:
        """The slip, and more if the object leans or is not at the table's height at the start, or if the hand is inside
        of the object or off its surface. A height that is a contradiction does not count: any other orientation may
        bring the object nearer to the table."""
        slip = self.slip()
        if self.surface is None or not len(self.distances):
            return slip
        _, grip, depth = self.grip
        height = abs(self.start_height)
        lean = np.clip(self.lean, 0.0, _MOST_LEAN)
        above = _LEAN_WEIGHT * (lean + height * (height <= _SETTLED))
        off = _DEPTH_WEIGHT * min(depth, _DEPTH) + _GRIP_WEIGHT * np.clip(grip, _NEAR, _GRIP)
        return float(slip * np.exp(above + off))

    @cached_property
    def nearest(self) -> float:
        """Least distance of a keypoint from the object's surface, or from its origin if its mesh is unknown, in any
        frame with a hand [m]."""
        return float(self._distances_of(self.in_object[self.seen]).min())

    @cached_property
    def matrix(self) -> np.ndarray:
        """[F, 3, 3] rotation matrices of the object."""
        return self.turn.as_matrix()

    def slip(self, lag: int = 0) -> float:
        """Mean speed of the hand in the object's frame, in speeds of the object, where the object moves; NaN without
        enough frames.

        Args:
            lag: frames by which the hand is late: its numbers are taken from later frames. Most of the steps without
                the lag must be known with it.
        """
        base, begin, step = self._steps
        last = len(self.points) - 1
        own = []
        for frame in (begin, begin + base):
            hand = self.points[(frame + lag).clip(0, last)]
            own.append(_in_frame(self.pos[frame], self.matrix[frame], hand))
        speed = np.linalg.norm(own[1] - own[0], axis=2).mean(axis=1)
        counts = np.isfinite(speed) & (begin + lag >= 0) & (begin + base + lag <= last)
        if counts.sum() < max(4, _KNOWN * len(begin)):
            return np.nan
        return float(speed[counts].sum() / step[counts].sum())

    @cached_property
    def _steps(self) -> tuple[int, np.ndarray, np.ndarray]:
        """Length of a step in frames, the frames in which a step begins that moves the object, and the object's
        motion in each of these steps [m]."""
        base = max(1, round(_BASE * self.fps))
        step = np.linalg.norm(self.places[base:] - self.places[:-base], axis=1)
        begin = np.flatnonzero(step > _LEAST_STEP)
        return base, begin, step[begin]

    @cached_property
    def off_table(self) -> float:
        """Distance from the object to the table's top in the first frame, from above; 0 above it [m]."""
        table = TableSpec()
        beyond = np.abs(self.places[0, :2] - table.center) - table.half_size[:2]
        return float(np.linalg.norm(beyond.clip(0.0)))

    @cached_property
    def lean(self) -> float:
        """How much higher the center of mass is at the start than where the object would rest on its next face, with
        the same side up [m]; 0 if the mesh is unknown or flat, or no face is near."""
        if self.surface is None:
            return 0.0
        obj = self.surface.obj
        up = self.matrix[0, 2]
        tops, heights = resting_faces(obj)
        near = tops @ up > _NEXT_FACE
        rests = heights[near].min(initial=np.inf)
        if not _THICK < rests < np.inf:
            return 0.0
        return float((obj.com @ up) - (obj.vertices @ up).min() - rests)

    @cached_property
    def contradictions(self) -> list[Contradiction]:
        """Contradictions between the places of hand, object and table."""
        return [*_of_start(self), *_of_hand(self)]

    @property
    def is_wrong(self) -> bool:
        """Whether a contradiction cannot be."""
        return any(contradiction.wrong for contradiction in self.contradictions)


def length_text(length: float) -> str:
    """Return a length [m] in words: ``47 mm``, ``41 cm``, ``3.2 m``."""
    size = abs(length)
    if size < 0.0995:
        return f"{1e3 * size:.0f} mm"
    return f"{100 * size:.0f} cm" if size < 1.995 else f"{size:.3g} m"


def _in_frame(pos: np.ndarray, matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """[F, K, 3] points in frames at positions [F, 3] with rotation matrices [F, 3, 3]."""
    return np.einsum("fji,fkj->fki", matrix, points - pos[:, None])


def _of_start(r: Recording) -> Iterator[Contradiction]:
    """Yield contradictions between the object's start and the table."""
    height = r.start_height
    low = r.least_height
    if r.surface is None:
        if not _ORIGIN[0] <= height <= _ORIGIN[1]:
            yield Contradiction(
                f"the object starts at z = {height:.3f} m, but the table's top is at z = 0", True
            )
        elif low < _ORIGIN[0]:
            yield Contradiction(
                f"the object is at z = {low:.3f} m later, but the table's top is at z = 0", True
            )
    elif height < -_SETTLED:
        yield Contradiction(
            f"the object starts {length_text(height)} inside the table", height < _SUNK
        )
    elif height > _SETTLED:
        yield Contradiction(
            f"the object starts {length_text(height)} above the table", height > _STACKED
        )
    if r.surface is not None and low < min(height, 0.0) - _BELOW:
        yield Contradiction(
            f"the object is {length_text(low)} inside the table later", low < _BURIED
        )
    if r.off_table > 0:
        yield Contradiction(
            f"the object starts {length_text(r.off_table)} beside the table's top", True
        )


def _of_hand(r: Recording) -> Iterator[Contradiction]:
    """Yield contradictions between the hand and the object."""
    if len(r.distances):
        yield from _of_grip(r)
    elif not r.moved.any() and r.seen.any() and r.nearest > (_AWAY if r.surface else _ARM):
        yield Contradiction(
            f"the hand comes no nearer to the object than {length_text(r.nearest)}", True
        )
    if (slip := r.slip()) > _SLIP:
        yield Contradiction(
            f"the hand moves past the object at {slip:.1f} times the object's speed", False
        )
    if r.seen.any():
        ahead = float(r.points[np.argmax(r.seen), 0, 1] - r.places[0, 1])
        if ahead < _BEHIND:
            yield Contradiction(
                "the hand comes from the -y side, but the person should be at +y", False
            )


def _of_grip(r: Recording) -> Iterator[Contradiction]:
    """Yield a contradiction of the distances of keypoints from a moved object's surface."""
    nearest, grip, depth = r.grip
    if r.surface is None:
        if nearest > _ARM:
            yield Contradiction(f"the hand is {length_text(nearest)} from the moving object", True)
        return
    where = "the surface of the moving object"
    if nearest > _NEAR:
        yield Contradiction(f"the hand is {length_text(nearest)} from {where}", nearest > _AWAY)
    elif grip > _GRIP:
        yield Contradiction(f"thumb or fingers are {length_text(grip)} from {where}", False)
    elif depth > _DEPTH:
        yield Contradiction(f"the hand is {length_text(nearest)} inside the moving object", False)


# Causes ---------------------------------------------------------------------------------------------------------------


class Cause(NamedTuple):
    """A cause, and the recording without it."""

    text: str
    """The cause and its remedy."""
    recording: Recording
    better: float = np.inf
    """Factor by which the misfit must be smaller without the cause, unless the recording cannot be right."""


def likeliest_cause(r: Recording) -> tuple[str, bool]:
    """Return the convention that fits best and leaves no contradiction, or else another place, or else what to look at;
    and whether the cause is certain."""
    if text := _best(r, _conventions(r), must_improve=not r.is_wrong):
        return text, True
    for cause in _places(r):
        if _fits(cause.recording, r.slip() * 1.1 + 0.02):
            return cause.text, False
    return _advice(r), False


def unnoticed_cause(r: Recording) -> str:
    """Return the cause of a recording without contradictions whose hand and object fit far better after a change; empty
    if there is none."""
    if np.isnan(r.slip()):
        found = (c.text for c in _units(r) if _fits(c.recording, _TOGETHER))
        return next(found, "")
    return _best(r, chain(_clocks(r), _orders(r), _inverses(r)), must_improve=True)


def _best(r: Recording, causes: Iterable[Cause], *, must_improve: bool) -> str:
    """Return the cause without which nothing contradicts itself and the misfit is smallest; empty if there is none.

    Args:
        must_improve: whether the misfit must be smaller by the cause's factor.
    """
    least = np.inf
    best = ""
    for cause in causes:
        other = cause.recording
        if not _fits(other, r.slip() * 1.1 + 0.02):
            continue
        if must_improve and other.misfit > cause.better * r.misfit:
            continue
        if not best or other.misfit < least:
            least = other.misfit
            best = cause.text
    return best


def _fits(other: Recording, slip: float) -> bool:
    """Return whether a changed recording has no contradiction and slips at most so much."""
    return bool(np.isnan(slip) or other.slip() <= slip) and not other.contradictions


def _conventions(r: Recording) -> Iterator[Cause]:
    """Yield other meanings of the numbers, the likeliest first."""
    yield from _cameras(r)
    yield from _units(r)
    yield from _clocks(r)
    yield from _orders(r)
    yield from _inverses(r)
    yield from _mirrors(r)
    yield from _mesh_units(r)
    points = np.einsum("fij,fkj->fki", r.matrix, r.points) + r.pos[:, None]
    yield Cause(
        "The keypoints may be given in the object's frame: convert them to the table's frame.",
        replace(r, points=points),
    )


def _places(r: Recording) -> Iterator[Cause]:
    """Yield other origins of the mesh, and axes of the table's frame if the object is far from its top."""
    yield from _origins(r)
    if r.is_wrong or r.start_height > 0:
        yield from _axes(r)


def _placed(r: Recording, hand: np.ndarray | None, obj: np.ndarray | None) -> Recording:
    """Return a recording whose hand and object are moved by matrices [4, 4]; None: it stays."""
    points = r.points
    pos = r.pos
    turn = r.turn
    if hand is not None:
        points = transformed(points, hand)
    if obj is not None:
        pos = transformed(pos, obj)
        turn = Rotation.from_matrix(obj[:3, :3]) * turn
    return replace(r, points=points, pos=pos, turn=turn)


def _in_own_frame(r: Recording) -> Recording:
    """Return a recording with the object's poses as the recording states them, in its own frame."""
    return _placed(r, None, np.linalg.inv(r.T_table))


def _cameras(r: Recording) -> Iterator[Cause]:
    """Yield errors of the camera's pose, and of what it was applied to."""
    if r.camera is None:
        return
    T = r.camera
    back = np.linalg.inv(T)
    flipped = T @ np.diag([1.0, -1.0, -1.0, 1.0]) @ back
    for of, hand, obj in (
        ("", True, True),
        (" of the hand", True, False),
        (" of the object", False, True),
    ):
        for text, change in (
            (
                f"The camera's matrix may be inverted: its inverse puts the object on the table. Write the inverse{of}"
                " into the file of --table-from-camera.",
                back @ back,
            ),
            (
                f"The coordinates{of} may be those of the table already: use --coordinates table for hand and object.",
                back,
            ),
            (
                f"The axes{of} may be OpenGL's (y up, z backwards): negate y and z of positions and poses{of}.",
                flipped,
            ),
        ):
            yield Cause(text, _placed(r, change if hand else None, change if obj else None))


def _axes(r: Recording) -> Iterator[Cause]:
    """Yield other axes of the table's frame."""
    for name, axis, angle in (
        ("y", "x", 90),
        ("-y", "x", -90),
        ("-z", "x", 180),
        ("x", "y", -90),
        ("-x", "y", 90),
    ):
        text = f"The {name} axis may point up: turn all poses so that z does."
        for heading in (0, 180, 90, -90):
            turned = _turn("z", heading) @ _turn(axis, angle)
            yield Cause(text, _placed(r, turned, turned))
    center = transform(np.eye(3), (*TableSpec().center, 0.0))
    for angle in (180, 90, -90):
        turn = _turn("z", angle)
        text = (
            f"The table's frame may be turned by {abs(angle)} degrees about z: the person should be at +y. Turn all"
            " poses."
        )
        for matrix in (turn, center @ turn @ np.linalg.inv(center)):
            yield Cause(text, _placed(r, matrix, matrix))


def _turn(axis: str, degrees: float) -> np.ndarray:
    """[4, 4]"""
    return transform(Rotation.from_euler(axis, degrees, degrees=True).as_matrix(), np.zeros(3))


def _mirrors(r: Recording) -> Iterator[Cause]:
    """Yield mirror images of the hand, in the camera's frame and in the table's."""
    T = r.T_table
    for axis in range(3):
        mirror = np.eye(4)
        mirror[axis, axis] = -1.0
        yield Cause(
            "The hand may be mirrored, as in the picture of a selfie camera, so that the side is wrong as well: negate"
            f" {'xyz'[axis]} of the keypoints, and give the other --side.",
            _placed(r, T @ mirror @ np.linalg.inv(T), None),
        )


def _orders(r: Recording) -> Iterator[Cause]:
    """Yield other orders of the numbers of the object's quaternions."""
    own = _in_own_frame(r)
    numbers = own.turn.as_quat(scalar_first=True)
    better = _BETTER if r.surface is None else _BETTER_TURN
    for order, shift in (("(x, y, z, w)", 1), ("(w, x, y, z)", -1)):
        turn = turn_of(np.roll(numbers, shift, axis=1))
        yield Cause(
            f"The object's quaternions may be in the order {order}: name them so.",
            _placed(replace(own, turn=turn), None, r.T_table),
            better,
        )


def _inverses(r: Recording) -> Iterator[Cause]:
    """Yield inverse orientations and poses of the object."""
    own = _in_own_frame(r)
    inverse = own.turn.inv()
    yield Cause(
        "The object's orientations may be inverted: transpose its matrices, or negate x, y and z of its quaternions.",
        _placed(replace(own, turn=inverse), None, r.T_table),
        _BETTER_INVERSE,
    )
    yield Cause(
        "The object's poses may be inverted, those of the camera in the object's frame: invert them.",
        _placed(replace(own, turn=inverse, pos=-inverse.apply(own.pos)), None, r.T_table),
        _BETTER_INVERSE,
    )


def _units(r: Recording) -> Iterator[Cause]:
    """Yield other units of the object's positions."""
    own = _in_own_frame(r)
    for scale, unit in (
        (1e3, "a thousandth"),
        (1e-3, "a thousand times"),
        (1e2, "a hundredth"),
        (1e-2, "a hundred times"),
        (10.0, "a tenth"),
        (0.1, "ten times"),
    ):
        yield Cause(
            f"The object's positions may be in another unit: their numbers are {unit} of what they should be. Use one"
            " unit for hand and object.",
            _placed(replace(own, pos=scale * own.pos), None, r.T_table),
        )


def _mesh_units(r: Recording) -> Iterator[Cause]:
    """Yield other units of the object's mesh, unless the hand is at its surface and only its height is unlikely."""
    off = len(r.distances) and (r.grip[0] > _NEAR or r.grip[1] > _GRIP)
    if r.surface is None or not (r.is_wrong or off):
        return
    for factor in _MESH_UNITS:
        for scale in (factor, 1 / factor):
            yield Cause(
                f"The mesh may be in another unit: import it again, {scale:.4g} times as large (xreset objects import"
                " --scale).",
                replace(r, surface=_Scaled(r.surface, scale)),
            )


class _Scaled(Surface):
    """The surface of an object in another unit."""

    def __init__(self, surface: Surface, scale: float) -> None:
        obj = surface.obj
        self.obj = replace(obj, vertices=scale * obj.vertices, com=scale * obj.com)
        self._surface = surface
        self._scale = scale

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        return self._scale * self._surface.signed_distance(points / self._scale)


def _clocks(r: Recording) -> Iterator[Cause]:
    """Yield the hand played backwards, and the lag of the hand that fits best."""
    backwards = replace(r, points=r.points[::-1])
    yield Cause("The hand may be played backwards: reverse its frames.", backwards, _BETTER)
    step = max(1, round(r.fps / 30))
    largest = min(round(_LARGEST_LAG * r.fps), len(r.pos) - 2)
    lags = list(range(-largest, largest + 1, step))
    slips = np.array([r.slip(lag) for lag in lags])
    if np.isfinite(slips).any():
        lag = lags[int(np.nanargmin(slips))]
        seconds = abs(lag) / r.fps
        if seconds > _LEAST_LAG:
            change = "late. Subtract it from" if lag > 0 else "early. Add it to"
            yield Cause(
                f"The clocks of hand and object may differ: the hand is {1e3 * seconds:.0f} ms {change} its times.",
                replace(r, points=_later(r.points, lag)),
                _BETTER,
            )


def _later(points: np.ndarray, lag: int) -> np.ndarray:
    """[F, ...] values that are taken from later frames; NaN beyond the ends."""
    moved = np.full_like(points, np.nan)
    count = len(points) - abs(lag)
    moved[max(-lag, 0) :][:count] = points[max(lag, 0) :][:count]
    return moved


def _origins(r: Recording) -> Iterator[Cause]:
    """Yield other origins of the object's mesh."""
    if r.surface is None:
        return
    obj = r.surface.obj
    low = obj.vertices.min(axis=0)
    high = obj.vertices.max(axis=0)
    middle = (low + high) / 2
    for name, origin in (
        ("the center of its box", middle),
        ("its center of mass", obj.com),
        ("the mean of its vertices", obj.vertices.mean(axis=0)),
        ("the middle of its lowest face", np.append(middle[:2], low[2])),
    ):
        yield Cause(
            f"The poses may be those of a mesh whose origin is {name}. Use the mesh that was tracked, or move its"
            " origin.",
            replace(r, pos=r.pos - r.turn.apply(origin)),
        )


def _advice(r: Recording) -> str:
    """Return what to look at if no cause was found by trying."""
    if list(_of_hand(r)):
        return (
            "Are hand and object in the same frame and unit, recorded at the same times, and is the mesh the one that"
            " was tracked?"
        )
    if r.off_table == 0 and r.start_height >= -_SETTLED and r.least_height < -_SETTLED:
        return (
            "The table's frame may be tilted, or the tracker may have lost the object: remove the frames in which it"
            " is inside the table."
        )
    if r.off_table > 0 or r.surface is None:
        return (
            "Are these the camera's coordinates (--coordinates camera --table-from-camera FILE), or is that matrix the"
            " inverse of what it should be?"
        )
    if r.start_height > 0:
        return (
            "It may stand on something that is not in the scene, or the recording begins after the lift. Otherwise the"
            " table's top is not at z = 0 in these coordinates, or the poses are those of a mesh with another origin."
        )
    return (
        "The poses may be those of a mesh with another origin, or the table's top is not at z = 0 in these coordinates."
        " Retargeting raises object and hand onto the table."
    )
