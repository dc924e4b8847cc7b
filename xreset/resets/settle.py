"""Starts at rest: let the objects of recorded start poses come to rest on the table before episodes begin there.

An object on a table is at rest, but recorded poses are off by some millimetres and degrees. In 12 to 14 % of DexYCB's
recordings the object tips or rolls by more than 10 degrees before a hand arrives. Shape letter: S sequences.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from xreset.files.progress import Progress, unseen
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
    engine: str = "mujoco",
    *,
    num_envs: int = 64,
    device: str = "cpu",
    progress: Progress = unseen,
) -> tuple[ResetBank, np.ndarray]:
    """Return a bank whose episodes from home begin with objects at rest.

    The robot holds its home configuration meanwhile, in which it touches no object.

    Args:
        bank: starts of S demonstrations.
        robot: the robot of the bank.
        objects: the objects of the bank.
        engine: engine in which the objects come to rest.
        num_envs: worlds at a time.
        device: where the engine runs if it can.
        progress: called with (start poses done, start poses in all).

    Returns:
        The bank, and whether each object came to rest on the table [S]; the others start as recorded.
    """
    scene = SceneSpec(robot=robot, objects=tuple(objects))
    number = len(bank.sequence_name)
    home = torch.as_tensor(robot.home, dtype=torch.float32).expand(number, -1)
    poses = (torch.as_tensor(bank.start_pos), torch.as_tensor(bank.start_quat_wxyz))
    found = probe(
        engine,
        scene,
        bank.sequence_object,
        State.at_rest(home, *poses),
        _rest_pose,
        gravity=1.0,
        steps=round(SECONDS / scene.control_dt),
        num_envs=num_envs,
        device=device,
        progress=lambda done: progress(done, number),
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
