"""A small robot for tests: an arm of three joints, a hand of two fingers, and a pair of jaws that mimic one another."""

import atexit
import tempfile
from functools import cache
from pathlib import Path

import torch

from xreset.geometry.rotations import quat_from_axis_angle
from xreset.spec import DriveSpec, FingertipSpec, JointSpec, KeypointSpec, MimicSpec, RobotSpec

_JOINTS = (
    # name, type, parent, child, xyz, rpy, axis, lower, upper
    ("arm_1", "revolute", "base", "shoulder", "0 0 0.2", "0 0 0", "0 0 1", -3.0, 3.0),
    (
        "arm_2",
        "revolute",
        "shoulder",
        "upper",
        "0.02 0.05 0",
        "1.2 -0.3 0.5",
        "0.6 0 0.8",
        -2.0,
        2.0,
    ),
    ("arm_3", "prismatic", "upper", "fore", "0.3 0 0.1", "0 0.4 0", "0 1 0", -0.1, 0.3),
    ("mount", "fixed", "fore", "palm", "0 0.1 0.05", "0.2 0.1 -0.4", None, 0, 0),
    ("finger_a1", "revolute", "palm", "finger_a1", "0.05 0.02 0", "0 0 0.3", "0 1 0", -0.5, 1.6),
    ("finger_a2", "revolute", "finger_a1", "finger_a2", "0.04 0 0", "0.1 0 0", "0 1 0", 0.0, 1.6),
    ("end_a", "fixed", "finger_a2", "tip_a", "0.03 0 0", "0 0 0", None, 0, 0),
    ("finger_b1", "revolute", "palm", "finger_b1", "0.05 -0.02 0", "0 0 -0.3", "0 -1 0", -1.6, 0.5),
    ("end_b", "fixed", "finger_b1", "tip_b", "0.06 0 0", "0 0 0", None, 0, 0),
    ("jaw_a", "prismatic", "palm", "jaw_a", "0 0.03 0", "0 0 0", "0 1 0", 0.0, 0.04),
    ("jaw_b", "prismatic", "palm", "jaw_b", "0 -0.03 0", "0 0 0", "0 -1 0", 0.0, 0.055),
)
_KEYPOINTS = {
    "wrist": "palm",
    "index1": "finger_a1",
    "index2": "finger_a2",
    "index4": "tip_a",
    "thumb1": "finger_b1",
    "thumb4": "tip_b",
}


def write_urdf(path, rename=None):
    """Write the test robot's URDF; ``rename`` changes joint names."""
    inertia = '<inertia ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/>'
    links = {"base", *(joint[3] for joint in _JOINTS)}
    lines = ['<robot name="toy">', '<mujoco><compiler fusestatic="false" angle="radian"/></mujoco>']
    for link in sorted(links):
        lines.append(
            f'<link name="{link}"><inertial><mass value="0.1"/>{inertia}</inertial>'
            '<collision><geometry><sphere radius="0.01"/></geometry></collision></link>'
        )
    for name, kind, parent, child, xyz, rpy, axis, lower, upper in _JOINTS:
        name = (rename or {}).get(name, name)
        moves = (
            f'<axis xyz="{axis}"/><limit lower="{lower}" upper="{upper}" effort="1" velocity="1"/>'
            if axis
            else ""
        )
        lines.append(
            f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{xyz}" rpy="{rpy}"/>{moves}</joint>'
        )
    path.write_text("\n".join([*lines, "</robot>"]))
    return path


@cache
def toy_robot():
    """The test robot, whose URDF stays until the process ends."""
    folder = tempfile.TemporaryDirectory()
    atexit.register(folder.cleanup)
    return toy_hand_arm(Path(folder.name))


def toy_hand_arm(folder):
    """The test robot; its URDF is written into ``folder``. Its joint order is not the URDF's."""
    drive = DriveSpec(kp=1.0, kd=0.1, effort=1.0)
    order = ("arm_3", "arm_1", "arm_2", "finger_b1", "finger_a1", "finger_a2", "jaw_a")
    return RobotSpec(
        name="toy",
        urdf=write_urdf(folder / "toy.urdf"),
        joints=tuple(
            JointSpec(name=n, group="arm" if "arm" in n else "hand", drive=drive, home=0.01)
            for n in order
        ),
        mimics=(MimicSpec(joint="jaw_b", source="jaw_a", multiplier=2.0, offset=0.005),),
        base_pos=(0.1, -0.2, 0.3),
        base_quat=(0.5, 0.5, 0.5, 0.5),
        palm="palm",
        fingertips=tuple(
            FingertipSpec(name=name, link=tip, contact_links=(link,), keypoint=f"{name}4")
            for name, tip, link in (
                ("thumb", "tip_b", "finger_b1"),
                ("index", "tip_a", "finger_a2"),
            )
        ),
        keypoints=tuple(
            KeypointSpec(keypoint=keypoint, link=link) for keypoint, link in _KEYPOINTS.items()
        ),
        hand_root="palm",
    )


def toy_motion(model, generator, *, margin, turn):
    """Three motions of 12 frames: the joints move between two postures, the root along a line while it turns.

    The postures keep a share ``margin`` of the joints' range from the limits. The root turns by ``turn`` [rad] about
    each axis.
    """
    from xreset.retarget.hand.model import HandState

    low = model.kinematics.lower
    high = model.kinematics.upper
    share = torch.linspace(0, 1, 12, dtype=low.dtype)[:, None]
    ends = low + (high - low) * (
        margin
        + (1.0 - 2.0 * margin) * torch.rand(2, 3, 1, len(low), dtype=low.dtype, generator=generator)
    )
    line = low.new_tensor([0.2, 0.3, 1.0]) + share * low.new_tensor([0.1, -0.2, 0.1])
    root_quat = quat_from_axis_angle(
        torch.randn(3, 1, 3, dtype=low.dtype, generator=generator) + turn * share
    )
    return HandState(
        joints=ends[0] + (ends[1] - ends[0]) * share,
        root_pos=line.expand(3, 12, 3),
        root_quat=root_quat,
    )
