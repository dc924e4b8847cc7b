"""The page of the engines: what it says of given results."""

import copy
import json
from pathlib import Path
from typing import Any

from tests.data import InFolder, refuses
from xreset.backends.conformance import SCHEMA
from xreset.errors import FileFormatError, XResetError
from xreset.eval.engines.page import page, read

STORED = Path(__file__).with_name("engines")
CONFORMANCE: dict[str, Any] = json.loads((STORED / "conformance.json").read_text())


class PageTest(InFolder):
    def page_of(self, *files):
        paths = [self.folder / f"{i}.json" for i in range(len(files))]
        for path, data in zip(paths, files, strict=True):
            path.write_text(json.dumps(data))
        return page(read(paths))

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
        self.assertEqual(
            page(read([STORED / "conformance.json"])), (STORED / "page.md").read_text()
        )

    def test_devices_of_an_engine_are_neighbouring_columns(self):
        slower = self.changed(engine="mujoco-warp", device="cuda", capabilities=["friction"])
        [fall] = [check for check in slower["runs"][0]["checks"] if check["check"] == "free_fall"]
        for measure in fall["measures"]:
            measure["measured"] = 0.5 * measure["tolerance"]
        text = self.page_of(
            CONFORMANCE, self.changed(engine="mujoco-warp"), self.changed(engine="sapien"), slower
        )
        version = CONFORMANCE["runs"][0]["engine_version"]
        columns = f"mujoco {version} | mujoco-warp {version} | mujoco-warp {version}, cuda | sapien {version} |"
        self.assertIn(f"| check | what must hold | {columns}", text)
        self.assertEqual(
            [cell == "0.50" for cell in self.row(text, "`free_fall`")[2:]],
            [False, False, True, False],
        )
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
        checks["mimic_joints"] |= {
            "verdict": "unsupported",
            "problem": "it has | none",
            "measures": [],
        }
        text = self.page_of(data)
        self.assertEqual(self.row(text, "`free_fall`")[-1], "**failed, inf**")
        self.assertEqual(self.row(text, "`mimic_joints`")[-1], "none")
        self.assertIn(r"| unsupported | it has \| none |", text)
        self.assertTrue(self.row(text, "`slope`")[-1].startswith("known, "))
        [known, *_] = [m for m in checks["slope"]["measures"] if m["verdict"] == "known difference"]
        self.assertIn(known["reason"], text)

    def test_wrong_files(self):
        for data, message in (
            ({"schema": "xreset-eval/1"}, "xreset-eval/1.*expected '" + SCHEMA),
            ({"schema": SCHEMA, "runs": [{}]}, "not a complete " + SCHEMA),
        ):
            with refuses(self, message, FileFormatError):
                self.page_of(data)
        self.assertRaisesRegex(XResetError, "nothing to make a page of", self.page_of)
