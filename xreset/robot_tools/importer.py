"""Makes a robot's folder from an arm and a hand as their makers publish them: ``robot.urdf``, its meshes and a
commented ``robot.toml``.

What the files do not say is guessed from the hand's geometry, and every guess is told: which chain of links is which
finger, where the palm looks, which links follow which human keypoint, drives, home, and which links always touch.
``xreset robots check`` and a picture show whether the guesses are right.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from xreset.description import DESCRIPTION, load_robot
from xreset.errors import RobotError
from xreset.files import atomic_folder
from xreset.geometry.collision import SelfCollision, height_above_table, table_points
from xreset.geometry.dynamics import drive_inertia
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.shapes import surface_of
from xreset.geometry.urdf import RobotTree
from xreset.geometry.urdf_writer import pose, roll_pitch_yaw
from xreset.robot_tools.draft import below, description_text, draft_spec, link_places, moving
from xreset.robot_tools.fingers import find_fingers, find_palm, with_frames
from xreset.robot_tools.sources import Source, combined, read_source
from xreset.spec import DriveSpec, RobotSpec, TableSpec

_ROTOR = 1e-3
"""[kg m^2] Rotor inertia on the diagonal of moving hand links where none is stated: finger links alone are too light
for a step of 1/240 s. The inertia of a link means the same in every engine, which armature does not (as in the built-in
robots)."""
_ARMATURE = 0.1
"""[kg m^2] Rotor inertia of the arm's joints, as in the built-in robots."""
_HAND_EFFORT = 1.0
_ARM_EFFORT = 50.0
"""[N m] Where none is stated."""
_ALWAYS = 0.9
"""Links that meet in this share of the hand's configurations are modelled so, and never collide."""
_SAMPLES = 200
_HOME_PALM = (0.57, 0.45, 0.25)
"""[m] Position of the palm at home: above the table, looking down, fingers away from the person."""
_ALONG = 0.9
"""Cosine of the angle to an axis below which fingers do not point along it."""
_IK_STARTS = 128
_IK_STEPS = 120


@dataclass(frozen=True, kw_only=True)
class Imported:
    """What an import made."""

    folder: Path
    guessed: tuple[str, ...]
    """What was not stated anywhere."""
    to_say: tuple[str, ...]
    """What only a person can say."""


def import_robot(
    arm: Path,
    hand: Path,
    out: Path,
    *,
    name: str | None = None,
    flange: str | None = None,
    offset: tuple[float, float, float] | None = None,
    rpy: tuple[float, float, float] | None = None,
    thumb: str | None = None,
) -> Imported:
    """Make a robot's folder.

    Args:
        arm: URDF or MJCF of the arm.
        hand: URDF or MJCF of the hand.
        out: folder to make; it appears whole or not at all.
        name: name of the robot; default: the folder's.
        flange: link of the arm that carries the hand; default: its last one.
        offset: position of the hand's root link in the flange's frame [m]; default: the flange's origin, or as far
            along its z axis as keeps the hand's body before the flange.
        rpy: roll, pitch and yaw of the hand's root link about the flange's fixed axes [rad]; default: as in the hand's
            file, or turned so that the fingers point along the flange's z axis.
        thumb: a link or joint of the thumb, where names and geometry do not tell.

    Raises:
        RobotError: a file cannot be read, the folder exists, or no fingers are found; the message says what to do.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise RobotError(f"{out} is there already; give another folder, or remove it.")
    arm_source = read_source(arm)
    hand_source = read_source(hand)
    notes: list[str] = []
    if rpy is None:
        rpy = _upright(hand_source, thumb)
        if any(rpy):
            notes.append(
                f"the hand is turned by --rpy {_angles(rpy)}, so that its fingers point along the flange's z axis"
            )
    stand_off = 0.0
    if offset is None:
        stand_off = _stand_off(hand_source.tree, rpy)
        offset = (0, 0, stand_off)
    T = pose(offset, rpy=rpy)
    whole = combined(arm_source, hand_source, flange=flange, T_flange_hand=T, name=name or out.name)
    mount = next(joint for joint in whole.tree.joints if joint.child not in arm_source.tree.link_names)
    notes += whole.notes
    if stand_off > 0:
        notes.append(
            f"the hand's root lies {1e3 * stand_off:.0f} mm along z of {mount.parent!r}, so that its body begins "
            "there (--offset)"
        )
    hand_root, wrist = _palm(whole.tree, mount.child, notes)
    with atomic_folder(out) as work:
        spec = _described(whole, hand_root, wrist, work, thumb, notes)
        (work / DESCRIPTION).write_text(description_text(spec, notes))
        load_robot(work)
        to_say = (_mounting(spec, mount.parent, wrist, T), *_TO_SAY)
    return Imported(folder=out, guessed=tuple(notes), to_say=to_say)


_TO_SAY = (
    "whether each finger and the thumb are what they are called, and the palm looks where its z axis points (see the "
    "picture)",
    "efforts and gains of the drives, where the maker's figures are better than the rule",
    "where the base stands: xreset robots place FOLDER --demos DEMOS --write",
)


def _mounting(spec: RobotSpec, flange: str, wrist: list[str], T_flange_hand: np.ndarray) -> str:
    """Return how the hand is mounted, and the angles that let its fingers point along the flange's z axis."""
    at = link_places(spec, dict.fromkeys(wrist, 0.0))
    palm = np.linalg.inv(at[flange]) @ at[spec.palm]
    ahead = palm[:3, 0]
    text = (
        f"how the hand is mounted (--offset, --rpy): now its fingers point along ({_vector(ahead)}) of {flange!r}, "
        f"its inner side along ({_vector(palm[:3, 2])})"
    )
    if ahead[2] > _ALONG:
        return f"{text}. The angle about z is yours to know: --rpy turns the hand as it is mounted on your arm"
    angles = _angles(_turned_up(ahead, T_flange_hand[:3, :3]))
    return f"{text}; for fingers along its z axis: --rpy {angles}"


def _upright(hand: Source, thumb: str | None) -> tuple[float, float, float]:
    """Return the roll, pitch and yaw with which a hand's fingers point along z; zeros where they nearly do as it is."""
    tree = hand.tree
    hand_root, wrist = _palm(tree, tree.root, [])
    with TemporaryDirectory() as folder:
        fingers = find_fingers(tree, hand.mimics, hand_root, Path(folder), thumb, [])
        palm, _, _ = find_palm(tree, hand.mimics, hand_root, fingers, Path(folder))
        at = link_places(draft_spec(tree, hand.mimics, hand_root, Path(folder)), dict.fromkeys(wrist, 0.0))
    ahead = (np.linalg.inv(at[tree.root]) @ palm)[:3, 0]
    return (0.0, 0.0, 0.0) if ahead[2] > _ALONG else _turned_up(ahead, np.eye(3))


def _turned_up(ahead: np.ndarray, R: np.ndarray) -> tuple[float, float, float]:
    """Return roll, pitch and yaw of a frame with rotation R after the shortest turn of a direction to the z axis."""
    if np.abs(ahead).max() > 0.95:
        ahead = ahead.round()  # along an axis, as far as fingers are straight
    turn = Rotation.align_vectors([[0, 0, 1]], [ahead])[0]
    roll, pitch, yaw = (np.round(roll_pitch_yaw(turn.as_matrix() @ R), 4) + 0.0).tolist()
    return roll, pitch, yaw


def _angles(angles: Iterable[float]) -> str:
    return " ".join(f"{angle:g}" for angle in angles)


def _vector(values: np.ndarray) -> str:
    return ", ".join(f"{value:.2f}" for value in values.round(2) + 0.0)


def _carrier(tree: RobotTree, link: str) -> str:
    """Return the first link from ``link`` on that has shapes, or more than one child."""
    while not tree.link(link).collisions:
        children = [joint for joint in tree.joints if joint.parent == link]
        if len(children) != 1 or children[0].type != "fixed":
            break
        link = children[0].child
    return link


def _palm(tree: RobotTree, link: str, notes: list[str]) -> tuple[str, list[str]]:
    """Return the link after which the fingers part, and the joints before it, which are those of a wrist."""
    wrist = []
    link = _carrier(tree, link)
    while True:
        inside = set(below(tree, link)) - {link}
        body = tree.moving_ancestor(link)
        first = [j for j in tree.joints if j.type != "fixed" and j.child in inside]
        first = [joint for joint in first if tree.moving_ancestor(joint.parent) == body]
        if len(first) != 1:
            break
        wrist.append(first[0].name)
        link = _carrier(tree, first[0].child)
    if wrist:
        notes.append(
            f"{', '.join(wrist)} move the whole hand: they are the last joints of the arm. To keep a wrist still, make "
            "its joints fixed in the hand's file"
        )
    return link, wrist


def _stand_off(hand: RobotTree, rpy: tuple[float, float, float]) -> float:
    """Distance [m] by which a hand's body would reach behind the flange's origin if its root were there."""
    poses = {hand.root: pose((0, 0, 0), rpy=rpy)}
    for joint in hand.joints:  # parents come before children
        if joint.type == "fixed" and joint.parent in poses:
            poses[joint.child] = poses[joint.parent] @ joint.T_parent_joint
    lowest = [0.0]
    for name, T in poses.items():
        if hand.link(name).collisions:
            vertices, _ = surface_of(hand.link(name).collisions)
            lowest.append(float((vertices @ T[2, :3] + T[2, 3]).min()))
    return max(0.0, round(-min(lowest), 3))


def _described(
    source: Source, hand_root: str, wrist: list[str], folder: Path, thumb: str | None, notes: list[str]
) -> RobotSpec:
    """Return the robot, its URDF written; what is guessed is appended to the notes."""
    tree = _with_rotors(source, hand_root, notes)
    mimics = source.mimics
    fingers = find_fingers(tree, mimics, hand_root, folder, thumb, notes)
    palm, straight, bent = find_palm(tree, mimics, hand_root, fingers, folder)
    tree, tips, keypoints = with_frames(tree, hand_root, fingers, palm, straight)
    home = {}
    for name in moving(tree, mimics):
        joint = tree.joint(name)
        home[name] = float(np.clip(0.0, joint.lower, joint.upper)) + bent.get(name, 0.0)
    spec = draft_spec(tree, mimics, hand_root, folder, tips=tips, keypoints=keypoints, home=home)
    spec = _with_arm_home(spec, wrist, notes)
    spec = _with_drives(spec, source, notes)
    pairs = always_meeting(spec)
    if pairs:
        listed = "; ".join(f"{a} and {b} ({why})" for (a, b), why in pairs.items())
        notes.append(f"never collide, because they meet: {listed}")
    return replace(spec, collision_exclude=tuple(pairs))


def _with_rotors(source: Source, hand_root: str, notes: list[str]) -> RobotTree:
    """Return the tree whose moving hand links carry their rotors."""
    moved_by = {joint.child: joint.name for joint in source.tree.joints if joint.type != "fixed"}
    inside = set(below(source.tree, hand_root)) - {hand_root}
    links = []
    for link in source.tree.links:
        if link.name in moved_by and link.name in inside:
            drive = source.drives.get(moved_by[link.name])
            rotor = drive.armature if drive and drive.armature else _ROTOR
            link = replace(link, inertia=link.inertia + rotor * np.eye(3))
        links.append(link)
    notes.append(
        f"moving links of the hand carry {_ROTOR:g} kg m^2 of rotor inertia, or what the MJCF states as armature"
    )
    return replace(source.tree, links=tuple(links))


# Home, drives, collisions ---------------------------------------------------------------------------------------------


def _with_arm_home(spec: RobotSpec, wrist: list[str], notes: list[str]) -> RobotSpec:
    """Return the robot whose arm at home holds the palm over the table, looking down, with a straight wrist.

    Of several solutions it is the one farthest from the limits that is clear of the table and of itself.
    """
    kinematics = Kinematics(spec)
    arm = torch.as_tensor([i for i in spec.arm_indices.tolist() if spec.joint_names[i] not in wrist])
    lower = kinematics.lower[arm]
    upper = kinematics.upper[arm]
    low = lower.clamp_min(-np.pi)
    high = upper.clamp_max(np.pi)
    draw = torch.rand(_IK_STARTS, len(arm), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    q = torch.tensor(spec.home).repeat(_IK_STARTS, 1)
    q[:, arm] = low + draw * (high - low)
    goal = torch.tensor(_HOME_PALM, dtype=torch.float64)
    goal_rot = torch.tensor([[0.0, -1, 0], [-1, 0, 0], [0, 0, -1]], dtype=torch.float64)  # columns: x to -y, z down
    damping = 1e-2 * torch.eye(len(arm), dtype=torch.float64)
    for _ in range(_IK_STEPS):
        at = kinematics.jacobian(q, (spec.palm,))
        turn = goal_rot @ at.rot[:, 0].mT
        angle = torch.as_tensor(Rotation.from_matrix(turn.numpy()).as_rotvec())
        error = torch.cat(((goal - at.pos[:, 0]) / 0.1, angle), dim=1)
        J = torch.cat((at.linear[:, 0][..., arm] / 0.1, at.angular[:, 0][..., arm]), dim=1)
        step = torch.linalg.solve(J.mT @ J + damping, J.mT @ error[..., None])[..., 0]
        q[:, arm] = torch.minimum(torch.maximum(q[:, arm] + step.clamp(-0.3, 0.3), low), high)
    reached = (error[:, :3].norm(dim=1) * 0.1 < 0.01) & (error[:, 3:].norm(dim=1) < 0.05)
    support = table_points(spec, kinematics)
    points = kinematics.points(q, support.links, torch.tensor(support.points))
    height = height_above_table(points, torch.tensor(support.radii), TableSpec())
    collision = SelfCollision(spec, kinematics, moved_by_arm=True)
    apart = torch.as_tensor(collision.clearance(kinematics.link_poses(q).numpy(), 0.02))
    room = torch.minimum(q[:, arm] - lower, upper - q[:, arm]).amin(dim=1).clamp_max(0.5)
    score = room + 10 * reached + 5 * (height.amin(dim=1) > 0.01) + 5 * (apart > 0)
    best = int(score.argmax())
    if not bool(reached[best]):
        notes.append(
            "the arm does not reach over the table from where it stands: `xreset robots place` finds a better place "
            "and home"
        )
    notes.append("home: the palm over the table, looking down; fingers bent a little")
    joints = []
    limits = torch.stack((kinematics.lower, kinematics.upper), dim=1).tolist()
    for joint, value, (low, high) in zip(spec.joints, q[best].tolist(), limits, strict=True):
        home = round(value, 4)
        if home < low:  # by rounding
            home = math.ceil(low * 1e4) / 1e4
        elif home > high:
            home = math.floor(high * 1e4) / 1e4
        joints.append(replace(joint, home=home))
    return replace(spec, joints=tuple(joints))


def _with_drives(spec: RobotSpec, source: Source, notes: list[str]) -> RobotSpec:
    """Return the robot with drives as the files state them, else by the built-in robots' rule.

    The rule: stiff enough that the effort is reached within 0.35 rad.
    """
    without = [joint.name for joint in spec.joints if joint.name not in source.effort]
    joints = []
    for joint in spec.joints:
        if joint.group == "arm":
            effort = source.effort.get(joint.name, _ARM_EFFORT)
            drive = DriveSpec(kp=float(np.clip(effort * 15, 300, 2000)), kd=0.0, effort=effort, armature=_ARMATURE)
        else:
            effort = source.effort.get(joint.name, _HAND_EFFORT)
            stated = source.drives.get(joint.name)
            kp = stated.kp if stated else float(np.clip(effort / 0.35, 0.5, 10))
            drive = DriveSpec(kp=kp, kd=0.0, effort=effort)
        joints.append(replace(joint, drive=drive))
    spec = replace(spec, joints=tuple(joints))
    damped = []
    for joint, inertia in zip(joints, drive_inertia(spec, spec.home), strict=True):
        factor = 2.0 if joint.group == "arm" else 1.8
        kd = factor * np.sqrt(joint.drive.kp * inertia)
        damped.append(replace(joint, drive=replace(joint.drive, kd=float(f"{kd:.3g}"))))
    if without:
        notes.append(
            f"no effort is stated for {', '.join(without)}; they get {_ARM_EFFORT:g} (arm) or {_HAND_EFFORT:g} N m "
            "(hand)"
        )
    notes.append(
        "drives: kd = 1.8 sqrt(kp I) in the hand, critical in the arm, with the inertia I about the joint at home"
    )
    return replace(spec, joints=tuple(damped))


def always_meeting(spec: RobotSpec) -> dict[tuple[str, str], str]:
    """Return pairs of links that meet at home, or nearly wherever the hand's joints are, and which of the two."""
    kinematics = Kinematics(spec)
    collision = SelfCollision(spec, kinematics)
    pairs = dict.fromkeys(collision.overlapping_at_home, "at home")
    q = torch.tensor(spec.home).repeat(_SAMPLES, 1)
    hand = torch.as_tensor(spec.hand_indices)
    draw = torch.rand(_SAMPLES, len(hand), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    q[:, hand] = kinematics.lower[hand] + draw * (kinematics.upper[hand] - kinematics.lower[hand])
    near = collision.near(kinematics.link_poses(q).numpy(), 0.0)
    meetings = set()
    for configuration, pair in zip(near.configuration, near.links, strict=True):
        meetings.add((int(configuration), tuple(sorted(map(int, pair)))))
    names = kinematics.link_names
    for (a, b), count in Counter(pair for _, pair in meetings).items():
        if count >= _ALWAYS * _SAMPLES:
            pairs[(names[a], names[b])] = "in nearly every position"
    return pairs
