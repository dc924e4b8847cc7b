"""The examination of recordings: what cannot be or is unlikely, and the likeliest cause.

Numbers of a recording may all be allowed and still mean something else: coordinates of a camera, another mesh origin,
clocks that differ. A mesh tells most of it. What is certainly wrong is refused (:func:`refuse_wrong`), the rest is
said. The limits are far outside of what 600 sequences of DexYCB have; their own extremes stand next to each.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment

from xreset.demos.archive import Demos, demo_objects, levelled
from xreset.demos.causes import MOVED, Recording, length_text, likeliest_cause, unnoticed_cause
from xreset.demos.hand import ORDERS, bone_lengths
from xreset.demos.offset import constant_offset
from xreset.errors import DemoError
from xreset.files.checks import frozen
from xreset.files.processes import batches, in_processes
from xreset.geometry.shapes import turn_of
from xreset.geometry.surface import Surface, prepared_surface
from xreset.spec import FINGERS

TRUST = "If the recording is right all the same, add --trust-recordings (in Python: trust=True)."
"""The one way to use what is refused."""
_BATCH = 90
"""Sequences that one process examines at a time, at most."""
_SMALL_BATCH = 60
"""Sequences up to which one batch takes less time than a second process takes to start."""
_TOUCH = 0.020
"""A human keypoint nearer than this to the object's surface touches it [m]."""

_ONE_POINT = 0.01
"""A hand whose keypoints are all this close to its wrist is none [m]."""
_LONGEST_BONE = 0.25
"""[m] 0.100."""
_PALM = (0.060, 0.140)
"""Distance from the wrist to the middle finger's knuckle [m]: 0.089 to 0.100, with room for children and trackers."""
_ORDER_RATIO = 1.1
"""A hand in a wrong order has longer bones by at least this factor: 1.29 (MANO's read as MediaPipe's) and 1.50 at the
median."""
_BONE_SPREAD = 0.3
"""Largest relative standard deviation of a bone's length over a sequence; a tracker's noise is below, image coordinates
are above."""
_CURL = 0.015
"""Fingers that bend this far to the back of the hand, at the median of a sequence, are those of the other hand [m]."""
_THUMB = -0.01
"""Least distance of the thumb's tip from the plane of the palm, to the side to which fingers bend, at the median of a
sequence [m]: 0.022."""
_SKELETON = (0.69, 0.95)
"""Length of an adult hand's bones together [m]: 0.74 to 0.84."""
_ALONG = 0.9
"""Cosine of wrist and fingers: at least 0.983; 0.35 and -0.67 at the median if read in a wrong order."""
_THUMB_RATIO = 0.75
"""The thumb's first joint is nearer to the wrist than this share of a knuckle's distance: 0.53."""
_TIPS_RATIO = 1.12
"""Last bones of the fingers together, as a ratio to those with the best order of tips: at most 1.09 in DexYCB."""
_ADULT = 0.79
"""Mean length of the bones of DexYCB's people [m]."""
_ONE_PLACE = 0.01
"""A wrist, or the center of a hand, that moves less than this while the object moves stays at one point [m]."""
_LEANS = 0.009
"""An object whose center of mass is this much higher than where it would rest leans [m]: at most 0.0082 in those
sequences of DexYCB in which it is on the table, but one, in which it leans on another object."""
_SPEED_TIME = 0.2
"""Time over which the hand's speed is measured [s]: noise of a tracker hardly matters."""
_MOVES = 0.05
"""An object that is faster moves [m/s]."""
_RETURN = 0.030
"""A hand that leaves its path by this much for one frame jumps [m]: 0.008."""
_OBJECT_RETURN = 0.040
"""The same of an object [m]: 0.015."""
_TURN_RETURN = np.radians(45.0)
"""The same of its orientation [rad]: 20 degrees."""
_ACCELERATION = (1.1, 7.9)
"""Largest change of the hand's speed in a sequence, from one such time to the next [m/s^2]: 1.39 to 6.29. A rate that
is wrong by a factor of two changes it by four."""
_OBJECT_SPEED = 5.0
"""Speed of an object from frame to frame [m/s]: at most 1.7 in 599 of 600 sequences, 3.2 in the other."""
_REACH = 0.2
"""A hand that comes from nearer than this need not be fast [m]."""
_COPIES = 0.3
"""Share of frames in motion that repeat the frame before: 0."""
_FROZEN = 0.3
"""Longest time for which a hand may stay exactly where it is while its object moves, and an object before or after a
jump [s]: 0."""
_GOES_ON = 0.02
"""Step of an object's position with which its tracker loses or finds it [m]."""
_TURNS_ON = np.radians(5.0)
"""The same of its orientation [rad]."""
_TREMBLES = 0.003
"""Largest noise of an object's position in the calmest quarter of the frames, from second differences [m]: 0.0008."""
_TURN_TREMBLES = np.radians(3.0)
"""The same of its orientation [rad]: 1.1 degrees."""
_CALM = 1.2
"""Acceleration of an object in the calmest quarter of the frames [m/s^2]; 1.2 in recordings at 10 per second that begin
with the lift."""
_TURN_CALM = np.radians(1100.0)
"""The same of its orientation [rad/s^2]: 1100 degrees."""
_NEVER_TURNS = np.radians(0.1)
"""Smallest angle by which an object that moves turns [rad]: some degrees."""
_LOWERED = 0.05
"""How far an object's origin may get below its start, if its mesh is unknown [m]: 0.011."""
_SAME_PLACE = 0.02
"""Distance from the start within which the goal counts as reached [m] (:data:`xreset.eval.metrics.GOAL_DISTANCE`)."""
_SAME_TURN = np.radians(15.0)
"""The same for the angle [rad]."""


@frozen
class Finding:
    """What an examination has found in some sequences."""

    name: str
    """What was examined, such as ``place`` or ``jumps``."""
    wrong: bool
    """Whether the sequences are certainly wrong, and refused."""
    found: str
    """What was found in the first sequence, as a sentence."""
    cause: str
    """The likeliest cause and its remedy."""
    sequences: tuple[str, ...] = ()
    """Names of the sequences."""
    examined: int = 1
    """Number of sequences that were examined."""

    def __str__(self) -> str:
        where = ""
        if self.examined > 1:
            count = f"{len(self.sequences)} of {self.examined} sequences"
            where = f"{count}, the first is {self.sequences[0]}: "
        return f"{where}{self.found} {self.cause}"


def examine(
    demos: Demos,
    surfaces: Mapping[str, Surface] | None = None,
    *,
    camera: np.ndarray | None = None,
) -> list[Finding]:
    """Examine demonstrations; what is certainly wrong comes first.

    Args:
        demos: as recorded: objects are not yet put onto the table.
        surfaces: of the objects, by name; without them, whatever needs a mesh is left out.
        camera: [4, 4] pose of the camera in the table frame that positions were converted with.
    """
    demos = levelled(demos)
    rows = batches(np.arange(len(demos)), small=_SMALL_BATCH, most=_BATCH)
    parts = [demos.select(indices=some) for some in rows]
    findings_of = partial(_named_findings, surfaces=surfaces or {}, camera=camera)
    merged: dict[tuple[str, bool, str], Finding] = {}
    for name, finding in chain.from_iterable(in_processes(findings_of, parts)):
        key = (finding.name, finding.wrong, finding.cause)
        first = merged.get(key, replace(finding, examined=len(demos)))
        merged[key] = replace(first, sequences=(*first.sequences, name))
    return sorted(merged.values(), key=lambda finding: not finding.wrong)


def _named_findings(
    demos: Demos, surfaces: Mapping[str, Surface], camera: np.ndarray | None
) -> list[tuple[str, Finding]]:
    """Return what is found in each sequence, with the sequence's name."""
    found = []
    for index, name in enumerate(demos.sequence_name.tolist()):
        recording = _recording(demos, index, surfaces, camera)
        with np.errstate(all="ignore"):  # numbers of damaged files overflow
            found += [(name, finding) for finding in _findings(recording)]
    return found


def surfaces_of(demos: Demos, folder: str | Path | None) -> dict[str, Surface]:
    """Return the surfaces of the objects of demonstrations by name, from a folder of meshes; without one, none.

    Raises:
        DemoError: the folder lacks an object.
        ObjectError: a mesh cannot be used.
    """
    if folder is None:
        return {}
    return {name: prepared_surface(spec) for name, spec in demo_objects(demos, folder).items()}


def refuse_wrong(found: Sequence[Finding], *, trust: bool) -> list[str]:
    """Return what was found as notes.

    Args:
        trust: whether what is certainly wrong is a note, too.

    Raises:
        DemoError: something is certainly wrong; the message has all of it.
    """
    wrong = [str(finding) for finding in found if finding.wrong]
    if wrong and not trust:
        raise DemoError(" ".join((*wrong, TRUST)))
    return [str(finding) for finding in found]


def _recording(
    demos: Demos, index: int, surfaces: Mapping[str, Surface], camera: np.ndarray | None
) -> Recording:
    """Return one sequence, the hand's numbers as NaN where it was not seen."""
    frames = demos.frames(index)
    seen = demos.hand_valid[frames]
    return Recording(
        side=str(demos.hand_side[index]),
        fps=float(demos.fps),
        points=np.where(seen[:, None, None], demos.hand_keypoints[frames], np.nan).astype(float),
        wrist=demos.wrist_quat_wxyz[frames].astype(float),
        pos=demos.object_pos[frames].astype(float),
        turn=turn_of(demos.object_quat_wxyz[frames]),
        surface=surfaces.get(str(demos.object_name[index])),
        camera=camera,
    )


def _findings(r: Recording) -> Iterator[Finding]:
    """Yield what is found in one sequence. A hand that is none, or in another convention, hides everything else."""
    for finding in _of_hand(r):
        yield finding
        if finding.wrong:
            return
    jumps = _hand_jumps(r)
    points = r.points.copy()
    points[jumps] = np.nan
    # such a frame makes the hand fast, for which clocks that differ would be blamed
    yield from _of_place(replace(r, points=points) if len(jumps) else r)
    yield from _of_motion(r)


def _of_place(r: Recording) -> Iterator[Finding]:
    """Yield what is found about the places of hand, object and table: one finding with one cause."""
    found = r.contradictions
    if found:
        sentence = ", and ".join(contradiction.clause for contradiction in found)
        cause, certain = likeliest_cause(r)
        yield Finding(
            name="place",
            wrong=certain or r.is_wrong,
            found=f"{sentence[0].upper()}{sentence[1:]}.",
            cause=cause,
        )
    elif cause := unnoticed_cause(r):
        yield _error(
            "together", "Hand and object do not move together while the object moves.", cause
        )
    else:
        yield from _doubts_of_place(r)


def _doubts_of_place(r: Recording) -> Iterator[Finding]:
    """Yield doubts about places that contradict nothing."""
    if r.lean > _LEANS:
        yield _doubt(
            "lean",
            f"The object leans at the start, its center of mass {length_text(r.lean)} higher than at rest.",
            "It may lean on something that is not in the scene. Otherwise the table's frame is tilted, or the object's"
            " orientations are wrong.",
        )
    if offset := constant_offset(r):
        x, y, z = (100 * offset.shift).round().astype(int).tolist()
        yield _doubt(
            "offset",
            f"Thumb and fingers are off the surface of the moving object, or inside of it, by"
            f" {length_text(offset.miss)} together, but by {length_text(offset.left)} with the hand shifted by"
            f" ({x}, {y}, {z}) cm in the object's frame.",
            "The poses may be those of a mesh with another origin or orientation, or the hand's positions are off. Look"
            " at it with xreset view.",
        )


def _of_hand(r: Recording) -> Iterator[Finding]:
    """Yield what is found about the hand's shape. What follows after an error means nothing."""
    if not r.seen.any():
        return
    points = r.points[r.seen]
    size = np.linalg.norm(points - points[:, :1], axis=2).max(axis=1)
    absent = size < _ONE_POINT * (size.max() > _ONE_POINT)
    if absent.any():
        yield _error(
            "absent",
            f"In {np.count_nonzero(absent)} of {len(r.seen)} frames all keypoints are at one point.",
            "Leave cells empty, or write NaN, where the hand was not seen; 0 and -1 are places.",
        )
    bones = bone_lengths(points)
    if misread := _order_problem(points):
        yield _error(
            "order",
            misread,
            "State the order (--order), or put the keypoints into the order of xreset.spec.KEYPOINTS.",
        )
    palm = float(np.median(np.linalg.norm(points[:, 9] - points[:, 0], axis=1)))
    if not _PALM[0] <= palm <= _PALM[1]:
        yield _error(
            "size",
            f"From the wrist to the middle finger's knuckle it is {1e3 * palm:,.0f} mm, expected 60 to 140 mm.",
            "Is the unit right (--units)? Keypoints must be metric and in space, not those of an image.",
        )
    spread = np.median(bones.std(axis=0) / bones.mean(axis=0))
    if spread > _BONE_SPREAD:
        yield _error(
            "bones",
            f"The lengths of the hand's bones change by {spread:.0%} (standard deviation).",
            "The keypoints are not metric. MediaPipe's normalised landmarks, for example, are coordinates of the"
            " image.",
        )
    long = bones.max(axis=1) > _LONGEST_BONE
    if long.any():
        frame = int(np.flatnonzero(r.seen)[np.argmax(long)])
        yield _error(
            "bones",
            f"In {np.count_nonzero(long)} of {len(r.seen)} frames, first in frame {frame}, a bone of the hand is"
            f" {length_text(float(bones.max()))} long.",
            "A keypoint that was not seen may be written as a number: leave its cells empty, or write NaN.",
        )
    if fixed := _fixed_point(r):
        yield _error(
            "place of the hand",
            f"{fixed} stays at one point while the object moves.",
            "The keypoints are relative to the hand, like MediaPipe's world landmarks or a hand model's joints. Add"
            " the hand's position in the camera's or the table's frame first.",
        )
    curl, thumb = _to_palm(points, r.side)
    if curl < -_CURL or thumb < _THUMB:
        does = f"its fingers bend {-1e3 * curl:.0f} mm towards"
        if curl >= -_CURL:
            does = f"its thumb's tip is {-1e3 * thumb:.0f} mm to"
        yield _error(
            "side",
            f"As a {r.side} hand {does} the back of the hand.",
            "It is the other hand (--side), or the coordinates are left-handed, as Unity's are: negate one axis of"
            " keypoints and poses.",
        )
    yield from _doubts_of_hand(r)


def _skeleton(points: np.ndarray) -> float:
    """Return the length of the bones of keypoints [F, 21, 3] together, at the median [m]."""
    return float(np.median(bone_lengths(points).sum(axis=1)))


def _order_problem(points: np.ndarray) -> str:
    """Return what shows that keypoints [F, 21, 3] are in another order; empty if nothing does."""
    mano = np.array(ORDERS["mano"])
    reversed_fingers = np.arange(1, 21).reshape(5, 4)[:, ::-1]
    tips_first = np.append(0, reversed_fingers)
    orders = {
        "in MANO's order (--order mano)": mano,
        "in MediaPipe's order (--order mediapipe)": np.argsort(mano),
        "if each finger goes from tip to base": tips_first,
    }
    own = _skeleton(points)
    lengths = {name: _skeleton(points[:, order]) for name, order in orders.items()}
    best = min(lengths, key=lambda name: lengths[name])
    if own > _ORDER_RATIO * lengths[best]:
        return f"The bones of the hand are {own:.2f} m long together, but {lengths[best]:.2f} m {best}."
    from_wrist = np.linalg.norm(points[:, 1::4] - points[:, :1], axis=2)
    bases = np.median(from_wrist, axis=0)
    thumb = int(np.argmin(bases))
    if bases[thumb] < _THUMB_RATIO * bases[0]:
        order = ""
        if thumb == 4:
            to_thumb = np.linalg.norm(points[:, [1, 13]] - points[:, 17:18], axis=2)
            first, fourth = np.median(to_thumb, axis=0)
            order = " The fingers may go from the little finger to the thumb."
            if first < fourth:
                order = " The fingers may go from the index to the little finger, and then to the thumb."
        return f"Of the five fingers, number {thumb + 1} begins next to the wrist, as only a thumb does.{order}"
    across = points[:, 17] - points[:, 5]
    row = np.median(((points[:, 5::4] - points[:, 5:6]) * across[:, None]).sum(axis=-1), axis=0)
    if not (np.diff(row) > 0).all():
        return "The knuckles are not in a row from the index to the little finger."
    return _tips_problem(points)


def _tips_problem(points: np.ndarray) -> str:
    """Return which fingertips of keypoints [F, 21, 3] fit better to other fingers; empty if none does."""
    last_joints = points[:, 3::4]
    tips = points[:, 4::4]
    bones = np.linalg.norm(last_joints[:, :, None] - tips[:, None], axis=-1)
    lengths = np.median(bones, axis=0)
    fingers, fitting = linear_sum_assignment(lengths)
    if np.trace(lengths) <= _TIPS_RATIO * lengths[fingers, fitting].sum():
        return ""
    wrong = [FINGERS[finger] for finger in np.flatnonzero(fitting != fingers)]
    return f"The fingertips of {' and '.join(wrong)} fit each other's fingers: they are in another order."


def _fixed_point(r: Recording) -> str:
    """Return which part of the hand stays at one point while the object moves; an empty text if none does."""
    points = r.points[r.seen]
    still = np.ptp(r.places[r.seen], axis=0).max() < MOVED
    if len(points) < 2 or still:
        return ""
    for what, at in (
        ("The wrist", points[:, 0]),
        ("The center of the hand", points.mean(axis=1)),
    ):
        if np.ptp(at, axis=0).max() < _ONE_PLACE:
            return what
    return ""


def _to_palm(points: np.ndarray, side: str) -> tuple[float, float]:
    """Return how far fingers bend towards the palm, and how far the thumb's tip is on that side, at the median of
    keypoints [F, 21, 3] [m]."""
    palm_normal = np.cross(points[:, 5] - points[:, 0], points[:, 17] - points[:, 0])
    if side == "left":
        palm_normal *= -1
    palm_normal /= np.linalg.norm(palm_normal, axis=1, keepdims=True).clip(1e-9)
    fingers = points[:, [8, 12, 16, 20]] - points[:, [5, 9, 13, 17]]
    curl = np.median((fingers * palm_normal[:, None]).sum(axis=-1))
    thumb = np.median(((points[:, 4] - points[:, 5]) * palm_normal).sum(axis=-1))
    return float(curl), float(thumb)


def _doubts_of_hand(r: Recording) -> Iterator[Finding]:
    """Yield what no or hardly any human hand does."""
    points = r.points[r.seen]
    length = _skeleton(points)
    if not _SKELETON[0] <= length <= _SKELETON[1]:
        yield _doubt(
            "size",
            f"The bones of the hand are {length:.2f} m long together, those of adults {_SKELETON[0]:.2f} to"
            f" {_SKELETON[1]:.2f} m.",
            f"Its scale may be wrong by a factor of {_ADULT / length:.2f}, unless it is a child's hand.",
        )
    # a right hand's fingers point along the wrist's -x axis, a left hand's along +x
    fingers = points[:, [5, 9, 13, 17]].mean(axis=1) - points[:, 0]
    fingers /= np.linalg.norm(fingers, axis=1, keepdims=True).clip(1e-9)
    along = (turn_of(r.wrist[r.seen]).apply([1.0, 0.0, 0.0]) * fingers).sum(axis=1)
    cosine = np.median(-along if r.side == "right" else along)
    if cosine < _ALONG:
        yield _doubt(
            "wrist",
            f"The wrist's orientations do not point along the fingers (cosine {cosine:.2f}, expected 1).",
            "Are they MANO's root, in the table frame, and quaternions (w, x, y, z)? Check those of the objects too.",
        )
    wrist = r.points[:, 0]
    jumps = _hand_jumps(r)
    if len(jumps):
        far = float(np.linalg.norm(wrist[jumps[0]] - wrist[jumps[0] - 1]))
        yield _doubt(
            "jumps",
            f"The hand jumps in {len(jumps)} of {len(wrist)} frames, first in frame {jumps[0]} by"
            f" {length_text(far)}.",
            "Leave the hand's cells empty in these frames.",
        )
    yield from _doubts_of_speed(r, jumps)


def _doubts_of_speed(r: Recording, jumps: np.ndarray) -> Iterator[Finding]:
    """Yield doubts about speeds and about frames that repeat; jumps: frames that do not count."""
    wrist = r.points[:, 0].copy()
    wrist[jumps] = np.nan
    base = max(1, round(_SPEED_TIME * r.fps))
    speed = (wrist[base:] - wrist[:-base]) * r.fps / base
    change = np.linalg.norm(speed[base:] - speed[:-base], axis=1) * r.fps / base
    if not np.isfinite(change).any():
        return
    largest = float(np.nanmax(change))
    place = wrist[r.seen & np.isfinite(wrist[:, 0])]
    came_from = np.linalg.norm(place - place[0], axis=1).max()
    low, high = _ACCELERATION
    if largest > high or (largest < low and came_from > _REACH):
        yield _doubt(
            "speed",
            f"The hand speeds up or slows down by {largest:.2g} m/s^2 at most; people reach with {low:g} to {high:g}.",
            f"Is the rate of {r.fps:g} frames per second right (--fps)?",
        )
    same = (r.points[1:] == r.points[:-1]).all(axis=(1, 2))
    moves = _moves(r)
    longest = _longest_run(same & moves) / r.fps
    if longest > _FROZEN:
        yield _doubt(
            "frozen",
            f"The hand does not move at all for {longest:.1f} s while the object moves.",
            "The tracker may have lost it: leave the hand's cells empty in these frames.",
        )
    else:
        yield from _copies("copies", "the hand", same, moves)


def _of_motion(r: Recording) -> Iterator[Finding]:
    """Yield doubts about the object's motion."""
    turn = (r.turn[-1] * r.turn[0].inv()).magnitude()
    if np.linalg.norm(r.places[-1] - r.places[0]) < _SAME_PLACE and turn < _SAME_TURN:
        yield _doubt(
            "goal",
            "It begins with the object at its goal already.",
            "A policy that leaves the object untouched solves such a demonstration.",
        )
    below = float(r.pos[0, 2] - r.pos[:, 2].min())
    if r.surface is None and below > _LOWERED:
        yield _doubt(
            "lowered",
            f"The object's origin gets {length_text(below)} below its place at the start, where the object should stand"
            " on the table.",
            "The recording may begin after the lift, or be played backwards. With meshes (--meshes) more can be told.",
        )
    if len(r.pos) < 3:
        return
    speed = r.fps * np.linalg.norm(np.diff(r.places, axis=0), axis=1)
    angle = r.step_turn.magnitude()
    across = (r.turn[2:] * r.turn[:-2].inv()).magnitude()
    turned = np.minimum(angle[1:], angle[:-1]) - across > _TURN_RETURN
    jumps = np.zeros(len(r.pos), dtype=bool)
    jumps[1:] |= speed > _OBJECT_SPEED
    jumps[1:-1] |= (_returns(r.places) > _OBJECT_RETURN) | turned
    if jumps.any():
        yield _doubt(
            "jumps",
            f"The object jumps from frame to frame, first in frame {np.argmax(jumps)}.",
            "Poses that were not seen may be written as numbers. Repair these frames, or leave the sequence out"
            " (xreset demos select --rest).",
        )
    elif lost := _lost_frame(r):
        yield _doubt(
            "frozen",
            f"The object's position or orientation does not change at all for {_FROZEN:g} s or longer, before or after"
            f" a jump, first in frame {lost}.",
            "The tracker may have lost it: repair these frames, or leave the sequence out (xreset demos select"
            " --rest).",
        )
    yield from _doubts_of_tracking(r)
    if r.moved.any() and (r.turn * r.turn[0].inv()).magnitude().max() < _NEVER_TURNS:
        yield _doubt(
            "turn",
            "The object moves but does not turn at all.",
            "Its orientations may be missing, or those of the first frame.",
        )
    if r.moved.any() and not (r.moved & r.seen).any():
        yield _doubt(
            "unseen",
            "The hand is not seen in any frame in which the object has moved.",
            "No state with a grasp can come from it.",
        )


def _copies(name: str, what: str, same: np.ndarray, moves: np.ndarray) -> Iterator[Finding]:
    """Yield a doubt about frames that are the same as the frame before [F-1] while the object moves [F-1]."""
    share = (same & moves).sum() / max(moves.sum(), 1)
    if share > _COPIES:
        yield _doubt(
            name,
            f"In {share:.0%} of the frames in which the object moves, {what} is an exact copy of the frame before.",
            "It may have been recorded at a lower rate: remove the copies, and state the times.",
        )


def _error(name: str, found: str, cause: str) -> Finding:
    return Finding(name=name, wrong=True, found=found, cause=cause)


def _doubt(name: str, found: str, cause: str) -> Finding:
    return Finding(name=name, wrong=False, found=found, cause=cause)


def _returns(path: np.ndarray) -> np.ndarray:
    """[F-2] how far a path [F, 3] leaves for one frame and comes back [m]; NaN where it is unknown."""
    step = np.linalg.norm(np.diff(path, axis=0), axis=1)
    across = np.linalg.norm(path[2:] - path[:-2], axis=1)
    return np.minimum(step[1:], step[:-1]) - across


def _hand_jumps(r: Recording) -> np.ndarray:
    """Return the frames in which the hand leaves its path and comes back."""
    return np.flatnonzero(_returns(r.points[:, 0]) > _RETURN) + 1


def _lost_frame(r: Recording) -> int:
    """Return the first frame to which an object jumps, before or after its position or its orientation does not change
    at all for a while; 0 if there is none. The first step of one that stood still is no jump at a low rate."""
    quats = r.turn.as_quat()
    dt = 1.0 / r.fps
    step = np.linalg.norm(np.diff(r.pos, axis=0), axis=1)
    angle = r.step_turn.magnitude()
    least = int(_FROZEN * r.fps) + 1
    for same, jumps in (
        (step == 0.0, step > _GOES_ON + _CALM * dt**2),
        ((quats[1:] == quats[:-1]).all(axis=1), angle > _TURNS_ON + _TURN_CALM * dt**2),
    ):
        for frame in np.flatnonzero(jumps).tolist():
            for stays in (same[:frame][-least:], same[frame + 1 :][:least]):
                if len(stays) == least and stays.all():
                    return frame + 1
    return 0


def _doubts_of_tracking(r: Recording) -> Iterator[Finding]:
    """Yield doubts about an object that trembles, or whose poses repeat while it moves."""
    quats = r.turn.as_quat()
    same = (r.pos[1:] == r.pos[:-1]).all(axis=1) & (quats[1:] == quats[:-1]).all(axis=1)
    if copies := list(_copies("object copies", "its pose", same, _moves(r))):
        yield from copies
        return
    place = np.linalg.norm(np.diff(r.places, n=2, axis=0), axis=1) / np.sqrt(6.0)
    angle = np.linalg.norm(np.diff(r.step_turn.as_rotvec(), axis=0), axis=1) / np.sqrt(6.0)
    trembles = []
    dt = 1.0 / r.fps
    for values, most, text in (
        (place, _TREMBLES + _CALM * dt**2, f"{1e3 * np.percentile(place, 25):.0f} mm"),
        (
            angle,
            _TURN_TREMBLES + _TURN_CALM * dt**2,
            f"{np.degrees(np.percentile(angle, 25)):.0f} degrees",
        ),
    ):
        if np.percentile(values, 25) > most:
            trembles.append(text)
    if trembles:
        yield _doubt(
            "trembles",
            f"The object trembles from frame to frame, by {' and '.join(trembles)}.",
            "Smooth its poses, or look for frames in a wrong order. States with a grasp follow the object exactly.",
        )


def _moves(r: Recording) -> np.ndarray:
    """[F-1] bool: whether the object moves around a step of its motion, between the first and the last one."""
    around = np.pad(r.places, ((1, 1), (0, 0)), mode="edge")
    moves = np.linalg.norm(around[3:] - around[:-3], axis=1) * r.fps > 3 * _MOVES
    steps = np.flatnonzero(np.diff(r.pos, axis=0).any(axis=1))
    moves[: steps.min(initial=len(moves))] = moves[steps.max(initial=-1) + 1 :] = False
    return moves


def _longest_run(flags: np.ndarray) -> int:
    """Return the length of the longest run of true flags."""
    ends = np.flatnonzero(np.diff(np.concatenate(([0], flags.astype(int), [0]))))
    return int((ends[1::2] - ends[::2]).max(initial=0))


def human_contacts(demos: Demos, surfaces: Mapping[str, Surface]) -> tuple[np.ndarray, np.ndarray]:
    """Find where human hands touch the objects: where keypoints are nearer than 2 cm to the surface.

    Args:
        demos: demonstrations over the table.
        surfaces: surface of every object that the demonstrations name.

    Returns:
        Contact points [F, 21, 3] in the world, zero where there is no contact, and whether there is one [F, 21].
    """
    keypoints = np.where(demos.hand_valid[:, None, None], demos.hand_keypoints, np.nan)
    points = np.zeros_like(keypoints)
    touching = np.zeros(keypoints.shape[:2], dtype=bool)
    object_name = demos.object_name[demos.sequence_of_frame]
    for name in demos.object_names:
        rows = object_name == name
        points[rows], touching[rows] = surfaces[name].contacts(
            keypoints[rows], demos.object_pos[rows], demos.object_quat_wxyz[rows], _TOUCH
        )
    return points, touching
