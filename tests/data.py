"""Temporary folders, and real demonstrations, which may not be part of the project."""

from __future__ import annotations

import contextlib
import io
import os
import tempfile
import unittest
from importlib.util import find_spec
from pathlib import Path

from xreset.cli import main

DEFAULT = Path(__file__).resolve().parents[2] / "shared" / "data"

PYBULLET = unittest.skipUnless(
    find_spec("pybullet"), "PyBullet is not installed: it has wheels for Python 3.11 only"
)


def data_dir() -> Path:
    """The folder of real data: ``XRESET_DATA``, or its place next to a development checkout; skips without it."""
    folder = Path(os.environ.get("XRESET_DATA", DEFAULT))
    if not folder.is_dir():
        raise unittest.SkipTest(
            f"no real data at {folder}; set XRESET_DATA to the folder with the DexYCB archives"
        )
    return folder


class InFolder(unittest.TestCase):
    """A test with a temporary folder."""

    def setUp(self):
        super().setUp()
        self.folder = Path(self.enterContext(tempfile.TemporaryDirectory()))


def run(*arguments: object) -> tuple[int, str]:
    """Run a command; return its exit code and all that it printed."""
    out = io.StringIO()
    code = 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
        try:
            main([str(argument) for argument in arguments])
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else 1
    return code, out.getvalue()
