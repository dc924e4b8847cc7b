"""Conversion of a policy's actions to joint targets, and back."""

from __future__ import annotations

import torch
from torch import Tensor

from xreset.geometry.dynamics import jaw_stiffness
from xreset.geometry.urdf import joint_limits, prismatic_joints
from xreset.spec import RobotSpec
from xreset.task.config import ActionConfig

FINGER_LEVER = 0.04
"""Length of a finger's link [m]. A hand joint that slides moves as far as a point at this distance from a joint that
turns."""


class ActionSpace:
    """Maps actions [N, J] in [-1, 1] to joint targets [N, J].

    Arm joints are relative. Hand joints are absolute within their limits or, if so configured, relative as well. An
    absolute target is piecewise linear in its action: the lower limit at -1, :attr:`zero` at 0, the upper limit at +1.

    Attributes:
        lower: [J] joint limits.
        upper: [J]
        is_arm: [J] bool
        step: [J] how far a relative target moves under action 1 [rad, m]; 0 for joints with absolute targets.
        lead: [J] farthest that a relative target may be ahead of its joint [rad, m].
        zero: [J] a hand joint's absolute target under action 0; 0 for arm joints.
        below: [J] from ``zero`` down to the lower limit, reached at -1; 1 for arm joints.
        above: [J] from ``zero`` up to the upper limit, reached at +1; 1 for arm joints.
    """

    def __init__(
        self, robot: RobotSpec, config: ActionConfig, device: torch.device | str = "cpu"
    ) -> None:
        """Read the joints of a robot."""
        self.config = config
        lower, upper = torch.tensor(joint_limits(robot), dtype=torch.float32, device=device)
        is_arm = torch.tensor(robot.is_arm, device=device)
        slides = torch.tensor(prismatic_joints(robot), device=device)
        unit = torch.where(slides & ~is_arm, FINGER_LEVER, 1.0)
        hand_step = config.hand_step if config.hand == "relative" else 0.0
        stiffness = jaw_stiffness(robot)
        if config.jaw_step is not None and stiffness is not None:
            (own,) = unit[~is_arm].tolist()
            hand_step = min(hand_step, config.jaw_step / (stiffness * own))
        zero = (lower + upper) / 2
        below = (upper - lower) / 2
        above = below
        if config.hand_zero == "home":
            home = torch.as_tensor(robot.home, dtype=torch.float32, device=device)
            zero = home.clamp(lower, upper)
            below = zero - lower
            above = upper - zero
        self.lower = lower
        self.upper = upper
        self.is_arm = is_arm
        self.step = torch.where(is_arm, config.arm_step, unit * hand_step)
        self.lead = torch.where(is_arm, config.arm_lead, unit * config.hand_lead)
        # Continuous arm joints have infinite limits; nothing may multiply their infinity by 0.
        self.zero = torch.where(is_arm, 0.0, zero)
        self.below = torch.where(is_arm, 1.0, below)
        self.above = torch.where(is_arm, 1.0, above)

    def targets(self, action: Tensor, target: Tensor, joint_pos: Tensor) -> Tensor:
        """Return new joint targets [N, J] for actions, old targets and joint positions, each [N, J].

        A relative target is the old target plus ``step`` times the action, at most ``lead`` away from the joint. It
        starts from the old target and not from the joint, because a loaded arm would otherwise sag with every step.
        """
        action = action.clamp(-1.0, 1.0)
        new = target + self.step * action
        new = new.clamp(joint_pos - self.lead, joint_pos + self.lead)
        if self.config.hand == "absolute":
            hand = self.zero + torch.where(action < 0, self.below, self.above) * action
            new = torch.where(self.is_arm, new, hand)
        return new.clamp(self.lower, self.upper)

    def action_for(self, wanted: Tensor, target: Tensor) -> Tensor:
        """Return the actions [N, J] whose targets come nearest to ``wanted`` [N, J], given the present targets."""
        action = (wanted - target) / self.step.clamp_min(1e-9)
        if self.config.hand == "absolute":
            action = torch.where(self.is_arm, action, self.absolute_action(wanted))
        return action.clamp(-1.0, 1.0)

    def absolute_action(self, joint_pos: Tensor) -> Tensor:
        """Return the actions [N, J] whose absolute targets are these positions of the hand's joints."""
        from_zero = joint_pos - self.zero
        slope = torch.where(from_zero < 0, self.below, self.above)
        return from_zero / slope.clamp_min(1e-9)
