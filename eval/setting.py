"""Options that several evaluating commands share. Imports no torch, so that the command line shows them at once."""

from __future__ import annotations

from pathlib import Path

from xreset.files.checks import Options, Seed, frozen
from xreset.physics.plugins import Device


@frozen
class Place(Options):
    """Robot, meshes, seed and device."""

    robot: str | None = None
    """Name or folder of the robot; default: the policy's, or the file's."""
    meshes: Path | None = None
    """Folder of real meshes; default: what the policy was trained with, else the stand-ins."""
    seed: Seed = 0
    """Seed of everything that is drawn; draws are the same in every engine."""
    device: Device = "cpu"
    """Where GPU engines run: cpu or cuda."""
