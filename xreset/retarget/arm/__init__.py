"""Arm inverse kinematics along a retargeted hand's path: ``solve``, on ``paths``, ``cost``, ``model`` and
``config``."""
