"""Let objects come to rest on the table, where the episodes of a goal set begin."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from xreset.files.progress import unseen
from xreset.physics import Backend, State
from xreset.resets.probe import probe, stays
from xreset.spec import ObjectSpec, RobotSpec, SceneSpec

SECONDS = 3.0
"""Time that an object is given to come to rest [s]."""
_WATCHED = 0.5
"""Time after a stop for which an object at rest stays where it is [s]."""
_MOVED = 0.005
"""Farthest that its center of mass may move in this time [m]."""
_TURNED = float(np.radians(3.0))
"""Farthest that it may turn in this time [rad]."""


def settled(
    robot: RobotSpec,
    objects: Sequence[ObjectSpec],
    object_name: Sequence[str],
    pos: np.ndarray,
    quat: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the poses to which objects come in MuJoCo from poses [S, 3], [S, 4], and whether they are at rest on the
    table there [S]. An object that still rolls is at rest if it stays where it is after a stop: so do episodes begin.
    The robot holds its home configuration meanwhile, in which it touches no object."""
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
    """Return the objects' poses, and whether they stay there after a stop: [N, 3 + 4 + 1]."""
    state = backend.state().clone()
    still = State.at_rest(start.joint_pos, state.object_pos, state.object_quat)
    backend.set_state(still)
    backend.step(round(_WATCHED / backend.scene.control_dt) * backend.scene.substeps)
    at_rest = stays(backend, still, moved=_MOVED, turned=_TURNED)
    return torch.cat((still.object_pos, still.object_quat, at_rest[:, None]), dim=-1)
