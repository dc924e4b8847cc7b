"""Arm inverse kinematics along a retargeted hand's path: ``solve``, on ``cost``, ``model`` and ``config``."""
