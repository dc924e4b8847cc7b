"""Holds a robot during an import: its links and joints, and in the end its commented ``robot.toml``."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

import jinja2
import numpy as np
import torch

from xreset.geometry.description import SCHEMA
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.urdf import RobotTree
from xreset.geometry.urdf_writer import urdf_text, write_meshes
from xreset.spec import DriveSpec, FingertipSpec, JointSpec, KeypointSpec, RobotSpec

_BASE = ((0.85, 0.85, 0.10), (0.6427876, 0.0, 0.0, -0.7660444))
"""Where the arm stands until `robots place` finds better: at the table's edge, next to the person, its x turned by
-100 degrees. Five published hands on xArm7 and iiwa 14 follow 98 % or more of five DexYCB sequences from there."""
_ARMATURE = 0.1
"""[kg m^2] Rotor inertia of the arm's joints, as in the built-in robots."""


Positions = float | np.ndarray
"""Joint positions or limits [rad or m]."""


def rounded(positions: Positions, lower: Positions, upper: Positions) -> np.ndarray:
    """Round joint positions to the four digits that get into a description, within the limits."""
    return np.clip(np.round(positions * 1e4), np.ceil(lower * 1e4), np.floor(upper * 1e4)) / 1e4


def draft_spec(
    tree: RobotTree,
    hand_root: str,
    folder: Path,
    *,
    tips: Sequence[FingertipSpec] = (),
    keypoints: Sequence[KeypointSpec] = (),
    bent: Mapping[str, float] | None = None,
) -> RobotSpec:
    """Write the URDF, and return the robot as far as it is known; at home, joints are at 0, and bent from there."""
    (folder / "robot.urdf").write_text(urdf_text(tree, "Written by xreset robots import."))
    shutil.rmtree(folder / "meshes", ignore_errors=True)  # of links that a draft before had
    write_meshes(tree, folder)
    inside = set(tree.below(hand_root)[1:])
    joints = []
    for joint in tree.joints:
        if joint.type == "fixed" or joint.mimic is not None:
            continue
        home = np.clip(0.0, joint.lower, joint.upper) + (bent or {}).get(joint.name, 0.0)
        home = float(rounded(home, joint.lower, joint.upper))
        group = "hand" if joint.child in inside else "arm"
        drive = DriveSpec(kp=1.0, kd=0.1, effort=1.0, armature=_ARMATURE if group == "arm" else 0.0)
        joints.append(JointSpec(name=joint.name, group=group, drive=drive, home=home))
    links = [link.name for link in tree.links if link.collisions]
    return RobotSpec(
        name=tree.name,
        urdf=folder / "robot.urdf",
        joints=tuple(joints),
        mimics=tree.mimics,
        base_pos=_BASE[0],
        base_quat=_BASE[1],
        palm="palm_frame" if tips else hand_root,
        hand_root=hand_root,
        fingertips=tuple(tips),
        keypoints=tuple(keypoints),
        self_collision_links=tuple(name for name in links if name in (hand_root, *inside)),
        table_exclude=tuple(name for name in links if tree.moving_ancestor(name) == tree.root),
    )


def link_places(spec: RobotSpec, positions: dict[str, float]) -> dict[str, np.ndarray]:
    """Return link -> pose [4, 4] in the frame of the hand's root, with some joints at positions and the others at
    home."""
    kinematics = Kinematics(spec)
    q = torch.tensor(
        [positions.get(joint.name, joint.home) for joint in spec.joints], dtype=torch.float64
    )
    poses = kinematics.link_poses(kinematics.clamp(q)).numpy()
    root = np.linalg.inv(poses[kinematics.link_index(spec.hand_root)])
    return dict(zip(kinematics.link_names, root @ poses, strict=True))


def hand_side(spec: RobotSpec) -> str:
    """Return ``right`` or ``left``, the side of a hand with a thumb and three or more fingers; empty for other hands.

    Seen from the palm's inner side with the fingers up, those of a right hand go from right to left.
    """
    if len(spec.fingertips) < 4:
        return ""
    places = link_places(spec, {})
    palm = np.linalg.inv(places[spec.palm])
    index, last = ((palm @ places[spec.fingertips[i].link])[1, 3] for i in (1, -1))
    return "right" if last > index else "left"


def description_text(spec: RobotSpec, notes: Sequence[str]) -> str:
    """Return the robot's ``robot.toml``, every part explained; ``notes`` say what was guessed."""
    loader = jinja2.FileSystemLoader(Path(__file__).with_name("templates"))
    pages = jinja2.Environment(
        loader=loader, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True
    )
    pages.filters["toml"] = lambda value: json.dumps(value, ensure_ascii=False)
    return pages.get_template("robot.toml").render(spec=spec, notes=notes, schema=SCHEMA)
