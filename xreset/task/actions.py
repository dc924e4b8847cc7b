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
    absolute target is linear in its action: the lower limit at -1, the upper limit at +1.

    Attributes:
        lower: [J] joint limits.
        upper: [J]
        is_arm: [J] bool
        step: [J] how far a relative target moves under action 1 [rad, m]; 0 for joints with absolute targets.
        lead: [J] farthest that a relative target may be ahead of its joint [rad, m].
        middle: [J] of a hand joint's limits, its absolute target under action 0; 0 for arm joints.
        half: [J] half the range of a hand joint; 1 for arm joints.
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
        self.lower = lower
        self.upper = upper
        self.is_arm = is_arm
        self.step = torch.where(is_arm, config.arm_step, unit * hand_step)
        self.lead = torch.where(is_arm, config.arm_lead, unit * config.hand_lead)
        # Continuous arm joints have infinite limits; nothing may multiply their infinity by 0.
        self.middle = torch.where(is_arm, 0.0, (lower + upper) / 2)
        self.half = torch.where(is_arm, 1.0, (upper - lower) / 2)

    def targets(self, action: Tensor, target: Tensor, joint_pos: Tensor) -> Tensor:
        """Return new joint targets [N, J] for actions, old targets and joint positions, each [N, J].

        A relative target is the old target plus ``step`` times the action, at most ``lead`` away from the joint. It
        starts from the old target and not from the joint, because a loaded arm would otherwise sag with every step.
        """
        action = action.clamp(-1.0, 1.0)
        new = target + self.step * action
        new = new.clamp(joint_pos - self.lead, joint_pos + self.lead)
        if self.config.hand == "absolute":
            new = torch.where(self.is_arm, new, self.middle + self.half * action)
        return new.clamp(self.lower, self.upper)

    def action_for(self, wanted: Tensor, target: Tensor) -> Tensor:
        """Return the actions [N, J] whose targets come nearest to ``wanted`` [N, J], given the present targets."""
        action = (wanted - target) / self.step.clamp_min(1e-9)
        if self.config.hand == "absolute":
            action = torch.where(self.is_arm, action, self.absolute_action(wanted))
        return action.clamp(-1.0, 1.0)

    def absolute_action(self, joint_pos: Tensor) -> Tensor:
        """Return the actions [N, J] whose absolute targets are these positions of the hand's joints."""
        return (joint_pos - self.middle) / self.half.clamp_min(1e-9)
