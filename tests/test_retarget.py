"""Retargeting: the solver, the hand, the arm, the validity of frames, and the whole pipeline."""

import contextlib
import dataclasses
import io
import json
import tempfile
import unittest
from pathlib import Path

import numpy as np
import torch

from tests.data import data_dir
from tests.toy_retarget import FLOAT, arm_targets, box_object, check_gradient, hand_targets
from tests.toy_robot import toy_hand_arm, toy_motion
from xreset import robots
from xreset.cli.retarget import retarget as command
from xreset.demos.archive import demo_objects, read_demos, write_demos
from xreset.demos.synth import synthesize
from xreset.errors import DemoError, FileFormatError, RobotError
from xreset.geometry.collision import table_clearance
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.rotations import quat_angle, quat_from_axis_angle, quat_to_matrix
from xreset.geometry.surface import Surface
from xreset.retarget.arm.config import ArmConfig
from xreset.retarget.arm.model import ArmModel, ArmTargets
from xreset.retarget.arm.solve import track
from xreset.retarget.file import Retargeted, read_retargeted, write_retargeted
from xreset.retarget.hand import terms
from xreset.retarget.hand.clearance import Distances, Objects, too_near
from xreset.retarget.hand.config import HandConfig
from xreset.retarget.hand.cost import system
from xreset.retarget.hand.model import HandModel, HandState, HandTargets, keypoint_pairs
from xreset.retarget.hand.solve import retarget_hand
from xreset.retarget.least_squares import solve_chain
from xreset.retarget.pipeline import RetargetConfig, rest_on_table, retarget_demos
from xreset.retarget.validity import REASONS, Measures, Thresholds, classify
from xreset.spec import KEYPOINTS

assert_close = torch.testing.assert_close


class ChainTest(unittest.TestCase):
    def test_agrees_with_the_dense_solution(self):
        generator = torch.Generator().manual_seed(0)
        S = 2
        T = 5
        n = 3
        A = torch.randn(S, T, n, n, dtype=FLOAT, generator=generator)
        diagonal = A @ A.mT + 6.0 * torch.eye(n, dtype=FLOAT)
        coupling = torch.randn(S, T - 1, n, dtype=FLOAT, generator=generator)
        rhs = torch.randn(S, T, n, dtype=FLOAT, generator=generator)
        dense = torch.diag_embed(coupling.flatten(1), offset=n) + torch.diag_embed(
            coupling.flatten(1), offset=-n
        )
        for t in range(T):
            block = slice(t * n, (t + 1) * n)
            dense[:, block, block] = diagonal[:, t]
        expected = torch.linalg.solve(dense, rhs.reshape(S, -1)).view(S, T, n)
        assert_close(solve_chain(diagonal, coupling, rhs), expected, atol=1e-10, rtol=0)


class TermTest(unittest.TestCase):
    def test_contact_costs_nothing_within_the_margin_and_is_linear_beyond_the_knee(self):
        x = torch.tensor([[[0.05, 0.0, 0.0], [0.11, 0.0, 0.0], [0.5, 0.0, 0.0]]], dtype=FLOAT)
        found = terms.contact(
            x, torch.zeros_like(x), torch.tensor([[1.0, 3.0, 5.0]], dtype=FLOAT), 0.1, 0.02
        )
        self.assertAlmostEqual(found.cost.item(), 3 * 0.01**2 / 0.04 + 5 * (0.4 - 0.01))

    def test_jumps_cost_beyond_their_limit(self):
        limit = torch.tensor([0.2, 0.2, torch.inf], dtype=FLOAT)
        weight = torch.tensor([2.0, 3.0, 4.0], dtype=FLOAT)
        d = torch.tensor([[0.1, -0.3, 0.5]], dtype=FLOAT)
        found = terms.change(d, weight, limit, 100.0)
        assert_close(found.curvature, torch.tensor([[2.0, 103.0, 4.0]], dtype=FLOAT))
        assert_close(found.gradient, torch.tensor([[0.2, -10.9, 2.0]], dtype=FLOAT))
        self.assertAlmostEqual(found.cost.item(), 2 * 0.01 + 3 * 0.09 + 4 * 0.25 + 100 * 0.01)


class HandTest(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.robot = toy_hand_arm(Path(cls.enterClassContext(tempfile.TemporaryDirectory())))
        cls.model = HandModel(cls.robot)
        cls.motion = toy_motion(cls.model, torch.Generator().manual_seed(1), margin=0.1, turn=0.3)
        cls.keypoints = cls.model.keypoints(**vars(cls.motion))
        cls.tip = cls.model.names.index("index4")
        cls.touching = torch.ones(cls.keypoints.shape[:3], dtype=torch.bool)
        cls.far = Surface(box_object(((0, 0, 0), (0.1, 0.1, 0.1)))).field

    def targets(self, **changes) -> HandTargets:
        return hand_targets(**({"keypoints": self.keypoints, "fields": self.far} | changes))

    def solve(self, config: HandConfig | None = None, **changes) -> HandState:
        return retarget_hand(self.model, self.targets(**changes), config)

    def too_near(self, targets: HandTargets, state: HandState, config: HandConfig) -> Distances:
        """What the clearance term acts on."""
        flat = (x.flatten(0, 1) for x in (state.joints, state.root_pos, state.root_quat))
        pos = targets.object_pos.flatten(0, 1)
        quat = targets.object_quat.flatten(0, 1)
        objects = Objects(
            pos, quat_to_matrix(quat), targets.object_index.repeat_interleave(12), targets.fields
        )
        annotated = targets.annotated.flatten()
        bodies = self.model.bodies(*flat)
        return too_near(
            self.model, bodies, objects, annotated, config.object_clearance, config.self_depth
        )

    def test_gradient_is_the_derivative_of_the_cost(self):
        """All terms at once: bones, alignment, contact (beyond and below the knee), object, smoothness, jumps."""
        turn = quat_from_axis_angle(torch.tensor([0.3, -0.2, 0.5], dtype=FLOAT))
        targets = self.targets(
            contact_points=self.keypoints
            + torch.tensor([0.011, 0.0, 0.0], dtype=FLOAT) * torch.arange(6)[:, None],
            in_contact=self.touching,
            object_pos=self.keypoints[:, :, 3] + 0.01,
            object_quat=turn.expand(*self.keypoints.shape[:2], 4),
        )
        config = HandConfig(jump_limit=0.02)
        joints = self.model.kinematics.clamp(self.motion.joints + 0.05)
        state = dataclasses.replace(
            self.motion, joints=joints, root_pos=self.motion.root_pos + 0.004
        )
        cost = system(self.model, targets, config, state).cost
        self.assertGreater(len(self.too_near(targets, state, config).value), 10)
        self.assertGreater(joints.diff(dim=1).abs().max().item(), config.jump_limit)
        for weight in (
            "jump_weight",
            "clearance_weight",
            "contact_weight",
            "global_weight",
            "local_weight",
        ):
            without = system(
                self.model, targets, dataclasses.replace(config, **{weight: 0.0}), state
            ).cost
            self.assertGreater((cost - without).max().item(), 1e-6, weight)
        check_gradient(self.model, targets, config, state, frames=(0, 5, 11))

    def test_recovers_a_motion_from_its_own_keypoints(self):
        config = HandConfig(
            smoothness_weight=1e-6, clearance_weight=0.0, iterations=60, tolerance=1e-9
        )
        found = self.solve(config)
        self.assertLess(
            (self.model.keypoints(**vars(found)) - self.keypoints).norm(dim=-1).max().item(), 1e-4
        )
        # no keypoint follows the jaws
        seen = [name != "jaw_a" for name in self.model.kinematics.joint_names]
        self.assertLess((found.joints - self.motion.joints)[..., seen].abs().max().item(), 5e-3)
        self.assertLess(quat_angle(found.root_quat, self.motion.root_quat).max().item(), 5e-3)

    def test_order_and_company_of_sequences_do_not_matter(self):
        targets = self.targets(object_pos=self.keypoints[:, :, self.tip] + 0.01)
        together = retarget_hand(self.model, targets).joints
        for order in ([2, 0, 1], [1]):
            assert_close(
                retarget_hand(self.model, targets[order]).joints, together[order], atol=1e-9, rtol=0
            )

    def test_joints_do_not_jump(self):
        """Keypoints that jump to another posture in one frame: the wall spreads the change over several."""
        swapped = torch.cat(
            (self.keypoints[:, :6], self.keypoints[:, -1:].expand(-1, 6, -1, -1)), dim=1
        )
        free, walled = (
            self.solve(HandConfig(jump_weight=w), keypoints=swapped).joints for w in (0.0, 1000.0)
        )
        self.assertGreater(free.diff(dim=1).abs().max().item(), 0.25)
        self.assertLess(walled.diff(dim=1).abs().max().item(), 0.2)

    def test_frames_without_annotation_do_not_matter_and_are_bridged(self):
        annotated = torch.ones(3, 12, dtype=torch.bool)
        annotated[:, 4:7] = False
        annotated[:, 10:] = False
        garbage = self.keypoints.clone()
        garbage[~annotated] = 1e3
        joints = self.solve(annotated=annotated).joints
        assert_close(
            self.solve(annotated=annotated, keypoints=garbage).joints, joints, atol=0, rtol=0
        )
        assert_close(joints[:, 5], (joints[:, 3] + joints[:, 7]) / 2, atol=1e-3, rtol=0)
        assert_close(joints[:, 11], joints[:, 9], atol=1e-3, rtol=0)

    def test_contact_pulls_the_links_that_touch(self):
        aim = self.keypoints.clone()
        aim[:, :, self.tip, 2] += 0.04
        mask = torch.zeros_like(self.touching)
        mask[:, :, self.tip] = True
        pulled = self.solve(HandConfig(contact_weight=50.0), contact_points=aim, in_contact=mask)
        self.assertLess(
            (self.model.keypoints(**vars(pulled)) - aim)[:, :, self.tip].norm(dim=-1).mean().item(),
            0.025,
        )

    def test_the_hand_stays_out_of_the_object(self):
        inside = self.targets(object_pos=self.keypoints[:, :, self.tip])
        depth = []
        for weight in (0.0, 2000.0):
            motion = retarget_hand(self.model, inside, HandConfig(clearance_weight=weight))
            near = self.too_near(inside, motion, HandConfig())
            depth.append(max((-near.value).tolist(), default=0.0))
            if weight == 0.0:
                self.check_distances(inside, motion, near)
        self.assertGreater(depth[0], 0.02)
        self.assertLess(depth[1], 0.005)

    def check_distances(self, targets: HandTargets, motion: HandState, near: Distances) -> None:
        """Distances from the object are those of the balls' surfaces, less what the hand keeps."""
        balls = self.model.balls
        number = near.number - len(balls.radii)
        mine = (number >= 0) & (number < len(balls.radii))
        ball = number[mine]
        frame = near.frame[mine]
        bodies = self.model.bodies(*(x.flatten(0, 1) for x in vars(motion).values()))
        local = self.model.ball_centers(bodies, frame, ball)
        local = local - targets.object_pos.flatten(0, 1)[frame]
        distance, _ = targets.fields.signed_distance(local, torch.zeros_like(ball))
        expected = distance - balls.radii[ball] - HandConfig().object_clearance
        assert_close(near.value[mine], expected, atol=1e-9, rtol=0)

    def test_pairs_for_any_subset_of_keypoints(self):
        jaws = keypoint_pairs(
            ("wrist", "thumb4", "index4", "middle4"), ("hand", "left", "right", "right")
        )
        self.assertEqual(set(jaws), {(0, 1), (0, 2), (0, 3), (1, 2), (1, 3)})

    def test_a_description_that_does_not_allow_retargeting_is_refused(self):
        for changes, message in (
            ({"hand_root": "upper"}, "hand_root"),
            ({"keypoints": self.robot.keypoints[:2]}, "3 or more"),
        ):
            with self.assertRaisesRegex(RobotError, message):
                HandModel(dataclasses.replace(self.robot, **changes))


class ArmTest(unittest.TestCase):
    CONFIG = ArmConfig(restarts=12, branches=2)

    @classmethod
    def setUpClass(cls):
        cls.robot = robots.load("ur7e-sharpa")
        cls.model = ArmModel(cls.robot)

    def path(self, frames: int) -> torch.Tensor:
        """[1, T, J] all joints along a path from home."""
        joints = torch.as_tensor(self.robot.home).repeat(1, frames, 1)
        direction = torch.tensor([1.0, 0.3, -0.5, 0.4, 0.3, 1.0], dtype=FLOAT)
        joints[..., self.model.arm] += (
            torch.linspace(0, 0.4, frames, dtype=FLOAT)[:, None] * direction
        )
        return joints

    def targets(
        self, frames: int, shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ) -> ArmTargets:
        """Targets from the hand's pose along the path, moved by a shift [m]."""
        targets = arm_targets(self.model, self.path(frames))
        clearance = self.model.hand_clearance(targets.hand_joints)
        pos = targets.root_pos + torch.tensor(shift, dtype=FLOAT)
        return dataclasses.replace(targets, root_pos=pos, hand_clearance=clearance)

    def track(self, targets: ArmTargets, **changes) -> tuple[torch.Tensor, Measures, list[str]]:
        """Joints, measures, and the reason of every frame of the first sequence."""
        joints, measures = track(
            self.model, targets, Thresholds(), dataclasses.replace(self.CONFIG, **changes)
        )
        return joints, measures, [REASONS[i] for i in classify(measures, Thresholds())[0]]

    def test_follows_a_path_that_the_arm_can_follow(self):
        joints, measures, reasons = self.track(self.targets(8))
        self.assertLess(measures.wrist_position.max().item(), 1e-3)
        self.assertLess(measures.wrist_orientation.max().item(), 5e-3)
        self.assertEqual(reasons, ["valid"] * 8)
        self.assertTrue(((joints >= self.model.lower) & (joints <= self.model.upper)).all())

    def test_stays_above_the_table(self):
        heights = table_clearance(self.model.kinematics, self.path(4), self.model.table)
        sunk = self.targets(4, shift=(0.0, 0.0, -heights.min().item() - 0.05))
        _, free, free_reasons = self.track(sunk, collision_weight=0.0)
        _, kept, kept_reasons = self.track(sunk)
        self.assertAlmostEqual(free.table_clearance.min().item(), -0.05, delta=0.005)
        self.assertGreater(kept.table_clearance.min().item(), -0.006)
        self.assertEqual(max(free_reasons, key=REASONS.index), "table collision")
        self.assertEqual(max(kept_reasons, key=REASONS.index), "wrist position")


class ValidityTest(unittest.TestCase):
    def test_every_reason_can_be_reached_and_the_first_counts(self):
        good = {
            "annotated": True,
            "at_limit": False,
            "arm_jump": 0.1,
            "table_clearance": 0.01,
            "self_clearance": 0.01,
        }
        good |= dict.fromkeys(("hand_error", "wrist_position", "wrist_orientation"), 0.001)

        def reason(**changes) -> str:
            measures = Measures(
                **{name: torch.tensor([value]) for name, value in (good | changes).items()}
            )
            return REASONS[int(classify(measures, Thresholds()))]

        self.assertEqual(reason(), "valid")
        self.assertEqual(reason(at_limit=True), "valid")  # a limit alone does no harm
        everything = {}
        for name, changes in (
            ("self collision", {"self_clearance": -0.01}),
            ("table collision", {"table_clearance": -0.01}),
            ("arm jump", {"arm_jump": 0.5}),
            ("wrist orientation", {"wrist_orientation": 0.2}),
            ("wrist position", {"wrist_position": 0.02}),
            ("joint limit", {"wrist_position": 0.02, "at_limit": True}),
            ("hand error", {"hand_error": float("nan")}),
            ("not annotated", {"annotated": False}),
        ):
            everything |= changes
            self.assertEqual((reason(**changes), reason(**everything)), (name, name))


class PipelineTest(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.folder = Path(cls.enterClassContext(tempfile.TemporaryDirectory()))
        cls.robot = robots.load("ur7e-sharpa")
        demos = synthesize(["soup"], per_object=2, seed=0, fps=20)
        valid = demos.hand_valid.copy()
        valid[demos.frames(1)] = False  # a sequence in which the hand was never seen
        valid[0] = False
        keypoints = np.where(valid[:, None, None], demos.hand_keypoints, np.nan)
        cls.demos = dataclasses.replace(demos, hand_valid=valid, hand_keypoints=keypoints)
        cls.objects = list(demo_objects(demos).values())
        cls.config = RetargetConfig(arm=ArmConfig(restarts=12, branches=2))
        cls.ticks = []
        cls.result = retarget_demos(
            cls.demos, cls.robot, cls.objects, cls.config, progress=lambda *at: cls.ticks.append(at)
        )
        cls.first, cls.second = (demos.frames(i) for i in range(2))

    def write(self, name: str, result: Retargeted) -> Path:
        write_retargeted(self.folder / name, result, config={}, inputs={})
        return self.folder / name

    def test_most_frames_of_a_synthetic_demonstration_are_valid(self):
        seen = self.result.annotated[self.first]
        self.assertGreater(self.result.valid[self.first].sum() / seen.sum(), 0.8)
        self.assertLess(self.result.hand_error[self.first][seen].mean(), 0.015)
        self.assertEqual(self.ticks, [(1, 1)])
        first = self.result.first_contact[0]
        self.assertEqual(np.flatnonzero(self.result.contact[self.first])[0], first)
        self.assertGreater(first, 0)

    def test_a_hand_that_is_elsewhere_while_the_object_moves_is_told(self):
        np.testing.assert_array_equal(self.result.untouched, [False, False])
        contact = self.result.contact.copy()
        contact[self.first][self.result.first_contact[0] + 2 :] = False
        gone = dataclasses.replace(self.result, contact=contact)
        np.testing.assert_array_equal(gone.untouched, [True, False])
        away = self.demos.select(indices=[0])
        away = dataclasses.replace(away, hand_keypoints=away.hand_keypoints + np.float32(0.3))
        left = np.full(1, "left")
        write_demos(self.folder / "away.npz", dataclasses.replace(away, hand_side=left))
        configs = {"hand": HandConfig(tolerance=0.1), "arm": ArmConfig(restarts=1, branches=1)}
        out = self.folder / "away-robot.npz"
        with contextlib.redirect_stdout(io.StringIO()) as text:
            command(self.folder / "away.npz", robot="ur7e-sharpa", out=out, **configs)
        self.assertIn("In 1 of 1 sequences the object moves while no hand", text.getvalue())
        self.assertIn("1 of 1 sequences are of left hands", text.getvalue())

    def test_the_file_says_what_the_robot_does(self):
        result = self.result
        kinematics = Kinematics(self.robot)
        q = torch.as_tensor(result.joint_pos)
        links = kinematics.link_poses(q, self.robot.tracked_links).numpy()
        np.testing.assert_allclose(result.palm_pos, links[:, 0, :3, 3], atol=1e-12)
        np.testing.assert_allclose(result.fingertip_pos, links[:, 1:, :3, 3], atol=1e-12)
        np.testing.assert_allclose(
            quat_to_matrix(torch.as_tensor(result.palm_quat_wxyz)), links[:, 0, :3, :3], atol=1e-9
        )
        self.assertTrue(((q >= kinematics.lower - 1e-12) & (q <= kinematics.upper + 1e-12)).all())
        seen = result.annotated & result.valid
        tips = [KEYPOINTS.index(tip.keypoint) for tip in self.robot.fingertips]
        human = rest_on_table(self.demos, self.objects).hand_keypoints[:, tips]
        gap = np.linalg.norm(result.fingertip_pos - human, axis=-1).mean(axis=1)
        # They differ by the wrist's error at most.
        np.testing.assert_allclose(gap[seen], result.hand_error[seen], atol=0.011)

    def test_a_sequence_without_a_hand_stays_at_home(self):
        joints = self.result.joint_pos[self.second]
        np.testing.assert_array_equal(joints, np.tile(self.robot.home, (len(joints), 1)))
        self.assertEqual({REASONS[r] for r in self.result.reason[self.second]}, {"not annotated"})
        self.assertEqual(self.result.first_contact[1], -1)
        np.testing.assert_array_equal(np.isinf(self.result.hand_error), ~self.result.annotated)
        np.testing.assert_array_equal(self.result.goal_pos[1], self.result.object_pos[-1])

    def test_a_file_comes_back_and_the_same_inputs_give_the_same_file(self):
        file = self.write("a.npz", self.result)
        again = retarget_demos(self.demos, self.robot, self.objects, self.config)
        self.assertEqual(self.write("b.npz", again).read_bytes(), file.read_bytes())
        back = read_retargeted(file)
        for field in dataclasses.fields(Retargeted):
            np.testing.assert_array_equal(
                getattr(back, field.name), getattr(self.result, field.name), field.name
            )

    def test_a_file_that_contradicts_itself_is_refused(self):
        for changes, message in (
            ({"valid": ~self.result.valid}, "contradict"),
            ({"joint_pos": np.full_like(self.result.joint_pos, np.nan)}, "non-finite"),
            ({"reason": self.result.reason + 100}, "points beyond"),
            ({"frame_offsets": self.result.frame_offsets[::-1].copy()}, "frame_offsets"),
            ({"first_contact": np.array([10_000, -1])}, "first_contact"),
        ):
            path = self.write("d.npz", dataclasses.replace(self.result, **changes))
            with self.subTest(message), self.assertRaisesRegex(FileFormatError, message):
                read_retargeted(path)

    def test_an_object_that_was_not_given_is_named(self):
        with self.assertRaisesRegex(DemoError, "005_tomato_soup_can"):
            retarget_demos(self.demos, self.robot, [])

    def test_the_command_writes_a_file_for_a_gripper(self):
        write_demos(self.folder / "demos.npz", self.demos.select(indices=[0]))
        configs = {"hand": HandConfig(tolerance=0.002), "arm": ArmConfig(restarts=8)}
        out = self.folder / "jaws.npz"
        with contextlib.redirect_stdout(io.StringIO()) as text:
            command(self.folder / "demos.npz", robot="openarm", out=out, **configs)
        self.assertIn("005_toma", text.getvalue())
        with np.load(out) as file:
            used = json.loads(str(file["meta"]))["config"]["retarget"]
        self.assertEqual((used["hand"]["tolerance"], used["arm"]["restarts"]), (0.002, 8))
        self.assertEqual(read_retargeted(out).robot, "openarm")


class RealDataTest(unittest.TestCase):
    def test_fingertips_follow_a_real_hand(self):
        demos = read_demos(data_dir() / "dexycb_right_9x20.npz").select(
            objects=["soup"], max_per_object=1
        )
        result = retarget_demos(
            demos, robots.load("ur7e-sharpa"), list(demo_objects(demos).values())
        )
        self.assertLess(result.hand_error[result.annotated].mean(), 0.010)
        self.assertGreater(result.valid.sum() / result.annotated.sum(), 0.9)


if __name__ == "__main__":
    unittest.main()
