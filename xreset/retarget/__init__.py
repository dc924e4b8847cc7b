"""Retargeting: human hand motion to robot joint trajectories.

    from xreset.retarget.verbs import retarget_demos
    motion = retarget_demos(demos, robot, objects)  # hand, then arm, then validity of every frame
    motion.joint_pos[motion.valid]                  # robot states that may become resets

Modules: ``verbs`` (the function that is a command), ``pipeline`` (the whole); ``hand`` and ``arm``, each with
``solve``, ``cost``, ``model`` and ``config``; ``least_squares`` (the solver of both); ``push`` (out of the object);
``validity`` and ``file``.
"""
