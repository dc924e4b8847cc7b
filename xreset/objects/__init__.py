"""Objects: parametric stand-ins for the YCB objects, import of real meshes, surface points.

.. code-block:: python

    from xreset.objects import load_object, surface_points
    can = load_object("soup")                       # a stand-in
    can = load_object("soup", Path("ycb_models"))   # the real mesh
    cloud = surface_points(can, 64)
"""

from xreset.geometry.shapes import shape_mesh
from xreset.objects.catalogue import canonical_name, load_object, load_objects, object_names
from xreset.objects.rest import rest_height, resting_orientation
from xreset.objects.sampling import bounding_box, bounding_radius, keypoints, surface_points

__all__ = [
    "bounding_box",
    "bounding_radius",
    "canonical_name",
    "keypoints",
    "load_object",
    "load_objects",
    "object_names",
    "rest_height",
    "resting_orientation",
    "shape_mesh",
    "surface_points",
]
