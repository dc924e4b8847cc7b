"""Makes a robot's folder from an arm and a hand as their makers publish them, in two files or in one: ``robot.urdf``,
its meshes and a commented ``robot.toml``.

What the files do not say is guessed from the hand's geometry, and every guess is told: which chain of links is which
finger, where the palm looks, which links follow which human keypoint, drives, home, and which links always touch.
``xreset robots check`` and a picture show whether the guesses are right.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from xreset.errors import RobotError
from xreset.files.checks import frozen
from xreset.files.storage import atomic_folder
from xreset.files.text import listed, quantity
from xreset.geometry.collision import SelfCollision
from xreset.geometry.description import load_robot
from xreset.geometry.dynamics import drive_inertia
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.shapes import roll_pitch_yaw, surface_of
from xreset.geometry.urdf import Joint, RobotTree, prismatic_joints
from xreset.geometry.urdf_writer import axes, pose
from xreset.physics.plugins import DESCRIPTION, robot_names
from xreset.robot_tools.check import MOST_TOUCHING, Finding, check, touching_itself
from xreset.robot_tools.draft import description_text, draft_spec
from xreset.robot_tools.fingers import Hand
from xreset.robot_tools.homes import hold_near, hold_up
from xreset.robot_tools.sources import (
    bare,
    combined,
    completed,
    grounded,
    last_link,
    read_source,
    renamed,
)
from xreset.spec import RobotSpec, SceneSpec

_ROTOR = {"revolute": 1e-3, "prismatic": 0.1}
"""[kg m^2 or kg] Rotor inertia on the diagonal of moving hand links, or mass of sliding ones, where none is stated:
finger links alone are too light for a step of 1/240 s. The inertia of a link means the same in every engine, which
armature does not (as in the built-in robots)."""
_ROTORS = {"revolute": (1e-6, 0.05), "prismatic": (1e-3, 5.0)}
"""[kg m^2 or kg] Rotor inertias of a hand that are believed."""
_EFFORT = {
    ("hand", "revolute"): 1.0,
    ("hand", "prismatic"): 20.0,
    ("arm", "revolute"): 50.0,
    ("arm", "prismatic"): 500.0,
}
"""[N m or N] Effort limits of joints without a stated one."""
_EFFORTS = {
    ("hand", "revolute"): (0.01, 50.0),
    ("hand", "prismatic"): (0.5, 1000.0),
    ("arm", "revolute"): (2.0, 3000.0),
    ("arm", "prismatic"): (20.0, 30_000.0),
}
"""[N m or N] Effort limits that are believed."""
_SLIDE = {"hand": 0.02, "arm": 0.05}
"""[m] Way of a sliding joint's target beyond the joint that asks for its whole effort."""
_SLIDE_SPREAD = 0.005
"""[m] Spread of a hand that only slides around home, as in the built-in gripper."""
_STABLE = {"hand": 0.8, "arm": 0.3}
"""Share of the largest kp that is stable in engines that integrate drives explicitly: kd times the step stays below the
inertia. With stiffer arms, MuJoCo's steps differ from finer ones by more than its check allows."""
_HOME_PALM = (0.57, 0.45, 0.25)
"""[m] Position of the palm at home: above the table, looking down, fingers away from the person."""
_FLUSH = 0.02
"""[m] A flange's frame that is nearer to the end of the flange's shapes is where the hand begins."""
_ALONG = 0.9
"""Cosine of the angle to an axis below which fingers do not point along it."""


_TO_SAY = (
    "whether each finger and the thumb are what they are called, and the palm looks where its z axis points (see the "
    "picture)",
    "efforts and gains of the drives, where the maker's figures are better than the rule",
    "where the base stands: xreset robots place FOLDER --demos DEMOS --write",
)
"""What no file and no geometry says."""


@frozen
class Imported:
    """What an import made."""

    folder: Path
    guessed: tuple[str, ...]
    """What was not stated anywhere."""
    to_say: tuple[str, ...]
    """What only a person can say."""
    findings: tuple[Finding, ...]
    """What its check finds: no errors."""


def make_robot(
    arm: Path | None,
    hand: Path,
    out: Path,
    *,
    flange: str | None = None,
    offset: tuple[float, float, float] | None = None,
    rpy: tuple[float, float, float] | None = None,
    thumb: str | None = None,
) -> Imported:
    """Make a robot's folder, without a picture: see :func:`xreset.robot_tools.verbs.import_robot`. The folder appears
    whole or not at all."""
    for option, values, most, unit in (
        ("--offset", offset, 1.0, "metres"),
        ("--rpy", rpy, 2 * np.pi, "radians"),
    ):
        if values is not None and not np.abs(values).max() <= most:
            raise RobotError(
                f"{option} is {_vector(np.array(values))}, expected {unit} from {-most:.3g} to {most:.3g}."
            )
    if arm is None and any(value is not None for value in (flange, offset, rpy)):
        raise RobotError(
            "--flange, --offset and --rpy say how an arm carries the hand, but there is no --arm. Give the arm, or "
            "leave them out."
        )
    notes = []
    carrier = None if arm is None else _read_arm(arm, flange, notes)
    hand_tree = read_source(hand, notes)
    if carrier is not None:
        if _holds_arm(hand_tree, carrier.tree):
            raise RobotError(
                f"{hand} holds the arm as well: it has all joints of {arm}. Leave out --arm, or remove the arm's links "
                "and joints from the hand's file."
            )
        hand_tree = grounded(hand_tree, notes)
    hand_tree = completed(hand_tree, hand, notes)
    if carrier is not None:
        hand_tree = renamed(hand_tree, carrier.tree)
    to_say = [*_TO_SAY]
    with atomic_folder(out) as work:
        found = Hand(hand_tree, work, thumb, notes)
        if carrier is None:
            tree = _with_rotors(found, notes)
        else:
            tree, mounting = _carried(found, carrier, offset, rpy, notes)
            to_say.insert(0, mounting)
        tree = _with_efforts(tree, found.root, notes)
        tree = replace(tree, name=out.resolve().name)
        spec = draft_spec(
            tree, found.root, work, tips=found.tips, keypoints=found.keypoints, bent=found.bent
        )
        if not len(spec.arm_indices):
            raise RobotError(
                f"{hand} has no arm: no joint moves all of its fingers. Give the arm with --arm."
            )
        spec = _with_arm_home(spec, found.palm_in_hand, notes)
        spec = _with_drives(spec, tree, notes)
        spec = replace(spec, collision_exclude=_excluded(tree))
        at_home = tuple(SelfCollision(Kinematics(spec)).overlapping_at_home)
        for why, pairs in (
            ("the MJCF says so", spec.collision_exclude),
            ("they meet at home", at_home),
        ):
            if pairs:
                names = listed([f"{a} with {b}" for a, b in pairs])
                notes.append(f"never collide, because {why}: {names}")
        spec = replace(spec, collision_exclude=(*spec.collision_exclude, *at_home))
        spec = _with_free_spread(spec, notes)
        (work / DESCRIPTION).write_text(description_text(spec, notes))
        findings = check(work)
        errors = [finding for finding in findings if finding.level == "error"]
        if errors:
            others = len(errors) - 1
            more = f" The check also finds {quantity(others, 'more error')}." if others else ""
            raise RobotError(
                f"the robot is not written, because it would fail its check: {errors[0].topic}: {errors[0].message}"
                f"{more}"
            )
    # the folder has its name only now
    findings = [
        replace(finding, message=finding.message.replace(str(work), str(out)))
        for finding in findings
    ]
    return Imported(
        folder=out, guessed=tuple(notes), to_say=tuple(to_say), findings=tuple(findings)
    )


@frozen
class _Arm:
    """An arm without what it carries."""

    tree: RobotTree
    flange: str
    """Link that carries the hand."""
    ahead: np.ndarray
    """[3] the axis of the flange's frame that points out of the arm."""


def _read_arm(path: Path, flange: str | None, notes: list[str]) -> _Arm:
    """Read an arm, or that of a robot with a robot.toml, and find its flange where that is None."""
    robot = None
    if path.is_dir() or str(path) in robot_names():
        robot = load_robot(path)
        path = robot.urdf
    elif not path.is_file():
        raise RobotError(
            f"'{path}' is not a file. Expected an arm's URDF or MJCF there, or the name of a robot: "
            f"{', '.join(robot_names())}."
        )
    tree = completed(read_source(path, notes), path, notes)
    if flange is None:
        flange = last_link(tree, None if robot is None else robot.hand_root)
        notes.append(f"the hand is carried by the arm's link {flange!r} (--flange chooses another)")
    arm = bare(tree, tree.link(flange).name, notes)
    if not arm.moved_by:
        raise RobotError(
            f"{path}: no joint moves the link {flange!r}, which would carry the hand. Name another one with --flange."
        )
    ahead = _out_of_flange(arm, flange)
    if robot is not None and robot.palm in tree.below(flange):
        fingers = tree.pose_in(flange, robot.palm)[:3, 0]
        if np.abs(fingers).max() > _ALONG:
            ahead = fingers.round() + 0.0
    return _Arm(tree=arm, flange=flange, ahead=ahead)


def _holds_arm(hand: RobotTree, arm: RobotTree) -> bool:
    """Return whether a hand has all moving joints of an arm: names may be the same in two files, places are not."""
    arm_joints = {_place(joint) for joint in arm.moved_by.values()}
    return bool(arm_joints) and arm_joints <= {_place(joint) for joint in hand.joints}


def _place(joint: Joint) -> tuple[str, ...]:
    """Return the name of a joint, and its place, as text."""
    return joint.name, joint.parent, joint.child, _vector(joint.T_parent_joint[:3, 3])


def _carried(
    hand: Hand,
    arm: _Arm,
    offset: tuple[float, float, float] | None,
    rpy: tuple[float, float, float] | None,
    notes: list[str],
) -> tuple[RobotTree, str]:
    """Return an arm with the hand on its flange, and what only a person can say about the mounting."""
    ahead = arm.ahead
    sign = "-" if ahead.sum() < 0 else ""
    along = f"the flange's {sign}{'xyz'[int(np.abs(ahead).argmax())]} axis"
    if rpy is None:
        rpy = _guessed_rpy(hand, ahead, along, notes)
    if offset is None:
        offset = _guessed_offset(hand, arm, rpy, along, notes)
    T_flange_hand = pose(offset, rpy=rpy)
    T_flange_palm = T_flange_hand @ hand.palm
    mounting = (
        f"how the hand is mounted (--offset, --rpy): its fingers point along ({_vector(T_flange_palm[:3, 0])}) of "
        f"{arm.flange!r}, its inner side along ({_vector(T_flange_palm[:3, 2])}). The angle about {along} is yours to "
        "know"
    )
    tree = combined(arm.tree, _with_rotors(hand, notes), arm.flange, T_flange_hand)
    return tree, mounting


def _out_of_flange(arm: RobotTree, flange: str) -> np.ndarray:
    """[3] the axis of the flange's frame that points out of the arm: along the last joint's axis, away from the link
    before that joint. It is z where the joint turns about none of the flange's axes."""
    link = arm.moving_ancestor(flange)
    T = arm.pose_in(link, flange)
    joint = arm.moved_by.get(link)
    axis = np.zeros(3) if joint is None else T[:3, :3].T @ joint.axis
    if joint is None or np.abs(axis).max() < _ALONG:
        return np.array((0.0, 0.0, 1.0))
    before = np.zeros(3)
    if arm.link(joint.parent).collisions:
        before = surface_of(arm.link(joint.parent).collisions)[0].mean(axis=0)
    outward = (joint.T_parent_joint @ T)[:3, 3] - before
    sign = np.sign(joint.T_parent_joint[:3, :3] @ joint.axis @ outward) or 1.0
    return sign * axis.round() + 0.0


def _guessed_rpy(
    hand: Hand, ahead: np.ndarray, along: str, notes: list[str]
) -> tuple[float, float, float]:
    """Return roll, pitch and yaw of the shortest turn of the fingers to the direction ahead; zeros where they nearly
    point there. ``along`` names the direction in the note."""
    fingers = hand.palm[:3, 0]
    if fingers @ ahead > _ALONG:
        return (0.0, 0.0, 0.0)
    if np.abs(fingers).max() > 0.95:
        fingers = fingers.round()  # along an axis, as far as fingers are straight
    turn = Rotation.align_vectors([ahead], [fingers])[0]
    roll, pitch, yaw = (np.round(roll_pitch_yaw(turn.as_matrix()), 4) + 0.0).tolist()
    notes.append(
        f"the hand is turned by --rpy {roll:g} {pitch:g} {yaw:g}: its fingers point along {along}"
    )
    return roll, pitch, yaw


def _vector(values: np.ndarray) -> str:
    return ", ".join(f"{value:.2f}" for value in values.round(2) + 0.0)


def _guessed_offset(
    hand: Hand,
    arm: _Arm,
    rpy: tuple[float, float, float],
    along: str,
    notes: list[str],
) -> tuple[float, float, float]:
    """Return the position of the hand's root in the flange's frame where no part of it is behind the flange, or behind
    the flange's own shapes where these end far in front of its frame [m]."""
    end = 0.0
    shapes = arm.tree.link(arm.flange).collisions
    if shapes:
        end = float((surface_of(shapes)[0] @ arm.ahead).max())
    depth = -(hand.body @ pose(rpy=rpy)[:3, :3].T @ arm.ahead)
    distance = depth.max(initial=0.0) + (end if end > _FLUSH else 0.0)
    distance = round(float(distance), 3)
    if distance > 0:
        notes.append(
            f"the hand's root is {1e3 * distance:.0f} mm along {along}, so that its body begins where the arm ends "
            "(--offset)"
        )
    x, y, z = (distance * arm.ahead).tolist()
    return x, y, z


def _with_rotors(hand: Hand, notes: list[str]) -> RobotTree:
    """Return the tree of a hand whose moving links carry their rotors."""
    inside = hand.tree.below(hand.root)[1:]
    links = []
    wrong = []
    for link in hand.tree.links:
        joint = hand.tree.moved_by.get(link.name)
        if joint is not None and link.name in inside:
            rotor = joint.rotor or _ROTOR[joint.type]
            least, most = _ROTORS[joint.type]
            if not least <= rotor <= most:
                wrong.append(f"{joint.name} ({rotor:g})")
                rotor = _ROTOR[joint.type]
            if joint.type == "prismatic":
                link = replace(link, mass=link.mass + rotor)
            else:
                link = replace(link, inertia=link.inertia + rotor * np.eye(3))
        links.append(link)
    notes.append(
        "moving links of the hand carry 0.001 kg m^2 of rotor inertia (0.1 kg where they slide), or what the MJCF "
        "states as armature"
    )
    if wrong:
        notes.append(f"with these in place of an armature that no finger has: {listed(wrong)}")
    return replace(hand.tree, links=tuple(links))


def _with_efforts(tree: RobotTree, hand_root: str, notes: list[str]) -> RobotTree:
    """Return a tree whose driven joints have efforts that arms and hands can have."""
    inside = tree.below(hand_root)[1:]
    changed = []
    without = []
    wrong = []
    for joint in tree.moved_by.values():
        if joint.mimic is None:
            group = "hand" if joint.child in inside else "arm"
            least, most = _EFFORTS[group, joint.type]
            if not joint.effort:
                without.append(joint.name)
            elif not least <= joint.effort <= most:
                wrong.append(f"{joint.name} ({joint.effort:g})")
                changed.append(replace(joint, effort=_EFFORT[group, joint.type]))
    rule = "they get 50 N m (arm) or 1 N m (hand); slides 500 N or 20 N"
    if without:
        notes.append(f"no effort is stated for {listed(without)}; {rule}")
    if wrong:
        notes.append(f"efforts that such joints do not have: {listed(wrong)}; {rule}")
    return tree.with_joints(changed)


def _excluded(tree: RobotTree) -> tuple[tuple[str, str], ...]:
    """Return the pairs of different links with shapes that the tree excludes."""
    solid = {link.name for link in tree.links if link.collisions}
    return tuple((a, b) for a, b in tree.exclude if a != b and {a, b} <= solid)


# Home, drives, collisions ---------------------------------------------------------------------------------------------


def _with_arm_home(spec: RobotSpec, T_hand_palm: np.ndarray, notes: list[str]) -> RobotSpec:
    """Return the robot whose arm at home holds the palm over the table, looking down."""
    T_world_palm = axes(x=(0, -1, 0), z=(0, 0, -1))  # fingers away from the person
    T_world_palm[:3, 3] = _HOME_PALM
    found = hold_near(spec, T_world_palm @ np.linalg.inv(T_hand_palm))
    if found is None:
        notes.append(
            "the arm does not reach over the table from where it stands: `xreset robots place` finds a better place "
            "and home"
        )
        return hold_up(spec)
    held, moved = found
    notes.append(f"home: the palm over the table, looking down{moved}; fingers bent a little")
    return held


def _with_free_spread(spec: RobotSpec, notes: list[str]) -> RobotSpec:
    """Return the robot with its hand's spread around home halved, once or twice, until its fingers rarely touch."""
    arm, hand = spec.home_std
    if prismatic_joints(spec)[spec.hand_indices].all():
        hand = _SLIDE_SPREAD
    for smaller in (hand, hand / 2, hand / 4):
        spec = replace(spec, home_std=(arm, smaller))
        if touching_itself(spec) <= MOST_TOUCHING:
            break
    if smaller < hand:
        notes.append(
            f"joints of the hand are spread by {smaller:g} rad or m around home, not {hand:g}: fingers are so near to "
            "each other that they would often touch when an episode begins"
        )
    return spec


def _with_drives(spec: RobotSpec, tree: RobotTree, notes: list[str]) -> RobotSpec:
    """Return the robot with drives as the files state them, else by the built-in robots' rule.

    The rule: stiff enough that the effort is reached within 0.35 rad, 2 cm (hand) or 5 cm (arm), and not too stiff for
    the step of the engines.
    """
    joints = []
    softer = []
    for joint, inertia in zip(spec.joints, drive_inertia(spec, spec.home), strict=True):
        stated = tree.joint(joint.name)
        effort = stated.effort or _EFFORT[joint.group, stated.type]
        factor = 2.0 if joint.group == "arm" else 1.8
        if stated.type == "prismatic":
            kp = effort / _SLIDE[joint.group]
        elif joint.group == "arm":
            kp = float(np.clip(effort * 15, 300, 2000))
        else:
            kp = float(np.clip(effort / 0.35, 0.5, 10))
        stable = float(f"{_STABLE[joint.group] * inertia / (factor * SceneSpec.timestep) ** 2:.3g}")
        if joint.group == "hand" and stated.stiffness > stable:
            softer.append(f"{joint.name} ({stated.stiffness:g})")
            kp = stable if stated.stiffness <= 10 * kp else min(kp, stable)
        elif joint.group == "hand" and stated.stiffness:
            kp = stated.stiffness
        else:
            kp = min(kp, stable)
        kd = float(f"{factor * np.sqrt(kp * inertia):.3g}")
        joints.append(replace(joint, drive=replace(joint.drive, kp=kp, kd=kd, effort=effort)))
    if softer:
        notes.append(
            f"with less stiffness than stated, which is too much for the step of the engines: {listed(softer)}"
        )
    notes.append(
        "drives: kd = 1.8 sqrt(kp I) in the hand, critical in the arm, with the inertia I about the joint at home; "
        "stiffness and armature of the arm are guessed, also where an MJCF states them"
    )
    return replace(spec, joints=tuple(joints))
