"""A small robot for tests: an arm of three joints, a hand of two fingers, and a pair of jaws that mimic one another."""

import shutil
from functools import cache
from pathlib import Path

import torch

from xreset.geometry.description import load_robot, read_description
from xreset.geometry.rotations import quat_from_axis_angle

ROBOTS = Path(__file__).with_name("robots")


@cache
def toy_robot():
    """The test robot."""
    return read_description(ROBOTS / "toy.toml")


def toy_hand_arm(folder):
    """The test robot, whose files are copied into ``folder``."""
    shutil.copytree(ROBOTS, folder, dirs_exist_ok=True)
    return read_description(folder / "toy.toml")


def endless_robot(folder):
    """A built-in robot whose first joint turns without limits, copied into ``folder``."""
    described = load_robot("ur7e-robotiq")
    shutil.copytree(described.urdf.parent, folder, dirs_exist_ok=True)
    urdf = folder / described.urdf.name
    name = f'name="{described.joint_names[0]}" type='
    urdf.write_text(urdf.read_text().replace(f'{name}"revolute"', f'{name}"continuous"'))
    return load_robot(folder)


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
