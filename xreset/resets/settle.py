"""Starts at rest: let objects come to rest on the table, where the episodes of a goal set begin. Shape letter: S
sequences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from xreset.files.progress import unseen
from xreset.physics import Backend, State
from xreset.resets.bank import ResetBank
from xreset.resets.config import FilterConfig
from xreset.resets.probe import probe, rejection
from xreset.spec import ObjectSpec, RobotSpec, SceneSpec

SECONDS = 3.0
"""Time that an object is given to come to rest [s]."""
AT_REST = FilterConfig(linear_velocity=0.01, angular_velocity=0.1)
"""Speeds of an object at rest."""


def settle_starts(
    bank: ResetBank,
    robot: RobotSpec,
    objects: Sequence[ObjectSpec],
) -> tuple[ResetBank, np.ndarray]:
    """Return a bank whose episodes from home begin with objects at rest, in MuJoCo.

    The robot holds its home configuration meanwhile, in which it touches no object.

    Args:
        bank: starts of S demonstrations.
        robot: the robot of the bank.
        objects: the objects of the bank.

    Returns:
        The bank, and whether each object came to rest on the table [S]; the others start as before.
    """
    scene = SceneSpec(robot=robot, objects=tuple(objects))
    number = len(bank.sequence_name)
    home = torch.as_tensor(robot.home, dtype=torch.float32).expand(number, -1)
    poses = (torch.as_tensor(bank.start_pos), torch.as_tensor(bank.start_quat_wxyz))
    found = probe(
        "mujoco",
        scene,
        bank.sequence_object,
        State.at_rest(home, *poses),
        _rest_pose,
        gravity=1.0,
        steps=round(SECONDS / scene.control_dt),
        num_envs=64,
        device="cpu",
        progress=unseen,
    )
    at_rest = found[:, 7] > 0
    pos = np.where(at_rest[:, None], found[:, :3], bank.start_pos).astype(np.float32)
    quat = np.where(at_rest[:, None], found[:, 3:7], bank.start_quat_wxyz).astype(np.float32)
    return replace(bank, start_pos=pos, start_quat_wxyz=quat), at_rest


def _rest_pose(backend: Backend, start: State) -> Tensor:
    """Return the objects' poses and whether they are at rest on the table: [N, 3 + 4 + 1]."""
    state = backend.state()
    at_rest = rejection(backend, start, AT_REST) < 0
    return torch.cat((state.object_pos, state.object_quat, at_rest[:, None]), dim=-1)
