"""What works without torch: playing, exporting a policy that ships, pictures and pages of files, and reports."""

import subprocess
import sys

from tests.data import InFolder
from tests.toy_results import toy_result
from xreset.eval.results import write_result
from xreset.policy.shipped import shipped_graphs

BLOCKED = """
import sys

class NoTorch:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("torch", "tensordict"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, NoTorch())
"""
PLAY = """
import numpy as np
from xreset.eval.play.record import write_film
from xreset.eval.play.session import Session

session = Session("many-objects", object_name="mustard")
moment = session.step()
session.move_goal(moment.goal_pos + [0.05, 0.0, 0.0], moment.goal_quat)
session.grab("wrist_2_link", [0.4, 0.1, 0.5])
session.pull([0.4, 0.2, 0.5])
session.step()
session.release()
session.choose_object("soup")
for _ in range(120):
    moment = session.step()
print(moment.distance)
session.take_away()
session.step()
session.begin(keep_goal=True)
session.choose_policy("zero", robot="openarm")
for _ in range(3):
    still = session.step()
assert np.ptp([m.joint_target for m in session.history], axis=0).max() == 0
write_film("play.mp4", session, seconds=0.1)
"""
CAMERA = """
from xreset.errors import PolicyError
from xreset.eval.play.session import Session
try:
    Session("many-objects-camera")
except PolicyError as error:
    print("refused:", error)
"""


class WithoutTorchTest(InFolder):
    def run_blocked(self, code):
        """Run code in a process that finds no torch; returns what it prints."""
        done = subprocess.run(
            [sys.executable, "-c", BLOCKED + code], cwd=self.folder, capture_output=True, text=True
        )
        self.assertEqual(done.returncode, 0, done.stderr[-3000:])
        return done.stdout

    def test_a_policy_plays(self):
        distance = float(self.run_blocked(PLAY))
        self.assertLess(distance, 0.03)
        self.assertTrue((self.folder / "play.mp4").stat().st_size)

    def test_commands_list_export_view_and_report(self):
        write_result(self.folder / "run" / "eval", toy_result(), [], ("a",))
        names = shipped_graphs()
        commands = (
            "policies",
            *map("export deploy {0} --out on_robot/{0} --object soup".format, names),
            "demos synth --objects soup --per-object 1 --out demos.npz",
            "view demos.npz --out demos.png",
            "report run --out page",
        )
        calls = "".join(f"main({command.split()!r})\n" for command in commands)
        found = self.run_blocked(f"from xreset.cli import main\n{calls}{CAMERA}")
        self.assertIn("many-objects-camera: ", found)
        self.assertRegex(found, "refused: .*has cameras")
        for name in names:
            self.assertTrue((self.folder / "on_robot" / name / "policy.onnx").exists(), name)
        self.assertIn("page: page", found)
        self.assertTrue((self.folder / "page" / "index.html").exists())

    def test_wrong_names_are_refused(self):
        """Before torch loads, which takes seconds."""
        refusals = {
            "run x.npz --out run --robot none": "Unknown robot 'none'",
            "run x.npz --out run --robot openarm --engine mujoco --engine none": "engine 'none'",
            "train --resets x.npz --out run --robot none": "Unknown robot 'none'",
            "train --resets x.npz --out run --engine none": "Unknown engine 'none'",
            "train --resets x.npz --out run --recipe none": "no recipe, file, run folder or",
            "eval zero --demos x.npz --robot none": "Unknown robot 'none'",
            "eval zero --demos x.npz --engine none": "Unknown engine 'none'",
            "engines check --engine none": "Unknown engine 'none'",
        }
        code = "from xreset.cli import main\nsys.stderr = sys.stdout\n"
        for command in refusals:
            code += f"try: main({command.split()!r})\nexcept SystemExit: pass\n"
        said = self.run_blocked(code).splitlines()
        for refusal, line in zip(refusals.values(), said, strict=True):
            self.assertIn(refusal, line)
