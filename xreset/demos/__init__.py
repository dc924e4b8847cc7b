"""Human hand-object demonstrations: the archive, DexYCB, other trackers, and synthetic ones.

.. code-block:: python

    from xreset.demos.archive import read_demos, write_demos
    from xreset.demos.verbs import synthesize
    write_demos("demos.npz", synthesize(["soup", "banana"], per_object=4, seed=0))
    soup = read_demos("demos.npz").select(objects=["soup"])
"""
