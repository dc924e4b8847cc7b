"""Metrics on constructed trajectories, confidence intervals, result files."""

import json
import math
import os
import re
from contextlib import chdir
from dataclasses import replace
from pathlib import Path
from unittest import TestCase
from unittest.mock import patch

import numpy as np
import pandas as pd
import torch
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from pandas.testing import assert_frame_equal
from scipy.spatial.transform import Rotation
from torch import tensor
from torch.testing import assert_close

from tests import toy_grasp
from tests.command import succeeds
from tests.data import InFolder, refuses
from tests.toy_bank import SOUP, SPAM, toy_bank, toy_retargeted
from tests.toy_results import OBJECTS, toy_result, toy_rollouts
from xreset import (
    evaluate,
    load_object,
    load_policy,
    synthesize,
    write_demos,
    write_retargeted,
)
from xreset.errors import FileFormatError, PolicyError, XResetError
from xreset.eval.engines.recording import play
from xreset.eval.metrics import METRICS, EpisodeMetrics, MetricPoints
from xreset.eval.report.groups import estimate
from xreset.eval.results import Evaluation, read_evaluation, read_traces, write_result
from xreset.eval.rollout import chosen_engines, engine, load_trial, play_rounds, roll_out
from xreset.eval.stats import bootstrap_ci95, share_ci95
from xreset.eval.table import result_rows
from xreset.files.storage import claim_folder, file_hash
from xreset.geometry.rotations import quat_from_axis_angle
from xreset.objects.sampling import metric_points
from xreset.physics import Contacts, Health, Links, State
from xreset.task.config import RandomizationConfig, TaskConfig, TerminationConfig
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
        for world, quat in enumerate(quats):
            angle = 2 * math.acos(abs(float(quat[0])))  # starts are not turned
            self.assertAlmostEqual(float(together.turn[world]), angle, delta=1e-3)
        for name in (
            "approach", "grasp", "reorient", "reorient_once", "out_of_bounds", "published_success",
            "least_distance", "final_distance", "final_position_error", "final_angle",
            "reorientation_progress", "task_progress", "turn",
        ):  # fmt: skip
            found = getattr(together, name)
            assert_close(found, torch.cat([getattr(m, name) for m in alone]))

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
        policy = load_policy("zero", robot="ur7e-sharpa")
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

    def test_directions_do_not_depend_on_the_number_of_worlds(self):
        task = TaskConfig(
            reset=toy_grasp.AT_HOME, randomization=RandomizationConfig(object_com=(0.01, 0.01))
        )
        offsets = []
        for worlds in (1, 3):
            found = {}

            def note(played, found=found):
                com = played.env.variation.parameters["object_com"]
                for world in played.fresh:
                    found[int(played.sequence[world])] = com[world].tolist()

            trial = toy_grasp.trial(task, num_envs=worlds)
            play_rounds(engine("mujoco", workers=0), trial, 1, note)
            offsets.append(np.array([found[sequence] for sequence in range(3)]))
        assert_array_equal(offsets[0], offsets[1])
        assert_allclose(np.linalg.norm(offsets[0], axis=1), 0.01, rtol=1e-5)
        self.assertGreater(np.ptp(offsets[0], axis=0).min(), 1e-3)

    def test_the_same_engine_repeats_the_episode_with_its_recorded_targets(self):
        task = TaskConfig(
            reset=toy_grasp.AT_HOME,
            randomization=RandomizationConfig(enabled=False),
            termination=TerminationConfig(episode_seconds=0.7),
        )
        trial = toy_grasp.trial(task, num_envs=1)
        mujoco = engine("mujoco", workers=0)
        episode = roll_out(toy_grasp.OpenLoop(), mujoco, trial, episodes=1).traces[1]
        poses = (episode.joint_pos, episode.object_pos, episode.object_quat)
        start = State.at_rest(*(torch.as_tensor(pose[:1]) for pose in poses))
        targets = torch.as_tensor(episode.joint_target)[:, None].float()
        self.assertEqual(len(targets), 42)
        with trial.worlds(mujoco, torch.zeros(1, dtype=torch.long)) as env:
            replayed = play(env.backend, start, targets)
        every = slice(2, None, 3)  # control steps of 1/60 s between recorded states
        for name in ("object_pos", "joint_pos"):
            found = getattr(replayed, name)[every, 0]
            assert_allclose(found, getattr(episode, name)[1:], atol=1e-6)


class BootstrapTest(TestCase):
    @patch("xreset.eval.stats.DRAWS", 400)
    def covered(self, cluster):
        """Share of 200 experiments whose interval holds the true mean: 15 demonstrations, 5 episodes each, which are nearly alike."""
        rng = default_rng(3)
        hits = 0
        for _ in range(200):
            groups = np.repeat(np.arange(15), 5)
            values = rng.normal(0, 1, 15)[groups] + 0.1 * rng.normal(size=75)
            low, high = bootstrap_ci95(values, groups if cluster else np.arange(len(values)))
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
        self.assertEqual(bootstrap_ci95(np.array([0.3]), np.zeros(1)), (0.3, 0.3))
        alone = bootstrap_ci95(np.array([1.0, 0, 1, 0]), np.zeros(4))
        self.assertTrue(0 <= alone[0] < 0.5 < alone[1] <= 1)

    def test_four_of_four_are_not_certain(self):
        groups = np.arange(4)
        runs = np.zeros(4)
        low, high = share_ci95(np.ones(4), runs, groups)
        self.assertAlmostEqual(low, 4 / (4 + 1.959964**2), places=6)  # Wilson's interval
        self.assertEqual(high, 1.0)
        self.assertEqual(share_ci95(np.zeros(4), runs, groups)[0], 0.0)
        mixed = np.array([1.0, 1.0, 1.0, 0.0])
        self.assertEqual(share_ci95(mixed, runs, groups), bootstrap_ci95(mixed, groups))
        self.assertTrue(np.isnan(share_ci95(np.full(4, np.nan), runs, groups)).all())


JOINTS = ("a", "b", "c")


class ResultsTest(InFolder):
    """Results of the toy in two engines."""

    def setUp(self):
        super().setUp()
        self.rollouts = toy_rollouts()
        for name in ("sapien", "mujoco"):
            write_result(self.folder, toy_result(name), self.rollouts.traces, JOINTS)
        self.policy = toy_grasp.policy()

    def test_the_table_tells_trained_objects_from_unseen_ones(self):
        result = toy_result(unseen=(OBJECTS[1],))
        table = {row[0].strip(): row[1] for row in reversed(result_rows([result]))}
        self.assertEqual((table["trained objects"], table["unseen objects"]), ("66.5%", "33.0%"))
        for same in (toy_result(), toy_result(unseen=OBJECTS)):
            self.assertNotIn("unseen objects", {row[0].strip() for row in result_rows([same])})

    def test_an_evaluation_shows_its_table(self):
        evaluation = read_evaluation(self.folder)
        table = evaluation.to_frame()
        self.assertEqual(len(table), 8)
        means = table.groupby("engine")["task_progress"].mean().round(6).to_dict()
        self.assertEqual(means, dict.fromkeys(("mujoco", "sapien"), 0.4975))
        first = table.iloc[0][["policy", "robot", "seed", "property", "sequence_name"]]
        self.assertEqual(first.tolist(), ["zero", "toy", 3, "", "demo_0"])
        self.assertEqual(repr(evaluation), str(evaluation))
        for expected in ("mujoco", "sapien", "49.8%", "episodes: 4, demonstrations: 2, seed: 3"):
            self.assertIn(expected, str(evaluation))

    def test_a_kill_leaves_no_earlier_results_next_to_new_states(self):
        killed = patch("xreset.eval.results.write_json", side_effect=KeyboardInterrupt)
        with killed, self.assertRaises(KeyboardInterrupt):
            write_result(self.folder, toy_result(), self.rollouts.traces, JOINTS)
        self.assertEqual([result.engine for result in read_evaluation(self.folder)], ["sapien"])

    def test_means_and_intervals(self):
        found = toy_result()
        self.assertEqual((found.objects, found.episodes_per_demo), ((SOUP, SPAM), 2))
        means = {name: found.mean(name) for name in METRICS}
        expected = {"task_progress": 0.4975, "approach": 0.75, "grasp": 0.5, "reorient": 0.25}
        expected |= {"reorientation_progress": 0.375, "nonfinite": 0.25, "out_of_bounds": 0.25}
        self.assertEqual({name: means[name] for name in expected}, expected)
        self.assertEqual(found.ci95("task_progress"), (0.33, 0.665), "the two demonstrations")

    def test_impossible_values_are_refused(self):
        path = self.folder / "mujoco.json"
        whole = json.loads(path.read_text())
        for words, changes in (
            ("unknown(.|\n)*by xreset '9.9'", {"later": 1, "xreset": "9.9"}),
            ("inputs.demos is 3", {"inputs": {"demos": 3}}),
            ("schema version 'xreset-eval/0'", {"schema": "xreset-eval/0"}),
            ("'<script>alert", {"engine_version": ["<script>alert(1)</script>"]}),
            ("episodes is None, expected an object", {"episodes": ...}),
            ("measured is {'effort': 1.0}. This option was removed", {"measured": {"effort": 1.0}}),
        ):
            content = {name: x for name, x in (whole | changes).items() if x is not ...}
            path.write_text(json.dumps(content))
            with refuses(self, words, FileFormatError, changes):
                read_evaluation(self.folder)
        for words, column, values in (
            (
                r"task_progress\[0\] is 1e.308, expected a number from 0 to 1",
                "task_progress",
                1e308,
            ),
            (r"progress\[0\] is -7, expected", "reorientation_progress", -7),
            (r"sequence\[0\] is -1, expected", "sequence", -1),
            ("missing: grasp", "grasp", ...),
            ("unknown: colour", "colour", 1),
            (r"the columns of episodes have \[3, 4\] entries", "grasp", [True] * 3),
            ("no unchanged episode", "property", "object-mass"),
        ):
            columns = dict(whole["episodes"])
            columns[column] = values if isinstance(values, list) else [values] * 4
            if values is ...:
                del columns[column]
            path.write_text(json.dumps(whole | {"episodes": columns}))
            with refuses(self, words, FileFormatError, column):
                read_evaluation(self.folder)

    def write_as_earlier(self, engine, *unmeasured):
        """Replace a result by the two files of 0.1 to 0.3: a summary, and a list of episodes without some metrics."""
        path = self.folder / f"{engine}.json"
        content = json.loads(path.read_text())
        columns = content.pop("episodes")
        names = columns.keys() - {"property", "value", *unmeasured}
        rows = pd.DataFrame({name: columns[name] for name in names}).to_dict("records")
        earlier = {"schema": "xreset-episodes/1", "episodes": rows}
        path.with_name(f"{engine}.episodes.json").write_text(json.dumps(earlier))
        for name in ("left_out", "stopped"):
            del content[name]
        content["backend"] = content.pop("engine")
        content["backend_version"] = content.pop("engine_version")
        content |= {"schema": "xreset-eval/1", "episodes": 4, "episodes_per_demo": 2}
        content |= {"task_progress": {"mean": 0.4975, "ci95": [0.33, 0.665]}, "grasp_rate": 0.5}
        path.write_text(json.dumps(content))
        return path, content

    def test_an_earlier_version_did_not_measure_the_published_success(self):
        """Its files load and say so; the rest of the table is as it was, also next to results of today."""
        today = read_evaluation(self.folder)
        self.assertEqual(today.to_frame()["published_success"].dtype, bool)
        self.assertRegex(str(today), r"published success *│ *25.0% │ *25.0%")
        unmeasured = ("published_success", "least_distance", "final_distance", "final_angle")
        path, content = self.write_as_earlier("mujoco", *unmeasured)
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
        path.write_text(json.dumps(content | {"episodes": 5}))
        words = "states 5 episodes, .* holds 4"
        self.assertRaisesRegex(FileFormatError, words, read_evaluation, self.folder)
        # new results replace both files
        write_result(self.folder, toy_result("mujoco"), self.rollouts.traces, JOINTS)
        self.assertFalse(path.with_name("mujoco.episodes.json").exists())

    def test_files(self):
        sweep = {("object-mass", 0.5): self.rollouts.episodes}
        write_result(self.folder, toy_result(sweep=sweep), self.rollouts.traces, JOINTS)
        found = read_evaluation(self.folder)
        self.assertEqual([r.engine for r in found], ["mujoco", "sapien"])
        self.assertEqual(found[0], toy_result(sweep=sweep))
        assert_frame_equal(found[0].episodes, toy_result(sweep=sweep).episodes)
        self.assertEqual((len(found[0].nominal), len(found[0].changed)), (4, 4))
        traces = read_traces(self.folder, "mujoco", JOINTS)
        for read, made in zip(traces, self.rollouts.traces, strict=True):
            for name, value in vars(made).items():
                assert_array_equal(getattr(read, name), value, name)
        with self.assertRaisesRegex(FileFormatError, "joint_names\\[1\\] is .b., here .c."):
            read_traces(self.folder, "mujoco", ("a", "c", "b"))
        trace = self.folder / "mujoco.trace.npz"
        trace.write_bytes(trace.read_bytes()[:200])
        with self.assertRaisesRegex(FileFormatError, "cannot be read as an evaluation trace"):
            read_traces(self.folder, "mujoco", JOINTS)
        trace.unlink()
        with self.assertRaisesRegex(
            FileFormatError, "xreset eval makes it, xreset stress does not"
        ):
            read_traces(self.folder, "mujoco", JOINTS)

    def test_what_cannot_be_played_is_refused(self):
        with self.assertRaisesRegex(PolicyError, "Linear.*expected a name, a path or a PolicySpec"):
            evaluate(torch.nn.Linear(2, 2), "demos.npz")
        with self.assertRaisesRegex(XResetError, r"Found \['soup'\], expected Demos"):
            evaluate("zero", ["soup"], robot="openarm")
        with self.assertRaisesRegex(XResetError, r"needs a robot.* \(robot=... or --robot\)"):
            evaluate("zero", "demos.npz")

    def test_a_policy_of_ones_own_is_checked(self):
        mine = replace(self.policy, folder=str(self.folder))
        self.assertEqual(mine.folder, self.folder)
        for changes, words in (
            ({"robot": "openarm"}, "robot is 'openarm', expected RobotSpec"),
            ({"task": None}, "task is None, expected TaskConfig"),
            ({"folder": None}, "folder is None, expected Path"),
        ):
            with refuses(self, words, XResetError):
                replace(mine, **changes)

    def test_two_evaluations_are_not_written_into_one_folder(self):
        with (
            patch("xreset.eval.rollout.load_trial"),
            patch("xreset.eval.rollout.chosen_engines", return_value=[]),
        ):
            with claim_folder(self.folder), self.assertRaisesRegex(XResetError, "writing"):
                evaluate(self.policy, "demos.npz", out=self.folder)
            self.assertEqual(evaluate(self.policy, "demos.npz", out=self.folder), [])

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
            out = self.folder / str(seconds)
            (result,) = evaluate(
                policy,
                bank,
                engine("mujoco", workers=0),
                episodes=1,
                episode_seconds=seconds,
                out=out,
            )
            self.assertEqual(result.episode_seconds, seconds)
            self.assertIn(
                f"episodes: 3 of {seconds} s, demonstrations: 3", repr(Evaluation([result]))
            )
            self.assertEqual(read_evaluation(out), [result])
            found[seconds] = read_traces(out, "mujoco", policy.robot.joint_names)
        for short, long in zip(found[0.1], found[0.25], strict=True):
            self.assertEqual([len(short.joint_target), len(long.joint_target)], [6, 15])
            assert_array_equal(long.object_pos[: len(short.time)], short.object_pos)
        trained = load_trial(policy, bank).task.termination.episode_seconds
        self.assertEqual(trained, policy.task.termination.episode_seconds)

    def test_the_command_has_a_default_folder_and_the_function_has_none(self):
        with chdir(self.folder):
            write_demos("demos.npz", synthesize([SOUP], 1))
            made = evaluate("zero", "demos.npz", robot="openarm", episode_seconds=0.1)
            self.assertFalse(os.path.exists("runs"))
            succeeds("eval zero --robot openarm --demos demos.npz --episode-seconds 0.1")
            (found,) = read_evaluation(Path("runs/zero-openarm/eval"))
            assert_frame_equal(found.episodes, made[0].episodes)

    def test_starts_and_goals_that_are_in_no_file_are_told_apart(self):
        """Reports compare results only if they are of the same ones."""
        policy = load_policy("zero", robot="ur7e-sharpa")
        bank = toy_bank(policy.robot)
        other = replace(bank, goal_pos=bank.goal_pos + 0.01)
        hashes = [load_trial(policy, each).inputs["demos"] for each in (bank, bank, other)]
        self.assertEqual(hashes[0], hashes[1])
        self.assertNotEqual(hashes[0], hashes[2])

    def test_motion_counts_as_the_demonstrations_that_it_was_made_of(self):
        """ik plays motion, policies play demonstrations: reports compare them."""
        demos = self.folder / "demos.npz"
        write_demos(demos, synthesize([SOUP], 1, fps=8))
        policy = load_policy("zero", robot="openarm")
        motion = self.folder / "motion.npz"
        made = toy_retargeted(policy.robot, [SOUP], [0, 2])
        write_retargeted(motion, made, inputs={"demos": file_hash(demos)})
        trials = [load_trial(policy, path) for path in (demos, motion)]
        self.assertEqual(*[trial.inputs["demos"] for trial in trials])

    def test_the_shortest_episodes_have_traces(self):
        """Usually three control steps lie between two states; these episodes have one other state."""
        policy = load_policy("zero", robot="ur7e-sharpa")
        for steps in (1, 5):
            out = self.folder / str(steps)
            options = {"episodes": 1, "episode_seconds": steps / 59, "out": out}
            evaluate(policy, toy_bank(policy.robot), engine("mujoco", workers=0), **options)
            for trace in read_traces(out, "mujoco", policy.robot.joint_names):
                assert_allclose(trace.time, (0.0, steps / 60), atol=1e-6)
                self.assertEqual(trace.actions("it")[1], steps)

    def test_episodes_of_no_length_are_refused(self):
        for seconds in (0, -1.0, 0.01, math.nan, math.inf, 1e300, "12", True):
            words = rf"^episode_seconds is {re.escape(repr(seconds))}, expected a number( from 0.0167, .* to 1,000,000|\.)"
            with refuses(self, words, XResetError, seconds):
                evaluate("zero", "demos.npz", robot="openarm", episode_seconds=seconds)

    def test_results_of_other_episodes_are_not_replaced(self):
        file = self.folder / "mujoco.json"
        choose = r". Choose another folder \(--out; in Python: out\), or remove the file."
        for name, demos, seconds, told in (
            (self.policy.name, "ab", 5.0, ""),
            ("other", "ab", 5.0, f"{file} has results of another policy, other{choose}"),
            (self.policy.name, "cd", 5.0, f"{file} has results of other demonstrations"),
            (self.policy.name, "ab", 6.0, f"{file} has results of episodes of another length"),
        ):
            write_result(self.folder, toy_result(policy=name, episode_seconds=5.0), (), ())
            before = file.read_bytes()
            with (
                self.subTest(told),
                patch("xreset.eval.rollout.load_trial") as load_trial,
                patch("xreset.eval.experiment.roll_out", side_effect=KeyboardInterrupt),
                self.assertRaisesRegex(XResetError if told else KeyboardInterrupt, told),
            ):
                task = TaskConfig(termination=TerminationConfig(episode_seconds=seconds))
                load_trial.return_value = toy_grasp.trial(task, inputs={"demos": demos})
                evaluate(self.policy, "demos.npz", "mujoco", out=self.folder)
            self.assertEqual(file.read_bytes(), before)

    def test_a_result_that_is_not_a_number_is_not_written(self):
        bad = replace(self.rollouts.episodes[0], reorientation_progress=math.nan)
        broken = replace(self.rollouts, episodes=(bad,))
        new = self.folder / "new"
        with self.assertRaises(ValueError):
            write_result(new, toy_result(rollouts=broken), broken.traces, JOINTS)
        self.assertFalse(new.exists())
