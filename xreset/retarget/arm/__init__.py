"""Arm inverse kinematics along a retargeted hand's path: ``solve``, on ``model`` and ``config``."""
