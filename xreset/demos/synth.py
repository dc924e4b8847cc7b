"""Synthetic demonstrations: a human-like hand reaches for an object on the table, grasps it, lifts it and turns it to a goal pose.

They stand in for recorded motion where none may be shipped, and have the same form: the ranges below (where objects start, where hands
come from, how far objects are lifted, when) follow DexYCB's (Chao et al. 2021). Grasps are geometric: nothing here has been simulated.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from xreset.demos.archive import Demos, concatenate
from xreset.demos.grasp import Contacts, Grasp, Solid, fit_hand, plan_contacts
from xreset.demos.motion import HandPath, clear_approach, object_path, place_hand, random_timing
from xreset.errors import DemoError
from xreset.objects.catalogue import load_object, object_names
from xreset.objects.rest import rest_height, resting_orientation
from xreset.spec import ObjectSpec

SUBJECT = "synthetic"
WORKSPACE = ((0.42, 0.72), (0.12, 0.40))
"""Where objects start: ranges of x and y [m]."""
CLOSING_AZIMUTH = (np.radians(25.0), np.radians(80.0))
"""Direction from a right hand's fingers to its thumb, as an angle about z: people at +y hold objects so. A left hand's is mirrored in x."""

_REST_UP = {  # mesh directions that may point up at the start; else z
    "005_tomato_soup_can": ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0)),  # 9 of 20 lie in DexYCB
    "035_power_drill": ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0)),
}
_NEAR_BEST = 1.0  # planning costs within this of the best are as good
_TRIES = 12
_GRASP_TRIES = 5
_GOOD_TIP_ERROR = 0.006  # [m]
_GOOD_PENETRATION = 0.004  # [m]


@dataclass(frozen=True, kw_only=True)
class _Start:
    """A way in which an object rests at the origin, and how it may be held there."""

    rest: Rotation
    height: np.ndarray
    """[3] position of the mesh frame."""
    plans: tuple[Contacts, ...]


def synthesize(
    objects: Iterable[str] | None = None,
    per_object: int = 4,
    seed: int = 0,
    *,
    fps: float = 30.0,
    side: Literal["right", "left"] = "right",
    meshes: str | Path | None = None,
    progress: Callable[[int, int, str], None] = lambda done, total, name: None,
) -> Demos:
    """Synthetic demonstrations of the built-in stand-ins, or of the objects of a folder of meshes, which stand with z up.

    The same arguments give the same arrays, and a sequence does not depend on which others are made.

    Args:
        objects: names, official or the paper's; None for all.
        per_object: sequences of each object.
        seed: chooses all that varies: place and heading of the object, grasp, paths, timing, goal pose.
        fps: frames per second; a sequence lasts about 2.4 s.
        meshes: folder of real meshes; None for the stand-ins.
        progress: called with (sequences done, sequences in all, name) before each sequence is made.

    Raises:
        ObjectError: unknown object.
        DemoError: ``per_object`` is not positive, ``fps`` is too small for a motion of a second, or an object cannot be held.
    """
    if per_object < 1 or not 5 <= fps <= 1000:
        raise DemoError(f"per_object is {per_object} and fps is {fps}, expected at least 1, and 5 to 1000.")
    folder = None if meshes is None else Path(meshes)
    specs = [load_object(name, folder) for name in (object_names(folder) if objects is None else objects)]
    parts = []
    for spec in specs:
        starts = [_start(spec, np.array(up), side) for up in _REST_UP.get(spec.name, ((0.0, 0.0, 1.0),))]
        for index in range(per_object):
            name = f"{SUBJECT}/{spec.name}_{side}_{seed}_{index:03d}"
            progress(len(parts), len(specs) * per_object, name)
            rng = np.random.default_rng([seed, index, zlib.crc32(spec.name.encode()), side == "left"])
            parts.append(_sequence(spec, starts, name, side, fps, rng))
    return concatenate(parts)


def _sequence(
    obj: ObjectSpec, starts: Sequence[_Start], name: str, side: str, fps: float, rng: np.random.Generator
) -> Demos:
    start = starts[int(rng.integers(len(starts)))]
    timing = random_timing(fps, rng)
    best: tuple[Rotation, np.ndarray, Grasp, HandPath] | None = None
    for _ in range(_GRASP_TRIES):
        rest, pos, grasp = _grasped(obj, start, side, rng)
        path = clear_approach(Solid.of(obj, pos, rest), pos, grasp, timing, side, rng)
        if best is None or path.gap > best[3].gap:
            best = (rest, pos, grasp, path)
        if path.gap > 0:
            break
    assert best is not None
    rest, pos, grasp, path = best
    object_pos, object_rot = object_path(pos, rest, timing, rng)
    # From the grasp on, the hand moves with the object.
    moved = object_rot * rest.inv()
    held = np.arange(timing.frames) >= timing.lift
    wrist_pos = np.where(held[:, None], moved.apply(grasp.wrist_pos - pos) + object_pos, path.wrist_pos)
    wrist_rot = Rotation.from_quat(
        np.where(held[:, None], (moved * grasp.wrist_rot).as_quat(), path.wrist_rot.as_quat())
    )
    points = place_hand(wrist_pos, wrist_rot, path.angles, side)
    return Demos(
        sequence_name=np.array([name]),
        subject=np.array([SUBJECT]),
        object_name=np.array([obj.name]),
        hand_side=np.array([side]),
        frame_offsets=np.array([0, timing.frames], dtype=np.int32),
        hand_keypoints=points.astype(np.float32),
        hand_valid=np.ones(timing.frames, dtype=bool),
        wrist_quat_wxyz=_quaternions(wrist_rot),
        object_pos=object_pos.astype(np.float32),
        object_quat_wxyz=_quaternions(object_rot),
        fps=fps,
    )


def _start(obj: ObjectSpec, up: np.ndarray, side: str) -> _Start:
    quat = resting_orientation(obj, up)
    upright = Rotation.from_quat(quat, scalar_first=True)
    height = np.array([0.0, 0.0, rest_height(obj, quat)])
    plans = plan_contacts(Solid.of(obj, height, upright), np.radians(np.arange(0.0, 360.0, 20.0)), side)
    if not plans:
        raise DemoError(
            f"no way was found to hold {obj.name} between thumb and fingers: nothing within reach is narrow enough."
        )
    return _Start(
        rest=upright, height=height, plans=tuple(plan for plan in plans if plan.cost < plans[0].cost + _NEAR_BEST)
    )


def _grasped(obj: ObjectSpec, start: _Start, side: str, rng: np.random.Generator) -> tuple[Rotation, np.ndarray, Grasp]:
    """Orientation and position of the object at rest somewhere on the table, and a grasp of it."""
    best: tuple[Rotation, np.ndarray, Grasp] | None = None
    for _ in range(_TRIES):
        plan = start.plans[rng.integers(len(start.plans))]
        azimuth = rng.uniform(*CLOSING_AZIMUTH)
        if side == "left":
            azimuth = np.pi - azimuth
        yaw = Rotation.from_euler("z", azimuth - np.arctan2(plan.closing[1], plan.closing[0]))
        place = np.array([rng.uniform(*WORKSPACE[0]), rng.uniform(*WORKSPACE[1]), 0.0])
        rest, pos = yaw * start.rest, place + start.height
        contacts = Contacts(
            points=yaw.apply(plan.points) + place,
            approach=yaw.apply(plan.approach),
            closing=yaw.apply(plan.closing),
            cost=plan.cost,
        )
        grasp = fit_hand(Solid.of(obj, pos, rest), contacts, side)
        if best is None or _badness(grasp) < _badness(best[2]):
            best = (rest, pos, grasp)
        if grasp.tip_error < _GOOD_TIP_ERROR and grasp.penetration < _GOOD_PENETRATION:
            break
    assert best is not None
    return best


def _badness(grasp: Grasp) -> float:
    return grasp.tip_error / _GOOD_TIP_ERROR + grasp.penetration / _GOOD_PENETRATION


def _quaternions(rotation: Rotation) -> np.ndarray:
    return rotation.as_quat(canonical=True, scalar_first=True).astype(np.float32)
