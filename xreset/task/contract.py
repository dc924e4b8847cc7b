"""What a trained policy must know of robot and task. Imports no torch, so that the command line reads it at once."""

from __future__ import annotations

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
