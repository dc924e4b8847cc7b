"""The page of the engines: what it says of given results."""

import copy
import json
from pathlib import Path
from typing import Any
from unittest import TestCase

from xreset.eval.engines.page import page
from xreset.files.records import _kind_of

STORED = Path(__file__).with_name("engines")
CONFORMANCE: dict[str, Any] = json.loads((STORED / "conformance.json").read_text())


class PageTest(TestCase):
    def changed(self, **run):
        """The stored results of another engine, device or robot."""
        data = copy.deepcopy(CONFORMANCE)
        data["runs"][0] |= run
        return data

    def row(self, text, start):
        """Cells of the first line of a table that begins so."""
        line = next(line for line in text.splitlines() if line.startswith(f"| {start}"))
        return [cell.strip() for cell in line.strip("|").split(" | ")]

    def test_it_is_the_stored_page(self):
        stored = STORED / "page.md"
        self.assertEqual(page(CONFORMANCE), stored.read_text())
        self.assertEqual(_kind_of(stored), "xreset-engines")  # so that another one replaces it

    def test_each_engine_is_a_column(self):
        slower = self.changed(engine="mujoco-warp", device="cuda", capabilities=["friction"])
        [fall] = [check for check in slower["runs"][0]["checks"] if check["check"] == "free_fall"]
        for measure in fall["measures"]:
            measure["measured"] = 0.5 * measure["tolerance"]
        runs = CONFORMANCE["runs"] + slower["runs"] + self.changed(engine="sapien")["runs"]
        text = page(CONFORMANCE | {"runs": runs})
        version = CONFORMANCE["runs"][0]["engine_version"]
        columns = f"mujoco {version} | mujoco-warp {version}, cuda | sapien {version} |"
        self.assertIn(f"| check | what must hold | {columns}", text)
        self.assertEqual(
            [cell == "0.50" for cell in self.row(text, "`free_fall`")[2:]], [False, True, False]
        )
        self.assertEqual(self.row(text, "object mass"), ["object mass", "yes", "no", "yes"])

    def test_without_an_engine_there_is_no_table_of_checks(self):
        self.assertNotIn("what must hold |", page(CONFORMANCE | {"runs": []}))

    def test_verdicts(self):
        data = self.changed()
        checks = {check["check"]: check for check in data["runs"][0]["checks"]}
        checks["free_fall"] |= {"verdict": "failed"}
        checks["free_fall"]["measures"][0] |= {"measured": "nan", "verdict": "failed"}
        checks["mimic_joints"] |= {
            "verdict": "unsupported",
            "problem": "it has | none",
            "measures": [],
        }
        text = page(data)
        self.assertEqual(self.row(text, "`free_fall`")[-1], "**failed, inf**")
        self.assertEqual(self.row(text, "`mimic_joints`")[-1], "none")
        self.assertIn(r"| unsupported | it has \| none |", text)
        self.assertTrue(self.row(text, "`slope`")[-1].startswith("known, "))
        [known, *_] = [m for m in checks["slope"]["measures"] if m["verdict"] == "known difference"]
        self.assertIn(known["reason"], text)
