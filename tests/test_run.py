"""`xreset run`: the commands that it gives, and what it leaves out when it is given again."""

import shutil
from unittest import TestCase
from unittest.mock import patch

import trimesh

import xreset
from tests.command import refused
from tests.command import xreset as xreset_command
from tests.toy_results import InFolder
from tests.toy_retarget import retargets_quickly
from xreset.cli import perform
from xreset.cli import run as command
from xreset.demos.archive import write_demos
from xreset.demos.verbs import synthesize
from xreset.errors import FileFormatError, RunError
from xreset.files.storage import file_hash
from xreset.objects.catalogue import ALIASES
from xreset.physics.plugins import robot_folder
from xreset.retarget.file import read_retargeted, write_retargeted


class Run(InFolder, TestCase):
    def setUp(self):
        super().setUp()
        self.demos = self.folder / "soup.npz"
        write_demos(self.demos, synthesize(["soup"], 1, fps=5))

    def run_it(self, demos="soup.npz", robot="ur7e-sharpa", **options):
        """Run with real motion and bank; return the verbs of all steps."""
        verbs = []

        def step(words):
            verbs.append(words[0])
            if words[0] == "train":
                self.assertIn("--resets", words)
            if words[0] in ("retarget", "resets"):
                perform(words)

        with patch.object(command, "perform", step), retargets_quickly():
            xreset.run(f"{self.folder}/{demos}", robot=robot, out=f"{self.folder}/v0.1", **options)
        return verbs

    def test_steps_that_are_done_are_left_out(self):
        write_demos(self.folder / "other.npz", synthesize(["soup"], 1, fps=5, seed=1))
        self.assertEqual(self.run_it(), ["retarget", "resets", "train", "eval", "report"])
        self.assertEqual(self.run_it(iterations=7), ["train", "eval", "report"])
        self.write_run("v0.1", resets=f"{self.folder}/v0.1/resets.npz")
        demos = {"demos": file_hash(self.demos)}
        self.write_results("v0.1", inputs=demos, seed=3, episode_seconds=5.0)
        options = {"seed": 3, "episodes": 2, "engine": "mujoco"}
        self.assertEqual(self.run_it(**options), ["train", "report"])
        (self.folder / "v0.1/resets.npz").unlink()
        self.assertEqual(self.run_it(), ["resets", "train", "eval", "report"])
        with self.assertRaisesRegex(RunError, "another archive of demonstrations"):
            self.run_it("other.npz")
        with self.assertRaisesRegex(FileFormatError, "the robot 'ur7e-sharpa', not for 'openarm'"):
            self.run_it(robot="openarm")
        meshes = self.folder / "meshes"
        meshes.mkdir()
        trimesh.creation.box((0.06, 0.06, 0.1)).export(meshes / f"{ALIASES['soup']}.obj")
        with self.assertRaisesRegex(FileFormatError, "motion.npz was made with the built-in stand"):
            self.run_it(meshes=meshes)
        motion = self.folder / "v0.1/motion.npz"
        write_retargeted(motion, read_retargeted(motion))  # states no inputs
        with self.assertRaisesRegex(RunError, "motion.npz was made with another archive"):
            self.run_it()

    def test_times_are_of_the_robot_and_the_engines_that_were_measured(self):
        told = " ".join(command._times(1200, 900.0, ["mujoco", "pybullet", "drake"], 25.0))
        for words in (
            "retarget 0.5, resets 0.76, eval in mujoco 1.4, eval in pybullet 9. This machine has",
            "The time of eval in drake is not known.",
            "train takes 25 minutes, and compiles kernels first.",
        ):
            self.assertIn(words, told)
        self.assertNotIn("is not known", " ".join(command._times(60, 9.0, ["sapien"], 1.0)))
        self.assertIn("ends after its iterations", [*command._times(60, 9.0, [], None)][-1])
        own = self.folder / "mine"
        shutil.copytree(robot_folder("openarm"), own)
        for robot, is_known in (("openarm", True), (own, False)):
            with patch.object(command, "_step", side_effect=KeyboardInterrupt):
                words = (
                    "run",
                    self.demos,
                    "--engine mujoco --robot",
                    robot,
                    "--out",
                    self.folder / "a",
                )
                said = xreset_command(*words)[1]
            self.assertEqual("of another robot are not known" not in said, is_known, said)

    def test_training_starts_from_the_policy_that_ships(self):
        on = {"weights": "many-objects", "minutes": 7.0}
        anew = {"weights": None, "minutes": 25.0}
        own = self.folder / "mine"
        shutil.copytree(robot_folder("openarm"), own)
        for robot, options, expected in (
            ("ur7e-sharpa", {}, on),
            ("ur7e-sharpa", {"iterations": 5}, on | {"minutes": None}),
            ("ur7e-sharpa", {"weights": "none"}, anew),
            ("ur7e-sharpa", {"recipe": "any_object"}, anew),
            ("openarm", {}, {"weights": "openarm", "minutes": 7.0}),
            (own, {}, anew),
        ):
            with (
                self.subTest(robot=robot, options=options),
                patch.object(command, "file_hash", return_value="0"),
                patch.object(command, "_made_from", return_value=True),
                patch.object(command, "_step", side_effect=KeyboardInterrupt) as step,
                self.assertRaises(KeyboardInterrupt),
            ):
                out = self.folder / "out"
                xreset.run(self.demos, robot=robot, out=out, engine="mujoco", **options)
            given = step.call_args.kwargs
            self.assertEqual({name: given[name] for name in expected}, expected)

    def test_nothing_is_made_if_a_later_step_would_refuse(self):
        demos = self.demos
        out = self.folder / "out"
        for wrong in (
            "--robot nobody",
            "--recipe nothing",
            "--weights many-objects",
            "--minutes 0",
            "--engine none",
            "--engine mujoco --meshes missing",
        ):
            with patch.object(command, "perform") as performed:
                refused("run", demos, "--robot openarm", wrong, "--out", out)
            self.assertFalse(performed.called or out.exists(), wrong)
        write_demos(demos, synthesize(["soup", "spam"], 1, fps=5))
        with patch.object(command, "quick_engines") as loaded:
            said = refused("run", demos, "--robot openarm --num-envs 1 --out", out)
        self.assertIn("1 world cannot hold 2 objects", said)
        self.assertFalse(loaded.called or out.exists(), "engines take seconds to load")
        said = refused("run", demos, "--robot openarm --out", demos / "run")
        self.assertIn("cannot make the folder", said)
