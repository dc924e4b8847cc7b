"""Where tests find real demonstrations, which may not be part of the project."""

from __future__ import annotations

import os
import unittest
from pathlib import Path

DEFAULT = Path(__file__).resolve().parents[2] / "shared" / "data"


def data_dir() -> Path:
    """The folder of real data: ``XRESET_DATA``, or where a development checkout has it; skips the test if it is not there."""
    folder = Path(os.environ.get("XRESET_DATA", DEFAULT))
    if not folder.is_dir():
        raise unittest.SkipTest(f"no real data at {folder}; set XRESET_DATA to the folder with the DexYCB archives")
    return folder
