"""Human hand-object demonstrations: the archive, DexYCB, HO-3D, other trackers, and synthetic ones.

.. code-block:: python

    from xreset.demos import read_demos, synthesize, write_demos
    write_demos("demos.npz", synthesize(["soup", "banana"], per_object=4, seed=0))
    soup = read_demos("demos.npz").select(objects=["soup"])
"""

from xreset.demos.align import grounded, levelled
from xreset.demos.archive import Demos, concatenate, demo_objects, read_demos, write_demos
from xreset.demos.dexycb import read_dexycb
from xreset.demos.ho3d import read_ho3d
from xreset.demos.keypoints import Convention, read_keypoints, read_transform
from xreset.demos.mirror import Symmetry, mirrored, symmetry
from xreset.demos.synth import synthesize

__all__ = [
    "Convention",
    "Demos",
    "Symmetry",
    "concatenate",
    "demo_objects",
    "grounded",
    "levelled",
    "mirrored",
    "read_demos",
    "read_dexycb",
    "read_ho3d",
    "read_keypoints",
    "read_transform",
    "symmetry",
    "synthesize",
    "write_demos",
]
