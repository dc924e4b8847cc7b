"""Gives a robot the collision shapes of another description of it: joints, masses, drives and frames stay as they
are."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from xreset.description import DESCRIPTION, load_robot
from xreset.errors import RobotError
from xreset.files import atomic_folder
from xreset.geometry.urdf import RobotTree, robot_tree
from xreset.geometry.urdf_writer import urdf_text, write_meshes
from xreset.plugins import robot_folder
from xreset.robot_tools.importer import always_meeting
from xreset.robot_tools.placement import edited
from xreset.robot_tools.sources import read_source
from xreset.spec import Shape

_POSITION = 2e-3
"""[m] How far a joint may be from where the robot has it: two editions of a hand differ by tenths of a millimetre."""
_ANGLE = np.radians(2.0)
"""[rad]"""


def reshape(robot: str, shapes: Path, out: Path) -> tuple[str, ...]:
    """Make a robot's folder from a robot and another URDF or MJCF of some of its links, such as its hand.

    Links are matched by name; shapes of links that the robot does not have belong to the link that they are fixed to.

    Args:
        robot: name or folder of the robot.
        shapes: the URDF or MJCF.
        out: folder to make; it appears whole or not at all.

    Returns:
        Sentences on what was changed.

    Raises:
        RobotError: the folder exists, a file cannot be read, or its links are not the robot's.
    """
    if out.exists():
        raise RobotError(f"{out} is there already; give another folder, or remove it.")
    spec = load_robot(robot)
    description = robot_folder(robot) / DESCRIPTION
    tree = robot_tree(spec)
    other = _with_names_of(tree, read_source(shapes).tree)
    found = _shapes(tree, other, shapes)
    if apart := list(_apart(tree, other)):
        raise RobotError(
            f"{shapes} is of another robot than {spec.name!r}: {'; '.join(apart)}. To make a robot of it: xreset "
            "robots import."
        )
    links = [replace(link, collisions=found.get(link.name, link.collisions)) for link in tree.links]
    tree = replace(tree, links=tuple(links))
    shown_name = shapes.name.replace("--", "- -")  # which ends a comment of XML
    comment = f"{spec.name} with the collision shapes of {shown_name}. Written by xreset robots reshape."
    name = json.dumps(out.name, ensure_ascii=False)
    with atomic_folder(out) as work:
        (work / "robot.urdf").write_text(urdf_text(tree, comment))
        write_meshes(tree, work)
        met = always_meeting(replace(spec, urdf=work / "robot.urdf"))
        edits = [
            (
                r"^name *=.*$",
                f'name = {name}\nlike = "{spec.fingerprint}"  # {spec.name}, from which only shapes differ',
            ),
            (r"^urdf *=.*$", 'urdf = "robot.urdf"'),
        ]
        if met:
            pairs = "".join(f'\n    ["{a}", "{b}"],  # they meet {why}' for (a, b), why in met.items())
            edits.append((r"^exclude *= *\[()", pairs))
        (work / DESCRIPTION).write_text(edited(description.read_text(), description, edits))
        load_robot(work)
    kept = [link.name for link in tree.links if link.collisions and link.name not in found]
    notes = [f"new shapes: {', '.join(found)}", f"as they were: {', '.join(kept)}"]
    notes += [f"{a} and {b} never collide: they meet {why}" for (a, b), why in met.items()]
    return tuple(notes)


def _with_names_of(tree: RobotTree, other: RobotTree) -> RobotTree:
    """Return the other tree with the names that an import has given its links: ``hand_`` before those of the arm's
    links.

    Such a link of the robot has the same child as in the other tree.
    """
    parents = {joint.child: joint.parent for joint in tree.joints}
    renamed = {}
    for joint in other.joints:
        if joint.parent in tree.link_names and parents.get(joint.child) == f"hand_{joint.parent}":
            renamed[joint.parent] = f"hand_{joint.parent}"
    links = [replace(link, name=renamed.get(link.name, link.name)) for link in other.links]
    joints = [replace(joint, parent=renamed.get(joint.parent, joint.parent)) for joint in other.joints]
    joints = [replace(joint, child=renamed.get(joint.child, joint.child)) for joint in joints]
    return replace(other, links=tuple(links), joints=tuple(joints))


def _shapes(tree: RobotTree, other: RobotTree, path: Path) -> dict[str, tuple[Shape, ...]]:
    """Return the shapes in the other tree, by link of the robot."""
    before = {joint.child: joint for joint in other.joints}
    found: dict[str, tuple[Shape, ...]] = {}
    for link in other.links:
        if not link.collisions:
            continue
        owner = link.name
        T = np.eye(4)
        while owner not in tree.link_names and owner in before and before[owner].type == "fixed":
            T = before[owner].T_parent_joint @ T
            owner = before[owner].parent
        if owner not in tree.link_names:
            raise RobotError(
                f"{path}: {link.name!r} has shapes, and neither it nor what it is fixed to is a link of {tree.name!r}."
            )
        moved = (replace(shape, T_body_shape=T @ shape.T_body_shape) for shape in link.collisions)
        found[owner] = (*found.get(owner, ()), *moved)
    if not found:
        raise RobotError(f"{path} has no collision shapes.")
    return found


def _apart(tree: RobotTree, other: RobotTree) -> Iterator[str]:
    """Say which links are elsewhere in the other tree."""
    own = {joint.child: joint for joint in tree.joints}
    for joint in other.joints:
        if joint.parent not in tree.link_names or joint.child not in tree.link_names:
            continue
        same = own.get(joint.child)
        if same is None or same.parent != joint.parent:
            parent = same.parent if same else "nothing"
            yield f"{joint.child} hangs on {joint.parent}, in the robot on {parent}"
            continue
        T = np.linalg.inv(same.T_parent_joint) @ joint.T_parent_joint
        distance = float(np.linalg.norm(T[:3, 3]))
        angle = float(Rotation.from_matrix(T[:3, :3]).magnitude())
        if distance > _POSITION or angle > _ANGLE:
            yield f"{joint.child} is {1e3 * distance:.1f} mm and {np.degrees(angle):.1f} degrees away"
