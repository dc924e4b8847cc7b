"""From a policy's output to joint targets, and back."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from xreset.spec import RobotSpec
from xreset.task.config import ActionConfig
from xreset.urdf import robot_tree


@dataclass(frozen=True, kw_only=True)
class ActionSpace:
    """Maps actions [N, J] in [-1, 1] to joint targets [N, J]: arm joints relative, hand joints absolute within their limits."""

    lower: Tensor
    """[J] joint limits."""
    upper: Tensor
    is_arm: Tensor
    """[J] bool"""
    config: ActionConfig

    @classmethod
    def of(cls, robot: RobotSpec, config: ActionConfig, device: torch.device | str = "cpu") -> ActionSpace:
        """The action space of a robot."""
        tree = robot_tree(robot)
        limits = [(tree.joint(name).lower, tree.joint(name).upper) for name in robot.joint_names]
        lower, upper = torch.tensor(limits, dtype=torch.float32, device=device).unbind(-1)
        is_arm = torch.tensor([joint.group == "arm" for joint in robot.joints], device=device)
        return cls(lower=lower, upper=upper, is_arm=is_arm, config=config)

    def targets(self, action: Tensor, target: Tensor, joint_pos: Tensor) -> Tensor:
        """[N, J] new joint targets.

        Arm: the old target plus ``arm_step`` times the action, at most ``arm_lead`` away from the joint. Starting from the old target, not
        from the joint, keeps a loaded arm from sagging a little further at every step.
        """
        c = self.config
        action = action.clamp(-1.0, 1.0)
        arm = target + c.arm_step * action
        arm = torch.minimum(torch.maximum(arm, joint_pos - c.arm_lead), joint_pos + c.arm_lead)
        # Continuous joints have infinite limits; where() must not see inf * 0 from them.
        hand = self._hand_center + self._hand_half * action
        hand = target + c.hand_smoothing * (hand - target)
        return torch.minimum(torch.maximum(torch.where(self.is_arm, arm, hand), self.lower), self.upper)

    def action_for(self, wanted: Tensor, target: Tensor) -> Tensor:
        """[N, J] the action whose targets come nearest to ``wanted`` [N, J], given the present targets."""
        c = self.config
        arm = (wanted - target) / c.arm_step
        hand = (target + (wanted - target) / c.hand_smoothing - self._hand_center) / self._hand_half.clamp_min(1e-9)
        return torch.where(self.is_arm, arm, hand).clamp(-1.0, 1.0)

    @property
    def _hand_center(self) -> Tensor:
        return torch.where(self.is_arm, 0.0, (self.lower + self.upper) / 2)

    @property
    def _hand_half(self) -> Tensor:
        return torch.where(self.is_arm, 1.0, (self.upper - self.lower) / 2)
