"""Reads the description of a robot, ``robot.toml``.

A robot is a folder with a ``robot.toml`` and the URDF that it names. A package registers such a folder with an entry
point of the group ``xreset.robots`` whose value is the module in the folder: ``my-robot = "my_package.my_robot"``. The
built-in robots are listed in ``pyproject.toml`` in the same way, and their ``robot.toml`` are commented examples of the
format.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

from xreset.checks import Number, Text, parsed
from xreset.errors import RobotError
from xreset.files import read_toml
from xreset.geometry.urdf import mesh_files
from xreset.plugins import robot_folder
from xreset.spec import (
    KEYPOINTS,
    DriveSpec,
    FingertipSpec,
    JointSpec,
    KeypointSpec,
    MimicSpec,
    PlacementSpec,
    RobotSpec,
)

DESCRIPTION = "robot.toml"
"""Name of the description in a robot's folder."""
SCHEMA = "xreset-robot/1"
"""What ``schema`` in the description must be."""


def load_robot(name_or_folder: str | Path) -> RobotSpec:
    """Read a robot's description.

    Args:
        name_or_folder: a registered name, or a folder with a ``robot.toml``.

    Raises:
        RobotError: the robot is unknown, or its description is wrong; the message lists everything that is wrong.
            Whether the URDF has the named links and joints is found by :func:`xreset.robot_tools.check.check`.
    """
    return read_description(robot_folder(name_or_folder) / DESCRIPTION)


def read_description(path: Path) -> RobotSpec:
    """Read a ``robot.toml``; see :func:`load_robot`."""
    data = read_toml(path, SCHEMA, error=RobotError, hint=" A robot's folder holds one beside its URDF.")
    given, problems = parsed(Description, data, "the file")
    if given is not None:
        spec = _robot(given, path.parent)
        problems = _contradictions(spec)
        if not problems:
            return spec
    listed = "".join(f"\n  - {problem.removeprefix('the file.')}" for problem in problems)
    noun = "place" if len(problems) == 1 else "places"
    raise RobotError(f"{path} is wrong in {len(problems)} {noun}:{listed}")


# The format -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Joint(DriveSpec):
    """A joint and its drive, in one table."""

    name: Text
    group: Literal["arm", "hand"]
    home: Number


@dataclass(frozen=True, kw_only=True)
class Base:
    """Pose of the URDF's root link in the world."""

    pos: tuple[Number, Number, Number]
    quat: tuple[Number, Number, Number, Number]
    placement: PlacementSpec | None = None


@dataclass(frozen=True, kw_only=True)
class Hand:
    """Links of the hand."""

    root: Text
    palm: Text


@dataclass(frozen=True, kw_only=True)
class Collision:
    """Which links collide; see :class:`xreset.spec.RobotSpec`."""

    self: tuple[Text, ...] = ()
    exclude: tuple[tuple[Text, Text], ...] = ()
    table_exclude: tuple[Text, ...] = ()


@dataclass(frozen=True, kw_only=True)
class HomeSpread:
    """:attr:`xreset.spec.RobotSpec.home_std`."""

    arm: Number = RobotSpec.home_std[0]
    hand: Number = RobotSpec.home_std[1]


@dataclass(frozen=True, kw_only=True)
class Description:
    """The whole file."""

    schema: str
    name: Text
    urdf: Text
    joints: tuple[Joint, ...]
    fingertips: tuple[FingertipSpec, ...]
    base: Base
    hand: Hand
    keypoints: dict[str, Text]
    mimics: tuple[MimicSpec, ...] = ()
    collision: Collision = Collision()
    home_std: HomeSpread = HomeSpread()
    gravity_compensated: bool = True
    like: str = ""


def _robot(given: Description, folder: Path) -> RobotSpec:
    joints = []
    for joint in given.joints:
        drive = DriveSpec(**{f.name: getattr(joint, f.name) for f in fields(DriveSpec)})
        joints.append(JointSpec(name=joint.name, group=joint.group, home=joint.home, drive=drive))
    urdf = (folder / given.urdf).resolve()
    return RobotSpec(
        name=given.name,
        urdf=urdf,
        meshes=_meshes(urdf),
        joints=tuple(joints),
        mimics=given.mimics,
        base_pos=given.base.pos,
        base_quat=given.base.quat,
        placement=given.base.placement,
        palm=given.hand.palm,
        hand_root=given.hand.root,
        fingertips=given.fingertips,
        keypoints=tuple(KeypointSpec(keypoint=keypoint, link=link) for keypoint, link in given.keypoints.items()),
        self_collision_links=given.collision.self,
        collision_exclude=given.collision.exclude,
        table_exclude=given.collision.table_exclude,
        gravity_compensated=given.gravity_compensated,
        like=given.like,
        home_std=(given.home_std.arm, given.home_std.hand),
    )


def _meshes(urdf: Path) -> tuple[Path, ...]:
    """Mesh files of the collision shapes; a wrong URDF is reported by whoever reads it."""
    try:
        return tuple(mesh_files(urdf))
    except RobotError:
        return ()


def _contradictions(spec: RobotSpec) -> list[str]:
    """Return what is wrong although each entry has the right form."""
    problems = []
    unique = {
        "joints": [*spec.joint_names, *(mimic.joint for mimic in spec.mimics)],
        "fingertips": spec.fingertip_names,
        "fingertips' links": [tip.link for tip in spec.fingertips],
    }
    for what, names in unique.items():
        repeated = sorted(name for name, count in Counter(names).items() if count > 1)
        if repeated:
            problems.append(f"{what}: {', '.join(repeated)} occur more than once.")
    for mimic in spec.mimics:
        if mimic.source not in spec.joint_names:
            problems.append(f"mimics: {mimic.joint!r} follows {mimic.source!r}, which is not among the joints.")
    for keypoint in spec.keypoints:
        if keypoint.keypoint not in KEYPOINTS:
            problems.append(f"keypoints: unknown keypoint {keypoint.keypoint!r}. Choose from: {', '.join(KEYPOINTS)}.")
    if not spec.joints:
        problems.append("joints: there is none.")
    if not spec.fingertips or spec.fingertips[0].name != "thumb":
        problems.append(f"fingertips: the first must be 'thumb', found {list(spec.fingertip_names)}.")
    if not len(spec.arm_indices) or not len(spec.hand_indices):
        problems.append("joints: at least one joint must be of group 'arm' and one of group 'hand'.")
    length = math.hypot(*spec.base_quat)
    if abs(length - 1) > 1e-3:
        problems.append(f"base: quat {list(spec.base_quat)} has length {length:.4g}, expected 1.")
    return problems
