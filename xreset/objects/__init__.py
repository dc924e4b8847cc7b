"""Objects: parametric stand-ins for the YCB objects, import of real meshes, surface points.

.. code-block:: python

    from xreset.objects.catalogue import load_object
    from xreset.objects.sampling import surface_points
    can = load_object("soup")                       # a stand-in
    can = load_object("soup", Path("ycb_models"))   # the real mesh
    cloud = surface_points(can, 64)
"""
