"""Robots: one folder each, a URDF and a ``robot.toml``; further ones come as plugins."""

from xreset.robots.registry import load, robot_names

__all__ = ["load", "robot_names"]
