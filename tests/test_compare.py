"""Several runs in one report: what is read, what is taken together, what is unfair, and what is written."""

import re
import shutil
from dataclasses import replace
from html import unescape
from pathlib import Path
from unittest import mock

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from torch.utils.tensorboard import SummaryWriter

from tests.command import succeeds
from tests.data import refuses
from tests.toy_bank import SOUP, SPAM
from tests.toy_results import ENGINES, InFolder, rollouts_with, toy_episode, toy_rollouts
from xreset import TrainConfig
from xreset.errors import FileFormatError, RunError
from xreset.eval.metrics import METRICS
from xreset.eval.plots import COLORS
from xreset.eval.report.curves import amounts, draw_lines, line, usual_axis
from xreset.eval.report.groups import grouped, scores
from xreset.eval.report.make import collect, page
from xreset.eval.report.read import read_curves, read_training, read_trainings
from xreset.eval.results import read_evaluation
from xreset.eval.stats import (
    bootstrap_ci95,
    crossed_bootstrap_ci95,
    difference_ci95,
    difference_p,
    holm,
)
from xreset.learning.clock import Lift, write_lift
from xreset.learning.run import TEACHER, RobotData
from xreset.task.config import ResetConfig, TaskConfig, TerminationConfig

STEPS = 1024
"""Environment steps of an iteration."""
_ENDS = TerminationConfig(episode_seconds=2.5)
SHORT = TrainConfig(task=replace(TrainConfig().task, termination=_ENDS))


def reset_config(**options):
    return TrainConfig(task=TaskConfig(reset=ResetConfig(**options)))


def curves_of(seconds, success, first=1):
    """Curves of a training whose iterations took that long."""
    time = np.array(seconds)
    columns = {
        "speed/collect_seconds": 0.75 * time,
        "speed/learn_seconds": 0.25 * time,
        "speed/env_steps_per_second": STEPS / time,
        "task/success": success,
        "task/success_from_home": 0.5 * np.array(success),
    }
    return pd.DataFrame(columns, index=range(first, first + len(seconds)))


def text_of(html):
    """The text of a page, in one line; cells of tables end with a bar."""
    body = re.sub(r"(?s)<(style|script).*?</\1>", "", html)
    body = re.sub(r"</t[dh]>", " | ", body)
    return " ".join(unescape(re.sub(r"<[^>]+>", " ", body)).split())


class Compared(InFolder):
    def write_curves(self, name, curves):
        with SummaryWriter(log_dir=str(self.folder / name)) as writer:
            for tag in curves:
                for iteration, value in curves[tag].items():
                    writer.add_scalar(tag, value, iteration)
        return self.folder / name

    def training(self, name, curves=None):
        """What a folder holds, with curves that need not be written."""
        read = read_training(self.folder / name, name)
        return replace(read, curves=pd.DataFrame() if curves is None else curves)

    def run_and_results(self, name, results=None, **changes):
        self.write_run(name, **changes)
        self.write_results(name, **(results or {}))
        return name

    def compare(self, *names, **options):
        """The text of a page without curves and films, whose cells end with a bar; ``self.report`` is what it shows."""
        trainings = read_trainings([self.folder / name for name in names])
        with mock.patch("xreset.eval.report.make.draw_training", return_value=""):
            self.report = collect(trainings, **options)
        return text_of(page(self.report))

    def notes(self, *names):
        """The notes of the page, one a line."""
        self.compare(*names)
        return "\n".join(self.report.notes)


class ReadTest(Compared):
    def test_labels(self):
        a, b, odd = (str(self.write_results(name)) for name in ("a", "b", "p=0.5"))
        found = read_trainings([a, f"X-RESET, 2={b}", odd])
        self.assertEqual([training.label for training in found], ["a", "X-RESET, 2", "p=0.5"])
        self.assertEqual(read_trainings([f"{a}/eval"])[0].label, "a")

    def test_bad_arguments(self):
        a = self.write_results("a")
        other = self.write_results("other/a")
        bare = self.write_run("bare")
        without = "neither learning curves .* nor evaluation results.*xreset eval .*/bare"
        for runs, message in (
            ([], "nothing to report"),
            ([str(a), str(other)], f"(?s)both be called 'a'.*a-1={a} a-2=.*other/a"),
            ([f"={a}"], "a name is missing"),
            (["x="], "a folder is missing"),
            ([f"{self.folder}/nowhere"], "The folder .*nowhere does not exist"),
            ([str(bare)], without),
        ):
            with refuses(self, message, RunError):
                read_trainings(runs)

    def test_damaged_files(self):
        a = self.write_results("a")
        self.write_run("a")
        write_lift(a, Lift())
        for name, old, new, message in (
            (
                "run.json",
                '"lift": {',
                '"lift": 3, "other": {',
                "run.json: lift is 3, expected an object",
            ),
            ("run.json", "}", "", "run.json is not valid JSON"),
            ("run.json", '"config"', '"other"', "run.json lacks config"),
            ("eval/mujoco.json", '"policy"', '"other"', "missing: policy"),
        ):
            whole = (a / name).read_text()
            (a / name).write_text(whole.replace(old, new))
            with refuses(self, message, FileFormatError):
                read_training(a)
            (a / name).write_text(whole)
        self.assertEqual(read_training(a).label, "a")
        copy = a / "eval" / "mujoco (1).json"
        shutil.copy(a / "eval" / "mujoco.json", copy)
        words = r"mujoco \(1\).json has the results of mujoco, expected in mujoco.json"
        self.assertRaisesRegex(FileFormatError, words, read_training, a)

    def test_a_resumed_run_counts_even_if_the_clock_ran_back(self):
        first = pd.DataFrame({"task/grasped": 0.1}, index=range(1, 11))
        resumed = pd.DataFrame({"task/grasped": 0.2}, index=range(6, 13))
        a = self.write_curves("a", first)
        (file,) = a.glob("events*")
        file.rename(a / "events.out.tfevents.2000.x")
        self.write_curves("a", resumed)
        (other,) = set(a.glob("events*")) - {a / "events.out.tfevents.2000.x"}
        other.rename(a / "events.out.tfevents.1000.x")
        found = read_curves(a)["task/grasped"]
        assert_allclose(found, [0.1] * 5 + [0.2] * 7, rtol=1e-6)

    def test_iterations_that_a_resumed_run_has_not_repeated_yet_are_no_part_of_it(self):
        a = self.write_curves("a", pd.DataFrame({"task/grasped": 0.1}, index=range(1, 11)))
        self.write_curves("a", pd.DataFrame({"task/grasped": 0.2}, index=range(6, 9)))
        found = read_curves(a)["task/grasped"]
        assert_allclose(found, [0.1] * 5 + [0.2] * 3, rtol=1e-6)

    def test_event_files_that_are_not_whole(self):
        """Cut anywhere: the head is missed, what is left of a tail is read as it was."""
        curves = pd.DataFrame(
            {"task/grasped": 0.5, "task/success": np.arange(1, 5) / 8}, index=range(1, 5)
        )
        a = self.write_curves("a", curves)
        (file,) = a.glob("events*")
        whole = file.read_bytes()
        pd.testing.assert_frame_equal(
            read_curves(a), curves, check_names=False, check_index_type=False
        )
        for at in (1, 100, len(whole) - 40):
            with self.subTest(at):
                file.write_bytes(whole[at:])
                self.assertRaisesRegex(FileFormatError, "is damaged", read_curves, a)
                file.write_bytes(whole[:-at])
                for tag, values in read_curves(a).items():
                    known = values.dropna()
                    assert_array_equal(known, curves[tag][: len(known)])
        b = self.write_curves("b", curves_of((1.0,) * 40, (0.5,) * 40))
        (file,) = b.glob("events*")
        whole = file.read_bytes()
        middle = len(whole) // 2
        file.write_bytes(whole[:middle] + bytes(300) + whole[middle + 300 :])
        words = "is damaged.* up to step [0-9]+ and no farther"
        self.assertRaisesRegex(FileFormatError, words, read_curves, b)


class ProgressTest(Compared):
    def setUp(self):
        super().setUp()
        self.run_and_results("a")

    def test_minutes_and_steps_are_sums_over_iterations(self):
        training = self.training("a", curves_of((60.0, 30.0, 30.0), (0.0, 0.1, 0.2)))
        # what was not logged is as the next
        late = self.training("a", curves_of((60.0, 30.0), (0.0, 0.1), first=3))
        for run, x, expected in (
            (training, "minutes", [1.0, 1.5, 2.0]),
            (training, "steps", np.array([1, 2, 3]) * STEPS * 1e-6),
            (training, "iterations", [1, 2, 3]),
            (late, "minutes", [3.0, 3.5]),
        ):
            assert_allclose(amounts(run, x), expected)
        without = self.training("a", training.curves.drop(columns="speed/learn_seconds"))
        self.assertIsNone(amounts(without, "minutes"))
        self.assertIsNone(line([without], "task/success", "minutes"))
        self.assertEqual(usual_axis([training, late]), "minutes")
        self.assertEqual(usual_axis([training, without]), "iterations")
        self.assertIsNotNone(line([without], "task/success", "iterations"))

    def test_mean_and_band_over_what_all_have(self):
        a = self.training("a", curves_of((60.0,) * 4, (0.0, 0.2, 0.4, 0.6)))
        b = self.training("a", curves_of((120.0,) * 3, (0.2, 0.6, 0.8)))
        found = line([a, b], "task/success", "minutes")
        # the first has ended at 4 minutes, the second begins at 2
        assert_allclose(found.index, [2, 3, 4])
        assert_allclose(found[["low", "high"]].T, [[0.2, 0.4, 0.6]] * 2)
        mean = line([a, b], "task/success", "iterations")["mean"]
        assert_allclose(mean, [0.1, 0.4, 0.6], atol=1e-12)
        self.assertIsNone(line([a, b], "task/other", "minutes"))
        broken = self.training("a", curves_of((60.0,) * 2, (np.nan, np.nan)))
        for members in ([b], [b, broken]):
            found = line(members, "task/success", "minutes")
            assert_allclose(found.T, [[0.2, 0.6, 0.8]] * 3)


class GroupTest(Compared):
    def groups(self, *names):
        groups, notes = grouped([self.training(name) for name in names])
        return [(label, len(members)) for label, members in groups.items()], " ".join(notes)

    def test_trainings_that_differ_only_in_the_seed_are_one_group(self):
        seeds = []
        for i in (1, 2, 10):
            config = TrainConfig(iterations=1000 * i)
            changes = {"seed": i, "device": f"cuda:{i}", "resets": f"/{i}/b.npz", "config": config}
            seeds.append(self.run_and_results(f"soup-seed{i}", **changes))
        other = self.run_and_results("fixed", config=reset_config(random_gravity=False))
        bank = self.run_and_results("bank", seed=3, resets_hash="aa" * 32)
        self.write_results("ik")
        found = self.groups(seeds[0], other, seeds[1], bank, seeds[2], "ik")
        self.assertEqual(found, ([("soup", 3), ("fixed", 1), ("bank", 1), ("ik", 1)], ""))

    def test_trainings_with_another_teacher_or_second_bank_are_no_group(self):
        for i in range(3):
            self.run_and_results(f"student-{i}", seed=i, teacher="a/t.onnx")
            (self.folder / f"student-{i}" / TEACHER).write_text("b" if i == 2 else "a")
            second = RobotData(robot="b", resets="b.npz", resets_hash=f"{i // 2}", meshes=None)
            self.run_and_results(f"two-{i}", seed=i, others=(second,))
        for name in ("student", "two"):
            found = self.groups(*(f"{name}-{i}" for i in range(3)))
            self.assertEqual(found, ([(name, 2), (f"{name}-2", 1)], ""))

    def test_several_processes_are_another_training(self):
        for i, processes in enumerate((1, 2, 2)):
            self.run_and_results(f"p-{i}", seed=i)
            steps = 10 * TrainConfig().ppo.horizon * 64 * processes
            write_lift(self.folder / f"p-{i}", Lift(iteration=10, env_steps=steps))
        found = self.groups("p-0", "p-1", "p-2")
        self.assertEqual(found, ([("p-0", 1), ("p", 2)], ""))
        facts = self.training("p-1").facts
        self.assertEqual(facts["num_envs"], "64 in each of 2 processes")

    def test_names_of_groups(self):
        for names, expected in (
            (("X s0", "X s1"), "X"), (("run10", "run11"), "run"), (("first", "second"), "first + second"), (("seed0", "seed1"), "seed"),
        ):  # fmt: skip
            with self.subTest(expected):
                made = [self.run_and_results(name, seed=i) for i, name in enumerate(names)]
                self.assertEqual(self.groups(*made)[0], [(expected, 2)])
        names = [self.run_and_results(f"s-{i}", seed=i, num_envs=64 + i // 2) for i in range(4)]
        self.assertEqual(self.groups(*names)[0], [("s-0 + s-1", 2), ("s-2 + s-3", 2)], "told apart")

    def test_repetitions_must_have_seeds_of_their_own_and_be_evaluated_alike(self):
        self.run_and_results("a", seed=0)
        for name, results, changes, reason in (
            ("b", {}, {"seed": 0}, "Some have the same seed, too"),
            ("c", {"seed": 5}, {"seed": 1}, "not the same seed of the evaluation"),
            ("d", {"inputs": {"demos": "cd"}}, {"seed": 2}, "not the same demonstrations"),
            ("e", {"engine_version": "5.0"}, {"seed": 3}, "not the same version of mujoco"),
        ):
            self.run_and_results(name, results, **changes)
            found, notes = self.groups("a", name)
            self.assertEqual(found, [("a", 1), (name, 1)])
            words = f"a, {name} have the same configuration and are not grouped. .*{reason}"
            self.assertRegex(notes, words)

    def test_one_training_evaluated_differently_in_its_engines(self):
        self.run_and_results("a")
        inputs = {"demos": "cd", "policy": "ef"}
        self.write_results("a", engines=("pybullet",), policy="other", inputs=inputs)
        found, notes = self.groups("a")
        self.assertEqual(found, [("a", 1)])
        words = r"not the same policy \(.*not the same policy file .*not the same demonstrations"
        self.assertRegex(notes, words)
        self.assertNotIn("not grouped", notes)
        page = self.compare("a")
        self.assertEqual(page.count("not the same demonstrations"), 1)


class ScoreTest(Compared):
    def scored(self, *progress, engines=("mujoco",)):
        """The scores of trainings with other seeds, by engine."""
        trainings = []
        for i, values in enumerate(progress):
            results = {"rollouts": rollouts_with(*values), "engines": engines}
            trainings.append(self.training(self.run_and_results(f"s-{i}", results, seed=i)))
        found = scores(grouped(trainings)[0])
        return found[found["object"] == "all"].set_index(["engine", "metric"])

    def test_one_training_has_the_figures_of_its_evaluation(self):
        ours = self.scored((1.0, 0.33, 0.66, 0.0), engines=ENGINES).loc["pybullet"]
        result = self.training("s-0").results["pybullet"]
        progress = ours.loc["task_progress"]
        ci95 = result.ci95("task_progress")
        assert_allclose(progress[["low", "high"]].astype(float), ci95, atol=1e-6)
        for metric in METRICS:
            self.assertEqual(ours.loc[metric, "mean"], result.mean(metric), metric)

    def test_seeds_widen_the_interval(self):
        # one of the two seeds only is drawn in half of the resamples
        for progress, *expected in (
            (((0.4, 0.6, 0.2, 0.4), (0.4, 0.6, 0.2, 0.4)), 0.4, 0.3, 0.5),
            (((0.0, 0.2, 0.0, 0.2), (0.8, 1.0, 0.8, 1.0)), 0.5, 0.1, 0.9),
        ):
            found = self.scored(*progress).loc["mujoco", "task_progress"]
            assert_allclose(found[["mean", "low", "high"]].astype(float), expected)

    def test_the_crossed_bootstrap_has_the_variance_of_its_design(self):
        rng = default_rng(1)
        of_run = rng.normal(size=8)
        of_demo = 2 * rng.normal(size=30)
        values = (of_run[:, None] + of_demo).ravel()
        runs = np.repeat(np.arange(8), 30)
        demos = np.tile(np.arange(30), 8)
        with mock.patch("xreset.eval.stats.DRAWS", 20000):
            low, high = crossed_bootstrap_ci95(values, runs, demos)
        expected = 2 * 1.96 * np.sqrt(of_run.var() / 8 + of_demo.var() / 30)
        self.assertAlmostEqual(high - low, expected, delta=0.03 * expected)
        one_run = crossed_bootstrap_ci95(values, np.zeros(240), demos)
        self.assertEqual(one_run, bootstrap_ci95(values, demos))
        with self.assertRaisesRegex(ValueError, "every demonstration"):
            crossed_bootstrap_ci95(values[:4], np.array([0, 0, 0, 1]), np.array([0, 0, 1, 1]))

    def test_a_difference_is_of_the_same_demonstrations(self):
        rng = default_rng(0)
        hard = rng.normal(size=40)  # what is hard for one is hard for the other
        demos = np.tile(np.arange(40), 6)
        runs = np.arange(240) // 40
        both = [hard[demos] + rng.normal(scale=0.1, size=240) for _ in range(2)]
        low, high = difference_ci95([both[0], runs, demos], [both[1] + 1.0, runs, demos])
        self.assertTrue(0.95 < low < 1.0 < high < 1.05, (low, high))
        each = rng.normal(size=2)[np.arange(80) // 40]  # two seeds that differ much
        few = [hard[demos[:80]] + each, runs[:80], demos[:80]]
        low, high = difference_ci95(few, [both[1], runs, demos])
        self.assertGreater(high - low, 0.3 * abs(each[0] - each[-1]), "the seeds are drawn, too")
        one = np.zeros(40, int)
        low, high = difference_ci95([hard, one, one], [hard + rng.normal(size=40), one, one])
        self.assertGreater(high - low, 0.3, "episodes of one demonstration are drawn")
        few = [x[:3] for x in (both[0], runs, demos)]
        more = [x[:41] for x in (both[0], runs, demos)]
        self.assertRaisesRegex(ValueError, "every training needs", difference_ci95, few, more)

    @mock.patch("xreset.eval.stats.DRAWS", 600)
    def test_chance_among_many_comparisons_is_not_claimed(self):
        self.assertEqual(holm([0.01, 0.04, 0.03]), [True, False, False])
        self.assertEqual(holm([0.04, 0.001, 0.02]), [True, True, True])
        self.assertEqual(holm([]), [])
        rng = default_rng(0)
        demos = np.arange(60)
        runs = np.zeros(60, int)
        p_values = []
        for gain in (*np.zeros(200), 0.5):
            one, other = rng.normal(size=(2, 60))
            p_values.append(difference_p([one, runs, demos], [other + one + gain, runs, demos]))
        chance = np.array(p_values[:200])
        self.assertTrue(0.02 < (chance < 0.05).mean() < 0.10, (chance < 0.05).mean())
        self.assertTrue(holm(p_values[191:])[-1], "a true difference among nine that are none")
        for count, least in ((2, 0.5), (4, 0.125), (6, 2 / 64)):
            with self.subTest(f"{count} demonstrations that all became better"):
                gains = np.linspace(0.1, 0.3, count)
                alike = (np.zeros(count, int), np.arange(count))
                found = difference_p([0 * gains, *alike], [gains, *alike])
                self.assertAlmostEqual(found, least)

    def test_the_page_marks_differences_that_are_certain(self):
        def progress(gain):
            found = []
            for i, share in enumerate(np.linspace(0.2, 0.5, 12)):
                score = share + gain * (1 + i % 3)
                found.append(toy_episode(i, 0, object_name=SOUP, task_progress=score))
            return replace(toy_rollouts(), episodes=tuple(found), traces=())

        for name, gain in (("a", 0.0), ("better", 0.1), ("same", 0.0)):
            self.write_run(name, reset_config(demo_probability=0.3 + gain))
            self.write_results(name, progress(gain), inputs={"demos": "ab", "policy": name})
        self.compare("a", "better", "same")
        cells = re.findall(r'<td class="wrap">(<b>)?([^<]+)', page(self.report))
        marked = {text: bool(bold) for bold, text in cells}
        expected = {"-": False, "+20.0 (+15.0 to +25.0)": True, "+0.0 (+0.0 to +0.0)": False}
        self.assertEqual(marked, expected)

    def test_the_difference_of_two_evaluations(self):
        base = toy_rollouts()
        base = replace(base, episodes=tuple(replace(e, turn=1.0) for e in base.episodes))
        worse = [replace(e, task_progress=0.5 * e.task_progress) for e in base.episodes]
        for name, episodes, changes in (
            ("good", base.episodes, {}),
            ("bad", tuple(worse), {}),
            ("seed", base.episodes, {"seed": 4}),
            ("fewer", base.episodes[::2], {}),
            ("goals", tuple(replace(e, turn=e.turn + 0.1) for e in base.episodes), {}),
            ("frame", base.episodes, {"object_frame": "center"}),
            ("meshes", base.episodes, {"meshes": "ycb"}),
            ("same meshes", base.episodes, {"meshes": str(Path("ycb").resolve())}),
            ("sapien", base.episodes, {"engines": ("sapien",)}),
        ):
            changes = {"object_frame": "mesh"} | changes
            self.write_results(name, replace(base, episodes=episodes), **changes)
        good, bad, meshes, same = (
            read_evaluation(self.folder / name / "eval")
            for name in ("good", "bad", "meshes", "same meshes")
        )
        table = good.minus(bad).query("metric == 'task_progress'").set_index(["engine", "object"])
        self.assertEqual([*table.loc["mujoco"].index], ["all", SOUP, SPAM])
        half = [0.5 * mean for mean in (0.4975, 0.665, 0.33)]
        assert_allclose(table["mean"], half, atol=1e-5)
        row = table.loc["mujoco", "all"]
        self.assertTrue(row["low"] <= row["mean"] <= row["high"])
        self.assertTrue((bad.minus(bad).select_dtypes(float) == 0).all(axis=None))
        for name, words in (
            ("seed", "seed is 3 and 4"),
            ("fewer", "not the same demonstrations"),
            ("goals", "not the same goals"),
            ("frame", "object_frame is 'mesh' and 'center'"),
            ("meshes", "meshes is 'stand-ins' and '/.*ycb'"),
        ):
            other = read_evaluation(self.folder / name / "eval")
            with self.assertRaisesRegex(RunError, f"same episodes in mujoco: {words}"):
                good.minus(other)
        self.assertEqual(len(meshes.minus(same)), len(good.minus(bad)))
        elsewhere = read_evaluation(self.folder / "sapien" / "eval")
        self.assertRaisesRegex(RunError, "no engine in common", good.minus, elsewhere)


class FairnessTest(Compared):
    def test_results_that_are_alike_have_no_note(self):
        for name, share in (("a", 0.3), ("b", 0.6)):
            self.write_run(name, reset_config(demo_probability=share))
            self.write_results(name, inputs={"demos": "ab", "policy": name})
        text = self.compare("a", "b")
        self.assertNotIn("comparable", text)
        note = "Of 4 episodes of a in mujoco, 1 stopped being finite and 1 dropped contacts"
        self.assertIn(note, text)
        figures = self.report.scores
        found = figures[figures["metric"] == "published_success minus a"]
        self.assertEqual(found[["group", "mean", "low", "high"]].values.tolist(), [["b", 0, 0, 0]])

    def test_the_page_names_what_makes_results_incomparable(self):
        self.write_results("a", engines=("mujoco", "sapien"))
        base = toy_rollouts()
        soups = [replace(e, object="005_tomato_soup_can") for e in base.episodes]
        other = {"inputs": {"demos": "cd"}}
        both = "potted meat can, tomato soup can"
        for what, episodes, changes, expected in (
            ("seed", (), {"seed": 4}, r"seed of the evaluation \(3: a; 4: seed\)"),
            ("ycb", (), {"meshes": "/x"}, r"object meshes \(stand-ins: a; /x: ycb\)\."),
            ("new", (), {"engine_version": "5"}, r"version of mujoco \(4.0.0: a; 5: new\)"),
            ("demos", (), other, r"demonstrations \(ab: a; cd: demos\)\.$"),
            ("objects", soups, {}, rf"objects \({both}: a; tomato soup can: ob"),
            ("fewer", base.episodes[::2], {}, r"number of episodes \(4: a; 2: fewer\)"),
        ):
            with self.subTest(what):
                rollouts = replace(base, episodes=tuple(episodes) or base.episodes)
                self.write_results(what, rollouts, ("mujoco", "sapien"), **changes)
                note = "These results are not comparable: not the same"
                self.assertRegex(self.notes("a", what), rf"(?m)^{note} {expected}")
        with self.subTest("the same meshes, named from here and in full"):
            for name, folder in (("here", "meshes"), ("full", str(Path("meshes").resolve()))):
                self.write_results(name, meshes=folder)
            self.assertNotIn("object meshes", self.compare("here", "full"))
        self.write_results("a", engines=("sapien",), seed=9)
        words = r"seed of the evaluation \(3: a in mujoco; 9: a in sapien\)"
        self.assertRegex(self.compare("a"), words)

    def test_two_robots_may_be_compared_but_one_run_has_one(self):
        self.write_results("a", engines=("mujoco", "sapien"))
        self.write_results("b", engines=("mujoco", "sapien"), robot="x")
        text = self.compare("a", "b")
        self.assertNotIn("comparable", text)
        self.assertIn("a: toy, b: x", text)
        self.assertTrue(self.report.scores["metric"].str.endswith("minus a").any())
        self.write_results("a", engines=("sapien",), robot="x")
        words = r"not the same robot \(toy: a in mujoco; x: a in sapien\)"
        self.assertRegex(self.compare("a"), words)

    def test_policies_that_play_another_task(self):
        self.run_and_results("short", config=SHORT)
        self.run_and_results("usual")
        expected = r"not the same task.termination.episode_seconds \(2.5: short; 5: usual\)"
        self.assertRegex(self.compare("short", "usual"), expected)
        task = TrainConfig().task
        surfaces = task.randomization
        for name, changes, words in (
            ("frame", {"object_frame": "center"}, r"object_frame \(center: frame; mesh: usual\)"),
            (
                "rough",
                {"randomization": replace(surfaces, friction=(1.0, 1.5))},
                "friction .1.25: ",
            ),
            ("soft", {"randomization": replace(surfaces, elastomer=1.2)}, "elastomer .1.2: soft; "),
            (
                "slow",
                {"timestep": 0.02, "substeps": 1},
                r"timestep \(0.02: slow; 0.00416667: usual",
            ),
            ("wide", {"randomization": replace(surfaces, friction=(0.2, 1.3))}, ""),
            ("fine", {"timestep": 1 / 960, "substeps": 8}, ""),
        ):
            with self.subTest(name):
                self.run_and_results(name, config=TrainConfig(task=replace(task, **changes)))
                text = self.compare(name, "usual")
                self.assertRegex(text, words or name)
                self.assertEqual("not comparable" in text, bool(words))

    def test_episodes_of_another_length(self):
        """The length of an evaluation counts, and not that of the training, if the result states it."""
        self.run_and_results("earlier")  # of a version that did not state the length
        for name, config, seconds, words in (
            ("usual", None, 5.0, ""),
            ("long", None, 12.0, r"episode_seconds \(5: earlier; 12: long\)"),
            ("short", SHORT, 5.0, ""),
        ):
            with self.subTest(name):
                self.write_run(name, config)
                self.write_results(name, episode_seconds=seconds)
                text = self.compare("earlier", name)
                self.assertRegex(text, words or "earlier")
                self.assertEqual("not comparable" in text, bool(words))
                is_compared = self.report.scores["metric"].str.endswith("minus earlier").any()
                self.assertEqual(is_compared, not words)
        self.write_results("usual", engines=("sapien",), episode_seconds=12.0)
        self.assertRegex(self.compare("usual"), r"\(5: usual in mujoco; 12: usual in sapien\)")

    def test_policies_without_a_run_that_start_otherwise(self):
        for name, frame in (("old", None), ("by-mesh", "mesh"), ("by-center", "center")):
            self.write_results(name, object_frame=frame)
        self.assertNotIn("not comparable", self.compare("old", "by-mesh"))
        words = r"not the same task.object_frame \(mesh: by-mesh; center: by-center\)"
        self.assertRegex(self.compare("by-mesh", "by-center"), words)

    def test_results_of_a_policy_from_before_a_run_went_on(self):
        policy = "f2ca1bb6c7e907d06dafe4687e579fce76b37e4e93b7605022da52e6ccc26fd2"  # of "test\n"
        self.run_and_results("a", {"inputs": {"demos": "ab", "policy": policy}})
        self.assertNotIn("another policy", self.compare("a"), "no file to compare with")
        for content, is_same in (("test\n", True), ("trained on", False)):
            (self.folder / "a" / "policy.onnx").write_text(content)
            words = (
                "results of a in mujoco are of another policy than its policy.onnx. .*xreset eval"
            )
            found = re.search(words, self.compare("a"))
            self.assertEqual(found is None, is_same)
        (self.folder / "a" / "choice.json").write_text("{}")  # of xreset 0.1 to 0.3
        self.assertNotIn("another policy", self.compare("a"))

    def test_a_training_that_began_with_the_networks_of_another(self):
        file = "joint/checkpoints/000900.pt (abababab)"
        self.run_and_results("new")
        for seed, folder in enumerate(("/first", "/second machine")):
            weights = f"{folder}/joint/checkpoints/000900.pt"
            self.run_and_results(
                f"onwards-{seed}", seed=seed, weights=weights, weights_hash="ab" * 32
            )
        text = self.compare("new", "onwards-0", "onwards-1")
        self.assertIn(f"onwards-1 began with the networks of another training ({file}), ", text)
        self.assertIn(f" weights | new | {file} |", text)


class WrittenTest(Compared):
    def write_three(self):
        for name, seed, gravity, success in (
            ("x-s0", 0, True, 0.2),
            ("x-s1", 1, True, 0.4),
            ("fixed", 0, False, 0.1),
        ):
            self.write_run(name, reset_config(random_gravity=gravity), seed=seed)
            self.write_results(name, rollouts_with(success, 0.33, 0.66, 0.0), ("mujoco", "sapien"))
            self.write_curves(name, curves_of((60.0, 60.0), (0.0, success)))
        self.write_results("ik")
        return ["x-s0", "x-s1", "fixed", "ik"]

    def test_the_page(self):
        names = self.write_three()
        text = self.compare(*names)
        interval = r"\d+-\d+%"
        for row in (
            rf"x \| mujoco 4\.0\.0 8 / 2 / 2 \| 32\.2% {interval} \|",
            rf"\| \| sapien 4\.0\.0 8 / 2 / 2 \| 32\.2% {interval} \|",
            r"ik \| mujoco 4\.0\.0 4 / 2 / 1 \| 49\.8% 33-66% \| 75% ",
            r"fixed \| mujoco .* 7\.8 cm 5\.5-10\.0 cm .* \| -5\.0 \([-+.\d]+ to [-+.\d]+\) \|",
            r"seed \| 0; 1 \| 0 \|",
            r"task\.reset\.random_gravity \| True \| False \|",
            r"minutes of training \| 2\.0 \| 2\.0 \|",
            r"iterations of training \| 2 \| 2 \|",
            r"tomato soup can \| \d+% 1 \|",
        ):
            self.assertRegex(text, row)
        self.assertNotIn("num_envs", text, "the same in all")
        self.assertIn("x is 2 trainings that differ in the seed only (x-s0, x-s1)", text)

    def test_curves(self):
        names = self.write_three()
        runs = read_trainings([self.folder / name for name in names])
        self.assertEqual(collect(runs[3:]).curves, "")
        default = collect(runs)
        self.assertIn("at the goal, from home", default.curves)
        self.assertIn("minutes of training", default.curves)
        self.assertNotIn("speed/learn_seconds", default.curves)
        slow = runs[0].curves.drop(columns="speed/learn_seconds")
        self.assertIn("iterations of training", collect([replace(runs[0], curves=slow)]).curves)

    def test_curves_only(self):
        self.write_curves("a", curves_of((60.0, 60.0), (0.0, 0.5)))
        text = self.compare("a")
        self.assertNotIn("side by side", text)
        self.assertIn("a has no results. Make them first: xreset eval POLICY", text)


class DrawTest(Compared):
    def draw(self, function, *arguments, **options):
        ax = Figure().subplots()
        function(ax, *arguments, **options)
        return ax

    def test_lines_and_bands(self):
        mean = pd.DataFrame({"mean": [0.1, 0.3]}, index=[1.0, 3.0])
        alone = mean.assign(low=mean["mean"], high=mean["mean"])
        band = mean.assign(low=mean["mean"] - 0.1, high=mean["mean"] + 0.1)
        lines = {"0": alone, "2": band, "8": alone}
        ax = self.draw(draw_lines, "task/success", lines, "steps", [str(i) for i in range(9)])
        assert_allclose(ax.lines[0].get_xydata(), [[1, 10], [3, 30]])
        colors = [curve.get_color() for curve in ax.lines]
        self.assertEqual(colors, [COLORS[0], COLORS[2], COLORS[0]])
        first, _, ninth = (curve.get_linestyle() for curve in ax.lines)
        self.assertNotEqual(first, ninth)
        height = ax.collections[0].get_datalim(ax.transData).intervaly
        assert_allclose(height, (0, 40), atol=1e-9)
        words = (ax.get_xlabel(), ax.get_title(loc="left"))
        self.assertEqual(words, ("million environment steps", "at the goal"))


class CommandTest(Compared):
    def test_from_folders_to_page_and_figures(self):
        """No name is a formula in a spreadsheet, nor a style on the terminal."""
        for name, seed in (("a", 3), ("b", 4)):
            self.run_and_results(name, {"engines": ENGINES, "seed": seed}, num_envs=64 + seed)
        out = self.folder / "made"
        runs = (f"@[one]={self.folder}/a", self.folder / "b")
        printed = succeeds("compare", *runs, "--out", out)
        for expected in (*ENGINES, "@[one]", "49.8", "These results are", "compare is now report"):
            self.assertIn(expected, printed)
        self.assertEqual({f.name for f in out.iterdir()}, {"index.html", "results.csv"})
        text = text_of((out / "index.html").read_text())
        self.assertIn("num_envs | 67 | 68 |", text)
        figures = pd.read_csv(out / "results.csv")
        columns = ["group", "engine", "object", "metric", "mean", "low", "high"]
        self.assertEqual([*figures], columns)
        first = figures.iloc[0]
        expected = ["'@[one]", "mujoco", "all", "task_progress"]
        self.assertEqual(first[columns[:4]].tolist(), expected)
        self.assertAlmostEqual(first["mean"], 0.4975)
        self.assertLess(first["low"], first["mean"])
