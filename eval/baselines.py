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
    """The open-loop baseline (the paper's "Kinematic Retargeting", "IK Oracle"): retargeted motion, played as targets.

    Episodes start at home, so the robot first moves to the first frame in a straight line in joint space. Then it plays
    the demonstration at its own speed, and holds its last frame. Actions go through the same interface as a policy's.
    """

    name = "ik"

    def __init__(self, motion: Retargeted, *, lead_in: float = 1.0) -> None:
        """Prepare.

        Args:
            motion: in the order of the environment's demonstrations.
            lead_in: time of the way from home to the first frame [s].
        """
        self._motion = motion
        self._lead_in = lead_in
        self._env: ManipulationEnv | None = None
        self._step = 0

    def begin(self, env: ManipulationEnv) -> None:
        """Lay out the targets [N, steps, J] of the episodes that have just begun."""
        motion = self._motion
        dt = env.backend.scene.control_dt
        lead = max(1, round(self._lead_in / dt))
        time = torch.arange(env.max_episode_length) * dt
        blend = ((torch.arange(len(time)) + 1) / lead).clamp(0, 1)[:, None]
        plans = []
        for world, sequence in enumerate(env.sequence.tolist()):
            first, last = motion.frame_offsets[sequence : sequence + 2]
            path = torch.as_tensor(motion.joint_pos[first:last], dtype=torch.float32)
            position = ((time - lead * dt) * float(motion.fps)).clamp(0, len(path) - 1)
            low = position.floor().long().clamp_max(max(len(path) - 2, 0))
            share = (position - low)[:, None]
            plan = path[low] * (1 - share) + path[(low + 1).clamp_max(len(path) - 1)] * share
            plans.append(env.joint_target[world].cpu() * (1 - blend) + plan * blend)
        self._plan = torch.stack(plans).to(env.device)
        self._step = 0
        self._env = env

    def act(self, observations: TensorDict) -> Tensor:
        """Return the actions [N, J] that bring the targets nearest to the plan."""
        env = self._env
        assert env is not None, "begin() comes before act()"
        wanted = self._plan[:, min(self._step, self._plan.shape[1] - 1)]
        self._step += 1
        return env.actions.action_for(wanted, env.joint_target)
