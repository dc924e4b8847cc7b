"""Agreement of engines on grasps: the episodes, the grasps that are found, the figures, and the engines themselves."""

import json
import math
from dataclasses import replace
from unittest import TestCase, mock

import numpy as np
import torch
from torch import tensor
from torch.testing import assert_close

from tests import toy_grasp
from tests.command import refused, xreset
from tests.data import InFolder
from tests.toy_bank import toy_retargeted
from xreset import SceneSpec, load_object, robots, write_retargeted
from xreset.errors import DemoError
from xreset.eval.engines.agreement import (
    carried,
    compare,
    outcome_metric,
    palm_distance,
    press_metrics,
)
from xreset.eval.engines.grasps import (
    AMPLITUDE,
    REACH,
    Grasps,
    carried_palm,
    closing_episode,
    closing_steps,
    find_grasps,
    lifting_targets,
    moved_fingertips,
    squeezed,
)
from xreset.eval.rollout import engine
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.rotations import quat_from_axis_angle
from xreset.objects.rest import rest_height
from xreset.physics import State
from xreset.physics.plugins import backend_status

DT = 1 / 60
BRISK = mock.patch.multiple(
    "xreset.eval.engines.grasps",
    SQUEEZE=16.0,
    SETTLE_TIME=0.1,
    CLOSE_TIME=0.3,
    HOLD_TIME=0.2,
    LIFT_TIME=0.5,
    SHAKE_TIME=0.4,
)
"""Grasps are tried harder and faster."""
OFFSETS = ((0.0, 0.0), (0.02, 0.0), (0.0, 0.01), (-0.015, -0.005), (0.03, 0.0))
"""The open hand starts with fingers up to 17 mm inside the can, which every engine resolves in its own way: for MuJoCo against itself."""
FREE_OFFSETS = ((0.03, 0.01), (0.02, 0.02), (0.04, 0.0))
FREE_GAP = 0.09
"""With these nothing overlaps at the start."""


def tips(kinematics, q):
    return kinematics.points(q, [tip.link for tip in kinematics.robot.fingertips])


def between(kinematics, q):
    """Half way between the thumb's tip and the mean of the others."""
    points = tips(kinematics, q)
    return 0.5 * (points[:, 1:].mean(1) + points[:, 0])


def opening(kinematics, q):
    """[G, 3] from the thumb's tip to the mean of the others."""
    points = tips(kinematics, q)
    return points[:, 1:].mean(1) - points[:, 0]


def grasps_of(robot, thing, offsets=OFFSETS, *, gap=0.066):
    """The home pose's hand lowered over an upright object at several places between its fingers: sequences of two
    frames, the second of which is lifted by 0.1 m."""
    kinematics = Kinematics(robot)
    home = torch.as_tensor(robot.home)[None]
    width = float(opening(kinematics, home).norm())
    q = moved_fingertips(kinematics, home, 0.5 * (width - gap))

    def shifted(q, z):
        way = torch.zeros(40, 3)
        way[:, 2] = torch.linspace(0, z, 40)
        return carried_palm(kinematics, q, way)[-1]

    low = shifted(q, 0.06 - float(between(kinematics, q)[0, 2]))
    both = torch.cat((low, shifted(low, 0.1)))
    upright = np.array([1.0, 0.0, 0.0, 0.0])
    pos = between(kinematics, low).repeat(len(offsets), 1)
    pos[:, :2] += pos.new_tensor(offsets)
    pos[:, 2] = float(rest_height(thing, upright))
    n = len(offsets)
    joints = both.repeat(n, 1)
    object_pos = pos.repeat_interleave(2, dim=0)
    object_pos[1::2, 2] += 0.1
    return toy_retargeted(
        robot,
        [thing.name] * n,
        list(range(0, 2 * n + 1, 2)),
        joint_pos=joints.numpy(),
        object_pos=object_pos.numpy(),
        first_contact=np.zeros(n, dtype=np.int32),
    )


def weak(scene):
    """The scene with weaker drives."""
    joints = [
        replace(joint, drive=replace(joint.drive, kp=0.5 * joint.drive.kp))
        for joint in scene.robot.joints
    ]
    return replace(scene, robot=replace(scene.robot, joints=tuple(joints)))


def heavy(scene):
    """The scene with an object that hardly any grasp carries."""
    (thing,) = scene.objects
    return replace(scene, objects=(replace(thing, mass=8 * thing.mass),))


class Episodes(TestCase):
    robot = robots.load("ur7e-sharpa")
    kinematics = Kinematics(robot)
    home = torch.as_tensor(robot.home)[None]

    def test_fingertips_move_towards_and_away_from_the_opposite_ones(self):
        for name, distance in (("ur7e-sharpa", 0.01), ("openarm", -0.005)):
            kinematics = Kinematics(robots.load(name))
            home = torch.as_tensor(kinematics.robot.home)[None]
            q = moved_fingertips(kinematics, home, distance)
            before = tips(kinematics, home)
            after = tips(kinematics, q)
            line = torch.nn.functional.normalize(opening(kinematics, home), dim=-1)
            moved = ((after - before) * line[:, None]).sum(-1)[0]
            expected = torch.full_like(moved, -distance)
            expected[0] = distance
            assert_close(
                moved, expected, atol=0.2 * abs(distance), rtol=0, msg=f"{name} {distance}: {moved}"
            )
            arm = torch.as_tensor(kinematics.robot.arm_indices)
            assert_close(q[:, arm], home[:, arm], rtol=0, atol=0)

    def test_the_squeeze_is_a_force(self):
        held = moved_fingertips(self.kinematics, self.home, REACH)
        with mock.patch("xreset.eval.engines.grasps.SQUEEZE", 4.0):
            target = squeezed(self.kinematics, self.home)
        kp = tensor([joint.drive.kp for joint in self.robot.joints], dtype=torch.float64)
        torque = (kp * (target - held))[0]
        line = torch.nn.functional.normalize(opening(self.kinematics, self.home)[0], dim=0)
        # the four fingers share the thumb's force
        force = torch.stack([4.0 * line, *[-1.0 * line] * 4])
        jacobian = self.kinematics.jacobian(
            held, [tip.link for tip in self.robot.fingertips]
        ).linear[0]
        hand = torch.as_tensor(self.robot.hand_indices)
        assert_close(
            torque[hand], torch.einsum("ecj,ec->j", jacobian, force)[hand], atol=1e-9, rtol=0
        )
        self.assertLess(torque[torch.as_tensor(self.robot.arm_indices)].abs().max(), 1e-9)

    @BRISK
    def test_a_closing_opens_closes_lifts_and_shakes(self):
        grasp = Grasps(
            label=("toy",),
            object_index=torch.zeros(1, dtype=torch.long),
            start=State.at_rest(self.home, tensor([[0.6, 0.3, 0.05]]), tensor([[1.0, 0, 0, 0]])),
        )
        scene = SceneSpec(robot=self.robot, objects=())
        start, targets = closing_episode(scene, grasp)
        closing = closing_steps(DT)
        self.assertEqual(closing, 36)
        self.assertEqual(len(targets), 36 + 30 + 12 + 2 * 24)
        gaps = opening(self.kinematics, targets[:, 0].double()).norm(dim=-1).tolist()
        self.assertAlmostEqual(gaps[5], gaps[0], places=6)  # settling
        self.assertGreater(gaps[5], gaps[closing - 1] + 0.05)
        assert_close(start.joint_pos, targets[0])
        palm = self.kinematics.link_poses(targets[:, 0].double(), [self.robot.palm])[:, 0, :3, 3]
        height = palm[:, 2] - palm[0, 2]
        self.assertLess(height[:closing].abs().max(), 1e-6)
        self.assertAlmostEqual(height[closing + 31], 0.1, delta=1e-3)
        swing = (palm[closing + 42 :] - palm[closing + 41]).abs().amax(0)
        self.assertGreater(swing[:2].min(), 0.7 * AMPLITUDE)
        self.assertLess(targets.diff(dim=0).abs().max(), 0.1)  # nothing jumps
        state = replace(start, joint_target=targets[closing - 1])
        lifted = lifting_targets(scene, state)
        assert_close(lifted[0], state.joint_target)
        assert_close(lifted[12:], targets[closing:], rtol=0, atol=1e-6)


class Finding(TestCase):
    robot = robots.load("ur7e-sharpa")
    can = load_object("soup")

    def find(self, motion, *objects, count=10, **where):
        return find_grasps(
            motion, self.robot, objects or (self.can,), count, **({"where": "table"} | where)
        )

    def test_table_and_air_are_told_apart(self):
        motion = grasps_of(self.robot, self.can)
        table = self.find(motion)
        air = self.find(motion, where="air")
        for found, frame in ((table, 0), (air, 1)):
            self.assertEqual(set(found.label), {f"demo{i}:{frame}" for i in range(5)})
        assert_close(
            air.start.object_pos[:, 2] - table.start.object_pos[:, 2],
            torch.full((5,), 0.1),
            atol=6e-4,
            rtol=0,
        )
        before = replace(motion, first_contact=np.full(5, -1))
        away = grasps_of(self.robot, self.can, [(0.2, 0.0)])
        for ungrasped, frames in ((before, 0), (away, 2)):
            words = f"no grasp was found in {frames} frames after first contact"
            self.assertRaisesRegex(DemoError, words, self.find, ungrasped)

    def test_a_turned_or_moved_object_is_not_at_rest(self):
        motion = grasps_of(self.robot, self.can, [(0.0, 0.0), (0.0, 0.01), (0.02, 0.0)])
        pos = motion.object_pos
        joints = motion.joint_pos
        for values in (pos, joints):
            values[1::2] = values[::2]
        pos[1, 0] += 0.012
        quat = motion.object_quat_wxyz.copy()
        quat[3] = quat_from_axis_angle(tensor([0.0, 0.0, 0.2])).numpy()
        found = self.find(replace(motion, object_quat_wxyz=quat))
        self.assertEqual(set(found.label), {"demo0:0", "demo1:0", "demo2:0", "demo2:1"})

    def test_objects_and_sequences_take_turns(self):
        spam = load_object("spam")
        one = grasps_of(self.robot, self.can, [(0.0, 0.0)])
        other = grasps_of(self.robot, spam, [(0.0, 0.0)])
        shown = (one, one, one, one, other, other)  # sequences a, a, a, b, c, c
        motion = toy_retargeted(
            self.robot,
            [self.can.name, self.can.name, spam.name],
            [0, 3, 4, 6],
            sequence_name=np.array(["a", "b", "c"]),
            joint_pos=np.stack([m.joint_pos[0] for m in shown]),
            object_pos=np.stack([m.object_pos[0] for m in shown]),
            first_contact=np.zeros(3, dtype=int),
        )
        found = self.find(motion, self.can, spam, count=6)
        self.assertEqual(found.label, ("a:2", "c:1", "b:0", "c:0", "a:1", "a:0"))
        self.assertEqual(found.object_index.tolist(), [0, 1, 0, 1, 0, 0])
        self.assertEqual(self.find(motion, self.can, spam, count=3).label, ("a:2", "c:1", "b:0"))


def recording(**changes):
    """Two worlds, three steps, one joint; both fingertips press with 2 N against each other."""
    force = tensor([[2.0, 0, 0], [-2.0, 0, 0]]).expand(3, 2, 2, 3)
    return toy_grasp.recording(steps=3, worlds=2, joints=1, **{"tip_force": force} | changes)


class Numbers(TestCase):
    def test_press(self):
        force = recording().tip_force.clone()
        force[:, 0] *= 1.25  # 20 % of the larger
        force[:, 1, 1] = tensor([0.0, 2.0, 0.0])  # turned by a right angle, as strong
        pressed = recording(tip_force=force)
        for pair in ((pressed, recording()), (recording(), pressed)):  # whichever presses harder
            total, tip = press_metrics(*pair, steps=2)
            self.assertEqual((total.n, tip.n), (2, 4))
            # medians of 0.2 and 0, and of 0.2, 0.2, 0 and sqrt 2
            self.assertAlmostEqual(total.measured, 0.1, places=5)
            self.assertAlmostEqual(tip.measured, 0.2, places=5)
        force = recording().tip_force.clone()
        force[0] *= 100
        force[:, 0, 1] = 0.0
        total, tip = press_metrics(recording(tip_force=force), recording(), steps=2)
        self.assertEqual(
            (tip.n, tip.measured), (4, 0.0), "a finger that presses in one engine only counts"
        )

    def test_outcomes_and_nothing_to_compare(self):
        high = torch.zeros(3, 2, 3)
        high[-1, :, 2] = tensor([0.06, 0.04])
        up = recording(object_pos=high)
        self.assertEqual(carried(up).tolist(), [True, False])
        self.assertFalse(carried(replace(up, broken=tensor([True, False]))).any())
        metric = outcome_metric("closing, outcome", [(up, recording(object_pos=high.flip(1)))])
        self.assertEqual((metric.measured, metric.n, metric.ok), (0.0, 2, False))
        none = recording(tip_force=torch.zeros(3, 2, 2, 3))
        for metric in press_metrics(none, none, steps=1):
            self.assertEqual((metric.ok, metric.measured), (False, None))

    def test_object_in_palm(self):
        quarter = quat_from_axis_angle(tensor([0.0, 0.0, math.pi / 2]))
        corners = tensor([[[0.1, 0, 0], [-0.1, 0, 0]]]).expand(2, 2, 3)
        pos = tensor([0.0, 0.3, 0.0]).expand(3, 2, 3)
        quat = quarter.expand(3, 2, 4)
        # The same motion of palm and object changes nothing, and an object that turns in the palm is seen.
        moved = recording(object_pos=pos, palm_pos=pos, object_quat=quat, palm_quat=quat)
        for found, expected in ((moved, 0.0), (recording(object_quat=quat), 0.1 * math.sqrt(2))):
            distance = palm_distance(found, recording(), corners)
            assert_close(distance, torch.full((2,), expected), atol=1e-7, rtol=1e-6)


class Comparing(InFolder):
    """MuJoCo against MuJoCo with one thing wrong: each metric goes red where it must."""

    @classmethod
    @BRISK
    def setUpClass(cls):
        reference = engine("mujoco", workers=0)
        robot = robots.load("ur7e-sharpa")
        can = load_object("soup")
        # Engines are told apart even where two have one name.
        named = (("heavy", heavy), (reference.name, weak))
        tested = [toy_grasp.with_scene(reference, *each) for each in named]
        cls.motion = grasps_of(robot, can)
        cls.result = compare(robot, [can], cls.motion, tested, grasps=6, reference=reference)

    def metrics(self, name):
        tested = next(e for e in self.result.engines if e.engine == name)
        return {metric.metric: metric for metric in tested.metrics}

    def test_outcomes_are_mixed(self):
        """Else an engine in which nothing, or everything, is carried would agree."""
        floor = {metric.metric: metric for metric in self.result.floor.metrics}["press, total"]
        self.assertTrue(floor.ok)
        self.assertGreater(floor.measured, 0.0)
        outcomes = self.result.reference.carried
        self.assertEqual(set(outcomes["closing"]), {True, False})
        self.assertEqual(set(outcomes["hold 0.5"] + outcomes["hold 0.8"]), {True, False})

    def test_differences_of_engines_are_found(self):
        for name, missed in (
            ("heavy", ("hold, outcome", "closing, outcome")),
            ("mujoco", ("press, total", "press, fingertip")),
        ):
            for metric in missed:
                self.assertFalse(self.metrics(name)[metric].ok, f"{name}: {metric}")
        self.assertGreater(self.metrics("mujoco")["press, total"].measured, 0.3)

    def test_common_states_favour_no_engine(self):
        labels = [grasp["grasp"] for grasp in self.result.grasps["hold"]]
        self.assertTrue(any(label.endswith("as demonstrated") for label in labels))
        closed = {label.rpartition("closed in ")[2] for label in labels if "closed in" in label}
        self.assertGreaterEqual(len(closed), 2, labels)
        self.assertNotIn(self.result.floor.engine, closed)

    def test_the_exit_code_of_the_command_says_the_verdict(self):
        path = self.folder / "retargeted.npz"
        write_retargeted(path, self.motion)
        for result, code in ((self.result, 1), (replace(self.result, engines=()), 0)):
            with mock.patch(
                "xreset.eval.engines.agreement.compare", lambda *_, result=result, **__: result
            ):
                options = ("--engine mujoco --out", self.folder / "parity.json")
                found, text, _ = xreset("engines compare", path, *options)
            self.assertEqual(found, code)
            self.assertIn("press, fingertip", text)
            self.assertIn("missed: heavy: hold, outcome" if code else "all targets met", text)
            data = json.loads((self.folder / "parity.json").read_text())
            self.assertEqual((data["schema"], data["ok"]), ("xreset-measured/1", not code))
        self.assertEqual(len(data["grasps"]["hold"]), len(data["reference"]["carried"]["hold 0.5"]))
        self.assertIn(
            "for the robot 'ur7e-sharpa'", refused("engines compare", path, "--robot openarm")
        )


class Engines(TestCase):
    """A reduced comparison in the other engines."""

    @BRISK
    def test_they_agree_with_mujoco(self):
        robot = robots.load("ur7e-sharpa")
        can = load_object("soup")
        tested = [
            engine(name, workers=0)
            for name in ("pybullet", "sapien")
            if backend_status(name).reason is None
        ]
        motion = grasps_of(robot, can, FREE_OFFSETS, gap=FREE_GAP)
        reference = engine("mujoco", workers=0)
        result = compare(robot, [can], motion, tested, grasps=3, reference=reference)
        for found in result.engines:
            metrics = {metric.metric: metric for metric in found.metrics}
            for name in (
                "press, total",
                "press, fingertip",
                "closing, outcome",
            ):  # few holds near the edge say little
                with self.subTest(name, engine=found.engine):
                    self.assertTrue(metrics[name].ok, metrics[name])
