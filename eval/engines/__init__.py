"""Check physics engines, and compare them: how far they agree on grasps.

Modules: ``contract`` (the checks of :mod:`xreset.backends.conformance`) and ``page`` (their results), ``agreement``
(with ``grasps``, which it tries, and ``recording``, which plays them). ``verbs`` has the commands.

.. code-block:: python

    from xreset.eval.engines.agreement import compare
    from xreset.eval.rollout import engine
    from xreset.resets.inputs import load_inputs
    inputs = load_inputs(Path("retargeted.npz"))
    result = compare(inputs.robot, inputs.objects, inputs.motion(), [engine("pybullet"), engine("sapien")])
"""
