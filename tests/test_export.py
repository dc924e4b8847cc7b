"""Episodes for others: a LeRobot data set, which that package reads back, and plain arrays."""

import json
from contextlib import chdir
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from unittest import skipUnless

import numpy as np
import pyarrow.parquet as parquet
from numpy.testing import assert_allclose, assert_array_equal

import xreset
from tests.command import succeeds
from tests.data import refuses
from tests.toy_results import InFolder, toy_rollouts
from xreset.errors import FileFormatError, RunError, XResetError
from xreset.eval.export.lerobot import write_lerobot
from xreset.eval.export.recorded import read_recorded, write_arrays
from xreset.eval.report.read import read_training, without_results
from xreset.files.storage import file_hash
from xreset.geometry.description import load_robot


class Case(InFolder):
    robot = load_robot("ur7e-sharpa")

    def evaluate(self, name="", change=lambda rollouts: rollouts):
        rollouts = change(toy_rollouts(self.robot.home))
        about = {"joints": self.robot.joint_names, "robot": "ur7e-sharpa"}
        return self.write_results(name, rollouts, ("mujoco", "sapien"), **about)

    def change_first(self, **changes):
        return lambda rollouts: replace(
            rollouts, traces=(replace(rollouts.traces[0], **changes), *rollouts.traces[1:])
        )


class Episodes(Case):
    def test_the_action_is_the_last_target_before_the_next_frame(self):
        recording = read_recorded([self.evaluate()])
        self.assertEqual(recording.fps, 20.0)
        self.assertEqual(
            list(recording.episodes["engine"]), ["mujoco", "mujoco", "sapien", "sapien"]
        )
        assert_array_equal(recording.offsets, [0, 5, 10, 15, 20])
        steps = (recording.episodes["action"][0] - recording.robot.home)[:, 0] / 0.01
        assert_allclose(steps, [2, 5, 8, 11, 11], atol=1e-4)  # 12 control steps between 5 states
        self.assertEqual(
            recording.episodes["task"][0],
            "Grasp the tomato soup can and bring it to the goal pose.",
        )
        self.assertEqual(list(recording.episodes["repetition"]), [0] * 4)
        self.assertEqual(list(recording.episodes["least_distance"]), [0.01, 0.1] * 2)

    def test_python_reads_the_arrays_of_each_episode(self):
        folder = self.evaluate()
        table = read_training(folder).recorded()
        self.assertEqual(list(table["engine"]), ["mujoco"] * 2 + ["sapien"] * 2)
        made = toy_rollouts(self.robot.home).traces
        for read, trace in zip(table["trace"], made * 2, strict=True):
            assert_allclose(read.object_pos, trace.object_pos)
            assert_array_equal(read.joint_pos.shape, (5, len(self.robot.joints)))
            self.assertIn("object_pos=array[5, 3]", repr(read))
        with self.assertRaisesRegex(
            FileFormatError, "is a trace of other joints than .*joint_names"
        ):
            read_training(folder).recorded("openarm")
        with self.assertRaisesRegex(RunError, "no evaluation results. Make them first"):
            replace(read_training(folder), results={}).recorded()

    def test_recorded_arrays_need_no_description_of_the_robot(self):
        folder = self.evaluate()
        training = read_training(folder)
        results = {name: replace(result, robot="mine") for name, result in training.results.items()}
        table = replace(training, results=results).recorded()
        assert_array_equal(table["trace"][0].joint_pos.shape, (5, len(self.robot.joints)))

    def test_a_training_is_found_by_what_names_it(self):
        results = self.evaluate("runs/many-objects")
        self.assertEqual(len(read_training(self.folder, results=str(results / "eval")).results), 2)
        with chdir(self.folder):  # as xreset eval many-objects writes them
            self.assertEqual(len(read_training("many-objects").results), 2)
        file = self.folder / "a.txt"
        file.write_text("")
        with self.assertRaisesRegex(RunError, "a.txt is not a folder. Give a run folder"):
            read_training(file)
        empty = self.folder / "run"
        (empty / "eval").mkdir(parents=True)
        (empty / "run.json").write_text("{}")
        with self.assertRaisesRegex(RunError, f"Make them first: xreset eval {empty} --demos"):
            raise without_results(empty / "eval")

    def test_only_some_engines_of_several_folders(self):
        folders = [self.evaluate("a"), self.evaluate("b")]
        self.assertEqual(len(read_recorded(folders, engines=["sapien"]).episodes), 4)

    def test_an_episode_whose_engine_broke_down_is_left_out(self):
        broken = toy_rollouts(self.robot.home).traces[0].object_pos.copy()
        broken[3:] = np.nan
        with self.assertLogs("xreset.eval.export.recorded", "WARNING") as log:
            recording = read_recorded(
                [self.evaluate(change=self.change_first(object_pos=broken))], engines=["mujoco"]
            )
        self.assertIn("demonstration 0 is left out", log.output[0])
        self.assertEqual(list(map(len, recording.episodes["action"])), [5])

    def test_a_task_with_an_unknown_placeholder_is_refused(self):
        folder = self.evaluate()
        out = self.folder / "set"
        for task, words in (
            ("Bring {obj}.", r"Unknown placeholder '\{obj\}' in the task 'Bring .*\{object\}, the"),
            ("Bring {}.", r"Unknown placeholder '\{\}'"),
            ("Bring {object", r"Unknown placeholder '\{object'"),
            ("", "The task is empty"),
        ):
            with refuses(self, words, RunError):
                xreset.export_episodes(folder, out, task=task)
        self.assertFalse(out.exists())

    def test_refusals(self):
        def changed(name, **changes):
            return self.evaluate(
                name,
                change=lambda r: replace(r, traces=tuple(replace(t, **changes) for t in r.traces)),
            )

        slow = 2 * toy_rollouts().traces[0].time
        for folders, error, words in (
            ([changed("without", joint_target=None)], FileFormatError, "without the actions"),
            (
                [self.evaluate(), changed("slower", time=slow)],
                RunError,
                "different rates.*20 in.*10 in",
            ),
            ([self.folder / "nowhere"], RunError, "The folder .*nowhere does not exist"),
            ([self.folder, self.folder / "eval"], RunError, "eval are given twice"),
        ):
            with refuses(self, words, error):
                read_recorded(folders)
        with self.assertRaisesRegex(RunError, "no recorded episodes of pybullet"):
            read_recorded([self.evaluate()], engines=["pybullet"])
        stray = self.evaluate("stray", change=self.change_first(sequence=1_000_000))
        with self.assertRaisesRegex(
            FileFormatError, "a trace of demonstration 1000000, but no episode of it"
        ):
            read_recorded([stray])


class Arrays(Case):
    def test_every_array_of_the_documentation(self):
        recording = read_recorded([self.evaluate()])
        write_arrays(f"{self.folder}/out.npz", recording)
        with np.load(f"{self.folder}/out.npz") as file:
            arrays = dict(file)
        page = (Path(__file__).parents[1] / "docs/rollouts.md").read_text().split("## npz")[1]
        documented = set()
        for line in page.splitlines():
            if line.startswith("| `"):
                documented.update(line.split("|")[1].split("`")[1::2])
        self.assertEqual(documented, set(arrays))
        self.assertEqual(str(arrays["schema"]), "xreset-rollouts/1")
        self.assertIn(file_hash(f"{self.folder}/eval/sapien.trace.npz"), str(arrays["meta"]))
        self.assertEqual(arrays["joint_pos"].shape, (20, len(self.robot.joints)))
        assert_allclose(
            arrays["object_pos"][5:10], recording.episodes["trace"][1].object_pos, atol=1e-7
        )
        self.assertEqual(arrays["engine"].tolist(), ["mujoco", "mujoco", "sapien", "sapien"])
        self.assertEqual(arrays["success"].tolist(), [True, False, True, False])

    def test_the_command_takes_engines_and_words(self):
        out = self.folder / "out.npz"
        options = ("--engine sapien --task 'Lift the {object}.' --out", out)
        self.assertIn(
            "2 episodes of ur7e-sharpa", succeeds("export episodes", self.evaluate(), *options)
        )
        with np.load(out) as file:
            self.assertEqual(file["engine"].tolist(), ["sapien", "sapien"])
            self.assertEqual(file["task"][0], "Lift the tomato soup can.")
        again = self.folder / "again.npz"
        xreset.export_episodes(str(self.folder), again, engine="sapien", task="Lift the {object}.")
        self.assertEqual(again.read_bytes(), out.read_bytes())
        words = f"^{self.folder}: there are no recorded episodes of not-sapien. Make"
        with self.assertRaisesRegex(RunError, words):
            xreset.export_episodes(str(self.folder), again, engine="not-sapien")
        with self.assertRaisesRegex(XResetError, "again.npz cannot hold films of cameras"):
            xreset.export_episodes(str(self.folder), again, cameras=["front"])


class LeRobot(Case):
    def films(self, **options):
        """The episodes of one engine, and a data set with small films of them."""
        recording = read_recorded([self.evaluate()], engines=["sapien"])
        root = self.folder / "set"
        write_lerobot(root, recording, size=(64, 48), **options)
        return recording, root

    def test_meta_agrees_with_the_data(self):
        folder = self.evaluate()
        recording = read_recorded([folder])
        root = self.folder / "set"
        done = []
        xreset.export_episodes(folder, root, video=False, progress=lambda *n: done.append(n))
        self.assertEqual(done, [(1, 4), (2, 4), (3, 4), (4, 4)])
        info = json.loads((root / "meta/info.json").read_text())
        self.assertEqual(
            (info["codebase_version"], info["fps"], info["total_frames"]), ("v3.0", 20, 20)
        )
        data = parquet.read_table(
            root / info["data_path"].format(chunk_index=0, file_index=0)
        ).to_pydict()
        self.assertEqual(set(data), set(info["features"]))
        self.assertEqual(data["index"], list(range(20)))
        assert_allclose(data["action"][5], recording.episodes["action"][1][0], rtol=1e-6)
        assert_allclose(
            data["observation.environment_state"][19][7:], [0.5, 0.35, 0.15, 1, 0, 0, 0], rtol=1e-6
        )
        stats = json.loads((root / "meta/stats.json").read_text())
        assert_allclose(stats["action"]["mean"], np.mean(data["action"], axis=0), rtol=1e-6)
        episodes = parquet.read_table(root / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
        self.assertEqual(
            [(e["dataset_from_index"], e["dataset_to_index"]) for e in episodes],
            [(0, 5), (5, 10), (10, 15), (15, 20)],
        )
        self.assertEqual(
            [(e["engine"], e["success"]) for e in episodes][1:3],
            [("mujoco", False), ("sapien", True)],
        )
        self.assertEqual([p.name for p in self.folder.iterdir() if p.name.startswith(".")], [])

    def test_refuses_without_a_trace(self):
        recording = read_recorded([self.evaluate()])
        for words, options in (
            ("is there already", {"folder": self.folder / "eval"}),
            ("must be even", {"size": (321, 240)}),
            ("Unknown camera 'rear'", {"cameras": ("rear",)}),
            (
                "'side' is given twice. Give each camera once",
                {"cameras": ("side", "front", "side")},
            ),
            ("wanted and not wanted", {"cameras": ("front",), "video": False}),
        ):
            with refuses(self, words, XResetError):
                write_lerobot(options.pop("folder", self.folder / "set"), recording, **options)
        lost = replace(
            recording, episodes=recording.episodes.assign(meshes=self.folder / "nowhere")
        )
        self.assertRaisesRegex(XResetError, "no folder", write_lerobot, self.folder / "set", lost)
        self.assertEqual([p.name for p in self.folder.iterdir()], ["eval"])

    def test_films_of_depth_cameras(self):
        _, root = self.films(cameras=("side",))
        films = sorted(path.parts[-3] for path in root.rglob("*.mp4"))
        self.assertEqual(
            films, ["observation.images.depth_side"] * 2 + ["observation.images.front"] * 2
        )
        stats = json.loads((root / "meta/stats.json").read_text())["observation.images.depth_side"]
        self.assertLess(stats["min"][0][0][0], 0.05)  # beyond the table
        self.assertGreater(stats["max"][0][0][0], 0.4)  # the table

    @skipUnless(find_spec("lerobot"), "the package lerobot is not installed")
    def test_the_package_reads_it_back(self):
        from lerobot.datasets.lerobot_dataset import LeRobotDataset  # pyright: ignore[reportMissingImports]

        recording, root = self.films()
        found = LeRobotDataset(
            "xreset/test", root=root, delta_timestamps={"action": [0.0, 0.05]}, video_backend="pyav"
        )
        self.assertEqual((found.num_episodes, found.num_frames, found.fps), (2, 10, 20))
        item = found[8]
        trace = recording.episodes["trace"][1]
        action = recording.episodes["action"][1]
        assert_allclose(item["observation.state"], trace.joint_pos[3], atol=1e-6)
        assert_allclose(item["action"], action[3:5], atol=1e-6)
        assert_allclose(item["observation.environment_state"][:3], trace.object_pos[3], atol=1e-6)
        self.assertEqual((item["task"], item["engine"]), (recording.episodes["task"][1], "sapien"))
        self.assertEqual(tuple(item["observation.images.front"].shape), (3, 48, 64))
        self.assertEqual(set(found.meta.stats), set(found.meta.features) - {"engine"})
