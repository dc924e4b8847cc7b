"""Temporary folders, upright objects, and real demonstrations, which may not be part of the project."""

import os
import tempfile
from contextlib import contextmanager
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from unittest import SkipTest, TestCase, skipUnless
from unittest.mock import patch

from scipy.spatial.transform import Rotation

from xreset import synthesize

DEFAULT = Path(__file__).resolve().parents[2] / "shared" / "data"

PYBULLET = skipUnless(
    find_spec("pybullet"), "PyBullet is not installed: it has wheels for Python 3.11 only"
)


@cache
def upright(name, count, **options):
    """Return synthetic demonstrations of an object that start with its z up, as in the trainings of older policies."""
    with patch("xreset.demos.synth._UPRIGHT", 1.0):
        demos = synthesize([name], count, **options)
    start = demos.object_quat_wxyz[demos.frame_offsets[:-1]]
    ups = Rotation.from_quat(start, scalar_first=True).as_matrix()[:, 2, 2]
    assert (ups > 0.99).all(), ups
    return demos


@contextmanager
def refuses(test, words, error, case=None):
    """One case of a test: the block must raise the error, in whose message ``words`` is found. A failure names the case."""
    with test.subTest(words if case is None else case), test.assertRaisesRegex(error, words):
        yield


def data_dir():
    """The folder of real data: ``XRESET_DATA``, or its place next to a development checkout; skips without it."""
    folder = Path(os.environ.get("XRESET_DATA", DEFAULT))
    if not folder.is_dir():
        raise SkipTest(
            f"no real data at {folder}; set XRESET_DATA to the folder with the DexYCB archives"
        )
    return folder


class InFolder(TestCase):
    """A test with a temporary folder."""

    def setUp(self):
        super().setUp()
        self.folder = Path(self.enterContext(tempfile.TemporaryDirectory()))


class InOneFolder(TestCase):
    """Tests that share a temporary folder."""

    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        cls.folder = Path(cls.enterClassContext(tempfile.TemporaryDirectory()))
