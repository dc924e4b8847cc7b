"""Let objects come to rest on the table, where the episodes of a goal set begin."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from xreset.files.progress import unseen
from xreset.physics import Backend, State
from xreset.resets.config import FilterConfig
from xreset.resets.probe import probe, rejection
from xreset.spec import ObjectSpec, RobotSpec, SceneSpec

SECONDS = 3.0
"""Time that an object is given to come to rest [s]."""
AT_REST = FilterConfig(linear_velocity=0.01, angular_velocity=0.1)
"""Speeds of an object at rest."""


def settled(
    robot: RobotSpec,
    objects: Sequence[ObjectSpec],
    object_name: Sequence[str],
    pos: np.ndarray,
    quat: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the poses to which objects come in MuJoCo from poses [S, 3], [S, 4], and whether they are at rest on the
    table there [S]. The robot holds its home configuration meanwhile, in which it touches no object."""
    scene = SceneSpec(robot=robot, objects=tuple(objects))
    home = torch.as_tensor(robot.home).expand(len(pos), -1)
    found = probe(
        "mujoco",
        scene,
        np.array(object_name),
        State.at_rest(home, torch.as_tensor(pos), torch.as_tensor(quat)),
        _rest_pose,
        gravity=1.0,
        steps=round(SECONDS / scene.control_dt),
        num_envs=64,
        device="cpu",
        progress=unseen,
    )
    return found[:, :3], found[:, 3:7], found[:, 7] > 0


def _rest_pose(backend: Backend, start: State) -> Tensor:
    """Return the objects' poses and whether they are at rest on the table: [N, 3 + 4 + 1]."""
    state = backend.state()
    at_rest = rejection(backend, start, AT_REST) < 0
    return torch.cat((state.object_pos, state.object_quat, at_rest[:, None]), dim=-1)
