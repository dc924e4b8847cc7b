"""Jaws: their pads, which are drawn to the faces of the object that the human holds, and their way out of objects."""

import copy
import dataclasses
import math
from unittest import TestCase
from unittest.mock import patch

import numpy as np
import torch
from numpy.testing import assert_allclose, assert_array_equal
from torch.testing import assert_close

from tests.toy_retarget import FLOAT, box_object, check_gradient, double, hand_targets
from xreset import robots, synthesize
from xreset.demos.archive import demo_objects, rest_on_table
from xreset.geometry.collision import ObjectCollision, object_depth
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.rotations import matvec, quat_from_axis_angle, quat_rotate
from xreset.geometry.surface import Surface
from xreset.retarget.arm.config import ArmSearch
from xreset.retarget.arm.model import ArmModel
from xreset.retarget.arm.solve import track_each
from xreset.retarget.hand.config import HandWeights
from xreset.retarget.hand.cost import system
from xreset.retarget.hand.model import HandModel, HandState
from xreset.retarget.hand.solve import retarget_hand
from xreset.retarget.pipeline import HandMotions, RetargetConfig
from xreset.retarget.push import pushed_out
from xreset.retarget.validity import REASONS, Thresholds
from xreset.retarget.verbs import retarget_demos
from xreset.spec import KEYPOINTS

UP = double([0.0, 0.0, 1.0])
DEEP = REASONS.index("object collision")


class PadsTest(TestCase):
    """The OpenArm's jaw around a box 5 cm thick, far above the table. It opens along its root's y axis, reaches along
    z."""

    @classmethod
    def setUpClass(cls):
        cls.model = HandModel(robots.load("openarm"))
        cls.box = Surface(box_object(((0, 0, 0), (0.05, 0.05, 0.1))))

    def aslant(self, angle, *, held=True, frames=6):
        """A jaw turned by an angle [rad] about its axis of approach, its pads 2 mm from the box's edges, and its
        keypoints."""
        turn = quat_from_axis_angle(angle * UP).expand(1, frames, 4)
        half = 0.025 * (math.cos(angle) + math.sin(angle)) + 0.002
        # Each pad of the closed jaw is 0.5 mm from its middle.
        joints = torch.full((1, frames, 1), half - 0.0005, dtype=FLOAT)
        state = HandState(joints, torch.zeros(1, frames, 3, dtype=FLOAT), turn)
        middle = self.model.keypoints(state)[:, :, 1:].mean(dim=2)
        state = dataclasses.replace(state, root_pos=UP - middle)
        keypoints = self.model.keypoints(state)
        flags = torch.full((1, frames), held)
        return state, hand_targets(
            keypoints, self.box.field, held=flags, object_pos=UP.expand(1, frames, 3)
        )

    def degrees_off(self, targets, config):
        """Largest angle between the jaw's axis and the box's face."""
        motion = retarget_hand(self.model, targets, config)
        axis = quat_rotate(motion.root_quat, double([0.0, 1.0, 0.0]).expand_as(motion.root_pos))
        return math.degrees(axis[..., 1].abs().clamp_max(1.0).acos().max().item())

    def test_pads_are_the_faces_that_meet(self):
        balls = self.model.balls
        for side, link in ((1.0, "right_finger"), (-1.0, "left_finger")):
            mine = balls.link[self.model.pad_balls] == balls.links.index(link)
            own = self.model.pad_balls[mine]
            centers = balls.centers[own]
            self.assertLess((side * centers[:, 1] + balls.radii[own] - 0.0055).abs().max(), 1.1e-3)
            self.assertGreater(np.ptp(centers[:, 2].numpy()), 0.05)
            self.assertAlmostEqual(self.model.pad_shares[mine].sum().item(), 1.0)
        for name in ("ur7e-sharpa", "xarm7-leap"):
            self.assertEqual(len(HandModel(robots.load(name)).pad_balls), 0, name)

    def test_a_jaw_that_holds_is_turned_to_the_faces(self):
        _, targets = self.aslant(math.radians(20))
        self.assertLess(self.degrees_off(targets, HandWeights()), 5.0)
        self.assertGreater(self.degrees_off(targets, HandWeights(pad_weight=0.0)), 15.0)
        _, free = self.aslant(math.radians(20), held=False)
        self.assertGreater(self.degrees_off(free, HandWeights()), 15.0)

    def test_gradient_is_the_derivative_of_the_cost(self):
        state, targets = self.aslant(math.radians(17), frames=2)
        config = HandWeights(clearance_weight=0.0)
        without = dataclasses.replace(config, pad_weight=0.0)
        cost, free = (
            system(self.model, targets, each, state).cost.item() for each in (config, without)
        )
        self.assertGreater(cost - free, 1e-3)
        check_gradient(self.model, targets, config, state, frames=(1,))

    def test_an_object_is_held_between_the_human_s_thumb_and_a_finger(self):
        demos = synthesize(["spam", "soup"], per_object=1, seed=1)
        objects = list(demo_objects(demos).values())
        config = HandWeights(clearance_weight=0.0, iterations=0)
        hands = HandMotions(demos, self.model.robot, objects, RetargetConfig(hand=config))
        [batch] = hands.batches()
        self.assertFalse(batch.targets.held[0, 0])
        self.assertTrue(batch.targets.held[0, -1])
        names = [hands.objects[index].name for index in batch.targets.object_index]
        self.assertEqual(names, demos.object_name.tolist())
        hands.touching[:] = False
        touched = (["wrist", "thumb4"], ["wrist", "index4", "little1"], ["thumb1", "little4"])
        for frame, names in enumerate(touched):
            hands.touching[frame, [KEYPOINTS.index(name) for name in names]] = True
        [batch] = hands.batches()
        self.assertEqual(batch.targets.held[0, :4].tolist(), [False, False, True, False])
        touching = hands.touching[:4, hands.model.keypoint_indices]
        assert_array_equal(batch.targets.in_contact[0, :4], touching)
        assert_array_equal(batch.targets.object_pos[0, :4], hands.demos.object_pos[:4])


class PushTest(TestCase):
    """The OpenArm, whose jaw is around objects."""

    robot = robots.load("openarm")
    kinematics = Kinematics(robot)

    def plates(self, depths):
        """States at home, and the pose of a plate 2 mm thick and 8 cm high, whose edge is in the palm between the balls
        that fill it."""
        joints = torch.as_tensor(self.robot.home).repeat(len(depths), 1)
        palm = self.kinematics.link_poses(joints, ["gripper_body"])[:, 0]
        # the palm's box ends 2 cm from its middle
        edge = double([[0.0, 0.004, 0.02 + 0.04 - depth] for depth in depths])
        rot = palm[:, :3, :3]
        index = torch.zeros(len(depths), dtype=torch.long)
        return joints, index, palm[:, :3, 3] + matvec(rot, edge), rot

    def test_a_state_that_is_too_deep_is_pushed_out_and_no_other(self):
        plate = box_object(((0, 0, 0), (0.1, 0.002, 0.08)))
        joints, *placed = self.plates((0.0015, 0.004, 0.03))
        collision = ObjectCollision(self.kinematics, [plate])
        found, depth = pushed_out(self.kinematics, collision, joints, *placed, 0.002)
        assert_close(depth, double([0.0015, 0.001, math.inf]), atol=1e-4, rtol=0)
        poses = self.kinematics.link_poses(found, collision.links)
        exact = collision.overlaps(poses, *placed).deepest(3)
        assert_close(exact[:2], depth[:2])
        self.assertGreater(exact[2], 0.02)
        for state in (0, 2):
            assert_close(found[state], joints[state], atol=0, rtol=0)
        tips = [tip.link for tip in self.robot.fingertips]
        ways = [self.kinematics.points(q, tips) for q in (joints[1], found[1])]
        way = (ways[1] - ways[0]).norm(dim=-1)
        self.assertTrue((way < 0.005).all(), way)
        limited = copy.copy(self.kinematics)
        limited.upper = limited.upper.clone()
        limited.upper[0] = joints[1, 0] + 0.01
        self.assertGreater(found[1, 0], limited.upper[0])
        found, depth = pushed_out(limited, collision, joints, *placed, 0.002)
        self.assertLessEqual(found[1, 0], limited.upper[0])
        self.assertLess(depth[1], 0.002)

    def motion(self, demos, objects, push):
        """The motion that follows demonstrations, with a way of pushing in place of :func:`pushed_out`."""
        config = RetargetConfig(
            hand=HandWeights(object_clearance=-0.006, tolerance=0.1),
            arm=ArmSearch(restarts=8, branches=1),
        )
        with patch("xreset.retarget.pipeline.pushed_out", push):
            return retarget_demos(demos, self.robot, objects, config)

    def test_frames_that_fail_by_depth_alone_are_pushed_out(self):
        demos = synthesize(["soup"], per_object=2, seed=1)
        objects = list(demo_objects(demos).values())
        before = self.motion(demos, objects, lambda *x: (x[2], torch.full(x[3].shape, math.inf)))
        after = self.motion(demos, objects, pushed_out)
        path = self.check_that_pushes_are_judged(demos, objects, before)
        self.check_measures(after, path.root_pos, objects)
        deep = before.reason == DEEP
        self.assertGreater(deep.sum(), 10)
        self.assertGreater(after.valid[deep].sum(), 0.8 * deep.sum())
        self.assertTrue(after.valid[before.valid].all())
        self.assertEqual(set(after.reason[deep & ~after.valid].tolist()), {DEEP})
        moved = (after.joint_pos != before.joint_pos).any(axis=1)
        assert_array_equal(moved, deep & after.valid)
        self.assertLessEqual(after.object_depth[after.valid].max(), 0.002)
        tips = [KEYPOINTS.index(tip.keypoint) for tip in self.robot.fingertips]
        human = rest_on_table(demos, objects).hand_keypoints[:, tips]
        gap = np.linalg.norm(after.fingertip_pos - human, axis=-1).mean(axis=1)
        assert_allclose(after.hand_error[moved], gap[moved], atol=1e-9)
        self.assertTrue((after.hand_error[moved] != before.hand_error[moved]).all())

    def check_measures(self, motion, root_pos, objects):
        """Errors of the wrist, depths and first contacts are those of the motion; targets of the wrist are
        [S, T, 3]."""
        seen = motion.annotated
        root = self.kinematics.points(torch.as_tensor(motion.joint_pos), [self.robot.hand_root])
        lengths = np.diff(motion.frame_offsets)
        targets = np.vstack([own[:count] for own, count in zip(root_pos, lengths, strict=True)])
        off = np.linalg.norm(root[:, 0].numpy() - targets, axis=1)
        assert_allclose(motion.wrist_error, np.where(seen, off, np.inf), atol=1e-9)
        names = motion.object_name[motion.sequence_of_frame]
        poses = (motion.joint_pos, motion.object_pos, motion.object_quat_wxyz)
        depth = object_depth(self.robot, objects, names, *poses)
        assert_allclose(motion.object_depth[seen], depth[seen], atol=1e-9)
        for number, first in enumerate(motion.first_contact):
            self.assertEqual(np.flatnonzero(motion.contact[motion.frames(number)])[0], first)

    def check_that_pushes_are_judged(self, demos, objects, before):
        """A push changes nothing if it moves the wrist too far, or the hand meets itself. Jumps count within a sequence
        alone. Return the arm's path."""
        arm = self.robot.arm_indices[0]
        hand = self.robot.hand_indices[0]

        def moved(_kinematics, _collision, joints, *_):
            joints = joints.clone()
            joints[::2, arm] += 0.5
            joints[1::2, hand] = 0.05
            return joints, torch.zeros(len(joints), dtype=FLOAT)

        def clearance(_, joints):
            return -1e-3 * joints[..., 0] - (joints[..., 0] > 0.045).double()

        with (
            patch("xreset.retarget.pipeline.track_each", wraps=track_each) as tracked,
            patch.object(ArmModel, "hand_clearance", clearance),
        ):
            refused = self.motion(demos, objects, moved)
        assert_array_equal(refused.joint_pos, before.joint_pos)
        [path] = tracked.call_args.args[1]
        assert_close(path.hand_clearance, -1e-3 * path.hand_joints[..., 0])
        limits = dict.fromkeys(
            ("hand_error", "wrist_position", "wrist_orientation", "table_depth", "self_depth"), 9.0
        )
        with patch("xreset.retarget.pipeline._THRESHOLDS", Thresholds(**limits)):
            after = self.motion(demos, objects, moved)
        jumps = np.zeros(len(after.joint_pos), dtype=bool)
        change = np.abs(np.diff(after.joint_pos[:, self.robot.arm_indices], axis=0))
        jumps[1:] = change.max(axis=1) > 0.35
        jumps[after.frame_offsets[:-1]] = False
        reason = REASONS.index("arm jump")
        fine = np.isin(after.reason, (0, reason))
        assert_array_equal((after.reason == reason)[fine], jumps[fine])
        self.assertGreater(jumps[before.valid].sum(), 1)
        self.assertTrue(fine[after.frame_offsets[:-1]].all())
        return path
