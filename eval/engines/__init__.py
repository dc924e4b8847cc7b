"""How far engines agree on grasps and on one action sequence, and which difference costs a policy its skill.

.. code-block:: python

    from xreset.eval.engines.agreement import compare
    from xreset.eval.engines.sources import load_frames
    from xreset.eval.trial import engine
    robot, objects, frames = load_frames(Path("retargeted.npz"))
    result = compare(robot, objects, frames, [engine("pybullet"), engine("sapien")], grasps=48)
"""
