"""Human hand-object demonstrations: the archive, DexYCB, and synthetic ones.

from xreset.demos import read_demos, read_dexycb, write_demos
demos = synthesize(["soup", "banana"], per_object=4, seed=0)
write_demos("demos.npz", demos)
"""

from xreset.demos.align import grounded, levelled
from xreset.demos.archive import Demos, concatenate, demo_objects, read_demos, write_demos
from xreset.demos.dexycb import read_dexycb

__all__ = ["Demos", "concatenate", "demo_objects", "grounded", "levelled", "read_demos", "read_dexycb", "write_demos"]
