"""The same robot with the collision shapes of another description of it: joints, masses, drives and frames stay as they are."""

from __future__ import annotations

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

_POSITION, _ANGLE = 2e-3, np.radians(2.0)
"""[m], [rad] How far a joint may be from where the robot has it: two editions of a hand differ by tenths of a millimetre."""


def reshape(robot: str, shapes: Path, out: Path) -> tuple[str, ...]:
    """Make a robot's folder from a robot and another URDF or MJCF of some of its links, such as its hand.

    Links are matched by name; shapes of links that the robot does not have belong to the link that they are fixed to.

    Args:
        robot: name or folder of the robot.
        shapes: the URDF or MJCF.
        out: folder to make; it appears whole or not at all.

    Returns:
        What there is to tell of it.

    Raises:
        RobotError: the folder is there already, a file cannot be read, or its links are not the robot's.
    """
    if out.exists():
        raise RobotError(f"{out} is there already; give another folder, or remove it.")
    spec, text = load_robot(robot), (robot_folder(robot) / DESCRIPTION).read_text()
    tree, other = robot_tree(spec), read_source(shapes).tree
    found = _shapes(tree, other, shapes)
    if apart := list(_apart(tree, other)):
        raise RobotError(
            f"{shapes} is of another robot than {spec.name!r}: {'; '.join(apart)}. To make a robot of it: xreset robots import."
        )
    tree = replace(
        tree, links=tuple(replace(link, collisions=found.get(link.name, link.collisions)) for link in tree.links)
    )
    with atomic_folder(out) as work:
        comment = f"{spec.name} with the collision shapes of {shapes.name}. Written by xreset robots reshape."
        (work / "robot.urdf").write_text(
            urdf_text(tree, read_source(spec.urdf).effort, mimics=spec.mimics, comment=comment)
        )
        write_meshes(tree, work)
        met = always_meeting(replace(spec, urdf=work / "robot.urdf"))
        edits = [
            (
                r"^name *=.*$",
                f'name = "{out.name}"\nlike = "{spec.fingerprint}"  # {spec.name}, from which only shapes differ',
            ),
            (r"^urdf *=.*$", 'urdf = "robot.urdf"'),
        ]
        if met:
            pairs = "".join(f'\n    ["{a}", "{b}"],  # they meet {why}' for (a, b), why in met.items())
            edits.append((r"^(exclude *= *\[)", rf"\g<1>{pairs}"))
        (work / DESCRIPTION).write_text(edited(text, robot_folder(robot) / DESCRIPTION, edits))
        load_robot(work)
    kept = [link.name for link in tree.links if link.collisions and link.name not in found]
    notes = [f"new shapes: {', '.join(found)}", f"as they were: {', '.join(kept)}"]
    return (*notes, *(f"{a} and {b} never collide: they meet {why}" for (a, b), why in met.items()))


def _shapes(tree: RobotTree, other: RobotTree, path: Path) -> dict[str, tuple[Shape, ...]]:
    """Link of the robot -> its shapes in the other description."""
    before = {joint.child: joint for joint in other.joints}
    found: dict[str, tuple[Shape, ...]] = {}
    for link in other.links:
        owner, T = link.name, np.eye(4)
        while owner not in tree.link_names and owner in before and before[owner].type == "fixed":
            owner, T = before[owner].parent, before[owner].T_parent_joint @ T
        if not link.collisions:
            continue
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
    """What the other description has elsewhere."""
    own = {joint.child: joint for joint in tree.joints}
    for joint in other.joints:
        if not {joint.parent, joint.child} <= {*tree.link_names}:
            continue
        same = own.get(joint.child)
        if same is None or same.parent != joint.parent:
            yield f"{joint.child} hangs on {joint.parent}, in the robot on {same.parent if same else 'nothing'}"
            continue
        T = np.linalg.inv(same.T_parent_joint) @ joint.T_parent_joint
        far, turned = float(np.linalg.norm(T[:3, 3])), float(Rotation.from_matrix(T[:3, :3]).magnitude())
        if far > _POSITION or turned > _ANGLE:
            yield f"{joint.child} is {1e3 * far:.1f} mm and {np.degrees(turned):.1f} degrees away"
