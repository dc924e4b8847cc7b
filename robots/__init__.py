"""Robots: one folder each, a URDF and a ``robot.toml``; further ones come as plugins."""
