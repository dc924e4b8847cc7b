"""Metrics on constructed trajectories, confidence intervals, result files."""

import contextlib
import io
import json
import math
import re
from dataclasses import asdict, replace
from unittest import TestCase
from unittest.mock import patch

import numpy as np
import torch
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation
from torch import tensor

from tests import toy_grasp
from tests.data import InFolder
from tests.toy_bank import SOUP, SPAM, toy_bank
from tests.toy_results import OBJECTS, toy_rollouts, toy_summary
from xreset import evaluate, load_object, load_policy
from xreset.errors import FileFormatError, PolicyError, XResetError
from xreset.eval.metrics import EpisodeMetrics, MetricPoints
from xreset.eval.report.groups import estimate
from xreset.eval.results import (
    Episode,
    EvalResult,
    Evaluation,
    read_evaluation,
    read_traces,
    write_results,
)
from xreset.eval.rollout import chosen_engines, engine, load_trial, roll_out
from xreset.eval.stats import bootstrap_ci95, mean_of_known
from xreset.eval.table import result_rows
from xreset.files.checks import from_dict
from xreset.files.storage import claim_folder
from xreset.geometry.rotations import quat_from_axis_angle
from xreset.objects.sampling import metric_points
from xreset.physics import Contacts, Health, Links, State
from xreset.task.reading import Reading

CORNERS = tensor([[-1.0, -1, -1], [1, 1, -1], [1, -1, 1], [-1, 1, 1]]) * 0.05
POINTS = MetricPoints(keypoints=CORNERS[None], surface=CORNERS[None])
IDENTITY = tensor([1.0, 0, 0, 0])
START = tensor([0.5, 0.3, 0.05])
GOAL = tensor([0.5, 0.3, 0.25])
PRESS = (1.0, 0.0, 1.0)
LIGHT = (0.0, 1.0, 1.0)


def reading(
    pos=START,
    quat=IDENTITY,
    tips=(0.2, 0.2, 0.2),
    press=(0.0, 0.0, 0.0),
    nonfinite=False,
    overflow=False,
):
    """One world with three fingers (thumb first): the object's pose, fingertip distances [m], contact forces [N]."""
    zero3 = torch.zeros(1, 3)
    quats = IDENTITY.expand(1, 4, 4)
    joints = torch.zeros(1, 2)
    force = tensor(press)[None, :, None] * tensor([0.0, 0.6, 0.8])
    state = State.at_rest(joints, torch.as_tensor(pos)[None], torch.as_tensor(quat)[None])
    return Reading(
        state=state,
        task_state=state,
        links=Links(pos=torch.zeros(1, 4, 3), quat=quats, linvel=torch.zeros(1, 4, 3), angvel=torch.zeros(1, 4, 3)),
        contacts=Contacts(tip_force=force, tip_touch=force.norm(dim=-1) > 0, table_force=zero3),
        health=Health(nonfinite=tensor([nonfinite]), overflow=tensor([overflow])),
        tip_distance=tensor(tips)[None],
    )  # fmt: skip


def joined(places, quat=IDENTITY):
    """One reading of several worlds, in which the hand holds the object."""
    each = [reading(pos, quat, **HELD) for pos in places]
    parts = {}
    for name, value in vars(each[0]).items():
        if name not in ("tip_distance", "task_state"):
            parts[name] = type(value).cat([getattr(one, name) for one in each])
    distances = torch.cat([one.tip_distance for one in each])
    return Reading(**parts, task_state=parts["state"], tip_distance=distances)


def raised(height):
    return START + tensor([0.0, 0.0, height])


def turned(degrees):
    return quat_from_axis_angle(tensor([0.0, 0.0, math.radians(degrees)]))


def episode(*steps, start=None, lost_at=None):
    """The metrics of an episode; at step ``lost_at`` the object leaves the scene."""
    metrics = EpisodeMetrics(start or reading(), GOAL[None], IDENTITY[None], POINTS)
    for i, step in enumerate(steps):
        metrics.update(step, tensor([i == lost_at]))
    return metrics


SCORES = {"": 0.0, "a": 0.33, "ag": 0.66, "g": 0.66}
HELD = {"press": PRESS, "tips": (0.0, 0.0, 0.0)}
AWAY = GOAL + tensor([0.1, 0.1, 0.0])
OFF = GOAL + tensor([0.0, 0.0195, 0.0])


class MetricsTest(TestCase):
    def test_stages(self):
        """Reached stages are given by their first letters."""
        near = {"tips": (0.0, 0.0, 0.0)}
        for name, expected, m in (
            ("nothing", "", episode(reading(tips=(0.06, 0.051, 0.2)))),
            (
                "one finger within five centimetres",
                "a",
                episode(reading(tips=(0.2, 0.049, 0.2)), reading()),
            ),
            ("at the start", "a", episode(reading(), start=reading(tips=(0.2, 0.2, 0.04)))),
            ("thumb, finger and lift at once", "ag", episode(reading(raised(0.011), **HELD))),
            ("too low", "a", episode(reading(raised(0.009), **HELD))),
            ("no thumb", "a", episode(reading(raised(0.011), press=LIGHT, **near))),
            ("thumb too light", "a", episode(reading(raised(0.011), press=(0.09, 1, 1), **near))),
            ("light thumb", "ag", episode(reading(raised(0.011), press=(0.11, 1, 1), **near))),
            (
                "not at once",
                "a",
                episode(reading(press=PRESS, **near), reading(raised(0.05), **near)),
            ),
            ("dropped later", "ag", episode(reading(raised(0.05), **HELD), reading())),
            ("at the goal", "r", episode(reading(GOAL))),
            ("left the goal", "", episode(reading(GOAL), reading(raised(0.1)))),
            ("two centimetres, fifteen degrees", "r", episode(reading(OFF, turned(14.8)))),
            ("the other sign of the quaternion", "r", episode(reading(OFF, -turned(14.8)))),
            ("turned too far", "", episode(reading(OFF, turned(15.2)))),
            ("too far away", "", episode(reading(GOAL + tensor([0.0, 0.0205, 0.0])))),
            (
                "left the scene first",
                "",
                episode(reading(), reading(raised(0.05), **HELD), reading(GOAL), lost_at=1),
            ),
            (
                "left later",
                "ag",
                episode(reading(raised(0.1), **HELD), reading(GOAL), reading(GOAL), lost_at=2),
            ),
            ("overflow ends nothing", "r", episode(reading(overflow=True), reading(GOAL))),
        ):
            with self.subTest(name):
                stages = ["approach", "grasp", "reorient"]
                self.assertEqual("".join(s[0] for s in stages if getattr(m, s)), expected)
                self.assertAlmostEqual(m.task_progress, SCORES.get(expected, 1.0), delta=5e-7)
                self.assertEqual(
                    m.reorient_once, expected == "r" or name in ("left the goal", "left later")
                )
                self.assertEqual(
                    m.out_of_bounds, name.startswith("left the scene") or name == "left later"
                )
                self.assertEqual(m.overflow, name.startswith("overflow"))

    def test_reorientation_progress_is_the_best_of_the_episode(self):
        """The goal is 0.20 above the start without a turn, so every keypoint is that far. Half a turn about z moves
        every corner by 2 sqrt(2) 5 cm; a shift adds to it in the worst corner."""
        for expected, m in (
            (0.75, episode(reading(raised(0.05)), reading(raised(0.15)), reading(raised(0.1)))),
            (0.0, episode(reading(raised(-0.1)))),
            (1.0, episode(reading(GOAL))),
            (0.0, episode(reading(), reading(raised(0.05)), reading(GOAL), lost_at=1)),
            (
                1 - 0.12 * math.sqrt(2) / 0.2,
                episode(reading(GOAL + tensor([0.02, 0.02, 0.0]), turned(180))),
            ),
            (
                1 - 0.1 / (0.2 * math.sqrt(2)),
                episode(reading(raised(0.1)), start=reading(AWAY, turned(180))),
            ),
        ):
            self.assertAlmostEqual(m.reorientation_progress, expected, delta=5e-6)
        # nothing is left to do: no division by zero
        there = episode(reading(GOAL), start=reading(GOAL))
        self.assertTrue(0.0 <= float(there.reorientation_progress) <= 1.0)

    def test_published_success_is_a_mean_distance_of_two_centimetres_at_any_time(self):
        """No turn moves every point as far as the origin; 20 degrees about z move each corner by 2 sqrt(2) 5 cm sin 10
        degrees."""
        turn = 0.1 * math.sqrt(2) * math.sin(math.radians(10))
        near = GOAL + tensor([0.0, 0.0199, 0.0])
        far = GOAL + tensor([0.0, 0.0201, 0.0])
        for name, m, success, least, last in (
            (
                "near, then away",
                episode(reading(near), reading(raised(0.1))),
                True,
                0.0199,
                (0.1, 0.1, 0.0),
            ),
            ("not near enough", episode(reading(far)), False, 0.0201, (0.0201, 0.0201, 0.0)),
            ("at the start", episode(reading(), start=reading(GOAL)), True, 0.0, (0.2, 0.2, 0.0)),
            (
                "turned",
                episode(reading(GOAL, turned(20))),
                False,
                turn,
                (turn, 0.0, math.radians(20)),
            ),
            (
                "left the scene",
                episode(reading(raised(0.1)), reading(GOAL, turned(20)), lost_at=1),
                False,
                0.1,
                (0.1, 0.1, 0.0),
            ),
        ):
            with self.subTest(name):
                self.assertEqual(m.published_success, success)
                self.assertAlmostEqual(m.least_distance, least, delta=5e-7)
                found = torch.cat((m.final_distance, m.final_position_error, m.final_angle))
                assert_allclose(found, last, atol=1e-3)

    def test_each_world_has_its_own_start_goal_and_end(self):
        """The second lifts its object, not as high as the first one's start, and loses it. Also if what was given is
        overwritten later."""
        high = START + tensor([0.1, 0.0, 0.1])
        goal = high + tensor([0.05, 0.0, 0.15])
        worlds = (
            (high, goal, turned(40), (high, goal, goal), None),
            (START, GOAL, IDENTITY, (raised(0.05), raised(0.09), GOAL), 2),
            (START, high, IDENTITY, (START, START, START), None),
        )
        alone = []
        for start, goal, quat, places, lost_at in worlds:
            m = EpisodeMetrics(reading(start, **HELD), goal[None], quat[None], POINTS)
            for step, pos in enumerate(places):
                m.update(reading(pos, turned(5), **HELD), tensor([step == lost_at]))
            alone.append(m)
        starts, goals, quats, paths, losses = zip(*worlds, strict=True)
        given = (joined(starts), torch.stack(goals), torch.stack(quats))
        together = EpisodeMetrics(*given, MetricPoints.cat([POINTS] * 3))
        given[0].state.object_pos.zero_()
        given[1].zero_()
        given[2].zero_()
        for step, places in enumerate(zip(*paths, strict=True)):
            lost = tensor([step == lost_at for lost_at in losses])
            together.update(joined(places, turned(5)), lost)
        self.assertEqual(together.grasp.tolist(), [True, True, False])
        for name in (
            "approach", "grasp", "reorient", "reorient_once", "out_of_bounds", "published_success",
            "least_distance", "final_distance", "final_position_error", "final_angle",
            "reorientation_progress", "task_progress",
        ):  # fmt: skip
            found = getattr(together, name)
            torch.testing.assert_close(found, torch.cat([getattr(m, name) for m in alone]))

    def test_a_world_that_is_not_finite_is_counted_and_no_longer_looked_at(self):
        nan = torch.full((3,), math.nan)
        broken = reading(nan, tips=(math.nan,) * 3, press=(math.nan,) * 3, nonfinite=True)
        m = episode(
            reading(raised(0.05)), broken, broken, reading(GOAL, tips=(0, 0, 0), nonfinite=True)
        )
        self.assertFalse(m.approach or m.grasp or m.reorient or m.out_of_bounds)
        self.assertTrue(m.nonfinite)
        self.assertAlmostEqual(m.reorientation_progress, 0.25, delta=5e-6)
        self.assertAlmostEqual(m.final_distance, 0.15, delta=5e-6)

    def test_an_episode_has_one_end(self):
        """What happens to a world after its end is not counted, nor is the place of a broken world."""
        broken = reading(torch.full((3,), math.inf), nonfinite=True)
        late = reading(nonfinite=True, overflow=True)
        for expected, m in (
            ((True, False, False), episode(broken, reading(), lost_at=0)),
            ((True, False, False), episode(broken, reading(), lost_at=1)),
            ((False, False, True), episode(reading(), late, lost_at=0)),
        ):
            self.assertEqual((bool(m.nonfinite), bool(m.overflow), bool(m.out_of_bounds)), expected)


class RecordedTest(TestCase):
    def test_distances_are_those_of_the_recorded_states(self):
        """Objects fall past their goals, and numpy computes the distances of every recorded control step again."""
        policy = load_policy("random", robot="ur7e-sharpa")
        short = replace(policy.task.termination, episode_seconds=0.4)
        policy = replace(policy, task=replace(policy.task, termination=short))
        falling = toy_bank(policy.robot)
        falling.start_pos[:, 2] = (0.30, 0.35, 0.40)
        falling.goal_pos[:] = (0.51, 0.3, 0.20)
        trial = load_trial(policy, falling, seed=1)
        with patch("xreset.eval.rollout.TRACE_INTERVAL", 0.0):
            found = roll_out(policy.start(None), engine("mujoco", workers=0), trial, episodes=1)
        for episode, trace in zip(found.episodes, found.traces, strict=True):
            points = metric_points(load_object(trace.object))
            turns = Rotation.from_quat(trace.object_quat, scalar_first=True).as_matrix()
            goal = (
                Rotation.from_quat(trace.goal_quat, scalar_first=True).apply(points)
                + trace.goal_pos
            )
            distance = np.linalg.norm(
                points @ turns.swapaxes(1, 2) + trace.object_pos[:, None] - goal, axis=-1
            ).mean(1)
            error = np.linalg.norm(trace.object_pos[-1] - trace.goal_pos)
            measured = (
                episode.least_distance,
                episode.final_distance,
                episode.final_position_error,
            )
            assert_allclose(measured, (distance.min(), distance[-1], error), atol=5e-6)
            self.assertEqual(episode.published_success, distance.min() <= 0.02)
        self.assertGreater(
            len({e.least_distance for e in found.episodes}), 2, "each world is judged by itself"
        )


class BootstrapTest(TestCase):
    def test_agrees_with_the_normal_approximation(self):
        values = default_rng(2).normal(5.0, 2.0, 400)
        low, high = bootstrap_ci95(values)
        half = 1.96 * values.std() / math.sqrt(len(values))
        self.assertAlmostEqual(low, values.mean() - half, delta=0.05 * half)
        self.assertAlmostEqual(high, values.mean() + half, delta=0.05 * half)
        self.assertEqual(bootstrap_ci95(values), (low, high))
        self.assertEqual(bootstrap_ci95(np.array([0.3])), (0.3, 0.3))

    @patch("xreset.eval.stats.DRAWS", 400)
    def covered(self, cluster):
        """Share of 200 experiments whose interval holds the true mean: 15 demonstrations, 5 episodes each, which are nearly alike."""
        rng = default_rng(3)
        hits = 0
        for _ in range(200):
            groups = np.repeat(np.arange(15), 5)
            values = rng.normal(0, 1, 15)[groups] + 0.1 * rng.normal(size=75)
            low, high = bootstrap_ci95(values, groups if cluster else None)
            hits += low <= 0 <= high
        return hits / 200

    def test_whole_demonstrations_are_drawn(self):
        self.assertGreater(self.covered(cluster=True), 0.87)
        self.assertLess(self.covered(cluster=False), 0.75)

    def test_groups_may_differ_in_size(self):
        low, high = bootstrap_ci95(np.array([1.0, 1, 1, 1, 0]), np.array([7, 7, 7, 7, 2]))
        self.assertEqual((low, high), (0.0, 1.0))
        # 20 demonstrations of nine episodes that succeed, and 20 of one that fails
        groups = np.concatenate((np.repeat(np.arange(20), 9), 20 + np.arange(20)))
        low, high = bootstrap_ci95((groups < 20).astype(float), groups)
        self.assertTrue(0.75 < low < 0.9 < high < 1.0, (low, high))
        alone = bootstrap_ci95(np.array([1.0, 0, 1, 0]), np.zeros(4))
        self.assertTrue(0 <= alone[0] < 0.5 < alone[1] <= 1)

    def test_a_mean_of_what_was_not_always_measured_is_unknown(self):
        self.assertEqual(mean_of_known([1.0, 4.0]), 2.5)
        self.assertIsNone(mean_of_known([1.0, None]))


JOINTS = ("a", "b", "c")


class ResultsTest(InFolder):
    """Results of the toy in two engines."""

    def setUp(self):
        super().setUp()
        self.rollouts = toy_rollouts()
        for name in ("sapien", "mujoco"):
            write_results(self.folder, toy_summary(name), self.rollouts, JOINTS)
        self.policy = replace(toy_grasp.policy(), folder=self.folder)

    def test_the_table_tells_trained_objects_from_unseen_ones(self):
        summary = toy_summary(unseen=(OBJECTS[1],))
        table = {row[0].strip(): row[1] for row in reversed(result_rows([summary]))}
        self.assertEqual((table["trained objects"], table["unseen objects"]), ("66.5%", "33.0%"))
        for same in (toy_summary(), toy_summary(unseen=OBJECTS)):
            self.assertNotIn("unseen objects", {row[0].strip() for row in result_rows([same])})
        self.assertEqual(from_dict(EvalResult, json.loads(json.dumps(asdict(summary)))), summary)

    def test_an_evaluation_shows_its_table(self):
        evaluation = read_evaluation(self.folder)
        table = evaluation.to_frame()
        self.assertEqual(len(table), 8)
        means = table.groupby("engine")["task_progress"].mean().round(6).to_dict()
        self.assertEqual(means, dict.fromkeys(("mujoco", "sapien"), 0.4975))
        first = table.iloc[0][["policy", "robot", "seed", "sequence_name"]]
        self.assertEqual(first.tolist(), ["zero", "toy", 3, "demo_0"])
        self.assertEqual(repr(evaluation), str(evaluation))
        for expected in ("mujoco", "sapien", "49.8%", "episodes: 4, demonstrations: 2, seed: 3"):
            self.assertIn(expected, str(evaluation))
        self.assertIn("task progress", str(Evaluation([toy_summary()], [])))

    def test_summary(self):
        s = toy_summary()
        self.assertEqual((s.objects, s.episodes, s.task_progress.mean), ((SOUP, SPAM), 4, 0.4975))
        self.assertEqual(
            s.task_progress.ci95,
            (0.33, 0.665),
            "two demonstrations: the interval spans their means",
        )
        self.assertEqual((s.approach_rate, s.grasp_rate, s.reorient_rate), (0.75, 0.5, 0.25))
        self.assertEqual(s.reorientation_progress, 0.375)
        self.assertEqual(vars(s.health), {"nonfinite": 1, "overflow": 1, "out_of_bounds": 1})
        self.assertEqual(
            [(d.sequence, d.task_progress) for d in s.per_demo],
            [("demo_0", 0.665), ("demo_1", 0.33)],
        )
        self.assertEqual(
            (s.per_demo[1].grasp_rate, s.per_demo[1].object, s.per_demo[1].episodes), (0.5, SPAM, 2)
        )

    def test_impossible_values_are_refused(self):
        episode = asdict(self.rollouts.episodes[0])
        health = {"nonfinite": "<script>alert(1)</script>", "overflow": 0, "out_of_bounds": 0}
        wide = {"mean": 7, "ci95": [0, 1]}
        short = {"mean": 0.5, "ci95": [0]}
        for file, words, changes in (
            ("mujoco.json", "missing: grasp_rate", {}),
            ("mujoco.json", "unknown: later", {"later": 1}),
            ("mujoco.json", "unknown(.|\n)*by xreset '9.9'", {"later": 1, "xreset": "9.9"}),
            ("mujoco.json", "policy is 5, expected str", {"policy": 5}),
            ("mujoco.json", "mean is 7, expected a number from 0 to 1", {"task_progress": wide}),
            ("mujoco.json", "ci95 has 1 entries", {"task_progress": short}),
            ("mujoco.json", "nonfinite is '<script>alert", {"health": health}),
            ("mujoco.json", "inputs.demos is 3", {"inputs": {"demos": 3}}),
            ("mujoco.json", r"per_demo is \[\], expected one demonstration", {"per_demo": []}),
            ("mujoco.json", "schema version 'xreset-eval/0'", {"schema": "xreset-eval/0"}),
            ("mujoco.episodes.json", "task_progress is 1e.308, expected", {"task_progress": 1e308}),
            ("mujoco.episodes.json", "progress is -7, expected", {"reorientation_progress": -7}),
            ("mujoco.episodes.json", "sequence is -1, expected", {"sequence": -1}),
        ):
            path = self.folder / file
            whole = path.read_text()
            content = json.loads(whole)
            if "episodes" in file:
                content["episodes"] = [episode | changes] * 4
            elif changes:
                content |= changes
            else:
                del content["grasp_rate"]
            path.write_text(json.dumps(content))
            with self.subTest(changes), self.assertRaisesRegex(FileFormatError, words):
                read_evaluation(self.folder)
            path.write_text(whole)

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
        for name, expected in (("mujoco", np.nan), ("sapien", 0.0775)):
            found, low, _ = estimate(table[table["engine"] == name], "least_distance")
            assert_allclose(found, expected)
            self.assertEqual(np.isnan(low), np.isnan(expected))

    def test_files(self):
        found = read_evaluation(self.folder)
        self.assertEqual([s.engine for s in found], ["mujoco", "sapien"])
        self.assertEqual(found[0], toy_summary("mujoco"))
        traces = read_traces(self.folder, "mujoco", JOINTS)
        for read, made in zip(traces, self.rollouts.traces, strict=True):
            for name, value in vars(made).items():
                assert_array_equal(getattr(read, name), value, name)
        episodes = json.loads((self.folder / "mujoco.episodes.json").read_text())["episodes"]
        self.assertEqual(Episode(**episodes[2]), self.rollouts.episodes[2])
        with self.assertRaisesRegex(FileFormatError, "joints a, b, c.*robot has a, c, b"):
            read_traces(self.folder, "mujoco", ("a", "c", "b"))
        trace = self.folder / "mujoco.trace.npz"
        trace.write_bytes(trace.read_bytes()[:200])
        with self.assertRaisesRegex(FileFormatError, "cannot be read as an evaluation trace"):
            read_traces(self.folder, "mujoco", JOINTS)

    def test_what_cannot_be_played_is_refused(self):
        with self.assertRaisesRegex(PolicyError, "Linear.*expected a name, a path or a PolicySpec"):
            evaluate(torch.nn.Linear(2, 2), "demos.npz")
        with self.assertRaisesRegex(XResetError, r"Found \['soup'\], expected Demos"):
            evaluate("zero", ["soup"], robot="openarm")
        with self.assertRaisesRegex(XResetError, "episodes is 0"):
            evaluate("zero", "demos.npz", robot="openarm", episodes=0)
        with self.assertRaisesRegex(XResetError, r"needs a robot.* \(robot=... or --robot\)"):
            evaluate("zero", "demos.npz")
        policy = load_policy("zero", robot="openarm")
        policy.check_seed(None)  # no seed chose the policy, and the type is checked later

    def test_a_policy_of_ones_own_is_checked(self):
        mine = replace(self.policy, folder=str(self.folder))
        self.assertEqual(mine.folder, self.folder)
        for changes, words in (
            ({"robot": "openarm"}, "robot is 'openarm', expected RobotSpec"),
            ({"task": None}, "task is None, expected TaskConfig"),
            ({"folder": None}, "folder is None, expected a path"),
        ):
            with self.subTest(words), self.assertRaisesRegex(XResetError, words):
                replace(mine, **changes)

    def test_two_evaluations_are_not_written_into_one_folder(self):
        with (
            patch("xreset.eval.evaluate.load_trial"),
            patch("xreset.eval.evaluate.chosen_engines", return_value=[]),
        ):
            with claim_folder(self.folder), self.assertRaisesRegex(XResetError, "writing"):
                evaluate(self.policy, "demos.npz")
            self.assertEqual(evaluate(self.policy, "demos.npz"), [])

    def test_engines_of_one_name_and_another_robot_are_refused(self):
        alike = [engine("mujoco", workers=0), "mujoco"]
        words = "2 engines are called 'mujoco'.* same file"
        self.assertRaisesRegex(XResetError, words, chosen_engines, alike, "cpu")
        policy = load_policy("zero", robot="ur7e-sharpa")
        words = "'zero' is loaded for the robot 'ur7e-sharpa' already"
        with self.assertRaisesRegex(PolicyError, words):
            evaluate(policy, toy_bank(policy.robot), robot="openarm")
        self.assertIs(load_policy(policy, robot="ur7e-sharpa"), policy)

    def test_episodes_have_the_length_that_is_asked_for(self):
        """The same starts, played for longer: the first states are the same. The result states the length."""
        policy = load_policy("zero", robot="ur7e-sharpa")
        bank = toy_bank(policy.robot)
        found = {}
        for seconds in (0.1, np.float32(0.25)):
            (result,) = evaluate(
                policy,
                bank,
                engine("mujoco", workers=0),
                episodes=1,
                episode_seconds=seconds,
                out=self.folder,
            )
            self.assertEqual(result.episode_seconds, seconds)
            self.assertIn(
                f"episodes: 3 of {seconds} s, demonstrations: 3", repr(Evaluation([result], []))
            )
            self.assertEqual(read_evaluation(self.folder)[0], result)
            found[seconds] = read_traces(self.folder, "mujoco", policy.robot.joint_names)
        for short, long in zip(found[0.1], found[0.25], strict=True):
            self.assertEqual([len(short.joint_target), len(long.joint_target)], [6, 15])
            assert_array_equal(long.object_pos[: len(short.time)], short.object_pos)
        trained = load_trial(policy, bank).task.termination.episode_seconds
        self.assertEqual(trained, policy.task.termination.episode_seconds)

    def test_episodes_of_no_length_are_refused(self):
        for seconds in (0, -1.0, 0.01, math.nan, math.inf, 1e300, "12", True):
            words = rf"^episode_seconds is {re.escape(repr(seconds))}, expected a number from 0.0167, .* to 1,000,000"
            with self.subTest(seconds), self.assertRaisesRegex(XResetError, words):
                evaluate("zero", "demos.npz", robot="openarm", episode_seconds=seconds)

    def test_results_of_another_length_are_named_before_they_are_replaced(self):
        policy = load_policy("zero", robot="ur7e-sharpa")
        bank = toy_bank(policy.robot)
        for seconds, told in ((0.1, ""), (0.1, ""), (0.2, "results of episodes of another length")):
            errors = io.StringIO()
            with self.subTest(seconds), contextlib.redirect_stderr(errors):
                evaluate(
                    policy,
                    bank,
                    [engine("mujoco", workers=0)],
                    episodes=1,
                    episode_seconds=seconds,
                    out=self.folder / "new",
                )
            self.assertIn(told, errors.getvalue())
            self.assertEqual(bool(told), bool(errors.getvalue()))

    def test_results_of_other_demonstrations_are_named_before_they_are_replaced(self):
        before = (self.folder / "mujoco.json").read_bytes()
        for demos, told in (("ab", ""), ("cd", f"{self.folder / 'mujoco.json'}: results of other")):
            errors = io.StringIO()
            with (
                self.subTest(demos),
                patch("xreset.eval.evaluate.load_trial") as load_trial,
                patch("xreset.eval.evaluate.roll_out", side_effect=KeyboardInterrupt),
                contextlib.redirect_stderr(errors),
                self.assertRaises(KeyboardInterrupt),
            ):
                load_trial.return_value.inputs = {"demos": demos}
                evaluate(self.policy, "demos.npz", "mujoco")
            self.assertEqual(errors.getvalue()[: len(told) or None], told)
        self.assertEqual((self.folder / "mujoco.json").read_bytes(), before)

    def test_a_result_that_is_not_a_number_is_not_written(self):
        bad = replace(self.rollouts.episodes[0], reorientation_progress=math.nan)
        broken = replace(self.rollouts, episodes=(bad,))
        new = self.folder / "new"
        with self.assertRaises(ValueError):
            write_results(new, toy_summary(rollouts=broken), broken, JOINTS)
        self.assertFalse(new.exists())
