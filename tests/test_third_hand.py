"""A hand that nobody of this project wrote, from a package, made known by a plugin: described, retargeted, and tried in physics."""

import contextlib
import importlib
import io
import json
import sys
import tempfile
import unittest
from pathlib import Path

import numpy as np

from tests import allegro_plugin
from xreset.cli import main
from xreset.demos.archive import read_demos, write_demos
from xreset.demos.synth import synthesize
from xreset.description import load_robot as load
from xreset.geometry.kinematics import Kinematics
from xreset.plugins import robot_names
from xreset.resets.bank import read_bank
from xreset.retarget.file import read_retargeted
from xreset.robot_tools.check import check

OBJECTS = ["005_tomato_soup_can", "010_potted_meat_can"]


def run(*arguments: str) -> str:
    """What a command prints."""
    with contextlib.redirect_stdout(io.StringIO()) as output:
        main(list(arguments))
    return output.getvalue()


class ThirdHandTest(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        allegro_plugin.package_urdf()  # skips
        for engine in ("mujoco", "coal"):
            try:
                importlib.import_module(engine)
            except ImportError as error:
                raise unittest.SkipTest(str(error)) from error
        cls.folder = Path(cls.enterClassContext(tempfile.TemporaryDirectory()))
        allegro_plugin.write_plugin(cls.folder / "site")
        sys.path.insert(0, str(cls.folder / "site"))
        cls.addClassCleanup(sys.path.remove, str(cls.folder / "site"))
        cls.addClassCleanup(sys.modules.pop, "allegro_plugin", None)
        importlib.invalidate_caches()
        cls.robot = load(allegro_plugin.NAME)

    def test_the_plugin_is_found_and_nothing_is_wrong_with_it(self):
        self.assertIn(allegro_plugin.NAME, robot_names())
        findings = check(allegro_plugin.NAME)
        self.assertEqual([f for f in findings if f.level in ("warning", "error")], [])

    def test_demonstrations_become_states_that_physics_accepts(self):
        files = {name: str(self.folder / f"{name}.npz") for name in ("demos", "retargeted", "resets")}
        write_demos(files["demos"], synthesize(OBJECTS, per_object=1, seed=0))
        said = run("retarget", files["demos"], "--robot", allegro_plugin.NAME, "--out", files["retargeted"])
        self.assertIn("retargeted to allegro", said)
        trajectories = read_retargeted(files["retargeted"])
        annotated = read_demos(files["demos"]).hand_valid
        self.assertGreater(trajectories.valid.sum(), 0.8 * annotated.sum())
        self.assertLess(trajectories.hand_error[annotated].mean(), 0.020)
        self.assertTrue((np.asarray(trajectories.joint_pos) >= Kinematics(self.robot).lower.numpy() - 1e-9).all())

        run("resets", files["retargeted"], "--out", files["resets"])
        bank = read_bank(files["resets"], robot=self.robot)
        tried = bank.num_states + len(bank.rejected_reason)
        self.assertEqual(tried, trajectories.valid.sum())
        self.assertGreater(bank.num_states, 0.5 * tried)
        self.assertGreater(bank.post_contact.sum(), 0.5 * (trajectories.valid & trajectories.post_contact).sum())
        rows = json.loads((self.folder / "resets.accounts.json").read_text())["rows"]
        self.assertEqual(rows[-1]["kept"], bank.num_states)


if __name__ == "__main__":
    unittest.main()
