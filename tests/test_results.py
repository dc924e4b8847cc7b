"""The table of episodes, and values in files of results that are impossible."""

import json

import numpy as np

from tests.data import InFolder
from tests.toy_results import toy_rollouts, toy_summary
from xreset.errors import FileFormatError
from xreset.eval.report.groups import estimate
from xreset.eval.results import read_evaluation, write_results
from xreset.files import write_json
from xreset.learning.clock import read_lift


class ResultsTest(InFolder):
    def setUp(self):
        super().setUp()
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
            (first["policy"], first["robot"], first["seed"], first["sequence_name"]),
            ("zero", "toy", 3, "demo_0"),
        )
        for expected in ("mujoco", "sapien", "49.8%", "episodes: 4, demonstrations: 2, seed: 3"):
            self.assertIn(expected, str(evaluation))

    def test_an_earlier_version_did_not_measure_the_published_success(self):
        """Its files load and say so; the rest of the table is as it was, also next to results of today."""
        today = read_evaluation(self.folder)
        self.assertEqual(today.to_frame()["published_success"].dtype, bool)
        self.assertRegex(str(today), r"published success *│ *25.0% │ *25.0%")
        for file, fields in (
            ("mujoco.json", ("published_success_rate", "published_success_ci95", "least_distance")),
            (
                "mujoco.episodes.json",
                ("published_success", "least_distance", "final_distance", "final_angle"),
            ),
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
        self.assertEqual(
            table.groupby("engine")["least_distance"].count().to_dict(), {"mujoco": 0, "sapien": 4}
        )
        for engine, expected in (("mujoco", np.nan), ("sapien", 0.0775)):
            found, low, _ = estimate(table[table["engine"] == engine], "least_distance")
            np.testing.assert_allclose(found, expected)
            self.assertEqual(np.isnan(low), np.isnan(expected))

    def test_impossible_values_are_refused(self):
        episode = json.loads((self.folder / "mujoco.episodes.json").read_text())["episodes"][0]
        passing = {"share": 0.1, "iteration": 3, "env_steps": 30, "minutes": 0.5}
        lift = {
            "schema": "xreset-lift/1",
            "passed": [passing],
            "iteration": 9,
            "env_steps": 90,
            "minutes": 1.5,
        }
        for change in ({"task_progress": 1e308}, {"reorientation_progress": -7}, {"sequence": -1}):
            content = {"schema": "xreset-episodes/1", "episodes": [episode | change] * 4}
            self.refuse("mujoco.episodes.json", content, read_evaluation)
        for change in (
            {"minutes": 1e300},
            {"iteration": -5},
            {"passed": [passing | {"share": 1e308}]},
        ):
            self.refuse("lift.json", lift | change, read_lift)

    def refuse(self, name, content, read):
        write_json(self.folder / name, content)
        with self.subTest(content), self.assertRaisesRegex(FileFormatError, "is .*, expected a"):
            read(self.folder)
