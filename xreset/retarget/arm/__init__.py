"""Arm inverse kinematics along a retargeted hand's path. ``solve`` is the entry; it uses ``model`` and ``config``."""
