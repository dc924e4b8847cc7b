"""Arm inverse kinematics along a retargeted hand's path: ``solve`` on ``paths``, ``splice``, ``cost``, ``model`` and ``config``."""
