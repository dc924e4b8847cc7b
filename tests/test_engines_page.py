"""The support matrix: what the page says of given results, and the page in docs/."""

from __future__ import annotations

import contextlib
import copy
import io
import json
import tempfile
import unittest
from pathlib import Path
from typing import Any

from xreset.backends.conformance import SCHEMA
from xreset.cli import main
from xreset.errors import FileFormatError, XResetError
from xreset.eval.engines.agreement import SCHEMA as PARITY
from xreset.eval.engines.page import page, read

STORED = Path(__file__).with_name("engines")
CONFORMANCE: dict[str, Any] = json.loads((STORED / "conformance.json").read_text())

GRASPS: dict[str, Any] = {
    "schema": PARITY,
    "xreset_version": "0.1.0",
    "command": "xreset engines compare retargeted.npz --backend sapien",
    "robot": "ur7e-sharpa",
    "objects": [{"name": "005_tomato_soup_can", "source": "stand-in"}],
    "reference": {"backend": "mujoco", "version": "4.0.0", "device": "cpu", "metrics": []},
    "floor": {"backend": "mujoco at half the timestep", "version": "4.0.0", "device": "cpu", "metrics": []},
    "engines": [
        {
            "backend": "sapien",
            "version": "3.0.3",
            "device": "cpu",
            "metrics": [
                {"metric": "press, total", "claim": "total force", "unit": "", "target": 0.1, "sense": "at most",
                 "measured": 0.05, "n": 12, "verdict": "met"},
                {"metric": "closing, outcome", "claim": "same outcome", "unit": "", "target": 0.8, "sense": "at least",
                 "measured": None, "n": 0, "verdict": "missed"},
            ],
        }
    ],
    "grasps": {"closing": [{}] * 12, "hold": [{}] * 24},
}  # fmt: skip


class PageTest(unittest.TestCase):
    def setUp(self):
        self.folder = Path(self.enterContext(tempfile.TemporaryDirectory()))

    def page_of(self, *files: dict[str, Any]) -> str:
        paths = [self.folder / f"{i}.json" for i in range(len(files))]
        for path, data in zip(paths, files, strict=True):
            path.write_text(json.dumps(data))
        return page(read(paths))

    def changed(self, **run: Any) -> dict[str, Any]:
        """The stored results of another engine, device or robot."""
        data = copy.deepcopy(CONFORMANCE)
        data["runs"][0] |= run
        return data

    def row(self, text: str, start: str) -> list[str]:
        """Cells of the first line of a table that begins so."""
        line = next(line for line in text.splitlines() if line.startswith(f"| {start}"))
        return [cell.strip() for cell in line.strip("|").split(" | ")]

    def test_the_command_makes_the_stored_page(self):
        out = self.folder / "engines.md"
        with contextlib.redirect_stdout(io.StringIO()):
            main(["engines", "page", "--from", str(STORED / "conformance.json"), "--out", str(out)])
        self.assertEqual(out.read_text(), (STORED / "page.md").read_text())

    def test_every_number_is_on_the_page(self):
        text = self.page_of(CONFORMANCE)
        for run in CONFORMANCE["runs"]:
            self.assertIn(f"{run['engine']} {run['engine_version']} with {run['robot']} on {run['device']}", text)
            for check in run["checks"]:
                self.assertIn(check["statement"], text)
                for measure in check["measures"]:
                    self.assertIn(f"| `{check['check']}` | {measure['what']} |", text)
        self.assertIn(CONFORMANCE["command"], text)

    def test_engines_and_devices_stand_side_by_side(self):
        text = self.page_of(CONFORMANCE, self.changed(engine="mujoco-warp", device="cuda", capabilities=["friction"]))
        version = CONFORMANCE["runs"][0]["engine_version"]
        self.assertIn(f"| check | what must hold | mujoco {version} | mujoco-warp {version}, cuda |", text)
        self.assertEqual(self.row(text, "object mass"), ["object mass", "yes", "no"])

    def test_devices_of_an_engine_stand_side_by_side_whatever_the_order_of_the_files(self):
        slower = self.changed(engine="mujoco-warp", device="cuda", capabilities=["friction"])
        [fall] = [check for check in slower["runs"][0]["checks"] if check["check"] == "free_fall"]
        for measure in fall["measures"]:
            measure["measured"] = 0.5 * measure["tolerance"]
        text = self.page_of(CONFORMANCE, self.changed(engine="mujoco-warp"), self.changed(engine="sapien"), slower)
        version = CONFORMANCE["runs"][0]["engine_version"]
        columns = f"mujoco {version} | mujoco-warp {version} | mujoco-warp {version}, cuda | sapien {version} |"
        self.assertIn(f"| check | what must hold | {columns}", text)
        self.assertIn(f"| check | measure | tolerance | {columns}", text)
        self.assertEqual([cell == "0.50" for cell in self.row(text, "`free_fall`")[2:]], [False, False, True, False])
        self.assertEqual(self.row(text, "object mass"), ["object mass", "yes", "yes", "no", "yes"])

    def test_robots_have_tables_of_their_own(self):
        text = self.page_of(CONFORMANCE, self.changed(robot="openarm"))
        self.assertIn("## Conformance with openarm", text)
        self.assertIn("## Conformance with conformance-gripper", text)

    def test_a_later_file_replaces_single_checks(self):
        data = self.changed()
        [again] = [check for check in data["runs"][0]["checks"] if check["check"] == "free_fall"]
        for measure in again["measures"]:
            measure["measured"] = 0.5 * measure["tolerance"]
        data["runs"][0]["checks"] = [again]
        text = self.page_of(CONFORMANCE, data)
        self.assertEqual(self.row(text, "`free_fall`")[-1], "0.50")
        self.assertIn("`slope`", text)

    def test_verdicts(self):
        data = self.changed()
        checks = {check["check"]: check for check in data["runs"][0]["checks"]}
        checks["free_fall"] |= {"verdict": "failed"}
        checks["free_fall"]["measures"][0] |= {"measured": "nan", "verdict": "failed"}
        checks["mimic_joints"] |= {"verdict": "unsupported", "problem": "it has | none", "measures": []}
        text = self.page_of(data)
        self.assertEqual(self.row(text, "`free_fall`")[-1], "**failed, inf**")
        self.assertEqual(self.row(text, "`mimic_joints`")[-1], "none")
        self.assertIn(r"| unsupported | it has \| none |", text)
        self.assertTrue(self.row(text, "`slope`")[-1].startswith("known, "))
        [known, *_] = [m for m in checks["slope"]["measures"] if m["verdict"] == "known difference"]
        self.assertIn(known["reason"], text)

    def test_grasps(self):
        text = self.page_of(CONFORMANCE, GRASPS)
        self.assertEqual(self.row(text, "total force"), ["total force", "at most 0.1", "-", "0.05 (12)"])
        self.assertEqual(
            self.row(text, "same outcome"), ["same outcome", "at least 0.8", "-", "**missed: not measured (0)**"]
        )
        self.assertIn("12 closings and 24 holds of 005_tomato_soup_can, against mujoco 4.0.0", text)
        self.assertIn(GRASPS["command"], text)

    def test_grasps_name_engine_and_device(self):
        data = copy.deepcopy(GRASPS)
        data["engines"][0] |= {"backend": "mujoco-warp", "version": "4.0.0", "device": "cuda"}
        text = self.page_of(GRASPS, data)
        self.assertIn("## Agreement on grasps: ur7e-sharpa in sapien 3.0.3\n", text)
        self.assertIn("## Agreement on grasps: ur7e-sharpa in mujoco-warp 4.0.0, cuda\n", text)
        self.assertIn("| grasps of ur7e-sharpa: mujoco-warp 4.0.0, cuda against mujoco 4.0.0 |", text)

    def test_wrong_files(self):
        for data, message in (
            ({"schema": "xreset-eval/1"}, "xreset-eval/1.*expected " + SCHEMA),
            ({"schema": SCHEMA, "runs": [{}]}, "no complete " + SCHEMA),
        ):
            with self.subTest(message), self.assertRaisesRegex(FileFormatError, message):
                self.page_of(data)
        with self.assertRaisesRegex(XResetError, "nothing to make a page of"):
            self.page_of()


if __name__ == "__main__":
    unittest.main()
