"""The loop around a driver: it observes what the environment observes, and every fault ends in a soft stop and a sentence."""

from dataclasses import replace
from typing import ClassVar
from unittest import TestCase
from unittest.mock import Mock

import numpy as np
import torch
from numpy.testing import assert_allclose, assert_array_equal

from tests import toy_grasp
from tests.data import refuses
from xreset.eval.robot_loop import SimulatedRunner
from xreset.eval.rollout import engine, episode_starts
from xreset.learning.recipes import RECIPES
from xreset.live.deploy import deploy_contract, known_of
from xreset.live.engine import EngineDriver, centers
from xreset.live.graph import Act, Observe
from xreset.runtime import Driver, Limits, LiveError, Reading, Runner
from xreset.runtime.contract import joint_values
from xreset.task.config import TaskConfig, evaluation_task

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
    speed = np.array([0.6, np.inf], np.float32)
    links = None
    outputs = ("target",)

    def __init__(self, act=lambda target: target + 0.01):
        self.target = np.zeros((1, 2), np.float32)
        self.act = act

    def step(self, reading):
        self.target = self.act(self.target).astype(np.float32)
        return self.target


class Noting(Steady):
    """It notes the readings that it acts on."""

    def __init__(self):
        super().__init__()
        self.readings = []

    def step(self, reading):
        self.readings.append(reading)
        return super().step(reading)


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
    def reason(self, driver, controller=None, limits=None, seconds=30):
        """Run until the robot stops, which is logged; returns why."""
        with self.assertLogs("xreset"):
            return Runner(controller or Steady(), driver, limits or Limits()).run(seconds).reason

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
        self.assertGreater(slowing.sum() * Steady.dt, 0.15)
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
            ("NaN joint", after(1, joint_pos=np.array([0, np.nan])), "joint positions are 0.1. s old: newer ones"),
            ("NaN velocity", after(1, joint_vel=np.array([0, np.nan])), "joint positions are 0.1. s old: newer ones"),
            ("joint clock back", after(1, joint_time=lambda t, r: 2 - t), "joint positions are 0.1. s old: newer ones"),
            ("joint clock ahead", after(1, joint_time=lambda t, r: t + 60), "joint positions are 0.1. s old: newer ones"),
            ("old joints", after(1, joint_time=0.99), "joint positions are 0.1. s old"),
            ("NaN force", after(1, tip_force=np.full((2, 3), np.nan)), "joint positions are 0.1. s old: newer ones"),
            ("too fast", after(1, joint_vel=np.array([-1.3, 0])), "Joint shoulder moves at 1.30, faster than its limit 1.20"),
            ("limit", after(1, joint_pos=np.array([0, 9.11])), "Joint finger is at 9.11, beyond its limit 9.00"),
            ("lower limit", after(1, joint_pos=np.array([-1.11, 0])), "Joint shoulder is at -1.11, beyond its limit -1.00"),
            ("no pose", after(1, object_pos=None), "object_pos is None. Without a new value, give the last one"),
            ("millimetres", after(1, object_pos=np.array([500, 0, 100])), "old: newer ones hold .* more than 10 m"),
            ("one joint", after(1, joint_pos=np.zeros(1)), r"could not read: joint_pos has shape \(1, 1\), expected \(1, 2\)\.$"),
            ("times", after(1, joint_time=np.zeros(1)), r"joint_time has shape \(1, 1\), expected \(1,\)\.$"),
            ("no cable", lambda t, r: refuse() if t > 1 else r, "The driver could not read: the cable is out"),
        ):  # fmt: skip
            with self.subTest(name), self.assertLogs("xreset", "WARNING") as logs:
                self.assertRegex(self.stopped(Scripted(fault)), words)
                self.assertEqual(len(logs.output), 1)

    def test_a_driver_may_use_its_arrays_again(self):
        """A tracker writes into its own array, and the robot counts its first joint the other way."""
        pose = np.array([0.5, 0.0, 0.1], np.float32)

        def fault(time, reading):
            pose[0] = 50.0 if 1 < time < 1.5 else 0.5
            return replace(reading, object_pos=pose)

        driver = Scripted(fault)
        controller = Noting()
        send = driver.send

        def turned(target):
            send(target.copy())
            target[0] *= -1

        driver.send = turned
        self.assertIsNone(Runner(controller, driver, Limits(target_speed=0.5)).run(2).reason)
        assert_allclose([reading.object_pos[0, 0] for reading in controller.readings], 0.5)
        assert_allclose(np.diff(driver.sent, axis=0)[:, 0], 0.006, rtol=1e-4)

    def test_a_second_run_knows_nothing_of_the_first(self):
        driver = Scripted()
        controller = Steady()
        runner = Runner(controller, driver)
        runner.run(1)
        controller.target = np.zeros((1, 2), np.float32)  # another episode
        count = len(driver.sent)
        driver.fault = after(0, object_time=0.98)
        self.assertEqual(runner.run(0.5).steps, 25)
        driver.fault = after(0, object_time=-1.0)
        self.assertEqual(runner.run(0.5).steps, 0)
        assert_allclose(driver.sent[count], 0.01)
        self.assertEqual(len(driver.sent), count + 25)

    def test_a_robot_stops_while_another_goes_on(self):
        def fault(time, reading):
            pos = driver.sent[-1] if driver.sent else np.zeros((2, 2))
            return Reading(
                joint_pos=pos,
                joint_time=np.full(2, time),
                object_pos=[reading.object_pos] * 2,
                object_quat=[reading.object_quat] * 2,
                object_time=np.array([time, min(time, 1.0)]),
            )

        driver = Scripted(fault)
        controller = Steady()
        controller.target = np.zeros((2, 2), np.float32)
        outcome = Runner(controller, driver).run(3)
        self.assertIsNone(outcome.reasons[0])
        self.assertIn("The pose of the object is 1.0", outcome.reasons[1])
        first, second = np.diff(driver.sent, axis=0)[-20:, :, 0].T
        assert_allclose(first, 0.01, rtol=1e-4)
        assert_array_equal(second, 0)

    def test_joints_slightly_beyond_their_limits_are_tolerated(self):
        driver = Scripted(after(0, joint_pos=np.array([-1.09, 9.09])))
        outcome = Runner(Steady(), driver).run(0.2)
        self.assertEqual((outcome.reason, outcome.steps), (None, 10))

    def test_targets_are_no_faster_than_their_limit(self):
        driver = Scripted()
        controller = Steady()
        limits = Limits(target_speed=0.5)
        self.assertIsNone(Runner(controller, driver, limits).run(1).reason)
        moves = np.diff(driver.sent, axis=0)
        assert_allclose(moves[:, 0], 0.5 * 0.6 * 0.02, rtol=1e-4)
        assert_allclose(moves[:, 1], 0.01, rtol=1e-4)
        self.assertEqual(driver.sent[-1][0], controller.target[0, 0])

    def test_a_workspace(self):
        controller = Steady()
        with self.assertRaisesRegex(LiveError, "no output 'links', which a workspace needs"):
            Runner(controller, Scripted(), Limits(workspace=((0, 0, 0), (1, 1, 1))))
        for box in (((0, 0, 0), (1, 1, 0)), ((0, 0), (1, 1)), (0, 1)):
            with refuses(self, "expected the lowest and the highest corner", LiveError, str(box)):
                Limits(workspace=box)
        controller.outputs = ("target", "links")
        controller.contract = {**Steady.contract, "links": ["palm", "tip"]}

        def act(target):
            controller.links = np.array([[[0.5, 0.5, 0.5], [target[0, 0], 0.5, 0.5]]])
            return target + 0.01

        controller.act = act
        for lowest, highest, words in (
            (-1, 0.4, "palm is at (0.50, 0.50, 0.50)"),
            (0.1, 1.0, "tip is at (0.00, 0.50"),
            (-1, 0.6, "tip is at (0.61, 0.50"),
        ):
            driver = Scripted()
            controller.target *= 0
            limits = Limits(workspace=((lowest, 0, 0), (highest, 1, 1)))
            self.assertIn(words, self.reason(driver, controller, limits))
        self.assertLess(driver.sent[-1][0], 0.7)

    def test_resting_targets_are_sent_as_long_as_the_robot_holds(self):
        start = 1.7e9  # as ROS counts
        driver = Scripted(after(start + 1, object_time=start + 0.99))
        driver.time = start
        controller = Steady()
        controller.upper = np.array([1.02, 9.0], np.float32)
        reason = self.reason(driver, controller, limits=Limits(hold=3.0))
        self.assertIn("pose of the object", reason)
        assert_allclose(np.max(driver.sent, axis=0)[0], 1.02)
        moves = np.diff(driver.sent, axis=0)
        assert_array_equal(moves[-150:], 0)
        self.assertGreater(driver.time, start + 5.2)

    def test_wrong_or_old_data_at_the_start_move_nothing(self):
        for fault, words in (
            (after(0, object_time=-5.0), "pose of the object"),
            (after(0, joint_time=-5.0), "joint positions"),
            (after(0, object_pos=np.full(3, np.nan)), "old: newer ones hold numbers"),
            (refuse, "the cable is out"),
        ):
            driver = Scripted(fault)
            self.assertIn(words, self.reason(driver))
            self.assertEqual((driver.sent, driver.stops), ([], 1))

        def late(time, reading):
            joint_time = -5.0 if time < 2.05 else time
            object_time = -5.0 if time <= 2.5 else time
            return replace(reading, joint_time=joint_time, object_time=object_time)

        driver = Scripted(late)
        runner = Runner(Steady(), driver)
        driver.time = 2.0  # the operator took two seconds
        self.assertIsNone(runner.run(1).reason)
        self.assertEqual(runner.outcome.steps, 25)

    def test_limits_that_are_no_limits(self):
        for name, value in (("pose_age", float("nan")), ("slow_down", -1.0)):
            with self.assertRaisesRegex(LiveError, f"{name} is {value}, expected 0 or more"):
                Limits(**{name: value})
        with self.assertRaisesRegex(LiveError, "slow_down is inf, expected a finite time"):
            Limits(slow_down=np.inf)
        driver = Scripted(after(0, object_pos=np.full(3, 50.0)))
        self.assertEqual(Runner(Steady(), driver, Limits(pose_age=np.inf)).run(1).steps, 0)
        driver = Scripted(after(1, object_time=0.99))
        for name in ("joint_speed", "target_speed"):
            with self.assertRaisesRegex(LiveError, f"{name} is 0, expected a share above 0"):
                Limits(**{name: 0})
        self.reason(driver, limits=Limits(slow_down=0.0, hold=0.1))
        self.assertTrue(np.isfinite(driver.sent).all())
        assert_array_equal(np.diff(driver.sent[-4:], axis=0), 0)

    def test_a_policy_that_fails(self):
        calls = []

        def later(result):
            def act(target):
                calls.append(1)
                return target + 0.01 if len(calls) < 30 else result(target)

            return Steady(act)

        for result, words in (
            (lambda target: target * [1, np.nan], "The policy gave numbers that are not finite"),
            (refuse, "The policy could not act: the cable is out"),
        ):
            calls.clear()
            with self.subTest(words), self.assertLogs("xreset"):
                self.assertRegex(self.stopped(Scripted(), later(result)), words)

    def test_a_slow_step_a_lost_driver_and_ctrl_c(self):
        driver = Scripted()

        def slow(target):
            driver.time += 0.03 if driver.time < 1 else 1.0
            return target + 0.01

        with self.assertLogs("xreset"):
            outcome = Runner(Steady(slow), driver).run(30)
        self.assertRegex(outcome.reason, "A control step took 0.98 s too long")
        self.assertGreater(outcome.missed, 20)
        driver = Scripted()
        driver.send = Mock(side_effect=refuse)
        self.assertRegex(self.reason(driver), "could not send targets: the cable is out")
        self.assertEqual((driver.send.call_count, driver.stops), (1, 1))

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
        self.assertIsNone(Runner(Steady(), driver).run(3).reason)
        self.assertEqual(len(driver.sent), 150)
        driver.wait_until = lambda moment: None
        words = "waits 0.1. s too little, so the policy runs too fast"
        self.assertRegex(self.reason(driver, seconds=3), words)

    def test_a_clock_that_nobody_moves(self):
        driver = Scripted()
        driver.wait_until = lambda moment: None
        self.assertRegex(self.reason(driver), "too fast. Override now.. and wait_until")
        self.assertEqual(driver.stops, 1)
        self.assertLess(len(driver.sent), 10)

        driver.wait_until = lambda moment: setattr(driver, "time", moment // 0.05 * 0.05)
        self.assertIsNone(Runner(Steady(), driver).run(3).reason, "a coarse clock is no fault")

    def test_late_data_are_used_and_single_faults_are_ignored(self):
        def fault(time, reading):
            if 1 < time < 1.6:  # half a second of lost frames
                return replace(reading, object_time=1.0)
            if round(time / 0.02) % 7 == 0:
                return replace(reading, object_pos=np.full(3, np.nan))
            if round(time / 0.02) % 7 == 3:  # an earlier pose, which the last one has overtaken
                return replace(reading, object_pos=np.ones(3), object_time=time - 0.8)
            return replace(reading, object_time=time - 0.2)

        driver = Scripted(fault)
        controller = Noting()
        outcome = Runner(controller, driver).run(3)
        assert_allclose([reading.object_pos[0, 0] for reading in controller.readings], 0.5)
        self.assertIsNone(outcome.reason)
        self.assertGreater(outcome.refused[0], 10)
        self.assertEqual((len(driver.sent), driver.stops), (149, 1))  # the first pose is faulty

    def test_a_sensor_of_forces_that_begins_with_a_fault(self):
        """The first forces are not finite, so there are no sound ones before them."""

        def fault(time, reading):
            if time < 0.05:
                return reading
            return replace(reading, tip_force=np.full((2, 3), np.nan if time < 0.1 else 1.0))

        controller = Noting()
        self.assertIsNone(Runner(controller, Scripted(fault)).run(1).reason)
        forces = [reading.tip_force for reading in controller.readings]
        self.assertEqual(forces[:3], [None] * 3)
        assert_array_equal(np.concatenate(forces[3:5]), np.zeros((2, 2, 3)))
        assert_array_equal(forces[-1], np.ones((1, 2, 3)))


class EngineTest(TestCase):
    def test_the_graph_observes_what_the_environment_observes(self):
        for name in ("paper", "default", "live", "published"):
            with self.subTest(name):
                self._check(evaluation_task(RECIPES[name].task))
        task = evaluation_task(TaskConfig())
        observation = replace(task.observation, policy={"rotation_from_start": {}})
        self._check(replace(task, observation=observation))

    def _check(self, task):
        played = toy_grasp.trial(task)
        start = episode_starts(played.starts(), [(0, 0, 0), (0, 1, 1)])
        robot = played.robot
        actions = np.random.default_rng(0).uniform(-1.2, 1.2, (STEPS, 2, len(robot.joints)))
        observe = Observe(robot, task, ())
        act = Act(robot, task)
        memory = torch.zeros(2, observe.memory)
        known = known_of(toy_grasp.brick(), 64)
        points, normals = (
            torch.as_tensor(known[n]).expand(2, -1, -1) for n in ("points", "normals")
        )
        with played.worlds(engine("mujoco", workers=0), torch.zeros(2, dtype=torch.long)) as env:
            env.reset(start=start)
            driver = EngineDriver(env)
            center = torch.as_tensor(centers(env))
            tolerance = 1e-5
            for action in torch.from_numpy(actions.astype(np.float32)):
                reading = {k: torch.as_tensor(v) for k, v in vars(driver.read()).items()}
                flat, cloud, kept, links = observe(
                    reading["joint_pos"], reading["joint_vel"], env.joint_target.clone(),
                    reading["object_pos"], reading["object_quat"], reading["tip_force"],
                    env.goal_pos, env.goal_quat, points, normals, center, memory,
                )  # fmt: skip
                seen = env.get_observations()
                expected = torch.cat((seen["policy"], seen["proprio"]), dim=1)
                assert_allclose(flat, expected, atol=tolerance)
                assert_allclose(cloud, seen["perception"], atol=1e-5)
                assert_allclose(links, env.backend.links().pos, atol=tolerance)
                tolerance = 2e-3  # while the robot moves, the engine's mimic joint gives way
                before = env.joint_target.clone()
                target, memory = act(action, reading["joint_pos"], before, kept)
                env.advance(action)
                assert_allclose(target, env.joint_target, atol=1e-6)


class SafetyTest(TestCase):
    """Limits of the loop stop a robot in an engine: a gripper that lifts a brick at 1.2 m/s."""

    def lift(self, limits, fault=lambda time, reading: reading):
        """Return the outcome, and lift, its velocity and the brick's height at the end of every step [steps, 3]."""
        played = toy_grasp.trial(evaluation_task(TaskConfig()))
        rows = []
        with played.worlds(engine("mujoco", workers=0), torch.zeros(1, dtype=torch.long)) as env:
            env.backend.set_state(toy_grasp.start())
            backend = env.backend

            def look():
                state = backend.state()
                row = (state.joint_pos[0, 0], state.joint_vel[0, 0], state.object_pos[0, 2])
                rows.append([float(value) for value in row])  # the engine writes into its tensors

            driver = EngineDriver(env, look)
            driver.read = lambda read=driver.read: fault(driver.now(), read())
            outcome = Runner(Lifting(env), driver, limits).run(3)
        return outcome, np.array(rows)

    def test_a_joint_that_is_too_fast_stops_the_robot(self):
        with self.assertLogs("xreset"):
            outcome, rows = self.lift(Limits(joint_speed=0.3, hold=1.0))
        self.assertRegex(
            outcome.reason, r"Joint lift moves at 0\.\d\d, faster than its limit 0\.60"
        )
        self.assertLess(abs(rows[-1, 1]), 0.01)
        self.assertLess(rows[-1, 0], 0.25)

    def test_a_stopped_robot_holds_position_and_grip(self):
        with self.assertLogs("xreset"):
            limits = Limits(target_speed=0.1, pose_age=0.2, hold=2.0)
            outcome, rows = self.lift(limits, after(0.5, object_time=np.array([0.5])))
        self.assertIn("pose of the object is", outcome.reason)
        held = rows[-90:]
        assert_allclose(held[:, 0], held[0, 0], atol=1e-3)
        assert_allclose(held[:, 2], held[0, 2], atol=2e-3)
        self.assertGreater(held[0, 2], rows[0, 2] + 0.05)


class Lifting:
    """In place of a controller: the gripper closes, and lifts as fast as it is allowed to."""

    links = None
    outputs = ("target",)

    def __init__(self, env):
        robot = env.backend.scene.robot
        self.contract = deploy_contract(robot, env.task)
        self.dt = env.task.control_dt
        self.target = robot.home[None].astype(np.float32)
        self.lower = joint_values(self.contract, "lower", -np.inf)
        self.upper = joint_values(self.contract, "upper", np.inf)
        self.speed = joint_values(self.contract, "velocity", np.inf)
        self.step_size = joint_values(self.contract, "step", 0.0)

    def step(self, reading):
        target = self.target.copy()
        target[0, -1] = toy_grasp.CLOSED
        target[0, 0] += 0.02
        self.target = np.clip(target, self.lower, self.upper)
        return self.target
