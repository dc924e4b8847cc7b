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

from xreset.physics import Backend, State
from xreset.progress import Progress, unseen
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
    pos, quat, at_rest = settled_poses(
        SceneSpec(robot=robot, objects=tuple(objects)),
        bank.sequence_object,
        bank.start_pos,
        bank.start_quat_wxyz,
        engine,
        num_envs=num_envs,
        device=device,
        progress=progress,
    )
    return replace(bank, start_pos=pos, start_quat_wxyz=quat), at_rest


def settled_poses(
    scene: SceneSpec,
    object_name: np.ndarray,
    start_pos: np.ndarray,
    start_quat: np.ndarray,
    engine: str,
    *,
    num_envs: int,
    device: str,
    progress: Progress = unseen,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Let objects come to rest, while the robot holds its home configuration, in which it touches none.

    Args:
        scene: robot and objects.
        object_name: [S] names of the objects, which the scene has.
        start_pos: [S, 3] where they are [m].
        start_quat: [S, 4] their orientations.
        engine: engine in which they come to rest.
        num_envs: worlds at a time.
        device: where the engine runs if it can.
        progress: called with (poses done, poses in all).

    Returns:
        Positions [S, 3], quaternions [S, 4], and whether each object came to rest on the table [S]; the others stay
        where they were.
    """
    number = len(object_name)
    home = torch.as_tensor(scene.robot.home, dtype=torch.float32).expand(number, -1)
    start = State.at_rest(home, torch.as_tensor(start_pos), torch.as_tensor(start_quat))
    found = probe(
        engine,
        scene,
        object_name,
        start,
        _rest_pose,
        gravity=1.0,
        steps=round(SECONDS / scene.control_dt),
        num_envs=num_envs,
        device=device,
        progress=lambda done: progress(done, number),
    )
    at_rest = found[:, 7] > 0
    pos = np.where(at_rest[:, None], found[:, :3], start_pos).astype(np.float32)
    quat = np.where(at_rest[:, None], found[:, 3:7], start_quat).astype(np.float32)
    return pos, quat, at_rest


def _rest_pose(backend: Backend, start: State) -> Tensor:
    """Return the objects' poses and whether they are at rest on the table: [N, 3 + 4 + 1]."""
    state = backend.state()
    at_rest = rejection(backend, start, AT_REST) < 0
    return torch.cat((state.object_pos, state.object_quat, at_rest[:, None]), dim=-1)
