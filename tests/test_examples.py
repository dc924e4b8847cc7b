"""The numbered examples run as they are, and stay short; the names of the face lead where they say."""

import contextlib
import importlib.util
import io
import tempfile
import unittest
from pathlib import Path

import xreset

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def run(name: str, *arguments) -> str:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    with contextlib.redirect_stdout(io.StringIO()) as out:
        module.main(*arguments)
    return out.getvalue()


class FaceTest(unittest.TestCase):
    def test_every_name_is_there_and_documented(self):
        for name in xreset.__all__:
            if name == "VectorEnv" and not importlib.util.find_spec("gymnasium"):
                continue
            self.assertTrue(getattr(xreset, name).__doc__, name)
        with self.assertRaises(AttributeError):
            xreset.no_such_name  # noqa: B018


class ExamplesTest(unittest.TestCase):
    def setUp(self):
        self.folder = Path(self.enterContext(tempfile.TemporaryDirectory()))

    def test_they_are_short(self):
        for file in EXAMPLES.glob("[0-9]*.py"):
            self.assertLess(len(file.read_text().splitlines()), 60, file.name)

    @unittest.skipUnless(importlib.util.find_spec("coal"), "coal is not installed")
    def test_a_bank_is_made(self):
        self.assertIn("states are stable", run("01_make_a_bank", self.folder))
        self.assertGreater(xreset.read_bank(self.folder / "bank.npz").num_states, 0)

    def test_a_policy_plays_and_an_environment_is_stepped(self):
        self.assertIn("task progress", run("02_play_a_policy", self.folder))
        self.assertIn("return after", run("03_step_an_environment", self.folder / "demos.npz"))
        if importlib.util.find_spec("gymnasium"):
            self.assertRegex(run("04_gymnasium", self.folder / "demos.npz"), r"[1-9]\d* episodes")


if __name__ == "__main__":
    unittest.main()
