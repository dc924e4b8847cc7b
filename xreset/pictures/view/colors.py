"""Meaning of each color on the page and in the pictures."""

from __future__ import annotations

from xreset.pictures.meshes import INVALID_COLOR, Color

HUMAN_COLOR: Color = (0.85, 0.10, 0.45)
TOUCH_COLOR: Color = (1.00, 0.80, 0.00)
"""Keypoints in contact with the object."""
REACHED_COLOR: Color = (0.10, 0.55, 0.90)
"""The robot's fingertips."""

REASON_COLORS: dict[str, Color] = {
    "not annotated": (0.55, 0.55, 0.55),
    "hand error": (0.58, 0.20, 0.75),
    "joint limit": (0.50, 0.30, 0.12),
    "wrist position": (0.12, 0.30, 0.85),
    "wrist orientation": (0.10, 0.68, 0.85),
    "arm jump": (0.90, 0.75, 0.05),
    "table collision": (0.86, 0.13, 0.13),
    "self collision": (0.95, 0.35, 0.60),
    "object collision": (0.85, 0.50, 0.25),
}
"""Reason -> color that is mixed into the robot's in the frames that it makes invalid."""


def reason_color(reason: str) -> Color | None:
    """Return the color of a reason; None without a reason (empty text), red for an unknown one."""
    return REASON_COLORS.get(reason, INVALID_COLOR) if reason else None
