"""Robots: one folder each, a URDF and a ``robot.toml``; further ones come as plugins."""

from xreset.geometry.description import load_robot
from xreset.physics.plugins import robot_names

load = load_robot

__all__ = ["load", "robot_names"]
