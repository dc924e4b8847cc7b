"""From an arm and a hand as their makers publish them to a robot's folder: ``robot.urdf``, its meshes and a commented ``robot.toml``.

What the files do not say is guessed from the hand's geometry, and every guess is told: which chain of links is which finger, where the palm
looks, which links follow which human keypoint, drives, home, and which links always touch. ``xreset robots check`` and a picture show
whether the guesses are right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

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
from xreset.geometry.urdf_writer import pose
from xreset.robot_tools.draft import below, description_text, draft_spec, link_places, moving
from xreset.robot_tools.fingers import find_fingers, find_palm, with_frames
from xreset.robot_tools.sources import Source, combined, read_source
from xreset.spec import DriveSpec, MimicSpec, RobotSpec, TableSpec

_ROTOR = 1e-3
"""[kg m^2] Rotor inertia put on the diagonal of moving hand links where none is stated: finger links alone are too light for a step of
1/240 s, and a link's inertia means the same in every engine, which armature does not (as in the built-in robots)."""
_ARMATURE = 0.1
"""[kg m^2] Rotor inertia of the arm's joints, as in the built-in robots."""
_HAND_EFFORT, _ARM_EFFORT = 1.0, 50.0
"""[N m] Where none is stated."""
_ALWAYS = 0.9
"""Links that meet in this share of the hand's configurations are modelled so, and never collide."""
_SAMPLES = 200
_HOME_PALM = (0.57, 0.45, 0.25)
"""[m] Where the palm is at home: above the table, looking down, fingers away from the person."""
_IK_STARTS, _IK_STEPS = 128, 120


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
    rpy: tuple[float, float, float] = (0, 0, 0),
    thumb: str | None = None,
) -> Imported:
    """Make a robot's folder.

    Args:
        arm: URDF or MJCF of the arm.
        hand: URDF or MJCF of the hand.
        out: folder to make; it appears whole or not at all.
        name: of the robot; default: the folder's.
        flange: link of the arm that carries the hand; default: its last one.
        offset: position of the hand's root link in the flange's frame [m]; default: the flange's origin, or as far along its z axis as
            keeps the hand's body before the flange.
        rpy: its roll, pitch and yaw about the flange's fixed axes [rad].
        thumb: a link or joint of the thumb, where names and geometry do not tell.

    Raises:
        RobotError: a file cannot be read, the folder is there already, or no fingers are found; the message says what to do.
    """
    if out.exists() and any(out.iterdir() if out.is_dir() else [out]):
        raise RobotError(f"{out} is there already; give another folder, or remove it.")
    name = name or out.name
    parts = read_source(arm), read_source(hand)
    stand_off = _stand_off(parts[1].tree, rpy) if offset is None else 0.0
    whole = combined(*parts, flange=flange, T_flange_hand=pose(offset or (0, 0, stand_off), rpy=rpy), name=name)
    mount = next(joint for joint in whole.tree.joints if joint.child not in parts[0].tree.link_names)
    if stand_off > 0:
        moved = f"the hand's root lies {1e3 * stand_off:.0f} mm along z of {mount.parent!r}, so that its body begins there (--offset)"
        whole = replace(whole, notes=(*whole.notes, moved))
    hand_root = _carrier(whole.tree, mount.child)
    with atomic_folder(out) as work:
        guessed, to_say = _write(whole, mount.parent, hand_root, work, thumb=thumb)
        load_robot(work)
    return Imported(folder=out, guessed=guessed, to_say=to_say)


def _carrier(tree: RobotTree, link: str) -> str:
    """The first link from ``link`` on that has shapes, or more than one child."""
    while not tree.link(link).collisions:
        below = [joint for joint in tree.joints if joint.parent == link]
        if len(below) != 1 or below[0].type != "fixed":
            break
        link = below[0].child
    return link


def _stand_off(hand: RobotTree, rpy: tuple[float, float, float]) -> float:
    """Distance [m] by which a hand's body would reach behind the flange's origin, were its root there."""
    poses = {hand.root: pose((0, 0, 0), rpy=rpy)}
    for joint in hand.joints:  # parents come before children
        if joint.type == "fixed" and joint.parent in poses:
            poses[joint.child] = poses[joint.parent] @ joint.T_parent_joint
    height = [
        surface_of(hand.link(name).collisions)[0] @ T[2, :3] + T[2, 3]
        for name, T in poses.items()
        if hand.link(name).collisions
    ]
    return max(0.0, round(-float(np.concatenate(height).min()), 3)) if height else 0.0


def _write(
    source: Source, flange: str, hand_root: str, folder: Path, *, thumb: str | None
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    notes = list(source.notes)
    tree = _with_rotors(source, hand_root, notes)
    fingers = find_fingers(tree, source.mimics, hand_root, folder, thumb, notes)
    palm_axes, straight, bent = find_palm(tree, source.mimics, hand_root, fingers, folder)
    tree, tips, keypoints = with_frames(tree, hand_root, fingers, palm_axes, folder, source.mimics, straight)
    spec = draft_spec(
        tree,
        source.mimics,
        hand_root,
        folder,
        tips=tips,
        keypoints=keypoints,
        home=_hand_home(tree, source.mimics, bent),
    )
    spec = _arm_home(spec, notes)
    spec = _with_drives(spec, source, notes)
    spec = _with_exclusions(spec, notes)
    (folder / DESCRIPTION).write_text(description_text(spec, notes))
    at = link_places(spec, {})
    palm = np.linalg.inv(at[flange]) @ at[spec.palm]
    ahead, inner = (", ".join(f"{v + 0.0:.2f}" for v in axis.round(2)) for axis in (palm[:3, 0], palm[:3, 2]))
    to_say = (
        f"how the hand is mounted (--offset, --rpy): now its fingers point along ({ahead}) of {flange!r}, its inner side along ({inner})",
        "whether each finger and the thumb are what they are called, and the palm looks where its z axis points (see the picture)",
        "efforts and gains of the drives, where the maker's figures are better than the rule",
        "where the base stands: xreset robots place FOLDER --demos DEMOS --write",
    )
    return tuple(notes), to_say


def _with_rotors(source: Source, hand_root: str, notes: list[str]) -> RobotTree:
    """The tree whose moving hand links carry their rotors."""
    moved_by = {joint.child: joint.name for joint in source.tree.joints if joint.type != "fixed"}
    inside = set(below(source.tree, hand_root)) - {hand_root}
    links = []
    for link in source.tree.links:
        if link.name in moved_by and link.name in inside:
            drive = source.drives.get(moved_by[link.name])
            link = replace(
                link, inertia=link.inertia + (drive.armature if drive and drive.armature else _ROTOR) * np.eye(3)
            )
        links.append(link)
    notes.append(
        f"moving links of the hand carry {_ROTOR:g} kg m^2 of rotor inertia, or what the MJCF states as armature"
    )
    return replace(source.tree, links=tuple(links))


# Home, drives, collisions ----------------------------------------------------------------------------------------------------------------


def _hand_home(tree: RobotTree, mimics: Sequence[MimicSpec], bent: dict[str, float]) -> dict[str, float]:
    rest = {name: float(np.clip(0.0, tree.joint(name).lower, tree.joint(name).upper)) for name in moving(tree, mimics)}
    return {name: value + bent.get(name, 0.0) for name, value in rest.items()}


def _arm_home(spec: RobotSpec, notes: list[str]) -> RobotSpec:
    """Arm joints that hold the palm over the table, looking down: the solution farthest from the limits that is clear of table and self."""
    kinematics = Kinematics(spec)
    arm = torch.as_tensor(spec.arm_indices)
    lower, upper = kinematics.lower[arm], kinematics.upper[arm]
    low, high = lower.clamp_min(-np.pi), upper.clamp_max(np.pi)
    draw = torch.rand(_IK_STARTS, len(arm), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    q = torch.tensor(spec.home).repeat(_IK_STARTS, 1)
    q[:, arm] = low + draw * (high - low)
    goal = torch.tensor(_HOME_PALM, dtype=torch.float64)
    goal_rot = torch.tensor(
        [[0.0, -1, 0], [-1, 0, 0], [0, 0, -1]], dtype=torch.float64
    )  # x to -y, z down; columns are the axes
    for _ in range(_IK_STEPS):
        at = kinematics.jacobian(q, (spec.palm,))
        turn = goal_rot @ at.rot[:, 0].mT
        angle = torch.as_tensor(Rotation.from_matrix(turn.numpy()).as_rotvec())
        error = torch.cat(((goal - at.pos[:, 0]) / 0.1, angle), dim=1)
        J = torch.cat((at.linear[:, 0][..., arm] / 0.1, at.angular[:, 0][..., arm]), dim=1)
        step = torch.linalg.solve(J.mT @ J + 1e-2 * torch.eye(len(arm), dtype=J.dtype), (J.mT @ error[..., None]))[
            ..., 0
        ]
        q[:, arm] = torch.minimum(torch.maximum(q[:, arm] + step.clamp(-0.3, 0.3), low), high)
    reached = (error[:, :3].norm(dim=1) * 0.1 < 0.01) & (error[:, 3:].norm(dim=1) < 0.05)
    support = table_points(spec, kinematics)
    height = height_above_table(
        kinematics.points(q, support.links, torch.tensor(support.points)), torch.tensor(support.radii), TableSpec()
    )
    collision = SelfCollision(spec, kinematics, moved_by_arm=True)
    apart = torch.as_tensor(collision.clearance(kinematics.link_poses(q).numpy(), 0.02))
    room = torch.minimum(q[:, arm] - lower, upper - q[:, arm]).amin(dim=1).clamp_max(0.5)
    score = room + 10 * reached + 5 * (height.amin(dim=1) > 0.01) + 5 * (apart > 0)
    best = int(score.argmax())
    if not bool(reached[best]):
        notes.append(
            "the arm does not reach over the table from where it stands: `xreset robots place` finds a better place and home"
        )
    values = q[best].tolist()
    notes.append("home: the palm over the table, looking down; fingers bent a little")
    return replace(
        spec,
        joints=tuple(replace(joint, home=round(value, 4)) for joint, value in zip(spec.joints, values, strict=True)),
    )


def _with_drives(spec: RobotSpec, source: Source, notes: list[str]) -> RobotSpec:
    """Drives as the files state them, else by the built-in robots' rule: stiff enough that the effort is reached within 0.35 rad."""
    joints, without = [], []
    for joint in spec.joints:
        of_arm = joint.group == "arm"
        if joint.name not in source.effort:
            without.append(joint.name)
        effort = source.effort.get(joint.name, _ARM_EFFORT if of_arm else _HAND_EFFORT)
        stated = source.drives.get(joint.name)
        kp = float(np.clip(effort * 15, 300, 2000)) if of_arm else float(np.clip(effort / 0.35, 0.5, 10))
        drive = DriveSpec(kp=kp, kd=0.0, effort=effort, armature=_ARMATURE if of_arm else 0.0)
        if stated is not None and not of_arm:
            drive = replace(drive, kp=stated.kp)
        joints.append(replace(joint, drive=drive))
    spec = replace(spec, joints=tuple(joints))
    factor = [2.0 if joint.group == "arm" else 1.8 for joint in spec.joints]
    kd = [
        f * np.sqrt(j.drive.kp * inertia)
        for f, j, inertia in zip(factor, spec.joints, drive_inertia(spec, spec.home), strict=True)
    ]
    if without:
        notes.append(
            f"no effort is stated for {', '.join(without)}; they get {_ARM_EFFORT:g} (arm) or {_HAND_EFFORT:g} N m (hand)"
        )
    notes.append(
        "drives: kd = 1.8 sqrt(kp I) in the hand, critical in the arm, with the inertia I about the joint at home"
    )
    drives = [replace(joint.drive, kd=float(f"{value:.3g}")) for joint, value in zip(spec.joints, kd, strict=True)]
    return replace(
        spec, joints=tuple(replace(joint, drive=drive) for joint, drive in zip(spec.joints, drives, strict=True))
    )


def _with_exclusions(spec: RobotSpec, notes: list[str]) -> RobotSpec:
    pairs = always_meeting(spec)
    if pairs:
        notes.append(
            "never collide, because they meet: " + "; ".join(f"{a} and {b} ({why})" for (a, b), why in pairs.items())
        )
    return replace(spec, collision_exclude=tuple(pairs))


def always_meeting(spec: RobotSpec) -> dict[tuple[str, str], str]:
    """Pairs of links that meet at home, or nearly wherever the hand's joints are, and which of the two."""
    kinematics = Kinematics(spec)
    collision = SelfCollision(spec, kinematics)
    pairs = dict.fromkeys(collision.overlapping_at_home, "at home")
    q = torch.tensor(spec.home).repeat(_SAMPLES, 1)
    hand = torch.as_tensor(spec.hand_indices)
    draw = torch.rand(_SAMPLES, len(hand), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    q[:, hand] = kinematics.lower[hand] + draw * (kinematics.upper[hand] - kinematics.lower[hand])
    near = collision.near(kinematics.link_poses(q).numpy(), 0.0)
    meetings = {(int(f), tuple(sorted(map(int, pair)))) for f, pair in zip(near.configuration, near.links, strict=True)}
    counts: dict[tuple[int, ...], int] = {}
    for _, pair in meetings:
        counts[pair] = counts.get(pair, 0) + 1
    names = kinematics.link_names
    for (a, b), count in counts.items():
        if count >= _ALWAYS * _SAMPLES:
            pairs[(names[a], names[b])] = "in nearly every position"
    return pairs
