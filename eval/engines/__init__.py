"""How far engines agree on grasps (``agreement``) and on one action sequence (``replay``); which difference costs skill (``attribution``).

.. code-block:: python

    from xreset.eval.engines.agreement import compare
    from xreset.eval.engines.sources import load_frames
    from xreset.eval.trial import engine
    robot, objects, frames = load_frames(Path("retargeted.npz"))
    result = compare(robot, objects, frames, [engine("pybullet"), engine("sapien")], grasps=48)
"""
