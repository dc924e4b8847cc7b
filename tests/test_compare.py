"""Several trainings side by side: what is read, what is taken together, what is unfair, and what is written."""

import json
import unittest
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from unittest import mock

import numpy as np
import pandas as pd
from torch.utils.tensorboard import SummaryWriter

from tests.test_cli import run
from tests.toy_results import ENGINES, InFolder, rollouts_with, toy_rollouts
from xreset.errors import FileFormatError, RunError, XResetError
from xreset.eval.plots import COLORS, figure_style
from xreset.eval.report.curves import Fate, Line, amounts, fates, line, share_of_runs
from xreset.eval.report.figures import draw_lines, draw_scores
from xreset.eval.report.groups import grouped, score, scores
from xreset.eval.report.make import choose_curves, compare
from xreset.eval.report.read import Curve, read_curves, read_scalars, read_training, read_trainings
from xreset.eval.stats import bootstrap_ci95, crossed_bootstrap_ci95, wilson_ci95
from xreset.eval.table import escape
from xreset.learning.clock import Lift, LiftClock, Passing
from xreset.learning.config import TrainConfig
from xreset.task.config import ResetConfig, TaskConfig, TerminationConfig

WORLDS, HORIZON = 64, 16
STEPS = WORLDS * HORIZON
"""Environment steps of an iteration of one process."""


def curves_of(
    seconds: tuple[float, ...], success: tuple[float, ...], first: int = 1, steps: float = STEPS
) -> dict[str, Curve]:
    """Scalars of a training whose iterations took that long and had ``steps`` each."""
    iteration = np.arange(first, first + len(seconds))

    def curve(tag: str, values) -> Curve:
        return Curve(label=tag, iteration=iteration, value=np.array(values, dtype=float))

    tags = {
        "speed/collect_seconds": [0.75 * s for s in seconds],
        "speed/learn_seconds": [0.25 * s for s in seconds],
        "speed/env_steps_per_second": [steps / s for s in seconds],
        "task/success": success,
        "task/success_from_home": [0.5 * s for s in success],
    }
    return {tag: curve(tag, values) for tag, values in tags.items()}


class Compared(InFolder):
    def write_curves(self, name: str, curves: dict[str, Curve]) -> Path:
        from torch.utils.tensorboard import SummaryWriter

        writer = SummaryWriter(log_dir=str(self.folder / name))
        for tag, curve in curves.items():
            for iteration, value in zip(curve.iteration.tolist(), curve.value.tolist(), strict=True):
                writer.add_scalar(tag, value, iteration)
        writer.close()
        return self.folder / name

    def training(self, name: str, curves: dict[str, Curve] | None = None):
        """What lies in a folder, with curves that need not be written."""
        return replace(read_training(name, self.folder / name), scalars=curves or {})

    def compare(self, *names: str, **options):
        """Compare without the picture, which takes a second."""
        with mock.patch("xreset.eval.report.make.write_picture"):
            return compare([str(self.folder / n) for n in names], self.folder / "out", **options)


class ReadTest(Compared):
    def test_labels(self):
        a, b = (str(self.write_results(name)) for name in ("a", "b"))
        self.assertEqual([t.label for t in read_trainings([a, f"X-RESET, 2={b}"])], ["a", "X-RESET, 2"])
        self.assertEqual([t.label for t in read_trainings([f"{a}/eval"])], ["a"])
        odd = str(self.write_results("p=0.5"))
        self.assertEqual([t.label for t in read_trainings([odd])], ["p=0.5"], "a folder with = in its name is a folder")

    def test_bad_arguments(self):
        a = str(self.write_results("a"))
        self.write_results("other/a")
        for runs, message in (
            ([], "nothing to compare"),
            ([a, f"{self.folder}/other/a"], f"(?s)both be called 'a'.*a-1={a} a-2=.*other/a"),
            ([f"x={a}", f"x={self.folder}/other/a"], "both be called 'x'"),
            ([f"x={a}", f"y={a}/../a"], "'x' and 'y' are the same folder"),
            ([f"={a}"], "a name is missing"),
            (["x="], "a folder is missing"),
            ([f"{self.folder}/nowhere"], "there is no folder .*nowhere"),
        ):
            with self.subTest(message), self.assertRaisesRegex(RunError, message):
                read_trainings(runs)

    def test_a_folder_without_anything(self):
        self.write_run("a")
        with self.assertRaisesRegex(RunError, "neither learning curves .* nor evaluation results.*xreset eval .*/a"):
            read_training("a", self.folder / "a")

    def test_damaged_files(self):
        a = self.write_results("a")
        self.write_run("a")
        files = ("run.json", "eval/mujoco.json", "eval/mujoco.episodes.json")
        whole = {name: (a / name).read_text() for name in files}

        def lacks(name: str, entry: str) -> str:
            return json.dumps({k: v for k, v in json.loads(whole[name]).items() if k != entry})

        for name, text, message in (
            *((name, whole[name][:80], f"{name} is not valid JSON") for name in files),
            ("eval/mujoco.json", lacks("eval/mujoco.json", "seed"), "does not fit EvalResult .missing: seed"),
            ("run.json", lacks("run.json", "config"), "run.json lacks config"),
            (
                "eval/mujoco.json",
                whole["eval/mujoco.json"].replace('"episodes": 4', '"episodes": 5'),
                "states 5 episodes, .* holds 4",
            ),
        ):
            (a / name).write_text(text)
            with self.subTest(message), self.assertRaisesRegex(FileFormatError, message):
                read_training("a", a)
            (a / name).write_text(whole[name])
        read_training("a", a)
        (a / "events.out.tfevents.1.x").write_bytes(b"no events")
        with self.assertRaisesRegex(
            FileFormatError, "hold no learning curve.*Compare its evaluations alone: a=.*/eval"
        ):
            read_training("a", a)

    def test_event_files_that_are_not_whole(self):
        a = self.write_curves("a", curves_of((1.0,) * 40, (0.5,) * 40))
        (file,) = a.glob("events*")
        whole = file.read_bytes()

        def offset(record: int) -> int:
            at = 0
            for _ in range(record):
                at += 16 + int.from_bytes(whole[at : at + 8], "little")
            return at

        middle, last = offset(100), offset(1 + 5 * 40 - 1)
        file.write_bytes(whole[: last + 20])  # the training is still writing, or was killed
        self.assertEqual(read_training("a", a).scalars["task/success"].iteration[-1], 40)
        changed = bytes([whole[middle + 20] ^ 1])
        for what, damaged in (
            ("content", whole[: middle + 20] + changed + whole[middle + 21 :]),
            ("length", whole[:middle] + b"\xff" * 8 + whole[middle + 8 :]),
            ("zeros", whole[:middle] + bytes(300) + whole[middle + 300 :]),
            ("bytes missing", whole[:middle] + whole[middle + 11 :]),
        ):
            file.write_bytes(damaged)
            with (
                self.subTest(what),
                self.assertRaisesRegex(FileFormatError, f"{file.name} is damaged.* up to step 40 and no farther"),
            ):
                read_training("a", a)
            curves, note = read_curves(a)
            self.assertEqual(curves, ())
            self.assertIn("is damaged", note or "")

    def test_event_files_whose_head_or_tail_is_cut(self):
        """Cut anywhere: the head is missed, what is left of a tail is read as it was."""
        a = self.write_run("a")
        curves = SummaryWriter(str(a))
        for step in range(1, 5):
            curves.add_scalar("task/success", step / 8, step)
            curves.add_scalar("task/grasped", 0.5, step)
        curves.close()
        (file,) = a.glob("events*")
        whole = file.read_bytes()
        self.assertEqual(len(read_scalars(a)["task/success"].value), 4)
        for at in range(1, len(whole), 3):
            file.write_bytes(whole[at:])
            if at <= len(whole) - 16:  # less is no record at all
                with self.assertRaisesRegex(FileFormatError, "is damaged", msg=f"without the first {at} bytes"):
                    read_scalars(a)
            file.write_bytes(whole[:-at])
            found = read_scalars(a)
            if found:  # else the first values are gone, too
                values = found["task/success"].value
                np.testing.assert_array_equal(values, np.arange(1, 1 + len(values)) / 8)

    def test_configurations_of_other_versions_are_read(self):
        a = self.write_run("a")
        self.write_results("a")
        file = a / "run.json"
        file.write_text(file.read_text().replace('"iterations"', '"cycles"'))
        facts = read_training("a", a).facts
        self.assertEqual(facts["cycles"].text, "10000")
        self.assertNotIn("iterations", facts)
        self.assertEqual(facts["task.randomization.friction"].text, "0.5, 1")


class ProgressTest(Compared):
    def setUp(self):
        super().setUp()
        self.write_run("a")
        self.write_results("a")

    def test_minutes_and_steps_are_sums_over_iterations(self):
        training = self.training("a", curves_of((60.0, 30.0, 30.0), (0.0, 0.1, 0.2)))
        np.testing.assert_allclose(amounts(training, "minutes")[1], [1.0, 1.5, 2.0])
        np.testing.assert_allclose(amounts(training, "steps")[1], [STEPS, 2 * STEPS, 3 * STEPS])
        np.testing.assert_allclose(amounts(training, "iterations")[1], [1, 2, 3])
        late = self.training("a", curves_of((60.0, 30.0), (0.0, 0.1), first=3))
        np.testing.assert_allclose(
            amounts(late, "minutes")[1], [3.0, 3.5], err_msg="what was not logged is as the next"
        )

    def test_without_speed_only_iterations_are_known(self):
        curves = {k: v for k, v in curves_of((1.0,), (0.5,)).items() if k != "speed/learn_seconds"}
        training = self.training("a", curves)
        with self.assertRaisesRegex(RunError, "a did not log speed/learn_seconds.*--x iterations"):
            line([training], "task/success", "minutes")
        self.assertIsNotNone(line([training], "task/success", "iterations"))

    def test_mean_and_band_over_what_all_have(self):
        a = self.training("a", curves_of((60.0,) * 4, (0.0, 0.2, 0.4, 0.6)))
        b = self.training("a", curves_of((120.0,) * 3, (0.2, 0.6, 0.8)))
        found = line([a, b], "task/success", "minutes")
        assert found is not None
        np.testing.assert_allclose(found.x, [2, 3, 4])  # the first has ended at 4 minutes, the second begins at 2
        np.testing.assert_allclose(found.low, [0.2, 0.4, 0.6])
        np.testing.assert_allclose(found.high, [0.2, 0.4, 0.6])
        np.testing.assert_allclose(line([a, b], "task/success", "iterations").mean, [0.1, 0.4, 0.6], atol=1e-12)
        self.assertIsNone(line([a, b], "task/other", "minutes"))

        alone = line([b], "task/success", "minutes")
        for values in (alone.mean, alone.low, alone.high):
            np.testing.assert_allclose(values, [0.2, 0.6, 0.8])


class LiftTest(Compared):
    def lifted(self, name: str, end: float, *passed: tuple[float, float], seed: int = 0, **changes) -> str:
        """A run with ``lift.json``: minutes until its end and until each share that it passed; 10 iterations and 1e6 steps a minute."""

        def at(minutes: float) -> dict:
            return {"iteration": round(10 * minutes), "env_steps": round(1e6 * minutes), "minutes": minutes}

        folder = self.write_run(name, seed=seed, **changes)
        clock = LiftClock(folder, Lift(passed=tuple(Passing(share=s, **at(t)) for s, t in passed), **at(end)))
        clock.write()
        return name

    def read(self, *names: str):
        return [read_training(name, self.folder / name) for name in names]

    def test_the_share_of_runs_is_a_step_curve_with_censored_runs(self):
        """Of five runs, passed after 2, 4 and 8 minutes, ended without after 3 and 9: 1 - 4/5, then times 2/3, then times 1/2."""
        found = [
            Fate(2.0, True, 5.0),
            Fate(3.0, False, 3.0),
            Fate(4.0, True, 8.0),
            Fate(8.0, True, 11.0),
            Fate(9.0, False, 9.0),
        ]
        line = share_of_runs(found[::-1])
        np.testing.assert_allclose(line.x, [0, 2, 3, 4, 8, 9, 11], err_msg="until the last run ended")
        np.testing.assert_allclose(line.mean, [0, 1 / 5, 1 / 5, 1 - 8 / 15, 1 - 4 / 15, 1 - 4 / 15, 1 - 4 / 15])
        for i, known in enumerate((5, 5, 5, 4, 4, 4, 4)):  # after 3 minutes nothing is known of one
            np.testing.assert_allclose((line.low[i], line.high[i]), wilson_ci95(line.mean[i] * known, known))
        whole = share_of_runs([Fate(t, t < 9, 9.0) for t in (1.0, 5.0, 9.0, 9.0)])
        np.testing.assert_allclose(whole.mean, [0, 0.25, 0.5, 0.5], err_msg="none ended early: the share of all runs")
        at_once = share_of_runs([Fate(2.0, True, 2.0), Fate(2.0, False, 2.0), Fate(2.0, True, 2.0)])
        np.testing.assert_allclose(
            at_once.mean, [0, 2 / 3], err_msg="who ends when another passes was watched until then"
        )

    def test_wilsons_interval(self):
        """Its ends are where |p - share| is 1.96 standard deviations of p."""
        for hits, count in ((0, 1), (1, 1), (2, 3), (10, 10), (37, 100)):
            for p in wilson_ci95(hits, count):
                if 0 < p < 1:
                    self.assertAlmostEqual(abs(p - hits / count) / np.sqrt(p * (1 - p) / count), 1.959964, places=4)
        self.assertEqual(wilson_ci95(0, 0), (0.0, 1.0))
        self.assertEqual((wilson_ci95(0, 4)[0], wilson_ci95(4, 4)[1]), (0.0, 1.0))

    def test_fates(self):
        members = self.read(self.lifted("a", 12.0, (0.01, 6.0), (0.1, 8.5)), self.lifted("b", 10.0))
        self.assertEqual(fates(members, 0.01, "minutes"), [(6.0, True, 12.0), (10.0, False, 10.0)])
        self.assertEqual(fates(members, 0.1, "steps"), [(8.5e6, True, 12e6), (10e6, False, 10e6)])
        self.assertEqual(fates(members, 0.5, "iterations"), [(120.0, False, 120.0), (100.0, False, 100.0)])

    def test_seeds_are_one_row_and_one_curve(self):
        names = [self.lifted("x-s0", 12.0, (0.01, 6.0), (0.1, 8.5)), self.lifted("x-s1", 10.0, (0.01, 7.0), seed=1)]
        names += [self.lifted("other", 8.0, num_envs=2 * WORLDS)]
        self.write_curves("old", curves_of((60.0, 60.0), (0.0, 0.04)))
        made = self.compare(*names, "old")
        head, *body = [list(made.lifted.head), *map(list, made.lifted.body)]
        self.assertEqual(head, ["", "runs", "1 % [min]", "10 % [min]", "50 % [min]"])
        self.assertEqual(
            body[0], ["x", "2", "100 % (34-100); 6.0, 7.0", "50 % (9-91); 8.5, >10.0", "0 % (0-79); >12.0, >10.0"]
        )
        self.assertEqual(body[1], ["other", "1", *["0 % (0-79); >8.0"] * 3])
        self.assertEqual(len(body), 2)
        self.assertIn("No lift.json, so the first success from home is not known: old.", made.notes)
        page = made.page.read_text()
        self.assertIn("## First success from home", page)
        self.assertIn("Kaplan-Meier", page)

        self.write_results("a")
        made = self.compare("a")
        self.assertEqual(made.lifted.body, ())
        self.assertNotIn("First success", made.page.read_text())

    def test_steps_are_drawn_as_steps(self):
        with figure_style({}) as figure_class:
            ax = figure_class().subplots()
            lines = {"a": share_of_runs([Fate(2e6, True, 3e6), Fate(4e6, False, 4e6)])}
            draw_lines(ax, lines, "runs past 10 % from home", "steps", ["a"], percent=True, of="runs", steps=True)
        (curve,) = ax.lines
        np.testing.assert_allclose(curve.get_xydata(), [[0, 0], [2, 50], [4, 50]])
        self.assertEqual(curve.get_drawstyle(), "steps-post")
        self.assertEqual((ax.get_title(loc="left"), ax.get_ylabel()), ("runs past 10 % from home", "runs"))

    def test_a_damaged_clock(self):
        (self.folder / self.lifted("a", 3.0) / "lift.json").write_text("{")
        with self.assertRaisesRegex(FileFormatError, "lift.json is not valid JSON"):
            self.read("a")


class GroupTest(Compared):
    def groups(self, *names: str) -> tuple[list[tuple[str, int]], str]:
        groups, notes = grouped([self.training(name) for name in names])
        return [(g.label, len(g.members)) for g in groups], " ".join(notes)

    def run_and_results(self, name: str, results: dict | None = None, **changes) -> str:
        self.write_run(name, **changes)
        self.write_results(name, **(results or {}))
        return name

    def test_what_differs_in_the_seed_only_is_one(self):
        names = [
            self.run_and_results(
                f"soup-seed{i}",
                seed=i,
                device=f"cuda:{i}",
                resets=f"/{i}/b.npz",
                config=TrainConfig(iterations=1000 * i),
            )
            for i in (1, 2, 10)
        ]
        other = self.run_and_results(
            "fixed", config=TrainConfig(task=TaskConfig(reset=ResetConfig(random_gravity=False)))
        )
        bank = self.run_and_results("bank", seed=3, resets_hash="aa" * 32)
        baseline = "ik"
        self.write_results(baseline)
        found = self.groups(names[0], other, names[1], bank, names[2], baseline)
        self.assertEqual(found, ([("soup", 3), ("fixed", 1), ("bank", 1), ("ik", 1)], ""))

    def test_names_of_groups(self):
        for names, expected in (
            (("X s0", "X s1"), "X"), (("run10", "run11"), "run"), (("first", "second"), "first + second"), (("seed0", "seed1"), "seed"),
        ):  # fmt: skip
            with self.subTest(expected):
                found, _ = self.groups(*(self.run_and_results(name, seed=i) for i, name in enumerate(names)))
                self.assertEqual(found, [(expected, 2)])

    def test_groups_that_would_have_the_same_name_are_told_apart(self):
        names = [self.run_and_results(f"s-{i}", seed=i, num_envs=WORLDS + i // 2) for i in range(4)]
        self.assertEqual(self.groups(*names)[0], [("s-0 + s-1", 2), ("s-2 + s-3", 2)])

    def test_repetitions_must_have_seeds_of_their_own_and_be_evaluated_alike(self):
        self.run_and_results("a", seed=0)
        for name, results, changes, reason in (
            ("b", {}, {"seed": 0}, "a and b have the same seed, too"),
            ("c", {"seed": 5}, {"seed": 1}, "evaluations of a and c in mujoco the seed differs"),
            ("d", {"inputs": {"demos": "cd"}}, {"seed": 2}, "the demonstrations differs"),
            ("e", {"backend_version": "5.0"}, {"seed": 3}, "different versions of mujoco"),
        ):
            self.run_and_results(name, results, **changes)
            found, notes = self.groups("a", name)
            self.assertEqual(found, [("a", 1), (name, 1)])
            self.assertRegex(notes, f"a, {name} have the same configuration and are not grouped: .*{reason}")


class ScoreTest(Compared):
    def scored(self, *progress: tuple[float, ...], engines=("mujoco",)) -> pd.DataFrame:
        """The scores of trainings with other seeds, by engine."""
        for i, values in enumerate(progress):
            self.write_run(f"s-{i}", seed=i)
            self.write_results(f"s-{i}", rollouts_with(*values), engines)
        groups, _ = grouped([self.training(f"s-{i}") for i in range(len(progress))])
        self.assertEqual(len(groups), 1)
        return scores(groups).set_index("engine")

    def test_one_training_has_the_figures_of_its_evaluation(self):
        found = self.scored((1.0, 0.33, 0.66, 0.0), engines=ENGINES)
        self.assertEqual(list(found.index), list(ENGINES))
        summary = self.training("s-0").results["pybullet"]
        ours = found.loc["pybullet"]
        self.assertEqual(ours["task_progress"], summary.task_progress.mean)
        np.testing.assert_allclose(ours["task_progress_ci95"], summary.task_progress.ci95, atol=1e-6)
        for metric in ("approach", "grasp", "reorient", "reorient_once", "published_success"):
            self.assertEqual(ours[metric], getattr(summary, f"{metric}_rate"), metric)
        self.assertEqual(ours["reorientation_progress"], summary.reorientation_progress)
        self.assertEqual((ours["nonfinite"], ours["overflow"], ours["episodes"]), (1, 1, 4))

    def test_seeds_widen_the_interval(self):
        alike = self.scored((0.4, 0.6, 0.4, 0.6), (0.4, 0.6, 0.4, 0.6)).loc["mujoco"]
        self.assertEqual(
            (alike["task_progress"], alike["task_progress_ci95"]),
            (0.5, (0.5, 0.5)),
            "neither seeds nor demonstrations differ",
        )
        apart = self.scored((0.0, 0.2, 0.0, 0.2), (0.8, 1.0, 0.8, 1.0)).loc["mujoco"]
        np.testing.assert_allclose(
            apart["task_progress_ci95"],
            (0.1, 0.9),
            err_msg="one of the two seeds only is drawn in half of the resamples",
        )
        self.assertEqual({k: round(v, 9) for k, v in apart["each"].items()}, {"s-0": 0.1, "s-1": 0.9})
        bare = replace(self.training("s-1"), results={}, episodes=pd.DataFrame())
        (group,), _ = grouped([self.training("s-0"), bare])
        self.assertEqual(list(scores([group])["each"][0]), ["s-0"], "a seed that was not evaluated is left out")

    def test_the_crossed_bootstrap_has_the_variance_of_its_design(self):
        rng = np.random.default_rng(1)
        of_run, of_demo = rng.normal(size=8), 2 * rng.normal(size=30)
        values = (of_run[:, None] + of_demo).ravel()
        runs, demos = np.repeat(np.arange(8), 30), np.tile(np.arange(30), 8)
        low, high = crossed_bootstrap_ci95(values, runs, demos, draws=20000)
        expected = 2 * 1.96 * np.sqrt(of_run.var() / 8 + of_demo.var() / 30)
        self.assertAlmostEqual(high - low, expected, delta=0.05 * expected)
        only = bootstrap_ci95(values, demos)
        self.assertLess(only[1] - only[0], 0.95 * (high - low), "without the seeds it is narrower")

    def test_the_crossed_bootstrap_of_one_training_is_the_usual_one(self):
        values, demos = np.array([0.0, 1.0, 0.3, 0.4]), np.array([0, 0, 1, 1])
        self.assertEqual(crossed_bootstrap_ci95(values, np.zeros(4), demos), bootstrap_ci95(values, demos))
        with self.assertRaisesRegex(ValueError, "every demonstration"):
            crossed_bootstrap_ci95(values, np.array([0, 0, 0, 1]), demos)


class FairnessTest(Compared):
    def notes(self, *names: str) -> str:
        return "\n".join(self.compare(*names).notes)

    def test_alike(self):
        for name, progress in (("a", 0.3), ("b", 0.6)):
            self.write_run(name, TrainConfig(task=TaskConfig(reset=ResetConfig(demo_probability=progress))))
            self.write_results(name, rollouts_with(progress, 0.33, 0.66, 0.0), inputs={"demos": "ab", "policy": name})
        text = self.notes("a", "b")
        self.assertNotIn("comparable", text)
        self.assertIn("1 of 4 episodes of a in mujoco stopped being finite", text)
        self.assertIn("1 of 4 episodes of b in mujoco dropped contacts", text)
        self.assertIn("No learning curves: a, b.", text)

    def test_what_makes_results_incomparable_is_said(self):
        self.write_results("a", engines=("mujoco", "sapien"))
        base = toy_rollouts()
        renamed = tuple(replace(e, sequence_name=f"other_{e.sequence}") for e in base.episodes)
        soups = tuple(replace(e, object="005_tomato_soup_can") for e in base.episodes)
        for what, rollouts, changes, expected in (
            ("seed", None, {"seed": 4}, r"not the same seed of the evaluation \(3: a; 4: seed\)"),
            ("robot", None, {"robot": "other"}, r"not the same robot \(toy: a; other: robot\)"),
            (
                "meshes",
                None,
                {"objects_folder": "/ycb"},
                r"not the same object meshes \(stand-ins: a; /ycb: meshes\)\.\n",
            ),
            (
                "engine",
                None,
                {"backend_version": "5.1"},
                r"(?s)version of mujoco \(4.0.0: a; 5.1: engine\).*version of sapien \(",
            ),
            (
                "demos",
                replace(base, episodes=renamed),
                {"inputs": {"demos": "cd"}},
                r"not the same demonstrations \(ab: a; cd: demos\)",
            ),
            (
                "file",
                None,
                {"inputs": {"demos": "cd"}},
                r"files of demonstrations differ \(ab: a; cd: file\), .* same names",
            ),
            (
                "objects",
                replace(base, episodes=soups),
                {},
                r"not the same objects \(potted meat can, tomato soup can: a; tomato soup can: ob",
            ),
            (
                "fewer",
                replace(base, episodes=base.episodes[::2]),
                {},
                r"not the same number of episodes \(4: a; 2: fewer\)",
            ),
        ):
            with self.subTest(what):
                self.write_results(what, rollouts, ("mujoco", "sapien"), **changes)
                text = self.notes("a", what)
                self.assertRegex(text, expected)
                self.assertIn(escape(text.splitlines()[0]), (self.folder / "out" / "compare.md").read_text())

    def test_engines_of_one_run_that_were_not_evaluated_alike(self):
        self.write_results("a")
        self.write_results("a", engines=("sapien",), seed=9)
        self.write_results("b", engines=("mujoco", "sapien"))
        self.assertRegex(
            self.notes("a", "b"), r"a: These results are not comparable: the seed differs \(mujoco: 3, sapien: 9\)"
        )

    def test_policies_that_play_another_task(self):
        self.write_run("short", TrainConfig(task=TaskConfig(termination=TerminationConfig(episode_seconds=2.5))))
        self.write_run("usual")
        for name in ("short", "usual"):
            self.write_results(name)
        self.assertRegex(
            self.notes("short", "usual"),
            r"own task, whose task.termination.episode_seconds differs \(2.5: short; 5: usual\)",
        )

    def test_a_training_that_began_with_the_networks_of_another(self):
        for name, weights in (("new", None), ("onwards", "runs/joint/checkpoints/000900.pt")):
            self.write_run(name, weights=weights, weights_hash=weights and "ab" * 32)
            self.write_results(name)
        made = self.compare("new", "onwards")
        expected = "onwards began with the networks of another training (runs/joint/checkpoints/000900.pt): "
        self.assertEqual([note[: len(expected)] for note in made.notes if "networks" in note], [expected])
        self.assertIn(
            ["weights", "new", "runs/joint/checkpoints/000900.pt"], [list(row) for row in made.different.body]
        )

    def test_what_is_missing(self):
        self.write_results("a", engines=("mujoco", "sapien"))
        self.write_run("b")
        self.write_results("b")
        text = self.notes("a", "b")
        self.assertIn("Not evaluated in sapien: b.", text)
        self.assertIn("No run.json, so its configuration is not known: a.", text)


class WrittenTest(Compared):
    def write_three(self):
        for name, seed, gravity, success in (("x-s0", 0, True, 0.2), ("x-s1", 1, True, 0.4), ("fixed", 0, False, 0.1)):
            self.write_run(name, TrainConfig(task=TaskConfig(reset=ResetConfig(random_gravity=gravity))), seed=seed)
            self.write_results(name, rollouts_with(success, 0.33, 0.66, 0.0), ("mujoco", "sapien"))
            self.write_curves(name, curves_of((60.0, 60.0), (0.0, success)))
        self.write_results("ik")
        return ["x-s0", "x-s1", "fixed", "ik"]

    def rows(self) -> dict[tuple[str, str], list[str]]:
        """First two cells of every row of ``compare.md`` -> the others; an empty first cell repeats the one above."""
        found, last = {}, ""
        for text in (self.folder / "out" / "compare.md").read_text().splitlines():
            if text.startswith("| "):
                first, second, *others = (cell.strip() for cell in text.strip("|").split(" | "))
                last = first or last
                found[last, second] = others
        return found

    def test_the_page(self):
        names = self.write_three()
        made = self.compare(*names)
        rows = self.rows()
        self.assertEqual(rows["", ""], ["mujoco 4.0.0", "sapien 4.0.0"])
        mean = (0.2 + 0.4 + 2 * 0.99) / 8
        cell = rows["x", "task progress (95 % interval)"][0]
        self.assertTrue(cell.startswith(f"{100 * mean:.1f} % ("), cell)
        self.assertEqual(rows["x", "task progress of each seed"], ["29.8, 34.8 %"] * 2)
        self.assertEqual(rows["fixed", "approach / grasp / reorient"], ["75 / 50 / 25 %"] * 2)
        self.assertEqual(rows["ik", "at the goal at any time; reorientation progress"], ["25 %; 37.5 %", "-"])
        self.assertTrue(rows["fixed", "published success (95 % interval)"][0].startswith("25.0 % ("))
        self.assertEqual(rows["ik", "published distance"], ["7.8 cm", "-"])
        text = made.page.read_text()
        self.assertRegex(text, r"x is 2 trainings that differ in the seed only \(x-s0, x-s1\)")
        self.assertRegex(text, r"\| seed \| 0; 1 \| 0 \|")
        self.assertRegex(text, r"\| task\.reset\.random\\_gravity \| True \| False \|")
        self.assertRegex(text, r"\| minutes of training \| 2.0 \| 2.0 \|")
        self.assertNotIn("num_envs", text.replace("\\", ""), "the same in all")
        self.assertIn("![Learning curves and task progress](compare.png)", text)

        made = self.compare(*names, apart=True)
        self.assertEqual([g.label for g in made.groups], names)
        self.assertIn(("x-s1", "task progress (95 % interval)"), self.rows())

    def test_a_picture_of_the_right_size_with_everything_and_with_less(self):
        names = self.write_three()
        heights = []
        for chosen, curves in ((names[3:], ()), (names, ("task/success", *SPEED, "task/success_from_home"))):
            made = compare([str(self.folder / name) for name in chosen], self.folder / "drawn", curves=curves)
            content = made.picture.read_bytes()
            self.assertEqual(content[:8], b"\x89PNG\r\n\x1a\n")
            width, height = (int.from_bytes(content[i : i + 4], "big") for i in (16, 20))
            self.assertEqual(width, 1200)
            heights.append(height)
        self.assertLess(heights[0], heights[1])

    def test_curves_only(self):
        self.write_curves("a", curves_of((60.0, 60.0), (0.0, 0.5)))
        made = self.compare("a")
        self.assertEqual(made.results.body, ())
        self.assertIn("No evaluation results: a.", made.notes)
        self.assertNotIn("## Evaluation", made.page.read_text())

    def test_a_wrong_curve_names_those_that_exist(self):
        self.write_three()
        with self.assertRaisesRegex(
            RunError, r"no curve task/sucess; there are speed/.*task/success, task/success_from_home\. "
        ):
            self.compare("fixed", curves=["task/success", "task/sucess"])
        self.assertFalse((self.folder / "out").exists(), "nothing is written")
        with self.assertRaisesRegex(RunError, "no curve task/success; none of these runs has learning curves"):
            self.compare("ik", curves=["task/success"])

    def test_a_curve_that_only_some_have(self):
        self.write_results("a")
        curves = curves_of((1.0,), (0.5,))
        whole, part = (
            self.training("a", curves),
            self.training("a", {k: v for k, v in curves.items() if k != "task/success"}),
        )
        self.assertEqual(choose_curves([whole, part], []), ("task/success", "task/success_from_home"))
        with self.assertRaisesRegex(RunError, "no curve task/success;"):
            choose_curves([part], [])

    def test_nothing_is_half_written(self):
        a = self.write_results("a")
        blocked = self.folder / "file"
        blocked.write_text("")
        with self.assertRaisesRegex(XResetError, "cannot write"):
            compare([str(a)], blocked / "out")
        self.assertEqual(blocked.read_text(), "")

    def test_text_stays_text_in_markdown(self):
        self.assertEqual(escape("a|b*c_d<e>\nf"), "a\\|b\\*c\\_d\\<e\\> f")


SPEED = ("speed/collect_seconds", "speed/learn_seconds")


class DrawTest(Compared):
    def draw(self, function, *arguments, **options):
        with figure_style({}) as figure_class:
            ax = figure_class().subplots()
            function(ax, *arguments, **options)
        return ax

    def test_lines_and_bands(self):
        from matplotlib.collections import PolyCollection

        x, mean = np.array([1e6, 3e6]), np.array([0.1, 0.3])
        lines = {
            "a": Line(x=x, mean=mean, low=mean, high=mean),
            "c": Line(x=x, mean=mean, low=mean - 0.1, high=mean + 0.1),
        }
        ax = self.draw(draw_lines, lines, "at the goal", "steps", ["a", "b", "c"], percent=True, of="worlds")
        np.testing.assert_allclose(ax.lines[0].get_xydata(), [[1, 10], [3, 30]])
        self.assertEqual([curve.get_color() for curve in ax.lines], [COLORS[0], COLORS[2]])
        (band,) = (c for c in ax.collections if isinstance(c, PolyCollection))
        np.testing.assert_allclose(band.get_datalim(ax.transData).intervaly, (0, 40), atol=1e-9)
        self.assertEqual((ax.get_xlabel(), ax.get_title(loc="left")), ("million environment steps", "at the goal"))

    def test_the_ninth_training_has_another_line_and_hatch(self):

        values = np.array([0.1, 0.3])
        names = [f"n{i}" for i in range(9)]
        ax = self.draw(
            draw_lines,
            {n: Line(x=values, mean=values, low=values, high=values) for n in names},
            "loss/value",
            "minutes",
            names,
            percent=False,
        )
        self.assertEqual(ax.lines[0].get_color(), ax.lines[8].get_color())
        self.assertNotEqual(ax.lines[0].get_linestyle(), ax.lines[8].get_linestyle())
        self.write_results("a")
        own = score(self.training("a").episodes)
        found = pd.DataFrame([{"group": name, "engine": "mujoco"} | own for name in names])
        bars = self.draw(draw_scores, found, names).patches
        self.assertEqual((bars[0].get_hatch() or "", bars[8].get_hatch()), ("", "///"))
        edges = [(bar.get_x(), bar.get_x() + bar.get_width()) for bar in bars]
        self.assertTrue(all(a[1] < b[0] for a, b in pairwise(edges)), "bars do not overlap")

    def test_bars_are_as_long_as_the_results(self):

        self.write_results("a", rollouts_with(1.0, 0.5, 0.5, 0.0), ("mujoco", "sapien"))
        self.write_results("b", rollouts_with(0.2, 0.2, 0.2, 0.2), ("sapien",))
        found = scores(grouped([self.training(n) for n in "ab"])[0])
        ax = self.draw(draw_scores, found, ["a", "b"])
        np.testing.assert_allclose([bar.get_height() for bar in ax.patches], [50, 50, np.nan, 20])
        self.assertEqual([label.get_text() for label in ax.get_xticklabels()], ["mujoco", "sapien"])
        at = [bar.get_x() + bar.get_width() / 2 for bar in ax.patches]
        self.assertTrue(at[0] < 0 and at[1] < 1 < at[3])


class CommandTest(Compared):
    def run_command(self, *arguments: str) -> tuple[int, str]:
        code, out, err = run("compare", *arguments)
        return code, out + err

    def test_from_folders_to_picture_and_page(self):
        for name, seed in (("a", 3), ("b", 4)):
            self.write_run(name, num_envs=WORLDS + seed)
            self.write_results(name, engines=ENGINES, seed=seed)
        out = self.folder / "made"
        code, printed = self.run_command(f"[one]={self.folder}/a", str(self.folder / "b"), "--out", str(out))
        self.assertEqual(code, 0, printed)
        for expected in (
            *ENGINES,
            "[one]",
            "49.8",
            "75/50/25",
            "num_envs",
            "67",
            "note: These results are not comparable",
            "compare.png",
        ):
            self.assertIn(expected, printed)
        self.assertLessEqual(max(map(len, printed.split("picture:")[0].splitlines())), 160)
        self.assertEqual(sorted(f.name for f in out.iterdir()), ["compare.md", "compare.png"])

    def test_mistakes_are_one_line(self):
        for arguments, message in (
            ((), "there is nothing to compare"),
            ((str(self.folder / "x"),), "there is no folder"),
        ):
            code, printed = self.run_command(*arguments)
            self.assertEqual(code, 1)
            self.assertRegex(printed.strip(), f"^xreset compare: {message}[^\n]*$")
        self.assertEqual(self.run_command("a", "--x", "hours")[0], 2)


if __name__ == "__main__":
    unittest.main()
