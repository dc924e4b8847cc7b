"""Retargeting: the solver, the hand, the arm, the validity of frames, and the whole pipeline."""

import json
from dataclasses import replace
from unittest import TestCase
from unittest.mock import patch

import numpy as np
import torch
from numpy.testing import assert_allclose, assert_array_equal
from torch import tensor
from torch.testing import assert_close

from tests.command import refused, succeeds
from tests.data import InOneFolder, data_dir, refuses, upright
from tests.toy_retarget import (
    FLOAT,
    arm_targets,
    box_object,
    check_gradient,
    double,
    hand_targets,
    retargets_quickly,
    slope,
)
from tests.toy_robot import toy_motion, toy_robot
from xreset import read_retargeted, robots, write_retargeted
from xreset.demos.archive import demo_objects, read_demos, rest_on_table, write_demos
from xreset.errors import DemoError, FileFormatError, RobotError, XResetError
from xreset.files.records import arrays_of, stated_doubts, write_npz
from xreset.geometry.collision import table_clearance
from xreset.geometry.fields import DistanceFields
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.rotations import (
    quat_angle,
    quat_from_axis_angle,
    quat_multiply,
    quat_to_matrix,
)
from xreset.geometry.surface import Surface
from xreset.resets.fingers import fingers_of
from xreset.retarget.arm.config import ArmSearch
from xreset.retarget.arm.model import ArmModel, arm_jump
from xreset.retarget.arm.solve import Paths, best_path, branches, repaired, track
from xreset.retarget.arm.solve import system as arm_system
from xreset.retarget.file import SCHEMA, Retargeted
from xreset.retarget.hand import solve, terms
from xreset.retarget.hand.clearance import Objects, contact_distance, too_near
from xreset.retarget.hand.config import HandWeights
from xreset.retarget.hand.cost import system
from xreset.retarget.hand.model import HandModel, keypoint_pairs
from xreset.retarget.hand.solve import retarget_hand
from xreset.retarget.least_squares import change_cost, free_to_move, solve_chain
from xreset.retarget.pipeline import RetargetConfig
from xreset.retarget.validity import REASONS, Measures, Thresholds, classify, too_deep
from xreset.retarget.verbs import retarget_demos
from xreset.spec import KEYPOINTS


class ChainTest(TestCase):
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


class BoundsTest(TestCase):
    def test_variables_stay_at_bounds_that_the_cost_pulls_them_beyond(self):
        x = double([0.0, 0.0, 1.0, 1.0, 0.5])
        gradient = double([1.0, -1.0, 1.0, -1.0, 1.0])
        free = free_to_move(x, gradient, torch.zeros_like(x), torch.ones_like(x))
        self.assertEqual(free.tolist(), [0, 1, 1, 0, 1])


class TermTest(TestCase):
    def test_contact_costs_nothing_within_the_margin_and_is_linear_beyond_the_knee(self):
        x = double([[[0.05, 0.0, 0.0], [0.11, 0.0, 0.0], [0.5, 0.0, 0.0]]])
        found = terms.contact(x, torch.zeros_like(x), double([[1.0, 3.0, 5.0]]), 0.1, 0.02)
        self.assertAlmostEqual(found.cost.item(), 3 * 0.01**2 / 0.04 + 5 * (0.4 - 0.01))

    def test_jumps_cost_beyond_their_limit(self):
        limit = double([0.2, 0.2, torch.inf])
        weight = double([2.0, 3.0, 4.0])
        d = double([[0.1, -0.3, 0.5]])
        found = change_cost(d, weight, limit, 100.0)
        assert_close(found.curvature, double([[2.0, 103.0, 4.0]]))
        assert_close(found.gradient, double([[0.2, -10.9, 2.0]]))
        self.assertAlmostEqual(found.cost.item(), 2 * 0.01 + 3 * 0.09 + 4 * 0.25 + 100 * 0.01)


class HandTest(TestCase):
    @classmethod
    def setUpClass(cls):
        cls.robot = toy_robot()
        cls.model = HandModel(cls.robot)
        cls.motion = toy_motion(cls.model, torch.Generator().manual_seed(1), margin=0.1, turn=0.3)
        cls.keypoints = cls.model.keypoints(cls.motion)
        cls.tip = cls.model.keypoint_names.index("index4")
        cls.far = Surface(box_object(((0, 0, 0), (0.1, 0.1, 0.1)))).field

    def targets(self, **changes):
        return hand_targets(**({"keypoints": self.keypoints, "fields": self.far} | changes))

    def solve(self, config=None, **changes):
        return retarget_hand(self.model, self.targets(**changes), config)

    def off(self, motion, keypoints):
        """[S, T, P] distance of the keypoints of a motion from others [m]."""
        return (self.model.keypoints(motion) - keypoints).norm(dim=-1)

    def in_frames(self, targets, state, model=None):
        """Links of the hand and objects in all frames."""
        turn = quat_to_matrix(targets.object_quat.flatten(0, 1))
        index = targets.object_index.repeat_interleave(12)
        objects = Objects(targets.object_pos.flatten(0, 1), turn, index, targets.fields)
        return (model or self.model).bodies(state.map(lambda x: x.flatten(0, 1))), objects

    def too_near(self, targets, state, config):
        """What the clearance term acts on."""
        limits = (config.object_clearance, config.self_depth)
        frames = self.in_frames(targets, state)
        return too_near(self.model, *frames, targets.annotated.flatten(), *limits)

    def test_frames_without_a_hand_begin_with_the_nearest_frame_with_one(self):
        """In memory for a few numbers of each frame: one for each pair of frames would take 80 GB."""
        seen = torch.zeros(2, 100_000, dtype=torch.bool)
        seen[0, [2, 6, 7]] = True
        seen[1, -1] = True
        found = solve.nearest_annotated(seen)
        self.assertEqual(found[0, :9].tolist(), [2, 2, 2, 2, 2, 6, 6, 7, 7])
        self.assertEqual(found[1].unique().tolist(), [99_999])

    def test_contacts_are_measured_from_the_surface_of_the_rigid_link(self):
        """Balls of 1 cm around the origins of the fingertip and, 3 cm behind it, of the link that carries it."""
        bodies = self.model.bodies(self.motion.map(lambda x: x[0, :1]))
        body = self.model.keypoint_body[self.tip]
        ahead = bodies.rot[0, body, :, 0]
        for along, expected in ((0.02, 0.01), (0.006, 0.004), (-0.045, 0.005)):
            points = bodies.pos[:, self.model.keypoint_body] + along * ahead
            found = contact_distance(self.model, bodies, points)
            self.assertAlmostEqual(found[0, self.tip].item(), expected, delta=5e-4)

    def test_gradient_is_the_derivative_of_the_cost(self):
        """All terms at once: bones, alignment, contact (beyond and below the knee), object, smoothness, jumps."""
        turn = quat_from_axis_angle(double([0.3, -0.2, 0.5]))
        targets = self.targets(
            contact_points=self.keypoints + double([0.011, 0.0, 0.0]) * torch.arange(6)[:, None],
            in_contact=torch.ones(self.keypoints.shape[:3], dtype=torch.bool),
            object_pos=self.keypoints[:, :, 3] + 0.01,
            object_quat=turn.expand(*self.keypoints.shape[:2], 4),
        )
        config = HandWeights(jump_limit=0.02)
        joints = self.model.kinematics.clamp(self.motion.joints + 0.05)
        state = replace(self.motion, joints=joints, root_pos=self.motion.root_pos + 0.004)
        cost = system(self.model, targets, config, state).cost
        self.assertGreater(len(self.too_near(targets, state, config).value), 10)
        self.assertGreater(joints.diff(dim=1).abs().max(), config.jump_limit)
        for term in ["jump", "clearance", "contact", "global", "local"]:
            changed = replace(config, **{f"{term}_weight": 0.0})
            without = system(self.model, targets, changed, state).cost
            self.assertGreater((cost - without).max(), 1e-6, term)
        check_gradient(self.model, targets, config, state, frames=(0, 5, 11))

    def test_gradient_where_links_meet_each_other_and_the_table(self):
        links = tuple(self.model.balls.links)
        model = HandModel(replace(self.robot, self_collision_links=links))
        low = self.motion.root_pos * double([1.0, 1.0, 0.0]) + double([0.0, 0.0, 0.03])
        closed = double([-1.6, 1.6, 0.8, 0.0125]) + 0.05 * self.motion.joints
        state = replace(self.motion, root_pos=low, joints=closed)
        config = HandWeights(self_depth=-0.025)
        targets = self.targets()
        bodies, objects = self.in_frames(targets, state, model)
        number = too_near(model, bodies, objects, torch.ones(36) > 0, 0.0, -0.025).number
        self.assertGreater((number < len(model.balls.radii)).sum(), 10)
        self.assertGreater((number > 2 * len(model.balls.radii)).sum(), 10)
        check_gradient(model, targets, config, state, frames=(0, 11))

    def test_recovers_a_motion_from_its_own_keypoints(self):
        config = HandWeights(
            smoothness_weight=1e-6, clearance_weight=0.0, iterations=60, tolerance=1e-9
        )
        found = self.solve(config)
        self.assertLess(self.off(found, self.keypoints).max(), 1e-4)
        # no keypoint follows the jaws
        seen = [name != "jaw_a" for name in self.model.kinematics.joint_names]
        self.assertLess((found.joints - self.motion.joints)[..., seen].abs().max(), 5e-3)
        self.assertLess(quat_angle(found.root_quat, self.motion.root_quat).max(), 5e-3)

    def test_each_sequence_is_retargeted_independently(self):
        place = self.keypoints[:, :, self.tip] + 0.01
        small = Surface(box_object(((0, 0, 0), (0.03, 0.03, 0.03)))).field
        fields = DistanceFields.join([self.far, small])
        objects = {"fields": fields, "object_index": tensor([0, 1, 0])}
        targets = self.targets(object_pos=place, **objects)
        together = retarget_hand(self.model, targets).joints
        for order in ([2, 0, 1], [1]):
            assert_close(
                retarget_hand(self.model, targets[order]).joints, together[order], atol=1e-9, rtol=0
            )
        # a batch pads shorter sequences with frames that are not annotated
        keypoints = self.keypoints[[1], :8]
        short = self.targets(keypoints=keypoints, object_pos=place[[1], :8], fields=small)
        targets.annotated[1, 8:] = False
        padded = retarget_hand(self.model, targets).joints[1]
        assert_close(padded[:8], retarget_hand(self.model, short).joints[0], atol=1e-9, rtol=0)
        assert_close(padded[8:], padded[7].expand(4, -1))

    def test_the_motion_turns_with_the_scene(self):
        turn = quat_to_matrix(quat_from_axis_angle(double([0.0, 0.0, 0.7])))
        joints = self.solve(keypoints=self.keypoints @ turn.mT).joints
        assert_close(joints, self.solve().joints, atol=1e-9, rtol=0)

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

    def test_the_hand_stays_out_of_the_object(self):
        inside = self.targets(object_pos=self.keypoints[:, :, self.tip])
        depth = []
        for weight in (0.0, 2000.0):
            motion = retarget_hand(self.model, inside, HandWeights(clearance_weight=weight))
            near = self.too_near(inside, motion, HandWeights())
            depth.append(max((-near.value).tolist(), default=0.0))
            if weight == 0.0:
                self.check_distances(inside, motion, near)
        self.assertGreater(depth[0], 0.02)
        self.assertLess(depth[1], 0.005)

    def check_distances(self, targets, motion, near):
        """Distances from the object are those of the balls' surfaces, less what the hand keeps."""
        balls = self.model.balls
        number = near.number - len(balls.radii)
        mine = (number >= 0) & (number < len(balls.radii))
        ball = number[mine]
        frame = near.frame[mine]
        bodies, objects = self.in_frames(targets, motion)
        local = self.model.ball_centers(bodies, frame, ball) - objects.pos[frame]
        distance, _ = targets.fields.signed_distance(local, torch.zeros_like(ball))
        expected = distance - balls.radii[ball] - HandWeights().object_clearance
        assert_close(near.value[mine], expected, atol=1e-9, rtol=0)
        every = torch.arange(len(objects.pos)).repeat_interleave(len(balls.radii))
        centers = self.model.ball_centers(bodies, every, torch.arange(len(balls.radii)).repeat(36))
        distance, _ = targets.fields.signed_distance(centers - objects.pos[every], 0 * every)
        self.assertEqual(len(ball), (distance < balls.radii.repeat(36) + 0.0005).sum())

    def test_a_hand_is_filled_once(self):
        with patch("xreset.retarget.hand.model.hand_balls", None):
            HandModel(self.robot)
        with patch("xreset.retarget.hand.model.link_field", None):
            HandModel(replace(self.robot, name="another"))  # only retargeting needs solids

    def test_pairs_for_any_subset_of_keypoints(self):
        names = ["wrist", "thumb4", "index4", "middle4"]
        jaws = keypoint_pairs(names, ("hand", "left", "right", "right"))
        self.assertEqual(set(jaws), {(0, 1), (0, 2), (0, 3), (1, 2), (1, 3)})

    def test_a_description_that_does_not_allow_retargeting_is_refused(self):
        no_tips = [spec for spec in self.robot.keypoints if not spec.keypoint.endswith("4")]
        for changes, message in (
            ({"hand_root": "upper"}, "hand_root"),
            ({"keypoints": self.robot.keypoints[:2]}, "3 or more"),
            ({"keypoints": no_tips}, "fingertip's keypoint. Add thumb4, index4 to"),
        ):
            with self.assertRaisesRegex(RobotError, message):
                HandModel(replace(self.robot, **changes))


class ArmTest(TestCase):
    CONFIG = ArmSearch(restarts=12, branches=2)

    @classmethod
    def setUpClass(cls):
        cls.robot = robots.load("ur7e-sharpa")
        cls.model = ArmModel(cls.robot)

    def path(self, frames):
        """[1, T, J] all joints along a path from home."""
        joints = torch.as_tensor(self.robot.home).repeat(1, frames, 1)
        direction = double([1.0, 0.3, -0.5, 0.4, 0.3, 1.0])
        joints[..., self.model.arm] += (
            torch.linspace(0, 0.4, frames, dtype=FLOAT)[:, None] * direction
        )
        return joints

    def targets(self, frames, shift=(0.0, 0.0, 0.0)):
        """Targets from the hand's pose along the path, moved by a shift [m]."""
        targets = arm_targets(self.model, self.path(frames))
        clearance = self.model.hand_clearance(targets.hand_joints)
        pos = targets.root_pos + double(shift)
        return replace(targets, root_pos=pos, hand_clearance=clearance)

    def track(self, targets, **changes):
        """Joints, measures, and the reason of every frame of the first sequence."""
        joints, measures = track(self.model, targets, Thresholds(), replace(self.CONFIG, **changes))
        return joints, measures, [REASONS[i] for i in classify(measures, Thresholds())[0]]

    def test_follows_a_path_that_the_arm_can_follow(self):
        joints, measures, reasons = self.track(self.targets(8))
        self.assertLess(measures.wrist_position.max(), 1e-3)
        self.assertLess(measures.wrist_orientation.max(), 5e-3)
        self.assertEqual(reasons, ["valid"] * 8)
        self.assertTrue(((joints >= self.model.lower) & (joints <= self.model.upper)).all())

    def test_frames_that_pad_a_batch_do_not_choose_the_path(self):
        targets = self.targets(4)
        targets = replace(targets, annotated=torch.tensor([[True, True, False, False]]))
        problem = self.model.problem(targets, Thresholds())
        joints = self.model.home.repeat(1, 2, 4, 1)
        joints[:, 0, 2:] += 1.0  # nearest to home where it counts
        joints[:, 1, :2] += 0.1
        paths = Paths(joints, targets.annotated.expand(2, 4)[None])
        assert_close(best_path(problem, paths)[0], joints[:, 0], atol=0, rtol=0)

    def test_a_path_without_jumps_may_be_farther_from_home(self):
        problem = self.model.problem(self.targets(4), Thresholds())
        joints = self.model.home.repeat(1, 2, 4, 1)
        joints[:, 0, 2:] += 0.36
        joints[:, 1] += 0.3
        best, worth = best_path(problem, Paths(joints, torch.ones(1, 2, 4, dtype=torch.bool)))
        assert_close(best, joints[:, 1], atol=0, rtol=0)
        self.assertAlmostEqual(worth.item(), 4 - 6 * 0.3**2)

    def test_gradient_is_the_derivative_of_the_cost(self):
        """All terms at once: wrist, shapes of arm and hand in the margin above the table, smoothness, a jump."""
        targets = self.targets(1, shift=(0.01, -0.02, 0.03))
        turn = quat_from_axis_angle(double([[[0.3, -0.2, 0.5]]]))
        targets = replace(targets, root_quat=quat_multiply(turn, targets.root_quat))
        problem = self.model.problem(targets, Thresholds(), ArmSearch(table_margin=0.5))
        q = self.path(1)[:, 0, self.model.arm]
        previous = q + double([0.5, -0.1, 0.2, -0.4, 0.0, 0.1])

        def found(joints):
            return arm_system(problem[:, 0], joints, torch.arange(1), previous)

        for joint, expected in enumerate(found(q).gradient[0]):
            half = slope(lambda x: found(x).cost, q, (0, joint)) / 2
            assert_close(half[0], expected, rtol=1e-5, atol=1e-5)

    def test_measures_of_a_path(self):
        """Shapes of the robot are measured in frames that are valid without them."""
        joints = self.path(3)[..., self.model.arm]
        joints[0, 2, -1] = self.model.upper[-1]
        own = double([[0.0, -0.002, -0.02]])
        problem = self.model.problem(replace(self.targets(3), hand_clearance=own), Thresholds())
        of_arm = np.array([-0.01, -0.001])
        with patch.object(self.model.arm_collision, "clearance", return_value=of_arm) as measured:
            found = problem.measures(joints)
        self.assertEqual(len(measured.call_args.args[0]), 2)
        assert_close(found.self_clearance, double([[-0.01, -0.002, -0.02]]))
        self.assertEqual(found.at_limit.tolist(), [[False, False, True]])

    def test_no_joint_jumps_after_a_frame_without_a_hand(self):
        joints = double([[0.0, 9.0], [1.0, 8.5], [3.0, 9.0], [3.0, 8.0]])
        jump = arm_jump(joints, tensor([True, False, True, True]))
        self.assertEqual(jump.tolist(), [0.0, 1.0, 0.0, 1.0])

    def test_a_frame_that_is_solved_again_is_followed_both_ways(self):
        problem = self.model.problem(self.targets(6), Thresholds(), self.CONFIG)
        one, other = branches(problem).joints[0, :, 0]
        self.assertGreater((one - other).abs().max(), 0.5, "two solutions of the first frame")
        wrong = (self.model.home + 1.0).expand(1, 1, 6, -1)
        known = Paths(wrong, torch.zeros(1, 1, 6, dtype=torch.bool))
        found = repaired(problem, known, torch.arange(6)[None] == 2)
        self.assertFalse(problem.reasons(found).any())

    def test_lags_behind_a_turn_that_would_be_a_jump(self):
        """The last joint of the arm turns by 0.38 rad in one frame, next to a singularity others do as well."""
        joints = self.path(1).repeat(1, 6, 1)
        joints[:, 3:, self.model.arm[-1]] += 0.38
        targets = arm_targets(self.model, joints)
        for changes, expected in (({}, "valid"), ({"jump_weight": 0.0}, "arm jump")):
            _, measures, reasons = self.track(targets, **changes)
            self.assertEqual(reasons[3], expected)
            self.assertEqual(reasons[:3] + reasons[4:], ["valid"] * 5)
            self.assertLess(measures.wrist_orientation[0, 5], 0.01)

    def test_stays_above_the_table(self):
        heights = table_clearance(self.model.kinematics, self.path(4), self.model.table)
        sunk = self.targets(4, shift=(0.0, 0.0, -heights.min().item() - 0.05))
        for options, low, high, worst in (
            ({"collision_weight": 0.0}, -0.055, -0.045, "table collision"),
            ({}, -0.006, 1.0, "wrist position"),
        ):
            _, measures, reasons = self.track(sunk, **options)
            self.assertTrue(low < measures.table_clearance.min() < high)
            self.assertEqual(max(reasons, key=REASONS.index), worst)


class ValidityTest(TestCase):
    def test_every_reason_can_be_reached_and_the_first_counts(self):
        good = {
            "annotated": True,
            "at_limit": False,
            "hand_error": 0.0299,
            "wrist_position": 0.0099,
            "wrist_orientation": 0.0872,
            "arm_jump": 0.349,
            "table_clearance": -0.0029,
            "self_clearance": -0.0029,
        }

        def reason(changes):
            measures = {name: tensor([value]) for name, value in (good | changes).items()}
            return REASONS[int(classify(Measures(**measures), Thresholds()))]

        self.assertEqual(reason({}), "valid")
        self.assertEqual(reason({"hand_error": 0.0301}), "hand error")
        self.assertEqual(reason({"at_limit": True}), "valid")  # a limit alone does no harm
        everything = {}
        for name, changed, value in (
            ("self collision", "self_clearance", -0.0031),
            ("table collision", "table_clearance", -0.0031),
            ("arm jump", "arm_jump", 0.351),
            ("wrist orientation", "wrist_orientation", 0.0874),
            ("wrist position", "wrist_position", 0.0101),
            ("joint limit", "at_limit", True),
            ("hand error", "hand_error", float("nan")),
            ("not annotated", "annotated", False),
        ):
            everything[changed] = value
            # a limit matters where the wrist is off
            alone = {"wrist_position": 0.02 if changed == "at_limit" else 0.001} | {changed: value}
            self.assertEqual((reason(alone), reason(everything)), (name, name))

    def test_a_valid_frame_deep_in_the_object_is_not_valid(self):
        depth = np.array([0.0, 0.0019, 0.0021, np.inf, 0.0021])
        arm_jump = REASONS.index("arm jump")
        found = too_deep(np.array([0, 0, 0, 0, arm_jump]), depth, Thresholds())
        collision = "object collision"
        expected = ["valid", "valid", collision, collision, "arm jump"]
        self.assertEqual([REASONS[i] for i in found], expected)


class PipelineTest(InOneFolder):
    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        cls.robot = robots.load("ur7e-sharpa")
        demos = upright("soup", 2, seed=0, fps=20)
        valid = demos.hand_valid.copy()
        valid[demos.frames(1)] = False  # a sequence in which the hand was never seen
        valid[0] = False
        keypoints = np.where(valid[:, None, None], demos.hand_keypoints, np.nan)
        cls.demos = replace(demos, hand_valid=valid, hand_keypoints=keypoints)
        cls.objects = list(demo_objects(demos).values())
        cls.config = RetargetConfig(arm=ArmSearch(restarts=12, branches=2))
        cls.ticks = []
        cls.result = retarget_demos(
            cls.demos, cls.robot, cls.objects, cls.config, progress=lambda *at: cls.ticks.append(at)
        )
        cls.first, cls.second = (demos.frames(i) for i in range(2))

    def write(self, name, result):
        write_retargeted(self.folder / name, result)
        return self.folder / name

    def commanded(self, name, robot, *options):
        """What the command prints that retargets demonstrations."""
        out = self.folder / f"{name}-robot.npz"
        with retargets_quickly():
            demos = f"{self.folder}/{name}.npz"
            return succeeds("retarget", demos, "--robot", robot, "--out", out, *options)

    def test_most_frames_of_a_synthetic_demonstration_are_valid(self):
        seen = self.result.annotated[self.first]
        self.assertGreater(self.result.valid[self.first].sum() / seen.sum(), 0.8)
        self.assertLess(self.result.hand_error[self.first][seen].mean(), 0.015)
        self.assertEqual(self.ticks, [(0.5, 1), (1.0, 1)])
        first = self.result.first_contact[0]
        self.assertEqual(np.flatnonzero(self.result.contact[self.first])[0], first)
        self.assertGreater(first, 0)

    def test_a_wrong_recording_is_refused_unless_it_is_trusted(self):
        left = replace(self.demos.select(indices=[0]), hand_side=np.full(1, "left"))
        write_demos(f"{self.folder}/left.npz", left)
        out = self.folder / "left-robot.npz"
        words = "As a left hand its fingers bend"
        said = refused("retarget", f"{self.folder}/left.npz", "--out", out, "--robot ur7e-sharpa")
        self.assertIn(words, said)
        said = self.commanded("left", "ur7e-sharpa", "--trust-recordings")
        self.assertIn(words, said)
        self.assertIn("1 of 1 sequences are of left hands, but the robot's hand is a right", said)
        self.assertIn("select --side right; --mirror makes right hands of the others", said)
        self.assertRegex(said, r"frames +. +kept +. +rejected[\s\S]*xreset view shows why")
        self.assertIn(words, stated_doubts(out)[0])

    def test_the_file_says_what_the_robot_does(self):
        result = self.result
        kinematics = Kinematics(self.robot)
        q = torch.as_tensor(result.joint_pos)
        links = kinematics.link_poses(q, self.robot.tracked_links).numpy()
        assert_allclose(result.palm_pos, links[:, 0, :3, 3], atol=1e-12)
        assert_allclose(result.fingertip_pos, links[:, 1:, :3, 3], atol=1e-12)
        assert_allclose(
            quat_to_matrix(torch.as_tensor(result.palm_quat_wxyz)), links[:, 0, :3, :3], atol=1e-9
        )
        self.assertTrue(((q >= kinematics.lower - 1e-12) & (q <= kinematics.upper + 1e-12)).all())
        seen = result.annotated & result.valid
        tips = [KEYPOINTS.index(tip.keypoint) for tip in self.robot.fingertips]
        human = rest_on_table(self.demos, self.objects).hand_keypoints[:, tips]
        gap = np.linalg.norm(result.fingertip_pos - human, axis=-1).mean(axis=1)
        # they differ by the wrist's error, most often 0.1 mm
        assert_allclose(gap[seen], result.hand_error[seen], atol=0.001)

    def test_the_file_says_how_deep_the_hand_is_and_how_far_from_its_contacts(self):
        result = self.result
        poses = (result.joint_pos, result.object_pos, result.object_quat_wxyz)
        object_name = result.object_name[result.sequence_of_frame]
        fingers = fingers_of(self.robot, self.objects, object_name, *poses)
        deepest_finger = -fingers.gap.amin(dim=1).numpy()
        seen = result.annotated
        assert_array_equal(np.isfinite(result.object_depth), seen)
        # the fingers' balls are inside their shapes, and their distances from a grid
        self.assertTrue((result.object_depth[seen] >= deepest_finger[seen] - 1e-3).all())
        self.assertLess(result.object_depth[seen].max(), 0.004)
        self.assertLessEqual(result.object_depth[result.valid].max(), 0.002)
        touching = np.isfinite(result.contact_error)
        self.assertTrue(result.contact[touching].all())
        self.assertGreater(touching.sum(), 10)
        mean = result.contact_error[touching].mean()
        self.assertTrue(
            0.001 < mean < 0.010, mean
        )  # retargeting allows 1 cm between a link's origin and the point

    def test_a_sequence_without_a_hand_stays_at_home(self):
        joints = self.result.joint_pos[self.second]
        assert_array_equal(joints, np.tile(self.robot.home, (len(joints), 1)))
        self.assertEqual({REASONS[r] for r in self.result.reason[self.second]}, {"not annotated"})
        self.assertEqual(self.result.first_contact[1], -1)
        assert_array_equal(np.isinf(self.result.hand_error), ~self.result.annotated)
        assert_array_equal(self.result.goal_pos[1], self.result.object_pos[-1])

    def test_without_any_hand_every_sequence_stays_at_home(self):
        no_hand = self.demos.select(indices=[1])
        found = retarget_demos(no_hand, self.robot, self.objects, self.config)
        assert_array_equal(found.joint_pos, self.result.joint_pos[self.second])
        assert_array_equal(found.reason, self.result.reason[self.second])

    def test_a_file_comes_back_and_the_same_inputs_give_the_same_file(self):
        """With any number of threads, of which the hand uses one."""
        file = self.write("a.npz", self.result)
        self.addCleanup(torch.set_num_threads, torch.get_num_threads())
        torch.set_num_threads(2)
        threads = set()

        def counted(*parts):
            threads.add(torch.get_num_threads())
            return system(*parts)

        with patch("xreset.retarget.hand.solve.system", counted):
            again = retarget_demos(self.demos, self.robot, self.objects, self.config)
        self.assertEqual((threads, torch.get_num_threads()), ({1}, 2))
        self.assertEqual(self.write("b.npz", again).read_bytes(), file.read_bytes())
        back = read_retargeted(file)
        for name, value in vars(self.result).items():
            assert_array_equal(getattr(back, name), value, name)

    def test_a_file_that_contradicts_itself_is_refused(self):
        for changes, message in (
            ({"valid": ~self.result.valid}, "contradict"),
            ({"joint_pos": np.full_like(self.result.joint_pos, np.nan)}, "non-finite"),
            ({"reason": self.result.reason + 100}, "points beyond"),
            ({"frame_offsets": self.result.frame_offsets[::-1].copy()}, "frame_offsets"),
            ({"first_contact": np.array([10_000, -1])}, "first_contact"),
            ({"first_contact": np.array([0, -2])}, "first_contact"),
            ({"wrist_error": -self.result.wrist_error}, "negative or NaN"),
            ({"object_depth": np.nan * self.result.object_depth}, "negative or NaN"),
        ):
            path = self.folder / "d.npz"
            damaged = replace(self.result, **changes)
            write_npz(path, SCHEMA, arrays_of(Retargeted, damaged))
            with refuses(self, message, FileFormatError):
                read_retargeted(path)
            path.unlink()
            with self.assertRaisesRegex(XResetError, f"was not written, .*{message}"):
                self.write("d.npz", damaged)
            self.assertFalse(path.exists())

    def test_an_object_that_was_not_given_is_named(self):
        with self.assertRaisesRegex(DemoError, "005_tomato_soup_can"):
            retarget_demos(self.demos, self.robot, [])

    def test_the_command_writes_a_file_for_a_gripper(self):
        write_demos(f"{self.folder}/demos.npz", self.demos.select(indices=[0]))
        said = self.commanded("demos", "openarm")
        self.assertIn("005_toma", said)
        self.assertRegex(said, r"fingertips are [\d.]+ mm .* touch; in frames .* over 2 mm\)")
        with np.load(f"{self.folder}/demos-robot.npz") as file:
            used = json.loads(str(file["meta"]))["config"]["retarget"]
        self.assertEqual(used["arm"]["restarts"], 8)
        self.assertEqual(read_retargeted(f"{self.folder}/demos-robot.npz").robot, "openarm")


class RealDataTest(TestCase):
    def test_fingertips_follow_a_real_hand(self):
        demos = read_demos(data_dir() / "dexycb_right_9x20.npz")
        demos = demos.select(objects=["soup"], per_object=1)
        objects = [*demo_objects(demos).values()]
        result = retarget_demos(demos, robots.load("ur7e-sharpa"), objects)
        self.assertLess(result.hand_error[result.annotated].mean(), 0.010)
        self.assertGreater(result.valid.sum() / result.annotated.sum(), 0.9)
