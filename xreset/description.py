"""Reading of a robot's description, ``robot.toml``.

A robot is a folder with a ``robot.toml`` and the URDF that it names. A package makes such a folder known with an entry point of the group
``xreset.robots`` whose value is the module that lies in the folder: ``my-robot = "my_package.my_robot"``. The built-in robots are listed in
``pyproject.toml`` in the same way, and their ``robot.toml`` are commented examples of the format.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from xreset.checks import Number, Text, parsed
from xreset.errors import RobotError
from xreset.files import read_toml
from xreset.geometry.urdf import find_mesh, parse_xml
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
        RobotError: unknown robot, or a description that is wrong; the message lists everything that is wrong in it. What only the URDF can
            tell (whether the named links and joints exist) is found by :func:`xreset.robot_tools.check.check`.
    """
    return read_description(robot_folder(name_or_folder) / DESCRIPTION)


def read_description(path: Path) -> RobotSpec:
    """Read a ``robot.toml``; see :func:`load_robot`."""
    data = read_toml(path, SCHEMA, error=RobotError, hint=" A robot's folder holds one beside its URDF.")
    given, problems = parsed(Description, data, "the file")
    spec = None if given is None else _robot(given, path.parent)
    if spec is not None:
        problems = _contradictions(spec)
    if spec is None or problems:
        listed = "".join(f"\n  - {problem.removeprefix('the file.')}" for problem in problems)
        raise RobotError(f"{path} is wrong in {len(problems)} place{'s' * (len(problems) > 1)}:{listed}")
    return spec


# The format ------------------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Joint:
    """A :class:`~xreset.spec.JointSpec` and its drive, in one table."""

    name: Text
    group: Literal["arm", "hand"]
    home: Number
    kp: Number
    kd: Number
    effort: Number
    armature: Number = 0.0
    friction_loss: Number = 0.0

    def spec(self) -> JointSpec:
        """As the rest of xreset knows it."""
        drive = DriveSpec(
            kp=self.kp, kd=self.kd, effort=self.effort, armature=self.armature, friction_loss=self.friction_loss
        )
        return JointSpec(name=self.name, group=self.group, home=self.home, drive=drive)


@dataclass(frozen=True, kw_only=True)
class Base:
    """Where the robot stands."""

    pos: tuple[Number, Number, Number]
    quat: tuple[Number, Number, Number, Number]
    placement: PlacementSpec | None = None


@dataclass(frozen=True, kw_only=True)
class Hand:
    """Its links."""

    root: Text
    palm: Text


@dataclass(frozen=True, kw_only=True)
class Collision:
    """Links that collide, and those that do not."""

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
    urdf = (folder / given.urdf).resolve()
    return RobotSpec(
        name=given.name,
        urdf=urdf,
        meshes=_meshes(urdf),
        joints=tuple(joint.spec() for joint in given.joints),
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
    """Mesh files of the collision shapes, as far as they exist: a wrong URDF is reported by whoever reads it."""
    try:
        collisions = list(parse_xml(urdf).iter("collision"))
    except RobotError:
        return ()
    meshes = [mesh for collision in collisions for mesh in collision.iter("mesh")]  # noqa: XR002
    files = [find_mesh(mesh.get("filename", ""), urdf) for mesh in meshes]
    return tuple(file for file in files if file is not None)


def _contradictions(spec: RobotSpec) -> list[str]:
    """What is wrong although every entry by itself has the right form."""
    problems = []
    for what, names in (
        ("joints", [*spec.joint_names, *(mimic.joint for mimic in spec.mimics)]),
        ("fingertips", list(spec.fingertip_names)),
        ("fingertips' links", [tip.link for tip in spec.fingertips]),
    ):
        if twice := sorted({name for name in names if names.count(name) > 1}):
            problems.append(f"{what}: {', '.join(twice)} occur more than once.")
    for mimic in spec.mimics:
        if mimic.source not in spec.joint_names:
            problems.append(f"mimics: {mimic.joint!r} follows {mimic.source!r}, which is not among the joints.")
    for keypoint in spec.keypoints:
        if keypoint.keypoint not in KEYPOINTS:
            problems.append(f"keypoints: there is no keypoint {keypoint.keypoint!r}; there are {', '.join(KEYPOINTS)}.")
    if not spec.joints:
        problems.append("joints: there is none.")
    if not spec.fingertips or spec.fingertips[0].name != "thumb":
        problems.append(f"fingertips: the first must be 'thumb', found {list(spec.fingertip_names)}.")
    if not len(spec.arm_indices) or not len(spec.hand_indices):
        problems.append("joints: at least one joint must be of group 'arm' and one of group 'hand'.")
    if abs(math.hypot(*spec.base_quat) - 1) > 1e-3:
        problems.append(f"base: quat {list(spec.base_quat)} has length {math.hypot(*spec.base_quat):.4g}, expected 1.")
    return problems
