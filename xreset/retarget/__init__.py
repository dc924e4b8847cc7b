"""Retargeting: human hand motion to robot joint trajectories.

from xreset.retarget.pipeline import retarget, write_retargeted
trajectories = retarget(demos, robot, objects)      # hand, then arm, then validity of every frame
trajectories.joint_pos[trajectories.valid]          # robot states that may become resets

Modules: ``pipeline`` (the whole); ``hand`` (the solver) with ``hand_config``, ``problem``, ``hand_model``, ``cost``, ``terms``,
``clearance``, ``balls``, ``chain``, ``hold`` (grasps that are held) and ``scale`` (the user's size); ``arm`` with ``arm_config``,
``arm_model``, ``arm_solver`` (one frame), ``arm_paths`` (over time), ``splice`` and ``collision``; ``surface`` and ``fields`` (the object);
``validity``, ``file``, ``partial`` (stop and continue).
"""
