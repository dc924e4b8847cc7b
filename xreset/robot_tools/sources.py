"""Reads what makers publish of a robot, URDF or MJCF, as one kind of plain data, and puts an arm and a hand
together."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import Rotation

from xreset.errors import RobotError, needs
from xreset.files.text import listed
from xreset.geometry.shapes import shape_mesh, surface_of
from xreset.geometry.urdf import Joint, Link, RobotTree, load_urdf, parse_xml
from xreset.geometry.urdf_writer import FRAME_INERTIA, FRAME_MASS, fixed
from xreset.objects.decompose import mass_of_shapes

_DENSITY = 1000.0
"""[kg/m^3] Density of links whose mass is not stated."""
_DENSITIES = (5.0, 50_000.0)
"""[kg/m^3] Densities that links have by the volume of their shapes; shapes may leave out a part of a link."""
_MOST_MASS = 500.0
"""[kg] Mass of a link without shapes."""
_ROTOR_AT_MOST = 0.01
"""[kg m^2] Reflected inertia of a rotor that descriptions add to light links."""
_TURNS = 2 * math.pi
"""[rad] Range in either direction of a joint without limits."""
_SLIDE = 0.1
"""[m] The same of a joint that slides."""
_FARTHEST = {"revolute": 2 * _TURNS, "prismatic": 5.0}
"""[rad or m] Farthest limit of a joint."""
_UNITS = {
    "revolute": ("degrees", math.pi / 180, 360.0),
    "prismatic": ("millimetres", 1e-3, 1000.0),
}
"""In which unit limits beyond these are taken to be, how large it is [rad or m], and the farthest limit in it."""
_LEAST_RANGE = 1e-3
"""[rad or m] A joint with a smaller range is fixed."""
_LEAST_TURN = math.radians(3)
"""Some joint of a robot turns farther [rad]."""
_SPEED = math.pi
_SPEEDS = (0.01, 100.0)
"""[rad/s or m/s] Largest speed of a joint without a stated one, and bounds of stated ones."""
_FLANGES = (
    "tool0",
    "flange",
    "tool_link",
    "ee_link",
    "link_eef",
    "link_ee",
    "end_effector_link",
    "attachment",
    "panda_link8",
    "fr3_link8",
    "fer_link8",
    "iiwa_link_ee",
    "lbr_link_ee",
    "lbr_iiwa_link_7",
    "bracelet_link",
)
"""Links that carry the tool in the makers' files: UR, ABB and Fanuc (ROS-Industrial), xArm, Panda and FR3, iiwa,
Kinova."""
_CAMERA = re.compile(r"camera|realsense|optical|lidar|(?<![a-z])(cam|zed)(?![a-z])")
"""What the names of a camera's links and joints contain, in lower case."""
ARM_JOINTS = 3
"""An arm has at least as many joints more than other things that move."""


def read_source(path: str | Path, notes: list[str]) -> RobotTree:
    """Read a robot, or a part of one, from a URDF, or from an MJCF (needs the engine MuJoCo), before it is
    :func:`completed`.

    Args:
        path: the file.
        notes: what had to be changed or assumed is appended.

    Raises:
        RobotError: the file cannot be read, or uses what xreset does not have; the message names all of it.
    """
    path = Path(path)
    root = parse_xml(path)
    if root.tag == "mujocoinclude":
        raise RobotError(f"{path} is a part of an MJCF. Give the file that includes it.")
    if root.tag == "mujoco":
        with needs(f"mujoco, which reads {path},", "mujoco", RobotError):
            from xreset.robot_tools.mjcf import read_mjcf
        return read_mjcf(path, notes)
    tree = load_urdf(path, visuals=True)
    _note_urdf(root, tree, notes)
    return tree


def completed(tree: RobotTree, path: str | Path, notes: list[str]) -> RobotTree:
    """Return the tree of a file with limits, speeds, couplings and masses that joints and links can have.

    Raises:
        RobotError: the file contradicts itself, or its units are not known.
    """
    tree = _with_speeds(_with_ranges(tree, path, notes), notes)
    return _with_masses(_with_sources(tree, path, notes), notes)


def _note_urdf(root: Element, tree: RobotTree, notes: list[str]) -> None:
    """Note what a URDF lacks, and what of it is left out."""
    collide = {link.get("name") for link in root.iterfind("link[collision]")}
    visual = [link.name for link in tree.links if link.collisions and link.name not in collide]
    if visual:
        notes.append(f"visual shapes collide where there is no other: {listed(visual)}")
    damped = []
    for joint in root.iterfind("joint"):
        dynamics = joint.find("dynamics")
        values = [] if dynamics is None else [*dynamics.attrib.values()]
        if joint.get("type") != "fixed" and any(value.strip(" 0.") for value in values):
            damped.append(joint.get("name", ""))
    if damped:
        notes.append(f"left out: damping and friction of joints: {listed(damped)}")


def is_camera(names: Iterable[str]) -> bool:
    """Return whether names of links or joints say that they are those of a camera."""
    return any(_CAMERA.search(name.lower()) for name in names)


def last_link(arm: RobotTree, hand_root: str | None = None) -> str:
    """Return the link that carries the hand: one that makers of arms call so, or the arm's last link.

    Args:
        arm: the arm, or a robot.
        hand_root: link with which the robot's own hand begins. Its parent is the last link, or itself where a joint of
            the arm moves it.

    Raises:
        RobotError: the last one is not unique.
    """
    if hand_root is not None:
        carriers = [link for link in arm.link_names if hand_root in arm.below(link)[1:]]
        last = hand_root if hand_root in arm.moved_by else carriers[-1]
        known = [link for link in carriers if link in _FLANGES]
        return known[-1] if known else last
    known = [link for link in arm.link_names if link in _FLANGES]
    if known:
        return known[-1]
    cameras = [link for link, joint in arm.above.items() if is_camera((link, joint.name))]
    arm = without(arm, cameras)
    parents = {joint.parent for joint in arm.joints}
    ends = [link for link in arm.link_names if link not in parents]
    joints = {}
    for end in ends:
        joints[end] = sum(end in arm.below(link) for link in arm.moved_by)
    ends = [end for end in ends if joints[end] > max(joints.values()) - ARM_JOINTS]
    if len(ends) > 1:
        raise RobotError(
            f"the arm ends in {', '.join(ends)}. Name the link that carries the hand with --flange."
        )
    return ends[0]


def bare(arm: RobotTree, flange: str, notes: list[str]) -> RobotTree:
    """Return an arm without what its flange carries, and with no moving joint that does not move the flange."""
    removed = set(arm.below(flange)) - {flange}
    if removed:
        notes.append(
            f"left out, because it hangs on the flange where the hand goes: {listed(sorted(removed))}"
        )
    stiff = []
    for link, joint in arm.moved_by.items():
        if link not in removed and flange not in arm.below(link):
            stiff.append(joint.name)
    if stiff:
        notes.append(
            f"joints of the arm that do not move the hand are fixed at 0: {', '.join(stiff)}"
        )
    return without(with_fixed(arm, stiff), removed)


def grounded(hand: RobotTree, notes: list[str]) -> RobotTree:
    """Return a hand without the virtual joints that let it float: joints after each other, before any shape, of which
    one slides or there are three or more."""
    link = hand.root
    virtual = []
    while not hand.link(link).collisions:
        joints = [joint for joint in hand.joints if joint.parent == link]
        if len(joints) > 1:  # frames and loose objects next to the hand
            joints = [joint for joint in joints if len(_moving_ends(hand, joint.child)) > 1]
        if len(joints) != 1:
            break
        if joints[0].type != "fixed":
            virtual.append(joints[0])
        link = joints[0].child
    if len(virtual) < 3 and all(joint.type == "revolute" for joint in virtual):
        return hand
    names = [joint.name for joint in virtual]
    notes.append(f"left out: joints that only let the hand float: {listed(names)}")
    return with_fixed(hand, names)


def _moving_ends(tree: RobotTree, link: str) -> list[str]:
    """Return the moving links of a link's branch that carry no other moving link."""
    inside = tree.below(link)
    return [
        name
        for name in inside
        if name in tree.moved_by and not tree.moved_by.keys() & set(tree.below(name)[1:])
    ]


def without(tree: RobotTree, children: Iterable[str]) -> RobotTree:
    """Return a tree without some links and what they carry."""
    removed = set().union(*map(tree.below, children))
    links = tuple(link for link in tree.links if link.name not in removed)
    joints = tuple(joint for joint in tree.joints if joint.child not in removed)
    return replace(tree, links=links, joints=joints)


def with_fixed(tree: RobotTree, names: Sequence[str]) -> RobotTree:
    """Return a tree in which some joints are fixed at 0."""
    joints = [joint for joint in tree.joints if joint.name in names]
    return tree.with_joints(replace(joint, type="fixed", mimic=None) for joint in joints)


def renamed(hand: RobotTree, arm: RobotTree) -> RobotTree:
    """Return a hand with ``hand_`` before the names of links and joints that the arm has too."""
    link_names = _unlike(hand.link_names, arm.link_names)
    joint_names = _unlike(
        [joint.name for joint in hand.joints], [joint.name for joint in arm.joints]
    )
    joints = []
    for joint in hand.joints:
        name = joint_names[joint.name]
        mimic = joint.mimic
        if mimic is not None:
            mimic = replace(mimic, joint=name, source=joint_names[mimic.source])
        parent = link_names[joint.parent]
        child = link_names[joint.child]
        joints.append(replace(joint, name=name, parent=parent, child=child, mimic=mimic))
    links = [replace(link, name=link_names[link.name]) for link in hand.links]
    exclude = [(link_names[a], link_names[b]) for a, b in hand.exclude]
    return replace(
        hand,
        root=link_names[hand.root],
        links=tuple(links),
        joints=tuple(joints),
        exclude=tuple(exclude),
    )


def _unlike(names: Sequence[str], others: Sequence[str]) -> dict[str, str]:
    """Return name -> the same name, or one with a prefix that is in neither sequence where the others have it too."""
    prefix = "hand_"
    shared = set(names) & set(others)
    while any(f"{prefix}{name}" in {*names, *others} for name in shared):
        prefix += "hand_"
    return {name: f"{prefix}{name}" if name in shared else name for name in names}


def combined(arm: RobotTree, hand: RobotTree, flange: str, T_flange_hand: np.ndarray) -> RobotTree:
    """Return a bare arm with a renamed hand whose root link has a pose [4, 4] in the frame of the arm's flange."""
    return RobotTree(
        name=arm.name,
        root=arm.root,
        links=(*arm.links, *hand.links),
        joints=(*arm.joints, fixed(flange, hand.root, T_flange_hand), *hand.joints),
        exclude=(*arm.exclude, *hand.exclude),
    )


def _with_ranges(tree: RobotTree, path: str | Path, notes: list[str]) -> RobotTree:
    """Return the tree with finite limits that joints can have; a joint without a range is fixed, unless it follows
    another."""
    units = {}
    for kind, (name, unit, most) in _UNITS.items():
        moving = [joint for joint in tree.moved_by.values() if joint.type == kind]
        ends = [max(abs(joint.lower), abs(joint.upper)) for joint in moving]
        stated = [end for end in ends if math.isfinite(end)]
        far = [end for end in stated if _FARTHEST[kind] < end <= most]
        units[kind] = 1.0
        if far and 2 * len(far) >= len(stated):
            units[kind] = unit
            notes.append(f"limits and offsets of joints, up to {max(far):g}, are read as {name}")
        elif kind == "revolute" and len(stated) > 1 and max(stated) < _LEAST_TURN:
            raise RobotError(
                f"{path}: no joint turns by more than {max(stated):.2g} rad. Are the limits missing, or in other "
                'units? A URDF states radians; an MJCF states degrees, or <compiler angle="radian"/>.'
            )
    joints = []
    fixed = []
    unlimited = []
    for joint in tree.moved_by.values():
        unit = units[joint.type]
        mimic = joint.mimic and replace(joint.mimic, offset=joint.mimic.offset * unit)
        joint = replace(joint, lower=joint.lower * unit, upper=joint.upper * unit, mimic=mimic)
        if max(abs(joint.lower), abs(joint.upper)) > _FARTHEST[joint.type]:
            far = _TURNS if joint.type == "revolute" else _SLIDE
            unlimited.append(joint.name)
            joint = replace(joint, lower=-far, upper=far)
        elif joint.upper - joint.lower < _LEAST_RANGE and joint.mimic is None:
            fixed.append(joint.name)
            joint = replace(_at(joint, joint.lower), type="fixed")
        joints.append(joint)
    if unlimited:
        notes.append(
            f"without limits that a joint can have: {listed(unlimited)}; they get one turn, or 0.1 m, in either "
            "direction"
        )
    if fixed:
        notes.append(f"fixed, because their limits leave no range: {listed(fixed)}")
    return tree.with_joints(joints)


def _at(joint: Joint, position: float) -> Joint:
    """Return a joint whose position 0 is at another position."""
    motion = np.eye(4)
    if joint.type == "prismatic":
        motion[:3, 3] = position * joint.axis
    else:
        motion[:3, :3] = Rotation.from_rotvec(position * joint.axis).as_matrix()
    return replace(joint, T_parent_joint=joint.T_parent_joint @ motion)


def _with_speeds(tree: RobotTree, notes: list[str]) -> RobotTree:
    """Return the tree with speeds that joints can have."""
    changed = []
    for joint in tree.moved_by.values():
        if not _SPEEDS[0] <= joint.velocity <= _SPEEDS[1]:
            changed.append(replace(joint, velocity=_SPEED))
    if changed:
        names = listed([joint.name for joint in changed])
        notes.append(
            f"without a speed that a joint can have: {names}; they get {_SPEED:.2f} rad/s or m/s"
        )
    return tree.with_joints(changed)


def _with_sources(tree: RobotTree, path: str | Path, notes: list[str]) -> RobotTree:
    """Return the tree with mimic joints that follow a joint that follows nothing; a mimic joint has the limits that its
    source gives it."""
    moving = {joint.name: joint for joint in tree.moved_by.values()}
    joints = [replace(joint, mimic=None) for joint in tree.joints if joint.type == "fixed"]
    for name, joint in moving.items():
        mimic = joint.mimic
        if mimic is None:
            continue
        passed = [name]
        while mimic.source not in passed and mimic.source in moving and moving[mimic.source].mimic:
            passed.append(mimic.source)
            above = moving[mimic.source].mimic
            offset = mimic.multiplier * above.offset + mimic.offset
            mimic = replace(
                mimic,
                source=above.source,
                multiplier=mimic.multiplier * above.multiplier,
                offset=offset,
            )
        if mimic.source in passed:
            raise RobotError(
                f"{path}: joints follow one another in a circle: {', '.join(passed)}. Let one of them follow nothing."
            )
        if mimic.source not in moving:
            raise RobotError(
                f"{path}: {name!r} mimics {mimic.source!r}, which is not a moving joint of the same file. Make "
                f"{name!r} fixed, or let it follow another joint."
            )
        if not mimic.multiplier:
            notes.append(f"{name!r} is fixed, because its multiplier is 0")
            joints.append(replace(_at(joint, mimic.offset), type="fixed", mimic=None))
            continue
        driver = moving[mimic.source]
        ends = mimic.multiplier * np.array((driver.lower, driver.upper)) + mimic.offset
        low, high = sorted(ends.tolist())
        if low < joint.lower or high > joint.upper:
            limits = f"{low:.3g}..{high:.3g}"
            stated = f"{joint.lower:.3g}..{joint.upper:.3g}"
            if joint.lower < joint.upper and (low >= joint.upper or high <= joint.lower):
                raise RobotError(
                    f"{path}: {name!r} follows {mimic.source!r} from {limits}, but its own limits are {stated}. The "
                    "file contradicts itself: correct the coupling (in an MJCF also `ref`), or the limits."
                )
            if limits != stated:
                notes.append(
                    f"{name!r} has the limits {limits} that {mimic.source!r} gives it, in place of {stated}"
                )
            joint = replace(joint, lower=low, upper=high)
        joints.append(replace(joint, mimic=mimic))
    return tree.with_joints(joints)


def _with_masses(tree: RobotTree, notes: list[str]) -> RobotTree:
    """Return the tree with masses and inertias that a solid body can have: those of the shapes where the stated ones
    are impossible."""
    links = []
    replaced: dict[str, list[str]] = {}
    for link in tree.links:
        if link.collisions:
            why, mass = _better_mass(link)
            if why:
                link = _with_mass_of_shapes(link, mass)
                replaced.setdefault(why, []).append(f"{link.name} ({link.mass:.3g} kg)")
        elif link.mass > _MOST_MASS:
            raise RobotError(f"link {link.name!r} has {link.mass:.3g} kg. Are these grams?")
        elif link.mass <= FRAME_MASS or not plausible(link):
            mass = max(link.mass, FRAME_MASS)
            link = replace(link, mass=mass, inertia=np.eye(3) * FRAME_INERTIA)
        links.append(link)
    for why, names in replaced.items():
        notes.append(f"these links {why}, and get that of their shapes: {listed(names)}")
    return replace(tree, links=tuple(links))


def _better_mass(link: Link) -> tuple[str, float]:
    """Return what is wrong with a link (nothing: empty), and its mass [kg], 0 if that is wrong."""
    volume = float(sum(shape_mesh(shape).volume for shape in link.collisions))
    if link.mass <= 0:
        return "have no mass", 0.0
    if not _DENSITIES[0] * volume <= link.mass <= _DENSITIES[1] * volume and volume > 0:
        return "have a mass that their size does not allow", 0.0
    if not plausible(link):
        return "have an inertia that their mass and size do not allow", link.mass
    return "", link.mass


def _with_mass_of_shapes(link: Link, mass: float) -> Link:
    volume, com, inertia = mass_of_shapes(link.collisions)
    mass = mass or _DENSITY * volume
    inertia = inertia * mass
    if not (np.isfinite(com).all() and np.isfinite(inertia).all()):
        raise RobotError(
            f"the shapes of link {link.name!r} have no volume. State the mass and inertia of the link."
        )
    return replace(link, mass=mass, com=com, inertia=inertia)


def is_solid(link: Link) -> bool:
    """Return whether a link's moments are positive, and the largest is at most the sum of the others (rounded)."""
    moments = np.linalg.eigvalsh(link.inertia)
    return bool(moments[0] > 0 and moments[2] <= (moments[0] + moments[1]) * 1.001)


def plausible(link: Link) -> bool:
    """Return whether a link's moments are those of a solid body, and at most :func:`largest_moment`."""
    largest = np.linalg.eigvalsh(link.inertia)[2]
    return is_solid(link) and (not link.collisions or bool(largest <= largest_moment(link)))


def largest_moment(link: Link) -> float:
    """[kg m^2] Moment of the link's mass at twice the reach of its shapes, and of the rotor of a joint."""
    vertices, _ = surface_of(link.collisions)
    reach = float(np.linalg.norm(vertices - link.com, axis=1).max())
    return link.mass * (2 * reach) ** 2 + _ROTOR_AT_MOST
