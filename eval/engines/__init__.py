"""Compare physics engines: how far they agree on grasps and on an action sequence, and which of their differences costs
a policy its skill.

Modules: ``contract`` (the checks of :mod:`xreset.backends.conformance`), ``agreement`` (grasps, with ``grasps``),
``replay`` (the same actions, from ``actions``), ``attribution`` (a policy, with the properties that ``measure`` finds);
``recording`` plays targets for the second and the third. ``verbs`` has the commands.

.. code-block:: python

    from xreset.eval.engines.agreement import compare
    from xreset.eval.rollout import engine
    from xreset.resets.inputs import load_inputs
    inputs = load_inputs(Path("retargeted.npz"))
    result = compare(inputs.robot, inputs.objects, inputs.motion(), [engine("pybullet"), engine("sapien")])
"""
