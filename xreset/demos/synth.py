"""Synthetic demonstrations: a human-like hand reaches for an object on the table, grasps it, lifts it and turns it to a
goal pose.

They stand in for recorded motion where none may be shipped, and have the same form: the ranges below (starts of objects
and hands, heights and times of lifts) follow DexYCB's (Chao et al. 2021). Grasps are geometric: nothing here has been
simulated.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from xreset.demos import hand
from xreset.demos.archive import SIDES, Demos, merge_demos, one_sequence
from xreset.demos.grasp import Contacts, Grasp, Solid, fit_hand, handedness, plan_contacts
from xreset.errors import DemoError
from xreset.files.processes import in_processes
from xreset.files.progress import Progress
from xreset.geometry.shapes import transform, turn_of
from xreset.objects.catalogue import load_objects
from xreset.objects.rest import rest_height, resting_orientation
from xreset.objects.sampling import center
from xreset.spec import ObjectSpec

SUBJECT = "synthetic"
WORKSPACE = ((0.42, 0.72), (0.12, 0.40))
"""Ranges of x and y in which objects start [m]."""
CLOSING_AZIMUTH = (np.radians(25.0), np.radians(115.0))
"""Direction from a right hand's fingers to its thumb, as an angle about z: people at +y hold objects so. A left hand's
is mirrored in x."""
MAX_SEQUENCES = 100_000
"""Most sequences of each object."""

_Z = (0.0, 0.0, 1.0)
_UP = (_Z, (0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0))
"""Mesh directions that may point up at the start."""
_UPRIGHT = 0.25
"""Share of the sequences that start with z up; the others start with any of the sides up. With both, 37 % of 400 DexYCB
sequences start with z up."""
_NEAR_BEST = 1.0
"""Plans whose cost is within this of the best plan's count as equally good."""
_GRASP_TRIES = 5
"""Grasps that a sequence tries until one has an approach that stays clear."""
_TRIES = 12
"""Attempts at each grasp, and approaches to it."""
_GOOD_TIP_ERROR = 0.006
_GOOD_PENETRATION = 0.004
"""[m] A grasp is good below both."""
LIFT = (0.14, 0.41)
"""Range of heights to which objects are lifted [m]: the 5th and 95th percentile of 180 right-hand DexYCB sequences, as
in the ranges that follow."""
GOAL = ((0.42, 0.63), (0.0, 0.33))
"""Ranges of x and y in which objects end [m]."""
GOAL_HEADING = (np.radians(-26.0), np.radians(26.0))
"""Direction of a right hand's fingers at the goal, as an angle about z from -y."""
GOAL_PITCH = (np.radians(-34.0), np.radians(27.0))
"""Angle of the fingers at the goal above the horizontal."""
GOAL_ROLL = (np.radians(-85.0), np.radians(90.0))
"""Angle of the palm at the goal about the fingers: at -90 degrees it faces down, at 90 up, and at 0 a right hand's
faces +x. 90 is the 95th percentile of turns of over 120 degrees (66 that of all)."""

_NEAR_CENTER = 0.03
"""Farthest that an object's origin may be from its center [m]: 0.021 at most in twenty objects of the YCB set."""
_BATCH = 10
"""Sequences that a process makes before it reports: a few seconds, or a minute with a complicated mesh."""
_FEW = 16
"""Sequences up to which other processes take longer to start than they save."""
_CLEAR = 0.001
"""A path is good if no keypoint comes nearer than this to object or table [m]; a fingertip in contact is at about 2
mm."""
_OPENING = np.array([0.0, 0.4, 0.2] * 4 + [-0.15, -0.1, 0.0, 0.3, 0.3])
"""[17] joint angles by which a hand opens before a grasp [rad]."""


def synthetic_demos(
    names: Iterable[str] | None,
    per_object: int,
    seed: int,
    *,
    fps: float,
    sides: Sequence[str],
    meshes: str | Path | None,
    progress: Progress,
) -> Demos:
    """Return the demonstrations of :func:`xreset.demos.verbs.synthesize`, of one hand after another."""
    if not 1 <= per_object <= MAX_SEQUENCES or not 5 <= fps <= 1000:
        raise DemoError(
            f"per_object is {per_object} and fps is {fps}, expected 1 to {MAX_SEQUENCES} sequences and 5 to 1000"
            " frames per second."
        )
    if unknown := sorted(set(sides) - set(SIDES)):
        raise DemoError(f"side is {unknown[0]!r}, expected 'right', 'left' or 'both'.")
    specs = load_objects(names, meshes)
    batches = []
    for side in sides:
        for spec in specs:
            for first in range(0, per_object, _BATCH):
                indices = range(first, min(first + _BATCH, per_object))
                batches.append(_Batch(spec, side, seed, fps, indices))
    in_all = len(specs) * per_object * len(sides)
    compute = in_processes if in_all > _FEW else map
    parts = []
    for sequences in compute(_sequences, batches):
        parts += sequences
        progress(len(parts), in_all)
    return merge_demos(parts)


class _Batch(NamedTuple):
    """Sequences of one object and one hand that a process makes."""

    obj: ObjectSpec
    side: str
    seed: int
    fps: float
    indices: range


def _sequences(batch: _Batch) -> list[Demos]:
    """Make the sequences of a batch; a function of a module, for other processes."""
    obj, side, seed, fps, indices = batch
    obj, moved = _centered(obj)
    starts = _Starts(obj, side)
    parts = []
    for index in indices:
        name = f"{SUBJECT}/{obj.name}_{side}_{seed}_{index:03d}"
        rng = np.random.default_rng([seed, index, zlib.crc32(obj.name.encode()), side == "left"])
        demos = _sequence(obj, starts, name, side, fps, rng)
        shift = turn_of(demos.object_quat_wxyz).apply(moved).astype(np.float32)
        parts.append(replace(demos, object_pos=demos.object_pos - shift))
    return parts


def _sequence(
    obj: ObjectSpec,
    starts: _Starts,
    name: str,
    side: str,
    fps: float,
    rng: np.random.Generator,
) -> Demos:
    """Make one sequence from the ways in which the object may start."""
    resting, plans = starts.draw(rng)
    timing = _random_timing(fps, rng)
    approaches = (
        _clear_approach(_grasp(obj, resting, plans, side, rng), timing, rng)
        for _ in range(_GRASP_TRIES)
    )
    path = _first_clear(approaches, least_gap=0.0)
    grasp = path.grasp
    solid = grasp.solid
    object_pos, object_rot = _object_path(grasp, timing, side, rng)
    # From the lift on, the hand moves with the object.
    moved = object_rot * solid.rotation.inv()
    lift = timing[2]
    held = (np.arange(len(object_pos)) >= lift)[:, None]
    carried = moved.apply(grasp.wrist_pos - solid.pos) + object_pos
    wrist_pos = np.where(held, carried, path.wrist_pos)
    wrist_quat = np.where(held, (moved * grasp.wrist_rot).as_quat(), path.wrist_rot.as_quat())
    wrist_rot = Rotation.from_quat(wrist_quat)
    return one_sequence(
        name=name,
        subject=SUBJECT,
        object_name=obj.name,
        side=side,
        fps=fps,
        keypoints=hand.placed(wrist_pos, wrist_rot, path.angles, side),
        wrist=wrist_rot,
        object_pos=object_pos,
        object_rot=object_rot,
    )


def _centered(obj: ObjectSpec) -> tuple[ObjectSpec, np.ndarray]:
    """Return an object whose origin is near its center, and how far its origin was moved [3] [m]. Places, lifts and
    turns are those of the origin."""
    middle = center(obj)
    if np.linalg.norm(middle) <= _NEAR_CENTER:
        return obj, np.zeros(3)
    back = transform(np.eye(3), -middle)
    pieces = [replace(piece, T_body_shape=back @ piece.T_body_shape) for piece in obj.pieces]
    vertices = obj.vertices - middle
    return replace(obj, pieces=tuple(pieces), vertices=vertices, com=obj.com - middle), middle


class _Starts:
    """Ways in which an object may start, each planned when it is first drawn."""

    def __init__(self, obj: ObjectSpec, side: str) -> None:
        self._obj = obj
        self._side = side
        self._planned: dict[int, tuple[Solid, list[Contacts]]] = {}

    def draw(self, rng: np.random.Generator) -> tuple[Solid, list[Contacts]]:
        """Return the object at rest at the origin, on a random side that leaves something to hold, and the best plans
        to hold it."""
        order = rng.permutation(len(_UP)).tolist()
        if rng.random() < _UPRIGHT:
            order.insert(0, 0)
        for number in order:
            if number not in self._planned:
                self._planned[number] = self._plan(np.array(_UP[number]))
            resting, plans = self._planned[number]
            if plans:
                return resting, plans
        raise DemoError(
            f"No stable pinch found for {self._obj.name}: no part within reach of thumb and fingers is narrow enough."
            " Omit this object."
        )

    def _plan(self, up: np.ndarray) -> tuple[Solid, list[Contacts]]:
        """Return the object at rest with a side up, and the best plans to hold it."""
        quat = resting_orientation(self._obj, up)
        height = rest_height(self._obj, quat)
        solid = Solid.of(self._obj, np.array([0.0, 0.0, height]), turn_of(quat))
        plans = plan_contacts(solid, self._side)
        return solid, [plan for plan in plans if plan.cost < plans[0].cost + _NEAR_BEST]


def _grasp(
    obj: ObjectSpec, resting: Solid, plans: Sequence[Contacts], side: str, rng: np.random.Generator
) -> Grasp:
    """Return the best of some random grasps of the object somewhere on the table; a good grasp ends the search."""

    tries = []
    for _ in range(_TRIES):
        plan = plans[int(rng.integers(len(plans)))]
        azimuth = rng.uniform(*CLOSING_AZIMUTH)
        if side == "left":
            azimuth = np.pi - azimuth
        yaw = Rotation.from_euler("z", azimuth - np.arctan2(plan.closing[1], plan.closing[0]))
        place = np.array([rng.uniform(*WORKSPACE[0]), rng.uniform(*WORKSPACE[1]), 0.0])
        contacts = replace(
            plan,
            points=yaw.apply(plan.points) + place,
            approach=yaw.apply(plan.approach),
            closing=yaw.apply(plan.closing),
        )
        solid = Solid.of(obj, place + resting.pos, yaw * resting.rotation)
        grasp = fit_hand(solid, contacts, side)
        tries.append(grasp)
        if grasp.tip_error < _GOOD_TIP_ERROR and grasp.penetration < _GOOD_PENETRATION:
            break
    return min(
        tries,
        key=lambda grasp: grasp.tip_error / _GOOD_TIP_ERROR + grasp.penetration / _GOOD_PENETRATION,
    )


# Motion ---------------------------------------------------------------------------------------------------------------


_Timing = tuple[int, ...]
"""Events of a demonstration, as numbers of frames: the hand has arrived, the fingers are on the object, the object
begins to move, it is at the goal, and the last frame."""


class _HandPath(NamedTuple):
    """A hand's motion up to the grasp, which holds to the end."""

    gap: float
    """Smallest distance of a keypoint from object and table until the lift [m]."""
    grasp: Grasp
    wrist_pos: np.ndarray
    """[T, 3]"""
    wrist_rot: Rotation
    """T orientations."""
    angles: np.ndarray
    """[T, 17] joint angles."""


def _random_timing(fps: float, rng: np.random.Generator) -> _Timing:
    """Draw the timing of a demonstration of about 2.4 s whose object leaves the table after about 1.15 s."""
    spans = ((0.75, 0.95), (0.15, 0.25), (0.05, 0.1), (0.8, 1.0), (0.25, 0.45))
    seconds = np.cumsum([rng.uniform(*span) for span in spans])
    return tuple(round(second * fps) for second in seconds.tolist())


def _object_path(
    grasp: Grasp, timing: _Timing, side: str, rng: np.random.Generator
) -> tuple[np.ndarray, Rotation]:
    """Draw the motion of a grasped object: at rest, lifted, turned as the hand turns to its pose at the goal.

    Returns:
        Positions [T, 3] and T orientations.
    """
    pos = grasp.solid.pos
    goal = np.array([rng.uniform(*GOAL[0]), rng.uniform(*GOAL[1]), pos[2] + rng.uniform(*LIFT)])
    turn = _hand_at_goal(side, rng) * grasp.wrist_rot.inv()
    _, _, lift, end, last = timing
    frame = np.arange(last + 1)
    rise = _minimum_jerk(frame, lift, end)
    turned = _minimum_jerk(frame, lift + 0.2 * (end - lift), end)  # clear of the table
    object_rot = Rotation.from_rotvec(turned[:, None] * turn.as_rotvec()) * grasp.solid.rotation
    return pos + rise[:, None] * (goal - pos), object_rot


def _hand_at_goal(side: str, rng: np.random.Generator) -> Rotation:
    """Draw the wrist's orientation at the goal: people turn their palm about a forearm that points away from them."""
    heading = rng.uniform(*GOAL_HEADING)
    pitch = rng.uniform(*GOAL_PITCH)
    roll = rng.uniform(*GOAL_ROLL)
    level = np.array([np.sin(heading), -np.cos(heading), 0.0])
    fingers = np.cos(pitch) * level + np.sin(pitch) * np.array(_Z)
    sideways = np.cross(_Z, level)  # +x, where a right hand's palm faces
    up = np.cross(fingers, sideways)
    if side == "left":
        sideways = -sideways
    palm = np.cos(roll) * sideways + np.sin(roll) * up
    return Rotation.from_matrix(hand.hand_axes(fingers, palm, side))


def _clear_approach(grasp: Grasp, timing: _Timing, rng: np.random.Generator) -> _HandPath:
    """Return the first of some random approaches that stays clear of object and table, or else the one with the largest
    gap."""
    return _first_clear((_approach(grasp, timing, rng) for _ in range(_TRIES)), least_gap=_CLEAR)


def _first_clear(paths: Iterable[_HandPath], least_gap: float) -> _HandPath:
    """Return the first path whose gap is larger than ``least_gap`` [m], or else the path with the largest gap."""
    tries = []
    for path in paths:
        tries.append(path)
        if path.gap > least_gap:
            break
    return max(tries, key=lambda path: path.gap)


def _approach(grasp: Grasp, timing: _Timing, rng: np.random.Generator) -> _HandPath:
    """Move to a place before the object while the hand opens, then forward, then close: minimum-jerk motions that
    overlap."""
    reach, close, lift, _, last = timing
    frame = np.arange(last + 1)
    mirror = handedness(grasp.side)
    x = grasp.solid.pos[0] - mirror * rng.uniform(-0.05, 0.20)
    y = rng.uniform(0.60, 0.80)
    z = grasp.wrist_pos[2] + rng.uniform(0.02, 0.18)
    start = np.array([x, y, z])
    start_rot = Rotation.from_rotvec(rng.normal(0.0, 0.2, 3)) * grasp.wrist_rot
    fingers = grasp.wrist_rot.apply([-mirror, 0.0, 0.0])
    palm = grasp.wrist_rot.apply([0.0, -1.0, 0.0])
    inward = fingers + 0.6 * palm
    before = grasp.wrist_pos - rng.uniform(0.07, 0.10) * inward / np.linalg.norm(inward)
    before[2] = max(before[2], grasp.wrist_pos[2])

    coming = _minimum_jerk(frame, 0, 0.75 * reach)[:, None]
    entering = _minimum_jerk(frame, 0.5 * reach, close)[:, None]
    wrist_pos = start + coming * (before - start) + entering * (grasp.wrist_pos - before)
    turning = _minimum_jerk(frame, 0, 0.85 * reach)[:, None]
    wrist_rot = (
        Rotation.from_rotvec((1 - turning) * (start_rot * grasp.wrist_rot.inv()).as_rotvec())
        * grasp.wrist_rot
    )

    opened = np.clip(grasp.angles - _OPENING, hand.LOWER, hand.UPPER)
    opening = _minimum_jerk(frame, 0.1 * reach, 0.65 * reach)[:, None]
    closing = _minimum_jerk(frame, 0.8 * reach, close)[:, None]
    angles = hand.RELAXED + opening * (opened - hand.RELAXED) + closing * (grasp.angles - opened)
    points = hand.placed(wrist_pos, wrist_rot, angles, grasp.side)[:lift]
    gap = min(grasp.solid.distance(points).min(), points[..., 2].min())
    return _HandPath(float(gap), grasp, wrist_pos, wrist_rot, angles)


def _minimum_jerk(frame: np.ndarray, start: float, end: float) -> np.ndarray:
    """Return 0 until ``start``, 1 from ``end``, and between them the smoothest path of human reaching (Flash and Hogan
    1985)."""
    s = np.clip((frame - start) / (end - start), 0.0, 1.0)
    return s**3 * (10 + s * (6 * s - 15))
