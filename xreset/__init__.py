"""xreset: dexterous robot policies from human demonstrations used as reset states.

Importing this package loads nothing heavy: no torch, no physics engine, no display.
"""

__version__ = "0.1.0"
