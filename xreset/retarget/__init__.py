"""Retargeting: human hand motion to robot joint trajectories.

from xreset.retarget.pipeline import retarget_demos, write_retargeted
trajectories = retarget_demos(demos, robot, objects)      # hand, then arm, then validity of every frame
trajectories.joint_pos[trajectories.valid]          # robot states that may become resets

Modules: ``pipeline`` (the whole); ``hand`` and ``arm``, each with ``solve``, ``cost``, ``model`` and ``config``; ``validity``, ``file``,
``partial`` (stop and continue).
"""
