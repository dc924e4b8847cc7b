"""The numbered examples run as they are, in their order, and stay short; the names of the face lead where they say."""

import contextlib
import importlib.util
import io
import os
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path
from unittest import mock

import xreset

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
NUMBERED = sorted(EXAMPLES.glob("[0-9]*.py"))


def run(name: str, *arguments) -> str:
    with mock.patch.object(sys, "path", [str(EXAMPLES), *sys.path]), contextlib.redirect_stdout(io.StringIO()) as out:
        importlib.import_module(name).main(*arguments)
    return out.getvalue()


def has(*packages: str) -> bool:
    return all(importlib.util.find_spec(package) for package in packages)


class FaceTest(unittest.TestCase):
    def test_every_name_is_there_and_documented(self):
        for name in xreset.__all__:
            if name == "VectorEnv" and not has("gymnasium"):
                continue
            self.assertTrue(getattr(xreset, name).__doc__, name)
        with self.assertRaises(AttributeError):
            xreset.no_such_name  # noqa: B018


class ShelfTest(unittest.TestCase):
    def test_they_are_numbered_and_short(self):
        self.assertEqual([file.name[:2] for file in NUMBERED], [f"{number:02}" for number in range(1, 11)])
        for file in NUMBERED:
            self.assertLess(len(file.read_text().splitlines()), 60, file.name)

    def test_without_gymnasium_it_is_said_what_to_install(self):
        with mock.patch.dict(sys.modules, {"gymnasium": None}):
            sys.modules.pop("xreset.vector_env", None)
            vars(xreset).pop("VectorEnv", None)
            with self.assertRaisesRegex(xreset.errors.XResetError, r"pip install 'xreset\[gymnasium\]'"):
                xreset.VectorEnv  # noqa: B018

    def test_an_engine_is_checked(self):
        lines = run("06_own_engine").splitlines()
        self.assertEqual([line.split()[0] for line in lines], ["passed", "passed", "passed", "failed"], lines)

    def test_a_robot_is_checked(self):
        with tempfile.TemporaryDirectory() as folder:
            self.assertIn("my-robot: 0 errors", run("05_own_robot", Path(folder)))
            self.assertTrue((Path(folder) / "my-robot" / "robot.png").is_file())


@unittest.skipUnless(has("coal"), "coal is not installed")
class FromABankTest(unittest.TestCase):
    """Those that need the files of the first two."""

    @classmethod
    def setUpClass(cls):
        cls.folder = Path(cls.enterClassContext(tempfile.TemporaryDirectory()))
        cls.said = run("01_load_and_view", cls.folder), run("02_retarget_own_keypoints", cls.folder)
        cls.bank = cls.folder / "bank.npz"

    def test_a_bank_is_made(self):
        self.assertIn("2 demonstrations", self.said[0])
        self.assertRegex(self.said[1], r"[1-9]\d* states are stable")
        self.assertGreater((self.folder / "demos.png").stat().st_size, 1000)

    def test_an_environment_is_stepped(self):
        self.assertIn("return after 60 steps", run("03_step_an_environment", self.bank))

    def test_a_reward_term_pays(self):
        self.assertRegex(run("04_own_reward", self.bank), r"upright pays 0\.[0-4]\d*[1-9]\d* per step")

    @unittest.skipUnless(has("rsl_rl", "onnx"), "rsl-rl-lib or onnx is not installed")
    def test_a_policy_is_trained(self):
        run("07_train", self.bank, self.folder / "run")
        self.assertTrue((self.folder / "run" / "policy.onnx").is_file())

    @unittest.skipUnless(has("onnxruntime", "matplotlib"), "onnxruntime or matplotlib is not installed")
    def test_a_policy_is_evaluated(self):
        self.assertRegex(run("08_evaluate_and_plot", self.folder, ("mujoco",)), r"task progress [1-9]\d*%")
        self.assertTrue((self.folder / "progress.png").is_file())

    @unittest.skipUnless(has("onnxruntime"), "onnxruntime is not installed")
    def test_a_policy_plays_where_nothing_can_train(self):
        hidden = (
            "import sys; sys.modules.update(dict.fromkeys(('rsl_rl', 'warp', 'mujoco_warp', 'onnx', 'tensorboard')))"
        )
        program = f"{hidden}; sys.path.insert(0, {str(EXAMPLES)!r}); __import__('09_play_a_policy').main(sys.argv[1])"
        done = subprocess.run(
            [sys.executable, "-c", program, self.folder / "demos.npz"],
            capture_output=True, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"},
        )  # fmt: skip
        self.assertEqual(done.returncode, 0, done.stderr)
        self.assertLess(float(done.stdout.partition("the object ends ")[2].partition(" cm")[0]), 5.0, done.stdout)

    @unittest.skipUnless(has("gymnasium"), "gymnasium is not installed")
    def test_other_learning_code_trains(self):
        self.assertRegex(run("10_gymnasium", self.bank), r"iteration 3: reward per step -?\d")


if __name__ == "__main__":
    unittest.main()
