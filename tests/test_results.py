"""The table of episodes, and values in files of results that are impossible."""

import json
import tempfile
import unittest
from pathlib import Path

from tests.toy_results import toy_rollouts, toy_summary
from xreset.errors import FileFormatError
from xreset.eval.report.groups import score
from xreset.eval.results import read_evaluation, write_results
from xreset.files import write_json
from xreset.learning.choice import read_choice
from xreset.learning.clock import read_lift


class ResultsTest(unittest.TestCase):
    def setUp(self):
        self.folder = Path(self.enterContext(tempfile.TemporaryDirectory()))
        for engine in ("mujoco", "sapien"):
            write_results(self.folder, toy_summary(engine), toy_rollouts(), ("a", "b", "c"))

    def test_one_row_an_episode(self):
        evaluation = read_evaluation(self.folder)
        table = evaluation.to_frame()
        self.assertEqual(len(table), 8)
        self.assertEqual(
            table.groupby("engine")["task_progress"].mean().round(6).to_dict(),
            dict.fromkeys(("mujoco", "sapien"), 0.4975),
        )
        first = table.iloc[0].to_dict()
        self.assertEqual(
            (first["policy"], first["robot"], first["seed"], first["sequence_name"]), ("zero", "toy", 3, "demo_0")
        )
        for expected in ("mujoco", "sapien", "49.8%", "4 episodes of 2 demonstrations, seed 3"):
            self.assertIn(expected, str(evaluation))

    def test_an_earlier_version_did_not_measure_the_published_success(self):
        """Its files load and say so; the rest of the table is as it was, also next to results of today."""
        today = read_evaluation(self.folder)
        self.assertEqual(today.to_frame()["published_success"].dtype, bool)
        self.assertRegex(str(today), r"published success *│ *25.0% │ *25.0%")
        for file, fields in (
            ("mujoco.json", ("published_success_rate", "published_success_ci95", "least_distance")),
            ("mujoco.episodes.json", ("published_success", "least_distance", "final_distance", "final_angle")),
        ):
            content = json.loads((self.folder / file).read_text())
            rows = content["episodes"] if "episodes" in file else content["per_demo"]
            for entry in (content, *rows):
                for name in fields:
                    entry.pop(name, None)
            (self.folder / file).write_text(json.dumps(content))
        evaluation = read_evaluation(self.folder)
        self.assertRegex(str(evaluation), r"published success *│ *missing │ *25.0%")
        self.assertRegex(str(evaluation), r"task progress *│ *49.8% │ *49.8%")
        table = evaluation.to_frame()
        self.assertEqual(table.groupby("engine")["least_distance"].count().to_dict(), {"mujoco": 0, "sapien": 4})
        found = {engine: score(own) for engine, own in table.groupby("engine")}
        self.assertEqual((found["mujoco"]["published_success"], found["sapien"]["published_success"]), (None, 0.25))
        self.assertIsNone(found["mujoco"]["least_distance"])
        self.assertAlmostEqual(found["sapien"]["least_distance"], 0.0775)

    def test_nothing_was_evaluated(self):
        evaluation = read_evaluation(self.folder / "empty")
        self.assertEqual((len(evaluation), len(evaluation.to_frame()), str(evaluation)), (0, 0, "no results"))

    def test_impossible_episodes_are_refused(self):
        file = self.folder / "mujoco.episodes.json"
        content = json.loads(file.read_text())
        for name, value in (
            ("task_progress", 1e308),
            ("reorientation_progress", -7),
            ("sequence", -1),
            ("repetition", -1),
            ("least_distance", 1e308),
        ):
            changed = [content["episodes"][0] | {name: value}, *content["episodes"][1:]]
            file.write_text(json.dumps(content | {"episodes": changed}))
            with self.subTest(name), self.assertRaisesRegex(FileFormatError, rf"episodes\[0\]\.{name} is .*, expected"):
                read_evaluation(self.folder)

    def test_impossible_passings_are_refused(self):
        passing = {"share": 0.1, "iteration": 3, "env_steps": 30, "minutes": 0.5}
        lift = {"schema": "xreset-lift/1", "passed": [passing], "iteration": 9, "env_steps": 90, "minutes": 1.5}
        for changes in (
            {"minutes": -1e300},
            {"minutes": 1e300},
            {"success_from_home": 77},
            {"iteration": -5},
            {"passed": [passing | {"share": 1e308}]},
        ):
            write_json(self.folder / "lift.json", lift | changes)
            with self.subTest(changes), self.assertRaisesRegex(FileFormatError, "expected a"):
                read_lift(self.folder)

    def test_a_candidate_without_a_score_is_refused(self):
        choice = {
            "schema": "xreset-choice/1",
            "chosen": "1.pt",
            "policy_hash": "ab",
            "candidates": [{"name": "1.pt", "task_progress": {}}],
            "engines": {},
            "seed": 0,
            "episodes_per_demo": 1,
            "demos": "cd",
        }
        write_json(self.folder / "choice.json", choice)
        with self.assertRaisesRegex(FileFormatError, "task_progress is {}, expected an engine"):
            read_choice(self.folder)


if __name__ == "__main__":
    unittest.main()
