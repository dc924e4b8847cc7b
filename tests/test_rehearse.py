"""Faults between a policy and its robots, what they cost, and the verdict."""

from dataclasses import replace
from importlib.util import find_spec
from unittest import TestCase, mock, skipUnless

import numpy as np
import torch
from numpy.testing import assert_allclose, assert_array_equal

from tests import toy_grasp
from tests.command import refused, succeeds
from tests.data import InFolder
from tests.toy_bank import SOUP
from tests.toy_results import episodes, toy_card
from xreset.eval.rehearse import Rehearsal, judge, page, rehearse
from xreset.eval.rollout import engine, play_rounds
from xreset.eval.sensitivity import REHEARSED
from xreset.eval.stress import curve
from xreset.files.storage import read_json
from xreset.live.engine import EngineDriver
from xreset.live.faults import Faults, FaultyDriver
from xreset.policy.shipped import shipped
from xreset.task.config import TaskConfig, evaluation_task

STEPS = 30


@skipUnless(find_spec("mujoco"), "mujoco is not installed")
class FaultyDriverTest(TestCase):
    def setUp(self):
        self.trial = toy_grasp.trial(evaluation_task(TaskConfig()))

    def play(self, faults=None, *, worlds=1, seed=0):
        """Close and lift; returns the readings of all steps, and the targets of the first world's drives."""
        index = torch.zeros(worlds, dtype=torch.long)
        readings = []
        targets = []
        with self.trial.worlds(engine("mujoco", workers=0), index) as env:
            env.reset(start=self.trial.starts().home(index, torch.Generator().manual_seed(0)))
            env.backend.set_state(toy_grasp.start()[index])
            driver = EngineDriver(env)
            if faults is not None:
                driver = FaultyDriver(env, faults, [(seed, 1)] * worlds)
            for step in range(STEPS):
                readings.append(driver.read())
                wanted = np.tile(toy_grasp.targets(step).astype(np.float32), (worlds, 1))
                driver.send(wanted)
                driver.wait_until(driver.now() + env.backend.scene.control_dt)
                targets.append(env.backend.state().joint_target[0].numpy().copy())
        return readings, np.stack(targets)

    def poses(self, faults):
        """Return time stamps [T] and positions [T, 3] of the poses that are read with faults."""
        readings, _ = self.play(faults)
        times = [float(reading.object_time[0]) for reading in readings]
        return np.array(times), np.stack([reading.object_pos[0] for reading in readings])

    def test_without_faults_nothing_differs(self):
        for plain, faulty in zip(self.play()[0], self.play(Faults())[0], strict=True):
            for name in ("joint_pos", "object_pos", "object_quat", "object_time", "tip_force"):
                assert_array_equal(getattr(plain, name), getattr(faulty, name))

    def test_each_fault_does_what_it_says(self):
        step = 1 / 60
        now = np.arange(STEPS) * step
        _, true = self.poses(Faults())
        time, pos = self.poses(Faults(pose_delay=0.1))
        assert_allclose(now[8:] - time[8:], 0.1, atol=step)
        self.assertLess(np.abs(pos - true[0]).max() - 1e-6, np.abs(true - true[0]).max())
        time, _ = self.poses(Faults(tracker_interval=0.05))
        assert_allclose(time, np.floor(np.arange(STEPS) / 3) * 3 * step, atol=1e-9)
        time, _ = self.poses(Faults(lost_frames=Faults.LOSS_PERIOD))
        assert_array_equal(time, 0)
        _, pos = self.poses(Faults(position_bias=0.01, angle_bias=0.1))
        bias = (pos - true)[:5]
        self.assertGreater(np.abs(bias).max(), 1e-4)
        assert_allclose(bias, np.broadcast_to(bias[0], bias.shape), atol=1e-6)
        _, pos = self.poses(Faults(position_noise=0.01))
        noise = (pos - true)[:5]
        self.assertLessEqual(np.abs(noise).max(), 0.01 + 1e-6)
        self.assertGreater(np.ptp(noise, axis=0).max(), 1e-4)
        _, pos = self.poses(Faults(object_push=1.0))
        self.assertGreater(np.abs(pos - true).max(), 1e-3)

        is_arm = np.array([joint.group == "arm" for joint in self.trial.robot.joints])
        _, expected = self.play(Faults())
        _, targets = self.play(Faults(arm_delay=2 * step, hand_delay=4.5 * step))
        assert_array_equal(targets[2:, is_arm], expected[:-2, is_arm])
        assert_array_equal(targets[5:, ~is_arm], expected[:-5, ~is_arm])
        _, targets = self.play(Faults(missed_deadlines=0.5))
        lifts = np.diff(expected[:, is_arm].sum(axis=1))[15:] > 1e-6
        kept = np.diff(targets[:, is_arm].sum(axis=1))[15:] == 0
        self.assertTrue(0 < (kept & lifts).sum() < lifts.sum())
        _, targets = self.play(Faults(arm_push=1.0))
        self.assertTrue((targets[:, is_arm] != expected[:, is_arm]).any())

    def test_a_seed_decides_everything(self):
        faults = Faults(
            position_noise=0.01, pose_delay=0.2, missed_deadlines=0.3, drawn_delays=True
        )
        first = self.play(faults)[0]
        for other, same in (
            (self.play(faults, worlds=2)[0], True),
            (self.play(faults, seed=1)[0], False),
        ):
            equal = [
                np.array_equal(a.object_pos[0], b.object_pos[0])
                for a, b in zip(first, other, strict=True)
            ]
            self.assertEqual(all(equal), same)


@skipUnless(find_spec("mujoco"), "mujoco is not installed")
class FrameTest(TestCase):
    def test_distances_do_not_depend_on_the_frame_of_the_object(self):
        task = evaluation_task(TaskConfig())
        distances = []
        for frame in ("mesh", "center"):
            in_frame = replace(task, object_frame=frame, reset=toy_grasp.AT_HOME)
            trial = toy_grasp.trial(in_frame)
            episodes = play_rounds(engine("mujoco", workers=0), trial, 1, lambda r: None)
            distances.append(episodes[0].final_distance)
        self.assertAlmostEqual(distances[0], distances[1], places=5)


class VerdictTest(TestCase):
    def card(self, engine="mujoco", **losses):
        """A card; ``action_delay_67=0.2`` is a loss of 20 points in every episode."""
        curves = []
        for prop in REHEARSED:
            name = prop.option.replace("-", "_")
            swept = {}
            for value in prop.values:
                swept[value] = episodes([0.8 - losses.get(f"{name}_{value:g}", 0.0)] * 5)
            curves.append(curve(prop, episodes([0.8] * 5), swept))
        stopped = {"The pose is old.": 2}
        return toy_card(Rehearsal, engine=engine, curves=tuple(curves), stopped=stopped)

    def test_verdicts(self):
        self.assertEqual(judge([self.card()]), ("Ready for a first, careful trial on a robot.", []))
        sentence, reasons = judge([self.card(), self.card("sapien", action_delay_67=0.2)])
        self.assertEqual(sentence, "Not ready for a robot.")
        self.assertRegex(
            reasons[0], "sapien: action delay 67 ms costs 20.0 points .95 %: 20 to 20.. At most 4"
        )
        card = self.card(action_delay_67=0.2)
        curves = []
        for each in card.curves:
            points = tuple(replace(point, difference_ci95=(-0.2, 1e-6)) for point in each.points)
            curves.append(replace(each, points=points))
        self.assertRegex(judge([replace(card, curves=tuple(curves))])[1][0], "95 %: 0 to 20.")
        _, reasons = judge([replace(self.card(), task_progress=0.3)])
        self.assertIn("only 30 % without any fault", reasons[0])
        self.assertIn("No verdict", judge([replace(self.card(), curves=self.card().curves[:3])])[0])

    def test_the_page_has_every_fault(self):
        text = page([self.card(), self.card("sapien", action_delay_67=0.2, action_delay_133=0.4)])
        for expected in (
            "Not ready",
            "50 ms",
            "none that was tried",
            "not tried on hardware",
            "The pose is old",
            "<svg",
        ):
            self.assertIn(expected, text)
        for prop in REHEARSED:
            self.assertIn(prop.option.replace("-", " "), text)


@skipUnless(find_spec("mujoco"), "mujoco is not installed")
class CommandTest(InFolder):
    def test_a_page_from_the_command_line(self):
        demos = self.folder / "demos.npz"
        succeeds("demos", "synth", "--objects", SOUP, "--per-object", 1, "--out", demos)
        options = ("--demos", demos, "--engine", "mujoco", "--out", self.folder)
        out = succeeds(
            "rehearse",
            shipped()["soup-can"],
            *options,
            "--fault",
            "published-faults=0.5",
            "--fault",
            "lost-frames=1.2",
        )
        self.assertIn("No verdict: not every fault that decides was tried.", out)
        found = read_json(f"{self.folder}/mujoco.json", "xreset-rehearsal/1")
        self.assertEqual(
            [c["property"] for c in found["curves"]], ["published-faults", "lost-frames"]
        )
        self.assertEqual(list(found["stopped"].values()), [1])
        self.assertIn("pose of the object is ... s old", next(iter(found["stopped"])))
        self.assertTrue((self.folder / "index.html").is_file())
        self.assertFalse((self.folder / "mujoco.partial").exists())
        before = (self.folder / "mujoco.json").read_bytes()
        played = [episodes([0.8] * 5)] * 2
        with (
            mock.patch("xreset.eval.rehearse._play", side_effect=[*played, KeyboardInterrupt]),
            self.assertRaises(KeyboardInterrupt),
        ):
            rehearse("soup-can", demos, faults=("pose-delay=1", "lost-frames"), out=self.folder)
        after = (self.folder / "mujoco.json").read_bytes()
        self.assertEqual(after, before, "results of a whole rehearsal stay")
        partial = read_json(self.folder / "mujoco.partial", "xreset-rehearsal/1")
        self.assertEqual([c["property"] for c in partial["curves"]], ["pose-delay"])
        err = refused(
            "rehearse", shipped()["soup-can"], *options, "--fault", "missed-deadlines=150"
        )
        self.assertIn("missed-deadlines 150 % of the steps cannot be tried", err)
