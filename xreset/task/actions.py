"""From a policy's output to joint targets, and back."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from xreset.geometry.urdf import robot_tree
from xreset.spec import RobotSpec
from xreset.task.config import ActionConfig

FINGER = 0.04
"""A hand joint that slides moves as far [m] as a point at this distance from a joint that turns: the length of a finger's link."""


@dataclass(frozen=True, kw_only=True)
class ActionSpace:
    """Maps actions [N, J] in [-1, 1] to joint targets [N, J]: arm joints relative, hand joints absolute within their limits
    or, if so configured, relative as well.

    An absolute target is piecewise linear in its action: the lower limit at -1, :attr:`zero` at 0, the upper limit at +1.
    """

    lower: Tensor
    """[J] joint limits."""
    upper: Tensor
    is_arm: Tensor
    """[J] bool"""
    step: Tensor
    """[J] how far a relative target moves under action 1 [rad, m]; 0 for joints with absolute targets."""
    lead: Tensor
    """[J] farthest that a relative target may be ahead of its joint [rad, m]."""
    zero: Tensor
    """[J] a hand joint's absolute target under action 0; 0 for arm joints."""
    below: Tensor
    """[J] from ``zero`` down to the lower limit, reached at -1; 1 for arm joints."""
    above: Tensor
    """[J] from ``zero`` up to the upper limit, reached at +1; 1 for arm joints."""
    config: ActionConfig

    @classmethod
    def of(cls, robot: RobotSpec, config: ActionConfig, device: torch.device | str = "cpu") -> ActionSpace:
        """The action space of a robot."""
        tree = robot_tree(robot)
        limits = [(tree.joint(name).lower, tree.joint(name).upper) for name in robot.joint_names]
        lower, upper = torch.tensor(limits, dtype=torch.float32, device=device).unbind(-1)
        is_arm = torch.tensor([joint.group == "arm" for joint in robot.joints], device=device)
        if config.hand_zero == "home":
            home = torch.as_tensor(robot.home, dtype=torch.float32, device=device)
            zero = torch.minimum(torch.maximum(home, lower), upper)
            below, above = zero - lower, upper - zero
        else:
            zero = (lower + upper) / 2
            below = above = (upper - lower) / 2
        slides = torch.tensor([tree.joint(name).type == "prismatic" for name in robot.joint_names], device=device)
        unit = torch.where(slides & ~is_arm, FINGER, 1.0)
        step = torch.where(is_arm, config.arm_step, unit * (config.hand_step if config.hand == "relative" else 0.0))
        lead = torch.where(is_arm, config.arm_lead, unit * config.hand_lead)
        # Continuous arm joints have infinite limits; where() must not see inf * 0 from them.
        zero, below, above = (
            torch.where(is_arm, other, value) for value, other in ((zero, 0.0), (below, 1.0), (above, 1.0))
        )
        return cls(
            lower=lower,
            upper=upper,
            is_arm=is_arm,
            step=step,
            lead=lead,
            zero=zero,
            below=below,
            above=above,
            config=config,
        )

    def targets(self, action: Tensor, target: Tensor, joint_pos: Tensor) -> Tensor:
        """[N, J] new joint targets.

        Relative: the old target plus ``step`` times the action, at most ``lead`` away from the joint. Starting from the old target, not
        from the joint, keeps a loaded arm from sagging a little further at every step.
        """
        action = action.clamp(-1.0, 1.0)
        new = target + self.step * action
        new = torch.minimum(torch.maximum(new, joint_pos - self.lead), joint_pos + self.lead)
        if self.config.hand == "absolute":
            hand = self.zero + torch.where(action < 0, self.below, self.above) * action
            new = torch.where(self.is_arm, new, target + self.config.hand_smoothing * (hand - target))
        return torch.minimum(torch.maximum(new, self.lower), self.upper)

    def action_for(self, wanted: Tensor, target: Tensor) -> Tensor:
        """[N, J] the action whose targets come nearest to ``wanted`` [N, J], given the present targets."""
        action = (wanted - target) / self.step.clamp_min(1e-9)
        if self.config.hand == "absolute":
            action = torch.where(
                self.is_arm, action, self.within_limits(target + (wanted - target) / self.config.hand_smoothing)
            )
        return action.clamp(-1.0, 1.0)

    def within_limits(self, joint_pos: Tensor) -> Tensor:
        """[N, J] where between their limits hand joints [N, J] stand: -1, 0 and +1 as for absolute targets; of no meaning for the arm."""
        above_zero = joint_pos - self.zero
        return above_zero / torch.where(above_zero < 0, self.below, self.above).clamp_min(1e-9)
