"""Decide which retargeted frames are valid, and the reason why others are not.

As in the paper (appendix D.b), wrist position and orientation error, retargeting error and arm-joint jumps must stay
below thresholds. Frames with collisions and frames without annotation are invalid, too. Every invalid frame has one
reason, the first that applies.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from xreset.files.checks import frozen
from xreset.physics.tensors import Tensors

REASONS = (
    "valid",
    "not annotated",
    "hand error",
    "joint limit",
    "wrist position",
    "wrist orientation",
    "arm jump",
    "table collision",
    "self collision",
    "object collision",
)
"""Reasons why a frame is invalid, in the order of precedence. ``joint limit``: the wrist misses its target, and an arm
joint is at its limit. ``object collision``: see :func:`too_deep`."""


@frozen
class Thresholds:
    """Limits of a valid frame."""

    hand_error: float = 0.030
    """Mean distance of the fingertips from the human's [m]."""
    wrist_position: float = 0.010
    """Distance of the hand root from its target [m]."""
    wrist_orientation: float = 0.0873
    """Angle of the hand root to its target [rad] (5 degrees)."""
    arm_jump: float = 0.35
    """Largest change of an arm joint since the frame before [rad or m]."""
    table_depth: float = 0.003
    """Depth of the robot's shapes in the table [m]."""
    self_depth: float = 0.003
    """Depth of the robot's shapes in one another [m]."""
    object_depth: float = 0.002
    """Depth of the robot in the object [m]. Physics pushes them apart, with a jump of the object."""


@frozen
class Measures(Tensors):
    """Measures of frames; every tensor has the same shape."""

    annotated: Tensor
    """bool: whether the human hand was annotated."""
    hand_error: Tensor
    """Mean fingertip distance [m]."""
    wrist_position: Tensor
    """Distance of the hand root from its target [m]."""
    wrist_orientation: Tensor
    """Angle of the hand root to its target [rad]."""
    at_limit: Tensor
    """bool: whether an arm joint is at its limit."""
    arm_jump: Tensor
    """Largest change of an arm joint since the frame before [rad or m]; 0 after a frame without annotation."""
    table_clearance: Tensor
    """Lowest height of the robot's shapes above the table, at most 2 cm [m]."""
    self_clearance: Tensor
    """Smallest signed distance between the robot's shapes, at most 0 [m]."""


def classify(measures: Measures, thresholds: Thresholds) -> Tensor:
    """Return the index into :data:`REASONS` of every frame; 0 is valid. A NaN counts as beyond its threshold."""
    position = ~(measures.wrist_position <= thresholds.wrist_position)
    orientation = ~(measures.wrist_orientation <= thresholds.wrist_orientation)
    applies = {
        "valid": torch.zeros_like(measures.annotated),
        "not annotated": ~measures.annotated,
        "hand error": ~(measures.hand_error <= thresholds.hand_error),
        "joint limit": (position | orientation) & measures.at_limit,
        "wrist position": position,
        "wrist orientation": orientation,
        "arm jump": ~(measures.arm_jump <= thresholds.arm_jump),
        "table collision": ~(measures.table_clearance >= -thresholds.table_depth),
        "self collision": ~(measures.self_clearance >= -thresholds.self_depth),
    }
    never = torch.zeros_like(measures.annotated)
    # argmax returns the first reason that applies, and 0 (valid) if none does
    return torch.stack([applies.get(reason, never) for reason in REASONS]).long().argmax(dim=0)


def too_deep(reason: np.ndarray, object_depth: np.ndarray, thresholds: Thresholds) -> np.ndarray:
    """Add the reason ``object collision`` to frames that are valid else.

    Args:
        reason: [F] index into :data:`REASONS`.
        object_depth: [F] depth of the robot in the object [m]; infinite where it is not known.
        thresholds: limits of a valid frame.

    Returns:
        [F] index into :data:`REASONS`.
    """
    deep = ~(object_depth <= thresholds.object_depth)
    return np.where((reason == 0) & deep, REASONS.index("object collision"), reason)
