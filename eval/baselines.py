"""Policies that need no training: zero, and open-loop kinematic retargeting."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor

from xreset.env.manipulation import ManipulationEnv
from xreset.policy.onnx_policy import Policy
from xreset.retarget.file import Retargeted

LEAD_IN = 1.0
"""Time in which the baseline ``ik`` moves from home to the first frame [s]."""


class ZeroPolicy(Policy):
    """Action zero: the arm stays, the hand moves to its targets under action zero. A baseline and a smoke test."""

    def __init__(self, num_actions: int) -> None:
        self._num_actions = num_actions

    def act(self, observations: TensorDict) -> Tensor:
        """[N, J] zeros."""
        flat = observations["policy"]
        return flat.new_zeros(len(flat), self._num_actions)


class KinematicRetargeting(Policy):
    """The open-loop baseline (the paper's "Kinematic Retargeting", "IK Oracle"): retargeted motion, played as targets.

    Episodes start at home, so the robot first moves to the first frame in a straight line in joint space. Then it plays
    the demonstration at its own speed, and holds its last frame. Actions go through the same interface as a policy's.
    """

    def __init__(self, motion: Retargeted) -> None:
        """Take motion, in the order of the environment's demonstrations."""
        self._motion = motion

    def begin(self, env: ManipulationEnv) -> None:
        """Compute the joint targets [N, steps, J] of the episodes that have just begun."""
        motion = self._motion
        dt = env.backend.scene.control_dt
        lead = max(1, round(LEAD_IN / dt))
        time = torch.arange(env.max_episode_length) * dt
        blend = ((torch.arange(len(time)) + 1) / lead).clamp(0, 1)[:, None]
        plans = []
        for world, sequence in enumerate(env.sequence.tolist()):
            first, last = motion.frame_offsets[sequence : sequence + 2]
            path = torch.as_tensor(motion.joint_pos[first:last], dtype=torch.float32)
            frame = ((time - lead * dt) * float(motion.fps)).clamp(0, len(path) - 1)
            before = frame.floor().long().clamp_max(max(len(path) - 2, 0))
            after = (before + 1).clamp_max(len(path) - 1)
            share = (frame - before)[:, None]
            plan = path[before] * (1 - share) + path[after] * share
            start = env.joint_target[world].cpu()
            plans.append(start * (1 - blend) + plan * blend)
        self._plan = torch.stack(plans).to(env.device)
        self._step = 0
        self._env = env

    def act(self, observations: TensorDict) -> Tensor:
        """Return the actions [N, J] that bring the targets nearest to the plan."""
        env = self._env
        wanted = self._plan[:, min(self._step, self._plan.shape[1] - 1)]
        self._step += 1
        return env.actions.action_for(wanted, env.joint_target)
