"""Goal sets: starts and goals of any object, without demonstrations.

A goal set is a reset bank without states. Each of its S sequences is one episode: a start at rest on the table, and a
goal that the robot can reach with the grasp that it has at the start (:mod:`xreset.resets.reach`). The families are
those of the published paper, and goals drawn at random:

- ``lift``: the object is lifted;
- ``yaw``, ``tilt-x``, ``tilt-y``: it is lifted, and turned by 60 degrees about the world's z, x or y axis;
- ``random``: any place over the table, and any turn;
- ``own``: a pose that was given.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from scipy.spatial.transform import Rotation

from xreset.demos.synth import LIFT, WORKSPACE
from xreset.errors import FileFormatError, GoalError
from xreset.files.checks import frozen
from xreset.files.progress import Progress
from xreset.files.records import Field, read_record, schema_of, write_record
from xreset.files.text import shown, texts
from xreset.geometry.shapes import quat_of, turn_of
from xreset.objects.rest import rest_height, resting_orientation
from xreset.resets.bank import (
    ResetBank,
    bank_problem,
    check_objects,
    no_states,
    object_columns,
    same_source,
    stated_sources,
)
from xreset.spec import ObjectSpec, RobotSpec

if TYPE_CHECKING:
    from xreset.resets.reach import Reach

SCHEMA = "xreset-goals/1"
OWN = "own"
FAMILIES = ("lift", "yaw", "tilt-x", "tilt-y", "random")
"""Families of goals that are drawn; goals of the family :data:`OWN` are given."""
_MIDDLE = tuple(sum(span) / 2 for span in WORKSPACE)
_Z = (0.0, 0.0, 1.0)
_TURN_AXES = {"yaw": _Z, "tilt-x": (1.0, 0.0, 0.0), "tilt-y": (0.0, 1.0, 0.0)}
LIFT_HEIGHT = 0.20
"""Height of the goals of most families above the start [m]; not in the paper."""
ANGLE = 60.0
"""Angle of the families ``yaw``, ``tilt-x`` and ``tilt-y`` [degrees]."""
START_OFFSET = np.array([0.02, 0.02, np.radians(25.0)])
"""Starts are moved by U(-1, 1) times this: x and y [m], turn about the vertical [rad]. These offsets and the next are
those of the published paper's evaluation of objects without demonstrations (its table A3)."""
GOAL_OFFSET = np.array([0.03, 0.03, 0.05, np.radians(30.0)])
"""Goals are moved by U(-1, 1) times this: x, y and z [m], turn about the vertical [rad]."""
_START_SEED = 42
_GOAL_SEED = 71
"""The published paper's seed bases of its start and goal offsets."""
_DIRECTIONS = 16
"""Number of random directions of a mesh that are turned up to find an object's resting poses."""
_SAME_POSE = np.cos(np.radians(2.0))
"""Cosine of the largest angle between the up directions of two resting poses that count as one."""
_DRAWS = 12
"""Times that a goal is drawn before it is given up."""
_FLOATING = 0.01
"""A start is on the table if its lowest point is nearer than this to it [m]."""
_INSIDE = 0.005
"""A goal is inside the table if its lowest point is deeper than this [m]."""


@frozen
class GoalSet(ResetBank):
    """Contents of a goal set: starts and goals [S]. It has no states."""

    family: Annotated[np.ndarray, Field(("S",), "U")]
    """[S] one of :data:`FAMILIES` or :data:`OWN`."""


@frozen
class _Episode:
    """A start and a goal of one object."""

    obj: ObjectSpec
    family: str
    number: int
    """Number among the episodes of this object and family."""
    start: np.ndarray
    """[3] place of the centre of mass."""
    start_turn: Rotation
    goal: np.ndarray
    goal_turn: Rotation


def drawn_goals(
    objects: Sequence[ObjectSpec],
    robot: RobotSpec,
    families: str | Sequence[str] | None,
    poses: Sequence[Sequence[float]],
    *,
    per_family: int,
    upright: bool,
    seed: int,
    progress: Progress,
) -> GoalSet:
    """Return starts and goals of objects; see :func:`xreset.resets.verbs.make_goals`."""
    own = [_own_pose(pose) for pose in poses]
    if families is None:
        families = () if own else FAMILIES
    families = texts(families)
    if unknown := [family for family in families if family not in FAMILIES]:
        raise GoalError(f"Unknown family {unknown[0]!r}. Choose from: {', '.join(FAMILIES)}.")
    if not families and not own:
        raise GoalError("No family is named. Name one or several of them, or give a pose.")
    for obj in objects:
        for pos, quat in own:
            _check_above_table(obj.name, rest_height(obj, quat) - pos[2])
    rests = _resting_poses(objects, robot, upright=upright)
    from xreset.resets.reach import Reach  # torch, which a player of goals does not need

    reach = Reach(robot)
    wanted = [*product(families, range(per_family)), *product([OWN], range(len(own)))]
    episodes = []
    for obj in objects:
        done = len(episodes)
        found: dict[tuple[str, int], _Episode] = {}
        for attempt in range(_DRAWS):
            drawn = []
            for family, number in wanted:
                if (family, number) not in found:
                    drawn.append(_draw(obj, rests[obj.name], own, seed, family, number, attempt))
            found |= {(e.family, e.number): e for e in _reached(reach, drawn)}
            progress(done + len(found), len(wanted) * len(objects))
        if missing := [
            f"{family}_{number:03d}" for family, number in wanted if (family, number) not in found
        ]:
            raise GoalError(
                f"{robot.name} cannot reach {len(missing)} of {len(wanted)} goals of {obj.name}, such as {missing[0]}: "
                "no grasp holds the object both at its start and there. Leave out the "
                "family, or move the goal."
            )
        episodes += [found[item] for item in wanted]
    return _goal_set(robot, episodes)


def write_goals(
    path: str | Path,
    goals: GoalSet,
    *,
    config: Mapping[str, Any] | None = None,
    robot: str | Path | None = None,
    meshes: str | Path | None = None,
) -> None:
    """Write a goal set, how it was drawn, the name or folder of the robot, and the folder of the objects' meshes; see
    :func:`xreset.files.records.write_record`."""
    stated = {"robot": str(robot or goals.robot), "meshes": str(meshes) if meshes else None}
    made_with = {**(config or {}), **stated}
    write_record(GoalSet, path, SCHEMA, goals, check=bank_problem, config=made_with)


def read_goals(path: str | Path) -> GoalSet:
    """Read a goal set; ``FileFormatError`` if the file is damaged."""
    return read_record(GoalSet, path, SCHEMA, what="a goal set", check=bank_problem)


def with_goals(bank: ResetBank, goals: GoalSet) -> ResetBank:
    """Return a bank whose episodes from home also have the starts and goals of a goal set.

    Raises:
        FileFormatError: the goal set was made for another robot, or with another mesh of an object of the bank.
    """
    if bank.robot_fingerprint != goals.robot_fingerprint:
        raise FileFormatError(
            f"The bank is for the robot {bank.robot!r}, and the goal set for {goals.robot!r} or another version of it. "
            f"Make the goal set again: xreset goals --robot {bank.robot}."
        )
    sources = stated_sources(bank)
    for name, source in stated_sources(goals).items():
        if not same_source(sources.setdefault(name, source), source):
            raise FileFormatError(
                f"The bank and the goal set were made with different meshes of {name}. Make one again."
            )
    names = tuple(sorted(sources))
    joined: dict[str, Any] = {
        "object_mass": _of_both(bank, goals, "object_mass", names),
        "object_friction": _of_both(bank, goals, "object_friction", names),
    }
    for name, field in schema_of(ResetBank).items():
        if field.shape[:1] == ("S",):
            joined[name] = np.concatenate((getattr(bank, name), getattr(goals, name)))
    return replace(
        bank, **joined, object_names=names, object_sources=tuple(sources[name] for name in names)
    )


def _of_both(
    bank: ResetBank, goals: GoalSet, field: str, names: tuple[str, ...]
) -> np.ndarray | None:
    """Return a number of each object from a bank, or else from a goal set; None: neither states it."""
    found: dict[str, float] = {}
    for data in (goals, bank):
        values = getattr(data, field)
        if values is not None:
            found |= dict(zip(data.object_names, values.tolist(), strict=True))
    return np.array([found.get(name, 0.0) for name in names]) if found else None


def checked_goals(
    where: str, goals: GoalSet, robot: RobotSpec, objects: Sequence[ObjectSpec]
) -> GoalSet:
    """Return a goal set for a robot.

    In a goal set of another robot, every goal must be within this robot's reach. In one of its own, only goals that the
    stretched arm does not reach are refused, because the file was checked when it was made.

    Args:
        where: what messages call the goal set.
        goals: the goal set.
        robot: the robot.
        objects: the objects to check; goals of other objects are not looked at.

    Raises:
        FileFormatError: an object has another mesh than the one that the goal set was made with.
        GoalError: a start is not on the table, or a goal is inside it or out of reach.
    """
    check_objects(where, goals, tuple(objects))
    from xreset.resets.reach import Reach

    is_own = robot.has_fingerprint(goals.robot_fingerprint)
    reach = Reach(robot)
    for obj in objects:
        rows = np.flatnonzero(goals.sequence_object == obj.name)
        gaps = goals.start_pos[rows, 2] - rest_height(obj, goals.start_quat_wxyz[rows])
        depths = rest_height(obj, goals.goal_quat_wxyz[rows]) - goals.goal_pos[rows, 2]
        for row, gap, depth in zip(rows, gaps, depths, strict=True):
            name = f"{where}: {goals.sequence_name[row]}"
            if abs(gap) > _FLOATING:
                side = "above" if gap > 0 else "inside"
                raise GoalError(
                    f"{name}: the object starts {100 * abs(gap):.1f} cm {side} the table, expected at rest."
                )
            _check_above_table(name, depth)
        if not len(rows):
            continue
        start_turns = turn_of(goals.start_quat_wxyz[rows])
        goal_turns = turn_of(goals.goal_quat_wxyz[rows])
        start = goals.start_pos[rows] + start_turns.apply(obj.com)
        goal = goals.goal_pos[rows] + goal_turns.apply(obj.com)
        if is_own:
            held = reach.stretches_to(start) & reach.stretches_to(goal)
        else:
            held = reach.holds(start, goal, goal_turns * start_turns.inv())
        if not held.all():
            raise GoalError(
                f"{where}: {int((~held).sum())} of {len(held)} goals of {obj.name} are out of the reach of "
                f"{robot.name}, such as {goals.sequence_name[rows[held.argmin()]]}. Move them, or make a goal set for "
                f"this robot: xreset goals --robot {robot.name}."
            )
    return goals if is_own else replace(goals, **no_states(robot))


# Drawing --------------------------------------------------------------------------------------------------------------


def _own_pose(pose: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Return position [3] and unit quaternion [4] of a pose that a user gave."""
    values = np.asarray(pose, dtype=float)
    length = np.linalg.norm(values[3:]) if values.shape == (7,) else 0.0
    if not np.isfinite(values).all() or not length > 0:
        raise GoalError(
            f"The pose {shown(pose)} is not a pose; expected x, y, z [m] and a quaternion w, x, y, z."
        )
    return values[:3], values[3:] / length


def _check_above_table(name: str, depth: float) -> None:
    """Refuse, with ``GoalError``, a goal whose lowest point is too deep [m] in the table."""
    if depth > _INSIDE:
        raise GoalError(
            f"{name}: the goal is {100 * depth:.1f} cm inside the table. Raise it by as much."
        )


def _resting_poses(
    objects: Sequence[ObjectSpec], robot: RobotSpec, *, upright: bool
) -> dict[str, list[tuple[float, Rotation]]]:
    """Return the resting poses of each object: height of the centre of mass [m], and orientation. A pose that is more
    likely is listed more often.

    Raises:
        GoalError: an object does not come to rest.
    """
    names = []
    starts = []
    quats = []
    rows: dict[str, np.ndarray] = {}
    for obj in objects:
        random = np.random.default_rng(zlib.crc32(obj.name.encode()))
        directions = np.array([_Z]) if upright else random.normal(size=(_DIRECTIONS, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        turns = turn_of(np.array([resting_orientation(obj, up) for up in directions]))
        ups = turns.inv().apply(_Z)
        # for each direction, the first one that leads to the same pose
        first_alike = (ups @ ups.T > _SAME_POSE).argmax(axis=1)
        poses, which = np.unique(first_alike, return_inverse=True)
        rows[obj.name] = len(names) + which
        for quat in quat_of(turns)[poses]:
            names.append(obj.name)
            # the mesh's origin may be far from the object
            middle = _MIDDLE - turn_of(quat).apply(obj.com)[:2]
            starts.append((*middle, rest_height(obj, quat)))
            quats.append(quat)
    from xreset.resets.settle import settled

    pos, quat, at_rest = settled(robot, objects, names, np.array(starts), np.array(quats))
    rests = {}
    for obj in objects:
        tried = rows[obj.name]
        resting = tried[at_rest[tried]]
        if not len(resting):
            raise GoalError(
                f"{obj.name} does not come to rest on the table: it rolls off it or falls over in MuJoCo. Leave it"
                " out, or make a side of its mesh flat."
            )
        turns = turn_of(quat[resting])
        heights = pos[resting, 2] + turns.apply(obj.com)[:, 2]
        rests[obj.name] = list(zip(heights, turns, strict=True))
    return rests


def _draw(
    obj: ObjectSpec,
    rests: Sequence[tuple[float, Rotation]],
    own: Sequence[tuple[np.ndarray, np.ndarray]],
    seed: int,
    family: str,
    number: int,
    attempt: int,
) -> _Episode:
    """Draw a start and a goal. The arguments alone decide what is drawn."""
    key = [seed, zlib.crc32(f"{obj.name} {family}".encode()), number, attempt]
    random = np.random.default_rng(key)
    height, resting = rests[int(random.integers(len(rests)))]
    (x, y), (goal_x, goal_y) = random.uniform(*np.transpose(WORKSPACE), size=(2, 2))
    center = np.array([x, y, height])
    resting = _about_z(random.uniform(0.0, 2.0 * np.pi)) * resting
    start_offset = START_OFFSET * np.random.default_rng([_START_SEED, *key]).uniform(-1.0, 1.0, 3)
    goal_offset = GOAL_OFFSET * np.random.default_rng([_GOAL_SEED, *key]).uniform(-1.0, 1.0, 4)
    if family == OWN:
        pos, quat = own[number]
        goal_turn = turn_of(quat)
        goal = pos + goal_turn.apply(obj.com)
    else:
        goal = center + np.array([0.0, 0.0, LIFT_HEIGHT])
        turn = Rotation.identity()
        if family == "random":
            goal = np.array([goal_x, goal_y, height + random.uniform(*LIFT)])
            axis = random.normal(size=3)
            turn = Rotation.from_rotvec(axis / np.linalg.norm(axis) * random.uniform(0.0, np.pi))
        elif family in _TURN_AXES:
            angle = random.choice((-1.0, 1.0)) * np.radians(ANGLE)
            turn = Rotation.from_rotvec(angle * np.array(_TURN_AXES[family]))
        goal += goal_offset[:3]
        goal_turn = _about_z(goal_offset[3]) * turn * resting
    return _Episode(
        obj=obj,
        family=family,
        number=number,
        start=center + np.array([*start_offset[:2], 0.0]),
        start_turn=_about_z(start_offset[2]) * resting,
        goal=goal,
        goal_turn=goal_turn,
    )


def _about_z(angle: float) -> Rotation:
    return Rotation.from_rotvec((0.0, 0.0, angle))


def _reached(reach: Reach, drawn: Sequence[_Episode]) -> list[_Episode]:
    """Return the episodes whose goal is above the table and can be reached. The heights of given poses have been
    checked."""
    above = []
    for e in drawn:
        lowest = rest_height(e.obj, quat_of(e.goal_turn)) + e.goal_turn.apply(e.obj.com)[2]
        if e.goal[2] >= lowest or e.family == OWN:
            above.append(e)
    if not above:
        return []
    turns = Rotation.concatenate([e.goal_turn * e.start_turn.inv() for e in above])
    starts = np.stack([e.start for e in above])
    held = reach.holds(starts, np.stack([e.goal for e in above]), turns)
    return [e for e, holds in zip(above, held, strict=True) if holds]


def _goal_set(robot: RobotSpec, episodes: Sequence[_Episode]) -> GoalSet:
    """Return the episodes as a goal set, with the poses of mesh frames."""
    objects = {e.obj.name: e.obj for e in episodes}
    return GoalSet(
        **no_states(robot),
        sequence_name=np.array([f"{e.obj.name}/{e.family}_{e.number:03d}" for e in episodes]),
        sequence_object=np.array([e.obj.name for e in episodes]),
        family=np.array([e.family for e in episodes]),
        start_pos=np.array([e.start - e.start_turn.apply(e.obj.com) for e in episodes], np.float32),
        start_quat_wxyz=np.array([quat_of(e.start_turn) for e in episodes], np.float32),
        goal_pos=np.array([e.goal - e.goal_turn.apply(e.obj.com) for e in episodes], np.float32),
        goal_quat_wxyz=np.array([quat_of(e.goal_turn) for e in episodes], np.float32),
        **object_columns(tuple(sorted(objects)), objects.values()),
    )
