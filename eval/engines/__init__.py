"""How far engines agree on grasps and on one action sequence, and which difference costs a policy its skill.

.. code-block:: python

    from xreset.eval.engines.agreement import compare
    from xreset.eval.engines.sources import load_motion
    from xreset.eval.trial import engine
    robot, objects, motion = load_motion(Path("retargeted.npz"))
    result = compare(robot, objects, motion, [engine("pybullet"), engine("sapien")], grasps=48)
"""
