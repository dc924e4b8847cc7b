"""From an arm and a hand as their makers publish them to a robot's folder: ``robot.urdf``, its meshes and a commented ``robot.toml``.

What the files do not say is guessed from the hand's geometry, and every guess is told: which chain of links is which finger, where the palm
looks, which links follow which human keypoint, drives, home, and which links always touch. ``xreset robots check`` and a picture show
whether the guesses are right.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from xreset.description import DESCRIPTION, SCHEMA, load_robot
from xreset.errors import RobotError
from xreset.geometry.collision import SelfCollision, height_above_table, table_points
from xreset.geometry.dynamics import drive_inertia
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.shapes import surface_of
from xreset.geometry.urdf import RobotTree
from xreset.geometry.urdf_writer import fixed, frame, urdf_text, write_meshes
from xreset.robot_tools.sources import Source, combined, read_source
from xreset.spec import DriveSpec, FingertipSpec, JointSpec, KeypointSpec, MimicSpec, RobotSpec, TableSpec

_FINGERS = ("index", "middle", "ring", "little")
_HUMAN = (0.0, 0.45, 0.73)
"""Where a human finger's joints lie between its first one and its tip: knuckle, middle joint, last joint (rounded averages)."""
_BESIDE = 0.003
"""[m] A joint's origin that lies farther from the middle of the finger, along the joint's axis, gets a frame there for its keypoint."""
_WRIST_BEHIND = 0.095
"""[m] The human wrist behind the knuckles."""
_PALM_BEHIND = 0.04
"""[m] The palm's centre behind the knuckles."""
_ROTOR = 1e-3
"""[kg m^2] Rotor inertia put on the diagonal of moving hand links where none is stated: finger links alone are too light for a step of
1/240 s, and a link's inertia means the same in every engine, which armature does not (as in the built-in robots)."""
_ARMATURE = 0.1
"""[kg m^2] Rotor inertia of the arm's joints, as in the built-in robots."""
_HAND_EFFORT, _ARM_EFFORT = 1.0, 50.0
"""[N m] Where none is stated."""
_BEND = 0.15
"""Share of its range by which a finger's joint is bent at home."""
_ALWAYS = 0.9
"""Links that meet in this share of the hand's configurations are modelled so, and never collide."""
_SAMPLES = 200
_BASE = ((0.60, 1.00, 0.30), (0.7071068, 0.0, 0.0, -0.7071068))
"""Where the arm stands until `robots place` finds better: behind the table, on the person's side, its x towards the table."""
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


@dataclass(frozen=True, kw_only=True)
class _Finger:
    """A chain of moving links from the palm to a tip."""

    name: str
    links: tuple[str, ...]
    """Its moving links from the palm on."""
    joints: tuple[str, ...]
    rest: tuple[str, ...]
    """Links fixed to the last one."""


def import_robot(
    arm: Path,
    hand: Path,
    out: Path,
    *,
    name: str | None = None,
    flange: str | None = None,
    T_flange_hand: np.ndarray | None = None,
    thumb: str | None = None,
) -> Imported:
    """Make a robot's folder.

    Args:
        arm: URDF or MJCF of the arm.
        hand: URDF or MJCF of the hand.
        out: folder to make; it appears whole or not at all.
        name: of the robot; default: the folder's.
        flange: link of the arm that carries the hand; default: its last one.
        T_flange_hand: [4, 4] pose of the hand's root link in the flange's frame; default: the same frame.
        thumb: a link or joint of the thumb, where names and geometry do not tell.

    Raises:
        RobotError: a file cannot be read, the folder is there already, or no fingers are found; the message says what to do.
    """
    if out.exists() and any(out.iterdir() if out.is_dir() else [out]):
        raise RobotError(f"{out} is there already; give another folder, or remove it.")
    name = name or out.name
    parts = read_source(arm), read_source(hand)
    T = np.eye(4) if T_flange_hand is None else T_flange_hand
    whole = combined(*parts, flange=flange, T_flange_hand=T, name=name)
    mount = next(joint for joint in whole.tree.joints if joint.child not in parts[0].tree.link_names)
    hand_root = _carrier(whole.tree, mount.child)
    out.parent.mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(dir=out.parent, prefix=f".{out.name}."))
    try:
        guessed, to_say = _write(whole, hand_root, work, thumb=thumb, stated_offset=T_flange_hand is not None)
        load_robot(work)
        work.chmod(0o755)
        if out.is_dir():
            out.rmdir()
        os.replace(work, out)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return Imported(folder=out, guessed=guessed, to_say=to_say)


def _carrier(tree: RobotTree, link: str) -> str:
    """The first link from ``link`` on that has shapes, or more than one child."""
    while not tree.link(link).collisions:
        below = [joint for joint in tree.joints if joint.parent == link]
        if len(below) != 1 or below[0].type != "fixed":
            break
        link = below[0].child
    return link


def _write(
    source: Source, hand_root: str, folder: Path, *, thumb: str | None, stated_offset: bool
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    notes = list(source.notes)
    tree = _with_rotors(source, hand_root, notes)
    fingers = _fingers(tree, source.mimics, hand_root, folder, thumb, notes)
    palm_axes, straight, bent = _palm(tree, source.mimics, hand_root, fingers, folder)
    tree, tips, keypoints = _with_frames(tree, hand_root, fingers, palm_axes, folder, source.mimics, straight)
    spec = _spec(tree, source.mimics, hand_root, folder, tips=tips, keypoints=keypoints, home=_hand_home(tree, source.mimics, bent))
    spec = _arm_home(spec, notes)
    spec = _with_drives(spec, source, notes)
    spec = _with_exclusions(spec, notes)
    (folder / DESCRIPTION).write_text(_toml(spec, notes))
    to_say = [
        "whether each finger and the thumb are what they are called, and the palm looks where its z axis points (see the picture)",
        "efforts and gains of the drives, where the maker's figures are better than the rule",
        "where the base stands: xreset robots place FOLDER --demos DEMOS --write",
    ]
    if not stated_offset:
        to_say.insert(0, "the pose of the hand on the flange (--offset, --rpy): it was taken to be the flange's own frame")
    return tuple(notes), tuple(to_say)


# The hand's geometry ---------------------------------------------------------------------------------------------------------------------


def _moving(tree: RobotTree, mimics: Sequence[MimicSpec]) -> list[str]:
    """Joints that need a drive, root first."""
    followers = {mimic.joint for mimic in mimics}
    return [joint.name for joint in tree.joints if joint.type != "fixed" and joint.name not in followers]


def _below(tree: RobotTree, root: str) -> list[str]:
    found = {root}
    for joint in tree.joints:
        if joint.parent in found:
            found.add(joint.child)
    return [name for name in tree.link_names if name in found]


def _with_rotors(source: Source, hand_root: str, notes: list[str]) -> RobotTree:
    """The tree whose moving hand links carry their rotors."""
    moved_by = {joint.child: joint.name for joint in source.tree.joints if joint.type != "fixed"}
    inside = set(_below(source.tree, hand_root)) - {hand_root}
    links = []
    for link in source.tree.links:
        if link.name in moved_by and link.name in inside:
            drive = source.drives.get(moved_by[link.name])
            link = replace(link, inertia=link.inertia + (drive.armature if drive and drive.armature else _ROTOR) * np.eye(3))
        links.append(link)
    notes.append(f"moving links of the hand carry {_ROTOR:g} kg m^2 of rotor inertia, or what the MJCF states as armature")
    return replace(source.tree, links=tuple(links))


def _spec(
    tree: RobotTree,
    mimics: Sequence[MimicSpec],
    hand_root: str,
    folder: Path,
    *,
    tips: Sequence[FingertipSpec] = (),
    keypoints: Sequence[KeypointSpec] = (),
    home: dict[str, float] | None = None,
) -> RobotSpec:
    """The robot as far as it is known, its URDF written."""
    (folder / "robot.urdf").write_text(urdf_text(tree, {}, mimics=mimics, comment="Written by xreset robots import."))
    write_meshes(tree, folder)
    inside = {joint.name for joint in tree.joints if joint.child in set(_below(tree, hand_root)) - {hand_root}}
    joints = tuple(
        JointSpec(
            name=name,
            group="hand" if name in inside else "arm",
            drive=DriveSpec(kp=1.0, kd=0.1, effort=1.0),
            home=(home or {}).get(name, float(np.clip(0.0, tree.joint(name).lower, tree.joint(name).upper))),
        )
        for name in _moving(tree, mimics)
    )
    return RobotSpec(
        name=tree.name,
        urdf=folder / "robot.urdf",
        joints=joints,
        mimics=tuple(mimics),
        base_pos=_BASE[0],
        base_quat=_BASE[1],
        palm="palm_frame" if tips else hand_root,
        hand_root=hand_root,
        fingertips=tuple(tips),
        keypoints=tuple(keypoints),
        self_collision_links=tuple(n for n in _below(tree, hand_root) if tree.link(n).collisions),
        table_exclude=tuple(n for n in tree.link_names if tree.moving_ancestor(n) == tree.root and tree.link(n).collisions),
    )


def _places(spec: RobotSpec, positions: dict[str, float]) -> dict[str, np.ndarray]:
    """Link -> pose [4, 4] in the frame of the hand's root, at joint positions; others are at home."""
    kinematics = Kinematics(spec)
    q = torch.tensor([positions.get(joint.name, joint.home) for joint in spec.joints], dtype=torch.float64)
    poses = kinematics.link_poses(kinematics.clamp(q)).numpy()
    root = np.linalg.inv(poses[kinematics.link_index(spec.hand_root)])
    return {name: root @ poses[kinematics.link_index(name)] for name in kinematics.link_names}


def _fingers(
    tree: RobotTree, mimics: Sequence[MimicSpec], hand_root: str, folder: Path, thumb: str | None, notes: list[str]
) -> list[_Finger]:
    """The hand's fingers, thumb first, then from the thumb's side on."""
    by_child = {joint.child: joint for joint in tree.joints}
    inside = _below(tree, hand_root)
    moving = [name for name in inside if name != hand_root and by_child[name].type != "fixed"]
    carriers = {tree.moving_ancestor(by_child[name].parent) for name in moving}
    chains = []
    for end in (name for name in moving if name not in carriers):
        links, link = [], end
        while link != hand_root and link in by_child:
            if by_child[link].type != "fixed":
                links.insert(0, link)
            link = by_child[link].parent
        rest = tuple(name for name in inside if name != end and tree.moving_ancestor(name) == end)
        chains.append(_Finger(name="", links=tuple(links), joints=tuple(by_child[name].name for name in links), rest=rest))
    if len(chains) < 2:
        raise RobotError(f"below {hand_root!r} there are {len(chains)} chains of moving links, expected a thumb and at least one finger.")

    words = [" ".join((*c.links, *c.joints, *c.rest, *(by_child[name].name for name in c.rest))).lower() for c in chains]
    spec = _spec(tree, mimics, hand_root, folder)
    at = _places(spec, {})
    bases = np.array([at[chain.links[0]][:3, 3] for chain in chains])
    ends = np.array([_end(tree, chain, at) for chain in chains])
    if thumb is not None:
        marked = [i for i, chain in enumerate(chains) if thumb in (*chain.links, *chain.joints, *chain.rest)]
        if len(marked) != 1:
            raise RobotError(
                f"--thumb {thumb!r} is in {len(marked)} fingers; their links are {'; '.join(', '.join(c.links) for c in chains)}."
            )
    else:
        marked = [i for i, text in enumerate(words) if "thumb" in text]
    if len(marked) == 1:
        first = marked[0]
    else:
        directions = (ends - bases) / np.linalg.norm(ends - bases, axis=1, keepdims=True)
        first = int(np.argmin([np.delete(directions, i, axis=0).sum(axis=0) @ directions[i] for i in range(len(chains))]))
        if len(chains) > 2:
            ahead = [np.delete(directions, i, axis=0).mean(axis=0) for i in range(len(chains))]
            behind = [float((bases[i] - np.delete(bases, i, axis=0).mean(axis=0)) @ ahead[i]) for i in range(len(chains))]
            first = int(np.argmin(behind))
        notes.append(f"the thumb is the finger of {', '.join(chains[first].links)}: its base is farthest back (--thumb says another)")
    others = [i for i in range(len(chains)) if i != first]
    alias = {"index": ("index", "fore"), "middle": ("middle",), "ring": ("ring",), "little": ("little", "pinky")}
    named = {i: next((finger for finger in _FINGERS if any(word in words[i] for word in alias[finger])), "") for i in others}
    if sorted(named.values()) != sorted(set(named.values()) - {""}):
        across = np.linalg.svd(bases[others] - bases[others].mean(axis=0))[2][0]
        across *= np.sign((ends[first] - bases[others].mean(axis=0)) @ across) or 1.0
        others.sort(key=lambda i: -float(bases[i] @ across))
        if len(others) > len(_FINGERS):
            raise RobotError(f"the hand has {len(others)} fingers beside the thumb; xreset knows {', '.join(_FINGERS)}.")
        named = dict(zip(others, _FINGERS, strict=False))
        notes.append("fingers are named from the thumb's side on: " + "; ".join(f"{named[i]} is {chains[i].links[-1]}" for i in others))
    others.sort(key=lambda i: _FINGERS.index(named[i]))
    return [replace(chains[first], name="thumb"), *(replace(chains[i], name=named[i]) for i in others)]


def _end(tree: RobotTree, finger: _Finger, at: dict[str, np.ndarray]) -> np.ndarray:
    """[3] the tip of a finger in the hand root's frame: a fixed link called so, or the point of its shapes farthest from its last joint."""
    last = finger.links[-1]
    for name in finger.rest:
        if "tip" in name.lower():
            return at[name][:3, 3]
    points = [
        surface_of(tree.link(name).collisions)[0] @ at[name][:3, :3].T + at[name][:3, 3]
        for name in (last, *finger.rest)
        if tree.link(name).collisions
    ]
    if not points:
        raise RobotError(f"the last link of a finger, {last!r}, has no collision shape, so it can touch nothing.")
    cloud = np.concatenate(points)
    middle = (cloud.max(axis=0) + cloud.min(axis=0)) / 2
    away = middle - _on_axis(tree, last, at, middle)
    away /= max(float(np.linalg.norm(away)), 1e-9)
    return middle + away * float(((cloud - middle) @ away).max())


def _on_axis(tree: RobotTree, link: str, at: dict[str, np.ndarray], near: np.ndarray | None = None) -> np.ndarray:
    """[3] the point of the axis before a link that is nearest to the middle of its shapes: makers put origins anywhere along an axis."""
    shapes = tree.link(link).collisions
    if near is None:
        if not shapes:
            return at[link][:3, 3]
        cloud = surface_of(shapes)[0] @ at[link][:3, :3].T + at[link][:3, 3]
        near = (cloud.max(axis=0) + cloud.min(axis=0)) / 2
    axis = at[link][:3, :3] @ next(joint.axis for joint in tree.joints if joint.child == link)
    return at[link][:3, 3] + axis * float((near - at[link][:3, 3]) @ axis)


def _palm(
    tree: RobotTree, mimics: Sequence[MimicSpec], hand_root: str, fingers: list[_Finger], folder: Path
) -> tuple[np.ndarray, dict[str, np.ndarray], dict[str, float]]:
    """The palm's frame [4, 4] in the hand root's, poses of links with straight fingers, and bending of every joint in radians at home."""
    spec = _spec(tree, mimics, hand_root, folder)
    straight = _places(spec, {})
    others = fingers[1:]
    bases = np.array([_on_axis(tree, finger.links[0], straight) for finger in others])
    ends = np.array([_end(tree, finger, straight) for finger in others])
    x = ((ends - bases) / np.linalg.norm(ends - bases, axis=1, keepdims=True)).mean(axis=0)
    x /= np.linalg.norm(x)
    bent, moved = {}, np.zeros(3)
    for finger in fingers:
        for name in finger.joints:
            joint = tree.joint(name)
            if name not in spec.joint_names:
                continue
            zero = float(np.clip(0.0, joint.lower, joint.upper))
            far = joint.upper if joint.upper - zero > zero - joint.lower else joint.lower
            lopsided = abs(joint.upper + joint.lower - 2 * zero) / (joint.upper - joint.lower)
            if lopsided > 0.4:  # spreading joints go about as far to either side
                bent[name] = _BEND * (far - zero)
                if finger.name != "thumb":
                    at = _places(spec, {name: zero + 0.5 * (far - zero)})
                    moved += _end(tree, finger, at) - _end(tree, finger, straight)
    z = moved - (moved @ x) * x
    if np.linalg.norm(z) < 0.01:
        raise RobotError("the fingers do not bend to one side when their joints move, so the palm's inner side cannot be told.")
    z /= np.linalg.norm(z)
    T = np.eye(4)
    T[:3, :3] = np.stack((x, np.cross(z, x), z), axis=1)
    T[:3, 3] = bases.mean(axis=0) - _PALM_BEHIND * x
    return T, straight, bent


def _with_frames(
    tree: RobotTree,
    hand_root: str,
    fingers: list[_Finger],
    palm: np.ndarray,
    folder: Path,
    mimics: Sequence[MimicSpec],
    straight: dict[str, np.ndarray],
) -> tuple[RobotTree, list[FingertipSpec], list[KeypointSpec]]:
    """The tree with frames for palm, wrist and fingertips; the fingertips; and which link follows which human keypoint."""
    wrist = palm.copy()
    wrist[:3, 3] -= (_WRIST_BEHIND - _PALM_BEHIND) * palm[:3, 0]
    frames = [("palm_frame", hand_root, palm), ("wrist_frame", hand_root, wrist)]
    tips, keypoints = [], [KeypointSpec(keypoint="wrist", link="wrist_frame")]
    for finger in fingers:
        last = finger.links[-1]
        end = _end(tree, finger, straight)
        T = np.eye(4)
        T[:3, :3] = straight[last][:3, :3].T @ palm[:3, :3]
        T[:3, 3] = straight[last][:3, :3].T @ (end - straight[last][:3, 3])
        frames.append((f"{finger.name}_tip_frame", last, T))
        tip = FingertipSpec(
            name=finger.name,
            link=f"{finger.name}_tip_frame",
            contact_links=tuple(name for name in (last, *finger.rest) if tree.link(name).collisions),
            keypoint=f"{finger.name}4",
        )
        tips.append(tip)
        points = np.array([*(_on_axis(tree, name, straight) for name in finger.links), end])
        along = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))))
        share = along[:-1] / along[-1]
        taken: set[int] = set()
        for number, human in enumerate(_HUMAN, start=1):
            near = min((i for i in range(len(share)) if i not in taken), key=lambda i: (round(abs(share[i] - human), 2), -i), default=None)
            if near is not None and abs(share[near] - human) < 0.2:
                taken |= set(range(near + 1))
                link, keypoint = finger.links[near], f"{finger.name}{number}"
                beside = straight[link][:3, :3].T @ (points[near] - straight[link][:3, 3])
                if np.linalg.norm(beside) > _BESIDE:
                    T = np.eye(4)
                    T[:3, 3] = beside
                    frames.append((f"{keypoint}_frame", link, T))
                    link = frames[-1][0]
                keypoints.append(KeypointSpec(keypoint=keypoint, link=link))
        keypoints.append(KeypointSpec(keypoint=f"{finger.name}4", link=tip.link))
    for name, parent, T in frames:
        if name in tree.link_names:
            raise RobotError(f"the hand has a link {name!r} already; rename it.")
        tree = replace(tree, links=(*tree.links, frame(name)), joints=(*tree.joints, fixed(parent, name, T)))
    return tree, tips, keypoints


# Home, drives, collisions ----------------------------------------------------------------------------------------------------------------


def _hand_home(tree: RobotTree, mimics: Sequence[MimicSpec], bent: dict[str, float]) -> dict[str, float]:
    rest = {name: float(np.clip(0.0, tree.joint(name).lower, tree.joint(name).upper)) for name in _moving(tree, mimics)}
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
    goal_rot = torch.tensor([[0.0, -1, 0], [-1, 0, 0], [0, 0, -1]], dtype=torch.float64)  # x to -y, z down; columns are the axes
    for _ in range(_IK_STEPS):
        at = kinematics.jacobian(q, (spec.palm,))
        turn = goal_rot @ at.rot[:, 0].mT
        angle = torch.as_tensor(Rotation.from_matrix(turn.numpy()).as_rotvec())
        error = torch.cat(((goal - at.pos[:, 0]) / 0.1, angle), dim=1)
        J = torch.cat((at.linear[:, 0][..., arm] / 0.1, at.angular[:, 0][..., arm]), dim=1)
        step = torch.linalg.solve(J.mT @ J + 1e-2 * torch.eye(len(arm), dtype=J.dtype), (J.mT @ error[..., None]))[..., 0]
        q[:, arm] = torch.minimum(torch.maximum(q[:, arm] + step.clamp(-0.3, 0.3), low), high)
    reached = (error[:, :3].norm(dim=1) * 0.1 < 0.01) & (error[:, 3:].norm(dim=1) < 0.05)
    support = table_points(spec, kinematics)
    height = height_above_table(kinematics.points(q, support.links, torch.tensor(support.points)), torch.tensor(support.radii), TableSpec())
    collision = SelfCollision(spec, kinematics, moved_by_arm=True)
    apart = torch.as_tensor(collision.clearance(kinematics.link_poses(q).numpy(), 0.02))
    room = torch.minimum(q[:, arm] - lower, upper - q[:, arm]).amin(dim=1).clamp_max(0.5)
    score = room + 10 * reached + 5 * (height.amin(dim=1) > 0.01) + 5 * (apart > 0)
    best = int(score.argmax())
    if not bool(reached[best]):
        notes.append("the arm does not reach over the table from where it stands: `xreset robots place` finds a better place and home")
    values = q[best].tolist()
    notes.append("home: the palm over the table, looking down; fingers bent a little")
    return replace(spec, joints=tuple(replace(joint, home=round(value, 4)) for joint, value in zip(spec.joints, values, strict=True)))


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
    kd = [f * np.sqrt(j.drive.kp * inertia) for f, j, inertia in zip(factor, spec.joints, drive_inertia(spec, spec.home), strict=True)]
    if without:
        notes.append(f"no effort is stated for {', '.join(without)}; they get {_ARM_EFFORT:g} (arm) or {_HAND_EFFORT:g} N m (hand)")
    notes.append("drives: kd = 1.8 sqrt(kp I) in the hand, critical in the arm, with the inertia I about the joint at home")
    drives = [replace(joint.drive, kd=float(f"{value:.3g}")) for joint, value in zip(spec.joints, kd, strict=True)]
    return replace(spec, joints=tuple(replace(joint, drive=drive) for joint, drive in zip(spec.joints, drives, strict=True)))


def _with_exclusions(spec: RobotSpec, notes: list[str]) -> RobotSpec:
    """Pairs of links that meet at home, or nearly wherever the hand's joints are, never collide."""
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
    if pairs:
        notes.append("never collide, because they meet: " + "; ".join(f"{a} and {b} ({why})" for (a, b), why in pairs.items()))
    return replace(spec, collision_exclude=tuple(pairs))


# The description -------------------------------------------------------------------------------------------------------------------------


def _toml(spec: RobotSpec, notes: Sequence[str]) -> str:
    def text(value: str) -> str:
        return json.dumps(value, ensure_ascii=False)

    def texts(values: Sequence[str]) -> str:
        return "[" + ", ".join(map(text, values)) + "]"

    lines = [
        "# Written by `xreset robots import`. What it guessed:",
        *(f"#   - {note}" for note in notes),
        "# After every change: xreset robots check FOLDER --picture robot.png",
        "# Units: m, rad, kg, N, N m. Quaternions are (w, x, y, z). The world has z up and the table's top at z = 0.",
        f"schema = {text(SCHEMA)}",
        f"name = {text(spec.name)}",
        'urdf = "robot.urdf"',
        "",
        "# The arm's controller carries the arm's own weight (not the object's).",
        "gravity_compensated = true",
        "",
        "# Actuated joints; their order here is the joint order everywhere. Drive: torque = kp (target - q) - kd qd, at most effort.",
        "joints = [",
        *(
            f"    {{ name = {text(j.name)}, group = {text(j.group)}, home = {j.home:.4f}, kp = {j.drive.kp:.4g}, kd = {j.drive.kd:.4g},"
            f" effort = {j.drive.effort:.4g}, armature = {j.drive.armature:g} }},"
            for j in spec.joints
        ),
        "]",
        "",
    ]
    if spec.mimics:
        lines += ["# Joints that follow another: q = multiplier * q_source + offset, as the maker's description says.", "mimics = ["]
        lines += [
            f"    {{ joint = {text(m.joint)}, source = {text(m.source)}, multiplier = {m.multiplier!r}, offset = {m.offset!r} }},"
            for m in spec.mimics
        ]
        lines += ["]", ""]
    lines += ["# Fingertips, thumb first: a frame at the tip, the links whose contact counts, and the human keypoint that it follows."]
    lines += ["fingertips = ["]
    lines += [
        f"    {{ name = {text(t.name)}, link = {text(t.link)}, contact_links = {texts(t.contact_links)}, keypoint = {text(t.keypoint)} }},"
        for t in spec.fingertips
    ]
    pos, quat = (", ".join(f"{value:g}" for value in values) for values in (spec.base_pos, spec.base_quat))
    lines += [
        "]",
        "",
        "# Where the URDF's root link stands: behind the table. `xreset robots place FOLDER --demos DEMOS --write` finds better.",
        "[base]",
        f"pos = [{pos}]",
        f"quat = [{quat}]",
        "",
        "[hand]",
        f"root = {text(spec.hand_root)}  # carries the whole hand",
        f"palm = {text(spec.palm)}  # frame in the palm's centre: x towards the fingers, z out of the palm's inner side",
        "",
        "# Link whose origin follows each human keypoint in retargeting (1 is a finger's base, 4 its tip). Any subset will do.",
        "[keypoints]",
        *(f"{point.keypoint} = {text(point.link)}" for point in spec.keypoints),
        "",
        "[collision]",
        "# Links that collide with each other in physics. Neighbours never collide.",
        f"self = {texts(spec.self_collision_links)}",
        "# Pairs that never collide, in physics and in retargeting.",
        "exclude = [",
        *(f"    {texts(pair)}," for pair in spec.collision_exclude),
        "]",
        "# Links that may touch the table.",
        f"table_exclude = {texts(spec.table_exclude)}",
    ]
    return "\n".join(lines) + "\n"
