"""Faults between a policy and its robots, what they cost, and the verdict."""

from dataclasses import replace
from unittest import TestCase
from unittest.mock import Mock, patch

import numpy as np
import torch
from numpy.testing import assert_allclose, assert_array_equal

from tests import toy_grasp
from tests.command import succeeds, xreset
from tests.data import InFolder, upright
from tests.toy_bank import SOUP
from tests.toy_results import swept
from xreset import stress
from xreset.demos.archive import write_demos
from xreset.errors import PolicyError, XResetError
from xreset.eval.conditions import FAULTS
from xreset.eval.effects import verdict
from xreset.eval.policy_spec import load_policy
from xreset.eval.results import read_evaluation
from xreset.eval.rollout import Round, engine, play_rounds
from xreset.geometry.shapes import turn_of
from xreset.live.engine import EngineDriver
from xreset.live.faults import Faults, FaultyDriver
from xreset.policy.shipped import shipped
from xreset.task.config import TaskConfig, evaluation_task

STEPS = 30
STEP = 1 / 60


class FaultyDriverTest(TestCase):
    def setUp(self):
        self.trial = toy_grasp.trial(evaluation_task(TaskConfig()))

    def play(self, faults=None, *, worlds=1, seed=0, gain=1.0):
        """Close and lift; returns the readings of all steps, and the targets of the first world's drives."""
        index = torch.zeros(worlds, dtype=torch.long)
        readings = []
        targets = []
        with self.trial.worlds(engine("mujoco", workers=0), index) as env:
            env.reset(start=self.trial.starts().home(index, torch.Generator().manual_seed(0)))
            env.backend.set_state(toy_grasp.start()[index])
            env.variation.force_gain = gain
            wrench = env.backend.set_object_wrench
            self.wrench = env.backend.set_object_wrench = Mock(side_effect=wrench)
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

    def poses(self, **faults):
        """Return the ages [T] of the poses that are read with faults, and their positions and rotations since the
        start [T, 6]."""
        readings, _ = self.play(Faults(**faults))
        time = np.concatenate([reading.object_time for reading in readings])
        pos = np.concatenate([reading.object_pos for reading in readings])
        quat = np.concatenate([reading.object_quat for reading in readings])
        turn = turn_of(quat) * turn_of(toy_grasp.brick_pose()[1]).inv()
        return np.arange(STEPS) * STEP - time, np.column_stack((pos, turn.as_rotvec()))

    def test_without_faults_nothing_differs(self):
        for plain, faulty in zip(self.play()[0], self.play(Faults())[0], strict=True):
            for name in ("joint_pos", "object_pos", "object_quat", "object_time", "tip_force"):
                assert_array_equal(getattr(plain, name), getattr(faulty, name))

    def test_forces_are_read_with_their_gain(self):
        true, weak = (self.play(gain=gain)[0][-1].tip_force for gain in (1.0, 0.5))
        self.assertGreater(true.max(), 1)
        assert_allclose(weak, 0.5 * true)

    def test_poses_are_late_and_lost(self):
        age, pos = self.poses(pose_delay=0.1)
        assert_allclose(age[6:], 0.1)
        assert_array_equal(pos[6:], self.poses()[1][:-6])
        age, _ = self.poses(pose_delay=0.2, drawn_delays=True)  # draws 0.178 s
        assert_allclose(age[11:], 11 * STEP)
        age, _ = self.poses(tracker_interval=0.05)
        assert_allclose(age, np.arange(STEPS) % 3 * STEP, atol=1e-9)
        with patch.object(Faults, "LOSS_PERIOD", 0.25):
            age, _ = self.poses(lost_frames=0.1)
        self.assertAlmostEqual((age > 1e-9).sum(), 12, delta=2)
        age, _ = self.poses(pose_delay=0.1, pose_jitter=0.1)
        self.assertLess(age.max(), 0.2 + 1.1 * STEP)
        self.assertGreater(np.diff(age).max(), 1.1 * STEP, "one pose overtakes another")

    def test_poses_are_wrong(self):
        _, true = self.poses()
        for kind, own in (("position", slice(3)), ("angle", slice(3, 6))):
            bias, noise = (
                (self.poses(**{f"{kind}_{name}": 0.01})[1] - true)[:5] for name in ("bias", "noise")
            )
            self.assertGreater(np.abs(bias[:, own]).max(), 1e-4)
            assert_allclose(bias, np.broadcast_to(bias[0], bias.shape), atol=1e-5)
            self.assertLessEqual(np.abs(noise).max(), 0.01 + 1e-5)
            self.assertGreater(np.ptp(noise[:, own], axis=0).max(), 1e-4)

    def test_targets_are_late_and_robot_and_object_are_pushed(self):
        joints = self.trial.robot.joints
        is_arm = np.array([joint.group == "arm" for joint in joints])
        _, expected = self.play(Faults())
        _, targets = self.play(Faults(arm_delay=1.5 * STEP, hand_delay=4.5 * STEP))
        late = np.concatenate((expected[:1], expected[:-1]))
        assert_array_equal(targets[:, is_arm], late[:, is_arm])
        self.assertEqual((targets == expected)[:, ~is_arm].all(axis=1).argmax(), 4, "it closes")
        _, targets = self.play(Faults(missed_deadlines=0.5))
        lifts = np.diff(expected[:, is_arm].sum(axis=1))[15:] > 1e-6
        kept = np.diff(targets[:, is_arm].sum(axis=1))[15:] == 0
        self.assertTrue(0 < (kept & lifts).sum() < lifts.sum())
        half, whole = (self.play(Faults(arm_push=share))[1] - expected for share in (0.5, 1.0))
        reach = [joint.drive.effort / joint.drive.kp * (joint.group == "arm") for joint in joints]
        self.assertTrue((np.abs(whole) <= np.array(reach) + 1e-6).all())
        self.assertGreater(np.abs(whole).max(), 1e-3)
        assert_allclose(half, whole / 2, atol=1e-6)
        self.play(Faults(object_push=1.0))
        force = max(float(call.args[0].norm()) for call in self.wrench.call_args_list)
        self.assertAlmostEqual(force * STEP, toy_grasp.brick().mass, places=5)

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
    def result(self, engine="mujoco", progress=0.8, only=None, demos=6, **losses):
        """The result of a sweep; ``action_delay_0=0.2`` is a loss of 20 points at the first value in every episode."""
        sweep = {}
        for prop in FAULTS[:only]:
            name = prop.option.replace("-", "_")
            for i, value in enumerate(prop.values):
                loss = losses.get(f"{name}_{i}", 0.0)
                sweep[prop.option, value] = [progress - loss] * (2 * demos)
        return swept([progress] * (2 * demos), sweep, engine)

    def test_verdicts(self):
        ready = ("Ready for a first, careful trial on a robot.", [])
        self.assertEqual(verdict([self.result()]), ready)
        self.assertIn("by fewer than six", verdict([self.result(demos=5)])[0])
        found = [self.result(), self.result("sapien", action_delay_2=0.2)]
        sentence, reasons = verdict(found)
        self.assertEqual(sentence, "Not ready for a robot.")
        words = "sapien: action delay 0.067 s costs 20.0 points .95 %: 20 to 20.. At most 4"
        self.assertRegex(reasons[0], words)
        scattered = {("pose-delay", 0.2): [0.4] * 4 + [0.85] * 8}
        sentence, reasons = verdict([swept([0.8] * 12, scattered)])
        self.assertIn("Not shown to be ready", sentence)
        self.assertRegex(reasons[0], r"costs 10.0 points .95 %: -\d+ to \d+.")
        _, reasons = verdict([self.result(progress=0.3)])
        self.assertIn("only 30 % without any fault", reasons[0])
        self.assertIn("No verdict", verdict([self.result(only=6)])[0])
        self.assertEqual(verdict([swept([0.8] * 5, {("object-mass", 2.0): [0.8] * 5})]), ("", []))


class StoppedTest(InFolder):
    def test_an_episode_is_measured_to_its_end_although_its_robot_has_stopped(self):
        """Its object may go on moving. With other robots that go on, its episode goes on anyway."""
        demos = upright(SOUP, 1, seed=1)
        policy = load_policy("many-objects")
        steps = round(policy.task.termination.episode_seconds / policy.task.control_dt)
        measure = Round.update_metrics
        with patch.object(Round, "update_metrics", autospec=True, side_effect=measure) as measured:
            results = stress(policy, demos, properties="lost-frames=1.2", episodes=1)
        self.assertIsNone(results.folder)  # nothing was asked to be written
        (found,) = results
        self.assertEqual(list(found.stopped.values()), [1])
        self.assertEqual(measured.call_count, 2 * steps)


class CommandTest(InFolder):
    def test_a_verdict_from_the_command_line(self):
        demos = self.folder / "demos.npz"
        write_demos(demos, upright(SOUP, 1, seed=1))
        policy = shipped()["many-objects"]
        options = ("--demos", demos, "--engine mujoco --episodes 1 --out", self.folder)
        faults = "--property published-faults=0.5 --property lost-frames=1.2"
        out = succeeds("stress", policy, *options, faults)
        self.assertIn("No verdict: not every fault that decides was tried.", out)
        (found,) = read_evaluation(self.folder)
        names = found.changed["property"].tolist()
        self.assertEqual(names, ["published-faults", "lost-frames"])
        self.assertEqual(list(found.stopped.values()), [1])
        self.assertIn("pose of the object is ... s old", next(iter(found.stopped)))
        before = (self.folder / "mujoco.json").read_bytes()
        rolled = "xreset.eval.robot_loop.roll_out_on_robot"
        with patch(rolled, side_effect=KeyboardInterrupt), self.assertRaises(KeyboardInterrupt):
            stress("many-objects", demos, properties="pose-delay=1", out=self.folder)
        after = (self.folder / "mujoco.json").read_bytes()
        self.assertEqual(after, before, "results of a whole sweep stay")
        earlier = xreset("rehearse", policy, *options, "--fault pose-delay=200")
        self.assertEqual(earlier[0], 1)
        for words in (
            "rehearse is now stress --faults",
            "--fault is now --property",
            "200 is too much. Give s, at most 2",
        ):
            self.assertIn(words, earlier[2])
        with self.assertRaisesRegex(PolicyError, "not an exported policy"):
            stress("zero", demos, robot="openarm", faults=True)
        late = ("action-latency", "lost-frames")
        with self.assertRaisesRegex(XResetError, "Choose action-delay in place of action-latency"):
            stress("many-objects", demos, properties=late, out=self.folder)
