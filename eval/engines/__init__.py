"""Compare physics engines: how far they agree on grasps and on an action sequence.

Modules: ``contract`` (the checks of :mod:`xreset.backends.conformance`), ``agreement`` (grasps, with ``grasps``),
``replay`` (the same actions, from ``actions``); ``recording`` plays targets for the second and the third. ``verbs`` has
the commands.

.. code-block:: python

    from xreset.eval.engines.agreement import compare
    from xreset.eval.rollout import engine
    from xreset.resets.inputs import load_inputs
    inputs = load_inputs(Path("retargeted.npz"))
    result = compare(inputs.robot, inputs.objects, inputs.motion(), [engine("pybullet"), engine("sapien")])
"""
