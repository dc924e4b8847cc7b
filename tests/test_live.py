"""The loop around a driver: it observes what the environment observes, and every fault ends in a soft stop and a sentence."""

from dataclasses import replace
from importlib.util import find_spec
from typing import ClassVar
from unittest import TestCase, skipUnless

import numpy as np
import torch
from numpy.testing import assert_allclose, assert_array_equal

from tests import toy_grasp
from xreset.eval.robot_loop import SimulatedRunner
from xreset.eval.rollout import engine, episode_starts
from xreset.learning.recipes import RECIPES
from xreset.live.engine import EngineDriver, make_controller
from xreset.runtime import Driver, Reading, Runner
from xreset.task.config import evaluation_task

STEPS = 12


class Scripted(Driver):
    """A robot with a clock of its own that is always where its targets are; ``fault(time, reading)`` changes what is read."""

    def __init__(self, fault=lambda time, reading: reading):
        self.time = 0.0
        self.fault = fault
        self.sent = []
        self.stops = 0

    def now(self):
        return self.time

    def wait_until(self, moment):
        self.time = max(self.time, moment)

    def read(self):
        pos = self.sent[-1] if self.sent else np.zeros(2, np.float32)
        reading = Reading(
            joint_pos=pos,
            joint_vel=np.zeros(2),
            joint_time=self.time,
            object_pos=np.array([0.5, 0.0, 0.1]),
            object_quat=np.array([1.0, 0, 0, 0]),
            object_time=self.time,
        )
        return self.fault(self.time, reading)

    def send(self, target):
        self.sent.append(target)

    def stop(self):
        self.stops += 1


class Steady:
    """In place of a controller: both joints move by one step in every control step."""

    contract: ClassVar = {"joints": [{"name": "shoulder"}, {"name": "finger"}]}
    dt = 0.02
    lower = np.array([-1.0, -1.0], np.float32)
    upper = np.array([9.0, 9.0], np.float32)
    step_size = np.array([0.01, 0.0], np.float32)

    def __init__(self, act=lambda target: target + 0.01):
        self.target = np.zeros((1, 2), np.float32)
        self.act = act

    def step(self, reading):
        self.target = self.act(self.target).astype(np.float32)
        return self.target


def after(moment, **changes):
    """A fault from that time on: values, or functions of (time, reading)."""

    def fault(time, reading):
        if time < moment:
            return reading
        return replace(
            reading, **{k: v(time, reading) if callable(v) else v for k, v in changes.items()}
        )

    return fault


def refuse(*_):
    raise ConnectionError("the cable is out")


class FaultTest(TestCase):
    def stopped(self, driver, controller=None):
        """Run until the robot stops; returns the sentence. The targets must slow down and come to rest."""
        outcome = Runner(controller or Steady(), driver).run(seconds=30)
        self.assertEqual(driver.stops, 1)
        self.assertLess(driver.time, 5, "it hangs")
        moves = np.diff(driver.sent, axis=0)
        self.assertLessEqual(np.abs(moves).max(), 0.0101)
        self.assertTrue((np.diff(moves[-12:, 0]) <= 1e-6).all())
        self.assertLess(abs(moves[-1, 0]), 0.001)
        slowing = (moves[:, 0] > 1e-6) & (moves[:, 0] < 0.0099)
        self.assertLessEqual(slowing.sum() * Steady.dt, 0.26)
        assert_array_equal(moves[-10:, 1], 0)  # a target that may jump stays
        return outcome.reason

    def test_data_that_stay_away_or_are_wrong(self):
        nan = np.full(3, np.nan)
        for name, fault, words in (
            ("dead tracker", after(1, object_time=0.99), r"pose of the object is 1\.0\d? s old: no newer one has come"),
            ("clock back", after(1, object_time=lambda t, r: 2 - t), "old: the time stamps of newer ones run backwards"),
            ("clock ahead", after(1, object_time=lambda t, r: t + 60), "old: newer ones have time stamps ahead"),
            ("NaN pose", after(1, object_pos=nan), "old: newer ones hold numbers that are not finite"),
            ("no rotation", after(1, object_quat=np.zeros(4)), "old: newer ones hold numbers .* no unit quaternion"),
            ("no pose at all", after(0, object_pos=nan), "old: newer ones hold numbers"),
            ("NaN joint", after(1, joint_pos=np.array([0, np.nan])), "joint positions are 0.1. s old, or not finite"),
            ("old joints", after(1, joint_time=0.99), "joint positions are 0.1. s old"),
            ("NaN force", after(1, tip_force=np.full((2, 3), np.nan)), "joint positions are 0.1. s old, or not finite"),
            ("limit", after(1, joint_pos=np.array([0, 9.11])), "Joint finger is at 9.11, beyond its limit 9.00"),
            ("lower limit", after(1, joint_pos=np.array([-1.11, 0])), "Joint shoulder is at -1.11, beyond its limit -1.00"),
            ("no pose", after(1, object_pos=None), "object_pos is None. Without a new value, give the last one"),
            ("no cable", lambda t, r: refuse() if t > 1 else r, "The driver could not read: the cable is out"),
        ):  # fmt: skip
            with self.subTest(name), self.assertLogs("xreset", "WARNING") as logs:
                if name == "no pose at all":
                    driver = Scripted(fault)
                    self.assertRegex(Runner(Steady(), driver).run(30).reason or "", words)
                    self.assertEqual((np.abs(driver.sent).max(), driver.stops), (0, 1))
                    continue
                self.assertRegex(self.stopped(Scripted(fault)) or "", words)
                self.assertEqual(len(logs.output), 1)

    def test_joints_slightly_beyond_their_limits_are_tolerated(self):
        driver = Scripted(after(0, joint_pos=np.array([-1.09, 9.09])))
        self.assertIsNone(Runner(Steady(), driver).run(1).reason)

    def test_a_policy_that_fails(self):
        calls = []

        def later(result):
            def act(target):
                calls.append(1)
                return target + 0.01 if len(calls) < 30 else result(target)

            return Steady(act)

        for result, words in (
            (lambda target: target * np.nan, "The policy gave numbers that are not finite"),
            (refuse, "The policy could not act: the cable is out"),
        ):
            calls.clear()
            with self.subTest(words), self.assertLogs("xreset"):
                self.assertRegex(self.stopped(Scripted(), later(result)) or "", words)

    def test_a_slow_step_a_lost_driver_and_ctrl_c(self):
        driver = Scripted()

        def slow(target):
            driver.time += 0.03 if driver.time < 1 else 1.0
            return target + 0.01

        with self.assertLogs("xreset"):
            outcome = Runner(Steady(slow), driver).run(30)
        self.assertRegex(outcome.reason or "", "A control step took 0.98 s too long")
        self.assertGreater(outcome.missed, 20)
        driver = Scripted()
        driver.send = refuse  # type: ignore[method-assign]
        with self.assertLogs("xreset"):
            self.assertRegex(
                Runner(Steady(), driver).run(30).reason or "",
                "could not send targets: the cable is out",
            )
        self.assertEqual(driver.stops, 1)

        def interrupted(target):
            if driver.time > 1:
                raise KeyboardInterrupt
            return target + 0.01

        driver = Scripted()
        with self.assertLogs("xreset"):
            self.assertEqual(self.stopped(driver, Steady(interrupted)), "Ctrl-C was pressed.")
        driver = Scripted()
        with self.assertRaises(KeyboardInterrupt):
            SimulatedRunner(Steady(interrupted), driver).run(30)
        self.assertEqual(driver.stops, 1)

    def test_a_clock_that_moves_when_the_driver_reads(self):
        driver = Scripted()

        def moved(time, reading):
            driver.time = time + 0.015
            return reading

        driver.fault = moved
        driver.wait_until = lambda moment: None  # type: ignore[method-assign]
        self.assertIsNone(Runner(Steady(), driver).run(3).reason)

    def test_a_clock_that_nobody_moves(self):
        driver = Scripted()
        driver.wait_until = lambda moment: None  # type: ignore[method-assign]
        with self.assertLogs("xreset"):
            outcome = Runner(Steady(), driver).run(30)
        self.assertRegex(outcome.reason or "", "clock stands still. Override now.. and wait_until")
        self.assertEqual(driver.stops, 1)
        self.assertLess(len(driver.sent), 10)

        driver.wait_until = lambda moment: setattr(driver, "time", moment // 0.05 * 0.05)  # type: ignore[method-assign]
        self.assertIsNone(Runner(Steady(), driver).run(3).reason, "a coarse clock is no fault")

    def test_late_data_are_used_and_single_faults_are_ignored(self):
        def fault(time, reading):
            if 1 < time < 1.6:  # half a second of lost frames
                return replace(reading, object_time=1.0)
            if round(time / 0.02) % 7 == 0:
                return replace(reading, object_pos=np.full(3, np.nan))
            return replace(reading, object_time=time - 0.2)

        driver = Scripted(fault)
        outcome = Runner(Steady(), driver).run(3)
        self.assertIsNone(outcome.reason)
        self.assertGreater(outcome.refused[0], 10)
        self.assertEqual((len(driver.sent), driver.stops), (150, 1))


@skipUnless(find_spec("mujoco"), "mujoco is not installed")
class EngineTest(TestCase):
    def test_it_observes_and_acts_as_the_environment_bit_for_bit(self):
        for name in ("paper", "robust", "live", "published"):
            with self.subTest(name):
                self._check(evaluation_task(RECIPES[name].config.task))

    def _check(self, task):
        played = toy_grasp.trial(task)
        sequences = np.arange(2)
        start = episode_starts(played.starts(), sequences, sequences, seed=0)
        actions = np.random.default_rng(0).uniform(-1.2, 1.2, (STEPS, 2, len(played.robot.joints)))
        actor = Recorded(actions.astype(np.float32))
        recorded = []
        with played.worlds(engine("mujoco", workers=0), torch.zeros(2, dtype=torch.long)) as env:
            env.reset(start=start)
            for action in actor.actions:
                seen = env.get_observations()
                flat = torch.cat((seen["policy"], seen["proprio"]), dim=1)
                recorded.append((flat.numpy(), seen["perception"].numpy().copy()))
                env.advance(torch.from_numpy(action))
            moving = EngineDriver(env).read()
            found = make_controller(env, actor).kinematics.links(moving.joint_pos, moving.joint_vel)
            for name in ("palm_pos", "palm_linvel", "palm_angvel"):
                assert_allclose(
                    getattr(found, name), getattr(moving.links, name), atol=2e-4, err_msg=name
                )
            env.reset(start=start)
            controller = make_controller(env, actor)
            driver = EngineDriver(env)
            links = controller.observe(replace(driver.read(), links=None))[0]
            assert_allclose(links, recorded[0][0], atol=1e-6)  # forward kinematics
            controller = make_controller(env, actor)
            outcome = Runner(controller, driver).run(STEPS * controller.dt)
        self.assertEqual(
            (outcome.reasons, outcome.steps, len(actor.seen)), ([None, None], STEPS, STEPS)
        )
        for expected, found in zip(recorded, actor.seen, strict=True):
            assert_array_equal(found[0], expected[0])
            assert_array_equal(found[1], expected[1])


class Recorded:
    """In place of a network: actions, and what it saw."""

    def __init__(self, actions):
        self.actions = actions
        self.seen = []

    def begin(self, robots):
        self.seen = []

    def act(self, flat, cloud):
        self.seen.append((flat, cloud))
        return np.clip(self.actions[len(self.seen) - 1], -1, 1)
