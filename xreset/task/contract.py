"""What a trained policy must know of robot and task. Imports no torch, so that the command line reads it at once."""

from __future__ import annotations

from dataclasses import field
from typing import Literal

from xreset.files.checks import PositiveFloat, PositiveInt, frozen
from xreset.task.config import TaskConfig

SCHEMA = "xreset-policy/1"


@frozen
class Contract:
    """What must agree between training and evaluation."""

    schema: Literal["xreset-policy/1"]
    robot: str
    """Name of the robot."""
    robot_fingerprint: str
    """:attr:`xreset.spec.RobotSpec.fingerprint`"""
    joint_names: tuple[str, ...]
    """Order of the joints in observations and actions (length J)."""
    fingertip_names: tuple[str, ...]
    """Order of the fingertips in observations, thumb first."""
    objects: tuple[str, ...]
    """Objects of the training; a policy may play with others."""
    observation_layout: dict[str, dict[str, PositiveInt]]
    """Group -> term -> number of values, in order: :func:`xreset.task.observations.layout`."""
    control_dt: PositiveFloat
    """Time between two actions [s]."""
    task: TaskConfig
    """The task of the training. ``check_contract`` compares the parts of it that must agree."""
    others: dict[str, str] = field(default_factory=dict)
    """Fingerprints of the other robots of the training, by name. A policy with ``task.joint_slots`` plays every robot
    that fits into its slots."""

    @property
    def num_actions(self) -> int:
        """Number of values of an action: joints of the robot, or slots for joints."""
        return self.task.sizes(len(self.joint_names), len(self.fingertip_names))[0]
