from __future__ import annotations

import json
import math
import tempfile
import unittest
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import torch

from tests import toy_grasp
from tests.command import xreset
from tests.toy_bank import toy_bank
from xreset import robots
from xreset.errors import DemoError
from xreset.eval.engines.agreement import (
    Metric,
    carried,
    compare,
    outcome_metric,
    palm_distance,
    path_difference,
    path_metrics,
    press_metrics,
)
from xreset.eval.engines.episodes import (
    GraspMotion,
    carried_palm,
    closing_episode,
    lifting_episode,
    moved_fingertips,
    squeezed,
    squeezing_state,
)
from xreset.eval.engines.grasps import NEAR, Frames, find_grasps
from xreset.eval.engines.recording import Recording
from xreset.eval.engines.sources import load_frames
from xreset.eval.engines.trials import ParityConfig
from xreset.eval.trial import Engine, engine
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.rotations import quat_from_axis_angle
from xreset.objects.catalogue import load_object
from xreset.objects.rest import rest_height
from xreset.plugins import backend_status
from xreset.retarget.file import Retargeted, write_retargeted
from xreset.spec import ObjectSpec, RobotSpec, SceneSpec

DT = 1 / 60
BRISK = GraspMotion(squeeze=16.0, settle=0.1, close=0.3, hold=0.2, lift=0.5, shake=0.4)
CONFIG = ParityConfig(motion=BRISK, path_time=0.3)
OFFSETS = ((0.0, 0.0), (0.02, 0.0), (0.0, 0.01), (-0.015, -0.005), (0.03, 0.0))
"""The open hand starts with fingers up to 17 mm inside the can, which every engine resolves in its own way: for MuJoCo against itself."""
FREE_OFFSETS, FREE_GAP = ((0.03, 0.01), (0.02, 0.02), (0.04, 0.0)), 0.09
"""With these nothing overlaps at the start."""


def tips(kinematics: Kinematics, q: torch.Tensor) -> torch.Tensor:
    return kinematics.points(q, [tip.link for tip in kinematics.robot.fingertips])


def between(kinematics: Kinematics, q: torch.Tensor) -> torch.Tensor:
    """Half way between the thumb's tip and the mean of the others."""
    points = tips(kinematics, q)
    return 0.5 * (points[:, 1:].mean(1) + points[:, 0])


def frames_above(
    robot: RobotSpec, thing: ObjectSpec, offsets=OFFSETS, *, gap: float = 0.066, height: float = 0.06
) -> Frames:
    """The home pose's hand lowered over an upright object at several places between its fingers, and the same lifted by 0.1 m."""
    kinematics = Kinematics(robot)
    home = torch.as_tensor(robot.home)[None]
    points = tips(kinematics, home)
    q = moved_fingertips(kinematics, home, 0.5 * (float((points[:, 1:].mean(1) - points[:, 0]).norm()) - gap))

    def shifted(q: torch.Tensor, z: float) -> torch.Tensor:
        way = torch.zeros(40, 3)
        way[:, 2] = torch.linspace(0, z, 40)
        return carried_palm(kinematics, q, way)[-1]

    low = shifted(q, height - float(between(kinematics, q)[0, 2]))
    high = shifted(low, 0.1)
    pos = between(kinematics, low) + torch.nn.functional.pad(torch.tensor(offsets, dtype=torch.float64), (0, 1))
    upright = np.array([1.0, 0.0, 0.0, 0.0])
    pos[:, 2] = rest_height(thing, upright)
    n = len(offsets)
    both = torch.cat((pos, pos + torch.tensor([0.0, 0.0, 0.1]))).numpy()
    return Frames(
        joint_pos=torch.cat((low.expand(n, -1), high.expand(n, -1))).numpy(),
        object_pos=both,
        object_quat=np.tile(upright, (2 * n, 1)),
        object_name=np.full(2 * n, thing.name),
        sequence_name=np.tile([f"toy/{i}" for i in range(n)], 2),
        frame=np.repeat([30, 60], n),
        start_pos=np.tile(pos.numpy(), (2, 1)),
        start_quat=np.tile(upright, (2 * n, 1)),
    )


def altered(base: Engine, name: str, **changes) -> Engine:
    """An engine that simulates another scene than it is asked for."""

    def make(scene: SceneSpec, num_worlds: int, object_index: torch.Tensor):
        return base.make(
            replace(scene, **{field: change(getattr(scene, field)) for field, change in changes.items()}),
            num_worlds,
            object_index,
        )

    return replace(base, name=name, make=make)


def with_squared_friction(base: Engine) -> Engine:
    def make(scene: SceneSpec, num_worlds: int, object_index: torch.Tensor):
        pairs = scene.friction
        squared = replace(pairs, tip=pairs.tip**2, link=pairs.link**2, table=pairs.table**2)
        backend = base.make(replace(scene, friction=squared), num_worlds, object_index)
        set_friction = backend.set_friction
        backend.set_friction = lambda friction, worlds=None: set_friction(friction**2, worlds)
        return backend

    return replace(base, name="friction squared", make=make)


def heavier(objects: tuple[ObjectSpec, ...]) -> tuple[ObjectSpec, ...]:
    return tuple(replace(o, mass=2 * o.mass, inertia=2 * o.inertia) for o in objects)


def with_drives(robot: RobotSpec, factor: float) -> RobotSpec:
    joints = (replace(joint, drive=replace(joint.drive, kp=factor * joint.drive.kp)) for joint in robot.joints)
    return replace(robot, joints=tuple(joints))


class Episodes(unittest.TestCase):
    def setUp(self):
        self.robot = robots.load("ur7e-sharpa")
        self.kinematics = Kinematics(self.robot)
        self.home = torch.as_tensor(self.robot.home)[None]

    def test_fingertips_move_towards_and_away_from_the_opposite_ones(self):
        for name, distance in (("ur7e-sharpa", 0.01), ("ur7e-sharpa", -0.01), ("openarm", 0.01), ("openarm", -0.005)):
            kinematics = Kinematics(robots.load(name))
            home = torch.as_tensor(kinematics.robot.home)[None]
            q = moved_fingertips(kinematics, home, distance)
            before, after = tips(kinematics, home), tips(kinematics, q)
            line = torch.nn.functional.normalize(before[:, 1:].mean(1) - before[:, 0], dim=-1)
            moved = ((after - before) * line[:, None]).sum(-1)[0]
            expected = torch.full_like(moved, -distance)
            expected[0] = distance
            torch.testing.assert_close(
                moved, expected, atol=0.2 * abs(distance), rtol=0, msg=f"{name} {distance}: {moved}"
            )
            arm = torch.as_tensor(kinematics.robot.arm_indices)
            torch.testing.assert_close(q[:, arm], home[:, arm], rtol=0, atol=0)

    def test_fingertips_stay_within_the_limits(self):
        q = moved_fingertips(self.kinematics, self.home, -0.5)
        self.assertTrue(bool(((q >= self.kinematics.lower) & (q <= self.kinematics.upper)).all()))

    def test_the_squeeze_is_a_force(self):
        motion = GraspMotion(squeeze=4.0)
        held = moved_fingertips(self.kinematics, self.home, motion.reach)
        target = squeezed(self.kinematics, self.home, motion)
        kp = torch.tensor([joint.drive.kp for joint in self.robot.joints], dtype=torch.float64)
        torque = (kp * (target - held))[0]
        before = tips(self.kinematics, self.home)
        line = torch.nn.functional.normalize(before[0, 1:].mean(0) - before[0, 0], dim=0)
        force = torch.stack([4.0 * line, *[-1.0 * line] * 4])  # four fingers share what the thumb bears
        jacobian = self.kinematics.jacobian(held, [tip.link for tip in self.robot.fingertips]).linear[0]
        hand = torch.as_tensor(self.robot.hand_indices)
        torch.testing.assert_close(torque[hand], torch.einsum("ecj,ec->j", jacobian, force)[hand], atol=1e-9, rtol=0)
        self.assertLess(float(torque[torch.as_tensor(self.robot.arm_indices)].abs().max()), 1e-9)

    def test_the_palm_is_carried_without_turning(self):
        way = torch.zeros(30, 3)
        way[:, 1], way[:, 2] = torch.linspace(0, 0.02, 30), torch.linspace(0, 0.1, 30)
        path = carried_palm(self.kinematics, self.home, way)
        start = self.kinematics.link_poses(self.home, [self.robot.palm])[0, 0]
        palm = self.kinematics.link_poses(path, [self.robot.palm])[:, 0, 0]
        torch.testing.assert_close(palm[:, :3, 3], start[:3, 3] + way, atol=5e-5, rtol=0)
        torch.testing.assert_close(palm[:, :3, :3], start[:3, :3].expand(30, 3, 3), atol=2e-3, rtol=0)
        hand = torch.as_tensor(self.robot.hand_indices)
        torch.testing.assert_close(path[:, 0, hand], self.home[:, hand].expand(30, -1), rtol=0, atol=0)

    def test_a_closing_opens_closes_lifts_and_shakes(self):
        pos, quat = torch.tensor([[0.6, 0.3, 0.05]]), torch.tensor([[1.0, 0, 0, 0]])
        episode = closing_episode(self.robot, self.home, pos, quat, DT, BRISK)
        closing = BRISK.closing_steps(DT)
        self.assertEqual(closing, 36)
        self.assertEqual(len(episode.targets), 36 + 30 + 12 + 2 * 24)
        gaps = [
            float((t[:, 1:].mean(1) - t[:, 0]).norm())
            for t in (tips(self.kinematics, q.double()) for q in episode.targets)
        ]
        self.assertAlmostEqual(gaps[5], gaps[0], places=6)  # settling
        self.assertGreater(gaps[5], gaps[closing - 1] + 0.05)
        torch.testing.assert_close(episode.start.joint_pos, episode.targets[0])
        palm = self.kinematics.link_poses(episode.targets[:, 0].double(), [self.robot.palm])[:, 0, :3, 3]
        height = palm[:, 2] - palm[0, 2]
        self.assertLess(float(height[:closing].abs().max()), 1e-6)
        self.assertAlmostEqual(float(height[closing + 31]), 0.1, delta=1e-3)
        swing = (palm[closing + 42 :] - palm[closing + 41]).abs().amax(0)
        self.assertGreater(float(swing[0]), 0.7 * BRISK.amplitude)
        self.assertGreater(float(swing[1]), 0.7 * BRISK.amplitude)
        self.assertLess(float((episode.targets[1:] - episode.targets[:-1]).abs().max()), 0.1)  # nothing jumps

    def test_a_lift_begins_where_the_state_is(self):
        state = squeezing_state(self.robot, self.home, torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]))
        self.assertGreater(float((state.joint_target - state.joint_pos).abs().max()), 0.01)
        episode = lifting_episode(self.robot, state, DT, BRISK)
        torch.testing.assert_close(episode.targets[0], state.joint_target)
        palm = self.kinematics.link_poses(episode.targets[[0, -1], 0].double(), [self.robot.palm])[:, 0, 2, 3]
        self.assertAlmostEqual(float(palm[1] - palm[0]), 0.1, delta=1e-3)


class Finding(unittest.TestCase):
    def setUp(self):
        self.robot, self.can = robots.load("ur7e-sharpa"), load_object("soup")

    def test_table_and_air_are_told_apart(self):
        frames = frames_above(self.robot, self.can)
        table = find_grasps(frames, self.robot, [self.can], 10, where="table")
        air = find_grasps(frames, self.robot, [self.can], 10, where="air")
        self.assertEqual({label.split(":")[1] for label in table.label}, {"30"})
        self.assertEqual({label.split(":")[1] for label in air.label}, {"60"})
        self.assertEqual(len(table), 5)
        torch.testing.assert_close(
            air.object_pos[:, 2] - table.object_pos[:, 2], torch.full((5,), 0.1, dtype=torch.float64), atol=6e-4, rtol=0
        )

    def test_a_hand_that_is_not_at_the_object_grasps_nothing(self):
        away = frames_above(self.robot, self.can, [(0.0, 0.0), (0.12 + NEAR, 0.0)])
        self.assertEqual(find_grasps(away, self.robot, [self.can], 10, where="table").label, ("toy/0:30",))
        with self.assertRaisesRegex(DemoError, "no grasp was found in 2 frames"):
            find_grasps(frames_above(self.robot, self.can, [(0.2, 0.0)]), self.robot, [self.can], 10, where="table")

    def test_a_turned_or_moved_object_is_not_at_rest(self):
        frames = frames_above(self.robot, self.can, [(0.0, 0.0), (0.0, 0.01), (0.02, 0.0)])
        start_pos, start_quat = frames.start_pos.copy(), frames.start_quat.copy()
        start_pos[0, 0] += 0.012
        start_quat[1] = quat_from_axis_angle(torch.tensor([0.0, 0.0, 0.2])).numpy()
        moved = replace(frames, start_pos=start_pos, start_quat=start_quat)
        self.assertEqual(find_grasps(moved, self.robot, [self.can], 10, where="table").label, ("toy/2:30",))

    def test_objects_and_sequences_take_turns(self):
        one, spam = frames_above(self.robot, self.can, [(0.0, 0.0)]), load_object("spam")
        other = frames_above(self.robot, spam, [(0.0, 0.0)])

        def repeated(frames: Frames, sequences: list[str], numbers: list[int]) -> Frames:
            rows = np.zeros(len(sequences), dtype=int)  # on the table
            values = {name: getattr(frames, name)[rows] for name in Frames.__dataclass_fields__}
            return Frames(**values | {"sequence_name": np.array(sequences), "frame": np.array(numbers)})

        cans, spams = repeated(one, ["a", "a", "a", "b"], [1, 2, 3, 9]), repeated(other, ["c", "c"], [4, 5])
        joined = Frames(
            **{
                name: np.concatenate((getattr(cans, name), getattr(spams, name)))
                for name in Frames.__dataclass_fields__
            }
        )
        found = find_grasps(joined, self.robot, [self.can, spam], 6, where="table")
        self.assertEqual(found.label, ("a:3", "c:5", "b:9", "c:4", "a:2", "a:1"))
        self.assertEqual(found.object_index.tolist(), [0, 1, 0, 1, 0, 0])
        self.assertEqual(
            find_grasps(joined, self.robot, [self.can, spam], 3, where="table").label, ("a:3", "c:5", "b:9")
        )


def recording(**changes: torch.Tensor) -> Recording:
    """Two worlds, three steps, one joint; both fingertips press with 2 N against each other."""
    force = torch.tensor([[2.0, 0, 0], [-2.0, 0, 0]]).expand(3, 2, 2, 3)
    return toy_grasp.recording(steps=3, worlds=2, joints=1, **{"tip_force": force} | changes)


class Numbers(unittest.TestCase):
    def test_press(self):
        force = recording().tip_force.clone()
        force[:, 0] *= 1.25  # 20 % of the larger
        force[:, 1, 1] = torch.tensor([0.0, 2.0, 0.0])  # turned by a right angle, as strong
        total, tip = press_metrics(recording(tip_force=force), recording(), steps=2)
        self.assertAlmostEqual(total.measured, 0.1, places=5)  # median of 0.2 and 0
        self.assertEqual(total.n, 2)
        self.assertAlmostEqual(tip.measured, 0.2, places=5)  # median of 0.2, 0.2, 0 and sqrt 2
        self.assertEqual(tip.n, 4)
        self.assertAlmostEqual(tip.detail["p90"], float(np.quantile([0.2, 0.2, 0.0, math.sqrt(2)], 0.9)), places=3)

    def test_a_finger_that_presses_in_one_engine_only_counts(self):
        force = recording().tip_force.clone()
        force[:, 0, 1] = 0.0
        _, tip = press_metrics(recording(tip_force=force), recording(), steps=3)
        self.assertEqual(tip.n, 4)
        self.assertEqual(tip.detail["touch_same"], 0.75)

    def test_only_the_last_steps_of_a_press_count(self):
        force = recording().tip_force.clone()
        force[0] *= 100
        metrics = press_metrics(recording(tip_force=force), recording(), steps=2)
        self.assertEqual([m.measured for m in metrics], [0.0, 0.0])

    def test_nothing_to_compare_misses_the_target(self):
        none = recording(tip_force=torch.zeros(3, 2, 2, 3))
        for metric in press_metrics(none, none, steps=1):
            self.assertFalse(metric.ok)
            self.assertIsNone(metric.as_dict()["measured"])
            self.assertEqual(metric.as_dict()["verdict"], "missed")

    def test_outcomes(self):
        high = torch.zeros(3, 2, 3)
        high[-1, :, 2] = torch.tensor([0.06, 0.04])
        self.assertEqual(carried(recording(object_pos=high), 0.1).tolist(), [True, False])
        self.assertEqual(
            carried(recording(object_pos=high, broken=torch.tensor([True, False])), 0.1).tolist(), [False, False]
        )
        flags = torch.tensor([True, True, True, False, False])
        metric = outcome_metric("closing, outcome", flags, torch.tensor([True, True, False, True, False]))
        self.assertAlmostEqual(metric.measured, 0.6)
        self.assertFalse(metric.ok)
        self.assertEqual(metric.detail, {"both": 2, "neither": 1, "only_here": 1, "only_in_reference": 1})

    def test_object_in_palm(self):
        quarter = quat_from_axis_angle(torch.tensor([0.0, 0.0, math.pi / 2]))
        corners = torch.tensor([[[0.1, 0, 0], [-0.1, 0, 0]]]).expand(2, 2, 3)
        # The same motion of palm and object changes nothing ...
        moved = recording(
            object_pos=torch.tensor([0.0, 0.3, 0.0]).expand(3, 2, 3),
            palm_pos=torch.tensor([0.0, 0.3, 0.0]).expand(3, 2, 3),
            object_quat=quarter.expand(3, 2, 4),
            palm_quat=quarter.expand(3, 2, 4),
        )
        torch.testing.assert_close(palm_distance(moved, recording(), corners), torch.zeros(2), atol=1e-7, rtol=0)
        # ... and an object that turns in the palm is seen.
        turned = recording(object_quat=quarter.expand(3, 2, 4))
        torch.testing.assert_close(palm_distance(turned, recording(), corners), torch.full((2,), 0.1 * math.sqrt(2)))

    def test_paths(self):
        joints, pos = torch.zeros(3, 2, 1), torch.zeros(3, 2, 3)
        joints[:, 1], pos[2, 1, 0] = -4e-4, 2e-3
        joint, median, worst = path_metrics(*path_difference(recording(joint_pos=joints, object_pos=pos), recording()))
        self.assertAlmostEqual(joint.measured, 2e-4)
        self.assertEqual((median.measured, worst.detail["grasps_above"]), (0.0, 1))
        self.assertAlmostEqual(worst.measured, 2.0, places=5)
        self.assertEqual([m.ok for m in (joint, median, worst)], [True, True, False])


class Comparing(unittest.TestCase):
    """MuJoCo against MuJoCo with one thing wrong: each metric goes red where it must."""

    @classmethod
    def setUpClass(cls):
        reference = engine("mujoco", workers=0)
        robot, can = robots.load("ur7e-sharpa"), load_object("soup")
        cls.result = compare(
            robot,
            [can],
            frames_above(robot, can),
            [
                replace(reference, name="same", path=True),
                with_squared_friction(reference),
                altered(reference, "drives halved", robot=lambda robot: with_drives(robot, 0.5)),
                altered(replace(reference, path=True), "mass doubled", objects=heavier),
            ],
            grasps=6,
            config=CONFIG,
            reference=reference,
        )

    def metrics(self, name: str) -> dict[str, Metric]:
        tested = next(e for e in self.result.engines if e.engine.name == name)
        return {metric.name: metric for metric in tested.metrics}

    def test_the_same_engine_agrees_exactly(self):
        for name, metric in self.metrics("same").items():
            with self.subTest(name):
                self.assertTrue(metric.ok)
                self.assertEqual(metric.measured, 1.0 if metric.sense == "at least" else 0.0)

    def test_outcomes_are_mixed(self):
        """Else an engine in which nothing, or everything, is carried would agree."""
        outcomes = self.result.reference.carried
        for kind in ("closing", "hold"):
            self.assertEqual(
                {flag for name, flags in outcomes.items() if name.startswith(kind) for flag in flags},
                {True, False},
                outcomes,
            )

    def test_the_timestep_matters_little(self):
        metrics = {metric.name: metric for metric in self.result.floor.metrics}
        self.assertTrue(metrics["press, total"].ok)
        self.assertGreater(metrics["press, total"].measured, 0.0)

    def test_squared_friction_is_seen(self):
        metrics = self.metrics("friction squared")
        self.assertFalse(metrics["hold, outcome"].ok)
        self.assertGreater(metrics["hold, outcome"].detail["only_in_reference"], 0)
        self.assertFalse(metrics["closing, outcome"].ok)

    def test_halved_drives_are_seen(self):
        metrics = self.metrics("drives halved")
        self.assertFalse(metrics["press, total"].ok)
        self.assertLess(metrics["press, total"].detail["bias"], -0.3)
        self.assertFalse(metrics["press, fingertip"].ok)

    def test_a_doubled_mass_is_seen(self):
        metrics = self.metrics("mass doubled")
        self.assertFalse(metrics["path, object"].ok or metrics["path, object, worst"].ok)
        self.assertFalse(metrics["path, joints"].ok)
        self.assertFalse(metrics["hold, object in palm"].ok and metrics["hold, outcome"].ok)

    def test_common_states_favour_no_engine(self):
        labels = self.result.hold.label
        self.assertTrue(any(label.endswith("as demonstrated") for label in labels))
        closed = {label.rpartition("closed in ")[2] for label in labels if "closed in" in label}
        self.assertGreaterEqual(len(closed), 2, labels)
        self.assertNotIn(self.result.floor.engine.name, closed)

    def test_results_are_json(self):
        data = json.loads(json.dumps(self.result.as_dict(), allow_nan=False))
        self.assertEqual(data["schema"], "xreset-parity/1")
        self.assertFalse(data["ok"])
        row = data["engines"][0]["metrics"][0]
        self.assertEqual(
            {"metric", "target", "measured", "n", "verdict"} & set(row),
            {"metric", "target", "measured", "n", "verdict"},
        )
        self.assertEqual(len(data["grasps"]["hold"]), len(data["engines"][0]["carried"]["hold 0.5"]))


class Engines(unittest.TestCase):
    """A reduced comparison in the other engines."""

    def check(self, name: str) -> None:
        if backend_status(name).reason is not None:
            self.skipTest(f"{name} cannot be used here")
        robot, can = robots.load("ur7e-sharpa"), load_object("soup")
        frames = frames_above(robot, can, FREE_OFFSETS, gap=FREE_GAP)
        config = replace(CONFIG, frictions=(0.8,))
        tested, reference = engine(name, workers=0), engine("mujoco", workers=0)
        result = compare(robot, [can], frames, [tested], grasps=3, config=config, reference=reference)
        metrics = {metric.name: metric for metric in result.engines[0].metrics}
        for metric in ("press, total", "press, fingertip", "closing, outcome"):  # a few holds near the edge say little
            with self.subTest(metric):
                self.assertTrue(metrics[metric].ok, metrics[metric])

    def test_pybullet(self):
        self.check("pybullet")

    def test_sapien(self):
        self.check("sapien")


class Command(unittest.TestCase):
    def setUp(self):
        self.folder = Path(self.enterContext(tempfile.TemporaryDirectory()))

    def retargeted(self) -> Path:
        """A file with the frames of :func:`frames_above`, each a sequence of two."""
        robot, can = robots.load("ur7e-sharpa"), load_object("soup")
        frames = frames_above(robot, can, OFFSETS[:3])
        rows = np.array([0, 3, 1, 4, 2, 5])  # on the table and in the air, in turns
        kinematics = Kinematics(robot)
        q = torch.as_tensor(frames.joint_pos[rows])
        palm = kinematics.link_poses(q, [robot.palm])[:, 0]
        path = self.folder / "retargeted.npz"
        data = Retargeted(
            robot=robot.name,
            robot_fingerprint=robot.fingerprint,
            sequence_name=np.array(["a", "b", "c"]),
            object_name=np.array([can.name] * 3),
            hand_side=np.array(["right"] * 3),
            frame_offsets=np.array([0, 2, 4, 6], dtype=np.int32),
            fps=30.0,
            joint_names=robot.joint_names,
            joint_pos=q.numpy(),
            palm_pos=palm[:, :3, 3].numpy(),
            palm_quat_wxyz=np.tile([1.0, 0, 0, 0], (6, 1)),
            fingertip_names=robot.fingertip_names,
            fingertip_pos=tips(kinematics, q).numpy(),
            object_pos=frames.object_pos[rows],
            object_quat_wxyz=frames.object_quat[rows],
            goal_pos=frames.object_pos[rows[1::2]],
            goal_quat_wxyz=frames.object_quat[rows[1::2]],
            annotated=np.ones(6, dtype=bool),
            valid=np.ones(6, dtype=bool),
            reason=np.zeros(6, dtype=np.int32),
            reason_names=("valid",),
            contact=np.ones(6, dtype=bool),
            first_contact=np.zeros(3, dtype=np.int32),
            hand_error=np.zeros(6),
            wrist_error=np.zeros(6),
        )
        write_retargeted(path, data, config={}, inputs={})
        return path

    def test_a_file_is_measured_and_the_exit_code_says_the_verdict(self):
        path, out = self.retargeted(), self.folder / "parity.json"
        good, bad = (
            engine("mujoco", workers=0),
            altered(engine("mujoco", workers=0), "pybullet", robot=lambda r: with_drives(r, 0.3)),
        )
        for made, code in ((replace(good, name="pybullet"), 0), (bad, 1)):
            with (
                mock.patch("xreset.eval.trial.engine", lambda name, made=made, **_: made),
                mock.patch("xreset.eval.engines.agreement.engine", lambda name: good),
            ):
                options = ("--backend", "pybullet", "--grasps", 2, "--json", out)
                found, text, _ = xreset("engines", "compare", path, *options)
            self.assertEqual(found, code)
            self.assertIn("press, fingertip", text)
            self.assertIn("missed: pybullet: press, total" if code else "all targets met", text)
            self.assertEqual(json.loads(out.read_text())["ok"], not code)

    def test_wrong_use_is_explained(self):
        path = self.retargeted()
        for said, words in (
            ("there is no ", [self.folder / "none.npz"]),
            ("--grasps is 0, expected a whole number from 1", [path, "--grasps", 0]),
            ("Unknown object 'bottle'", [path, "--only", "bottle"]),
            ("for the robot 'ur7e-sharpa'", [path, "--robot", "openarm"]),
        ):
            with self.subTest(said):
                code, _, text = xreset("engines", "compare", *words, "--backend", "mujoco")
                self.assertEqual(code, 1)
                self.assertIn("xreset engines compare:", text)
                self.assertIn(said, text)

    def test_files_that_show_grasps(self):
        robot, objects, frames = load_frames(self.retargeted())
        self.assertEqual(
            (robot.name, [o.name for o in objects], len(frames.frame)), ("ur7e-sharpa", ["005_tomato_soup_can"], 6)
        )
        bank = toy_bank(robot)
        shown = Frames.of(bank)
        self.assertEqual(shown.sequence_name.tolist(), ["demo_a", "demo_b", "demo_c"])
        np.testing.assert_array_equal(shown.joint_pos, bank.joint_pos[1::2])
        np.testing.assert_array_equal(shown.start_pos, bank.start_pos)
        np.testing.assert_array_equal(shown.frame, [9, 8, 7])


if __name__ == "__main__":
    unittest.main()
