"""The table of episodes, and values in files of results that are impossible."""

import json
import tempfile
import unittest
from pathlib import Path

from tests.toy_results import toy_rollouts, toy_summary
from xreset.errors import FileFormatError
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
