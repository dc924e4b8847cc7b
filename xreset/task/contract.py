"""What a trained policy must know of robot and task. Imports no torch, so that the command line reads it at once."""

from __future__ import annotations

from typing import Literal

from xreset.checks import PositiveFloat, PositiveInt, frozen
from xreset.task.config import TaskConfig

SCHEMA = "xreset-policy/1"


@frozen
class Contract:
    """What must agree between training and evaluation."""

    schema: Literal["xreset-policy/1"]
    robot: str
    robot_fingerprint: str
    joint_names: tuple[str, ...]
    fingertip_names: tuple[str, ...]
    objects: tuple[str, ...]
    observation_layout: dict[str, dict[str, PositiveInt]]
    control_dt: PositiveFloat
    task: TaskConfig
