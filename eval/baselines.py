"""Baselines that need no training."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from xreset.env import ManipulationEnv
from xreset.retarget.file import Retargeted

if TYPE_CHECKING:
    from tensordict import TensorDict


class KinematicRetargeting:
    """The open-loop baseline (the paper's "Kinematic Retargeting" / "IK Oracle"): the retargeted trajectory, played as targets.

    Episodes start at home, so the robot first moves there in a straight line in joint space, then plays the demonstration at its own speed,
    then holds its last frame. It goes through the same action interface as every policy.
    """

    name = "ik"

    def __init__(self, retargeted: Retargeted, *, lead_in: float = 1.0) -> None:
        """Prepare.

        Args:
            retargeted: trajectories, in the order of the environment's demonstrations.
            lead_in: time from home to the first frame [s].
        """
        self._retargeted, self._lead_in = retargeted, lead_in
        self._env: ManipulationEnv | None = None

    def begin(self, env: ManipulationEnv) -> None:
        """Lay out the targets [N, steps, J] of the episodes that have just begun."""
        r, dt = self._retargeted, env.backend.scene.control_dt
        lead = max(1, round(self._lead_in / dt))
        time = torch.arange(env.max_episode_length) * dt
        plans = []
        for world, sequence in enumerate(env.sequence.tolist()):
            first, last = int(r.frame_offsets[sequence]), int(r.frame_offsets[sequence + 1])
            path = torch.as_tensor(r.joint_pos[first:last], dtype=torch.float32)
            position = ((time - lead * dt) * float(r.fps)).clamp(0, len(path) - 1)
            low = position.floor().long().clamp_max(max(len(path) - 2, 0))
            share = (position - low)[:, None]
            plan = path[low] * (1 - share) + path[(low + 1).clamp_max(len(path) - 1)] * share
            blend = ((torch.arange(len(time)) + 1) / lead).clamp(0, 1)[:, None]
            plans.append(env.joint_target[world].cpu() * (1 - blend) + plan * blend)
        self._plan, self._step, self._env = torch.stack(plans).to(env.device), 0, env

    def act(self, observations: TensorDict) -> Tensor:
        """[N, J] the action that brings the targets nearest to the plan."""
        env = self._env
        assert env is not None, "begin() comes before act()"
        wanted = self._plan[:, min(self._step, self._plan.shape[1] - 1)]
        self._step += 1
        return env.actions.action_for(wanted, env.joint_target)
