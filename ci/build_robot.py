"""Writes the ``robot.urdf`` of a built-in robot from the figures in its ``build.toml``: ``python ci/build_robot.py
FOLDER``.

``build.toml`` names its sources. Units are m, rad, kg, N and N m; quaternions are (w, x, y, z).

- ``base`` and ``palm`` are links, ``arm`` and ``hand`` are links with the joint before them. Each link of the arm
  carries the next one, the last one carries the palm.
- ``inertia`` is about the center of mass: three principal moments, or ixx ixy ixz iyy iyz izz. ``inertia_rpy`` and
  ``inertia_quat`` turn its axes.
- ``rotor`` is added to the diagonal of each moving link of the hand. Makers state it as armature of the joint, or not
  at all; not every engine has armature, but the inertia of a link means the same in all of them.
- ``shapes`` are boxes (edge lengths, center) and cylinders and capsules (ends of the axis, radius).
- ``frames`` are links without shapes.
- ``arm_of`` and ``hand_of`` name the folder of a robot that has the same arm or the same hand. What is stated in
  addition replaces that robot's figures; ``palm`` is merged with its table, since the hand may be mounted differently.
"""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from xreset.geometry import shapes
from xreset.geometry.urdf import Joint, Link, RobotTree
from xreset.geometry.urdf_writer import axes, fixed, frame, pose, urdf_text
from xreset.spec import Geometry, MimicSpec, Shape

Figures = dict[str, Any]
ROBOTS = Path(__file__).parents[1] / "robots"
SHARED = {"arm_of": ("base", "arm"), "hand_of": ("palm", "hand", "frames", "rotor")}
"""What a robot takes from another one."""


def read_figures(folder: str) -> Figures:
    """Return the content of a robot's ``build.toml``, completed with what it takes from other robots."""
    figures = tomllib.loads((ROBOTS / folder / "build.toml").read_text())
    for key, names in SHARED.items():
        if key in figures:
            other = read_figures(figures[key])
            mounted = {"palm": other["palm"] | figures.get("palm", {})} if key == "hand_of" else {}
            figures = {name: other[name] for name in names} | figures | mounted
    return figures


def robot_tree(figures: Figures) -> RobotTree:
    """Return the links and joints of a robot."""
    base = figures["base"]
    palm = figures["palm"]
    mimics = {mimic["joint"]: MimicSpec(**mimic) for mimic in figures.get("mimics", [])}
    links = [_link(part) for part in (base, *figures["arm"], palm)]
    joints = [
        _joint(part, before.name, mimics)
        for part, before in zip(figures["arm"], links, strict=False)
    ]
    joints.append(fixed(links[-2].name, palm["name"], _pose(palm)))
    for part in figures["hand"]:
        links.append(_link(part, figures.get("rotor", 0.0)))
        joints.append(_joint(part, part["parent"], mimics))
    for name, (link, position, x, z) in figures["frames"].items():
        links.append(frame(name))
        joints.append(fixed(link, name, pose(position) @ axes(x=x, z=z)))
    return RobotTree(
        name=figures["name"], root=base["name"], links=tuple(links), joints=tuple(joints)
    )


def robot_urdf(folder: str) -> str:
    """Return the text of a robot's ``robot.urdf``."""
    figures = read_figures(folder)
    return urdf_text(robot_tree(figures), figures["comment"])


def _pose(part: Figures) -> np.ndarray:
    return pose(part["xyz"], rpy=part.get("rpy", (0, 0, 0)), quat=part.get("quat"))


def _joint(part: Figures, parent: str, mimics: dict[str, MimicSpec]) -> Joint:
    lower, upper = part["range"]
    return Joint(
        name=part["joint"],
        type=part.get("type", "revolute"),
        parent=parent,
        child=part["name"],
        T_parent_joint=_pose(part),
        axis=np.array(part.get("axis", (0, 0, 1)), dtype=float),
        lower=lower,
        upper=upper,
        velocity=part["velocity"],
        effort=part.get("effort", 0.0),
        mimic=mimics.get(part["joint"]),
    )


def _link(part: Figures, rotor: float = 0.0) -> Link:
    moments = part["inertia"]
    inertia = np.diag(moments[:3])
    if len(moments) == 6:
        inertia = np.array(moments)[[[0, 1, 2], [1, 3, 4], [2, 4, 5]]]
    R = pose(rpy=part.get("inertia_rpy", (0, 0, 0)), quat=part.get("inertia_quat"))[:3, :3]
    return Link(
        name=part["name"],
        mass=part["mass"],
        com=np.array(part["com"], dtype=float),
        inertia=R @ inertia @ R.T + rotor * np.eye(3),
        collisions=tuple(_shape(*values) for values in part.get("shapes", [])),
    )


def _shape(kind: Any, first: list[float], second: list[float], radius: float = 0.0) -> Shape:
    """Make a box from edge lengths and center, or a cylinder or capsule from the ends of its axis and its radius."""
    if kind == "box":
        return shapes.box(second, first)
    axis = np.subtract(second, first)
    length = float(np.linalg.norm(axis))
    turn = Rotation.align_vectors(axis / length, [0, 0, 1])[0]
    T = shapes.transform(turn.as_matrix(), np.add(first, second) / 2)
    return Shape(geometry=Geometry(kind=kind, size=(radius, length / 2)), T_body_shape=T)


if __name__ == "__main__":
    path = ROBOTS / sys.argv[1] / "robot.urdf"
    path.write_text(robot_urdf(sys.argv[1]))
    print(f"wrote {path}")
