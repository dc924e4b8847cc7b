"""Whether engines agree on grasps: the same hand, object and joint targets in each, and how far what happens differs.

.. code-block:: python

    from xreset.backends.parity.compare import compare
    from xreset.backends.parity.load import load_frames
    from xreset.backends.parity.trials import engine
    robot, objects, frames = load_frames(Path("retargeted.npz"))
    result = compare(robot, objects, frames, [engine("pybullet"), engine("sapien")], grasps=48)

Modules, each on top of those before: ``episodes`` (what the joints are told), ``grasps`` and ``load`` (which hands and objects),
``recording`` (what an engine did), ``metrics`` (how far two recordings differ), ``trials`` (what an engine is put through), ``compare``.
"""
