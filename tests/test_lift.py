"""States in which a hand lifts an object: grasps of later frames, carried back to where the object starts."""

import json
from dataclasses import replace
from importlib.util import find_spec
from unittest import TestCase, skipUnless
from unittest.mock import patch

import numpy as np
import torch
from numpy.testing import assert_allclose, assert_array_equal

from tests import toy_grasp
from tests.toy_bank import toy_bank, toy_retargeted
from xreset import LiftConfig, SqueezeConfig, make_bank
from xreset.geometry.collision import table_clearance
from xreset.geometry.kinematics import Kinematics
from xreset.resets.lift import grasp_frames, lift_states
from xreset.retarget.file import write_retargeted
from xreset.spec import TableSpec

ROBOT = toy_grasp.robot()
BRICK = (toy_grasp.brick(),)
JAW, LIFT = ROBOT.joint_names.index("jaw_a_slide"), ROBOT.joint_names.index("lift")
HEIGHTS = np.array([0, 0, 0.04, 0.05, 0.06, 0.07])
"""Heights of the brick in the frames of a demonstration [m]."""


def lifted(jaws=toy_grasp.OPEN, **changes):
    """A gripper comes to a brick with its jaws apart, closes them to 0.1 mm from it, and lifts it."""
    joints = np.tile(ROBOT.home, (len(HEIGHTS), 1))
    joints[0, JAW] += 0.03
    joints[1:, JAW] = jaws
    joints[:, LIFT] += HEIGHTS
    pos, quat = toy_grasp.brick_pose()
    links = [tip.link for tip in ROBOT.fingertips]
    values = {
        "joint_pos": joints,
        "fingertip_pos": Kinematics(ROBOT).points(torch.as_tensor(joints), links).numpy(),
        "object_pos": pos + HEIGHTS[:, None] * [0, 0, 1],
        "object_quat_wxyz": np.tile(quat, (len(HEIGHTS), 1)),
        "first_contact": np.array([1]),
    }
    return toy_retargeted(ROBOT, ["brick"], [0, len(HEIGHTS)], **(values | changes))


class LiftTest(TestCase):
    def carried(self, motion, robot=ROBOT, *, shift=0.0, heights=(0.0, 0.01), grasps=8):
        """The lift states of a motion whose object rests higher by ``shift`` than where it starts."""
        start_pos, start_quat = motion.start_pose
        frames = grasp_frames(motion, robot, BRICK)
        config = LiftConfig(grasps=grasps, heights=heights)
        start_pos = start_pos + np.array([0, 0, shift])
        return lift_states(motion, robot, BRICK, frames, start_pos, start_quat, config)

    def test_grasps_are_frames_in_the_air_with_thumb_and_finger_at_the_object(self):
        motion = lifted()
        self.assertEqual(grasp_frames(motion, ROBOT, BRICK).tolist(), [2, 3, 4, 5])
        valid = np.array([True] * 5 + [False])
        lost = replace(motion, valid=valid, reason=(~valid).astype(int))
        self.assertEqual(grasp_frames(lost, ROBOT, BRICK).tolist(), [2, 3, 4])
        far = lifted(toy_grasp.OPEN + 0.02)
        self.assertEqual(grasp_frames(far, ROBOT, BRICK).tolist(), [])

    def test_the_hand_comes_along(self):
        sequence, (joints, pos, quat) = self.carried(lifted())
        self.assertEqual(sequence.tolist(), [0] * 8)
        start, turned = toy_grasp.brick_pose()
        above = np.repeat([0.0, 0.01], 4)
        assert_allclose(pos, start + above[:, None] * [0, 0, 1], atol=1e-12)
        assert_allclose(quat, np.tile(turned, (8, 1)), atol=1e-12)
        expected = np.tile(ROBOT.home, (8, 1))
        expected[:, JAW] = toy_grasp.OPEN
        expected[:, LIFT] += above
        assert_allclose(joints, expected, atol=1e-3)

    def test_a_hand_gives_way_to_the_table_as_far_as_it_still_grasps(self):
        """The robot is mounted so low that the jaws are 1 cm above the table at home."""
        x, y, z = ROBOT.base_pos
        low = replace(ROBOT, base_pos=(x, y, z - 0.24))
        motion = lifted()
        motion = replace(motion, object_pos=motion.object_pos - [0, 0, 0.24])
        sequence, (joints, *_) = self.carried(motion, low, shift=-0.02, heights=(0.0,))
        self.assertEqual(sequence.tolist(), [0] * 4)
        clearance = table_clearance(Kinematics(low), torch.as_tensor(joints), TableSpec())
        assert_allclose(clearance, 0.0, atol=2e-3)
        self.assertEqual(len(self.carried(motion, low, shift=-0.06, heights=(0.0,))[0]), 0)

    def test_a_motion_without_a_grasp_has_none(self):
        sequence, (joints, pos, quat) = self.carried(lifted(toy_grasp.OPEN + 0.02))
        self.assertEqual((len(sequence), len(joints), len(pos), len(quat)), (0, 0, 0, 0))

    def test_grasps_of_other_demonstrations_of_the_object_are_borrowed(self):
        """The second demonstration starts 2 cm higher and its jaws never close."""
        closed, apart = lifted(), lifted(toy_grasp.OPEN + 0.02)
        names = ("joint_pos", "fingertip_pos", "object_pos", "object_quat_wxyz")
        both = {
            name: np.concatenate((getattr(closed, name), getattr(apart, name))) for name in names
        }
        both["object_pos"][len(HEIGHTS) :, 2] += 0.02
        count = len(HEIGHTS)
        contact = {"first_contact": np.array([1, 1])}
        two = toy_retargeted(ROBOT, ["brick", "brick"], [0, count, 2 * count], **(both | contact))
        sequence, (joints, pos, _) = self.carried(two, heights=(0.0,), grasps=3)
        self.assertEqual(sequence.tolist(), [0] * 3 + [1] * 3)
        assert_allclose(joints[:, JAW], toy_grasp.OPEN)
        assert_allclose(joints[3:, LIFT] - joints[:3, LIFT], 0.02, atol=1e-3)
        assert_allclose(pos[3:, 2] - pos[:3, 2], 0.02)


@skipUnless(find_spec("mujoco"), "MuJoCo is not installed")
class BankTest(toy_grasp.ResetsTest):
    def setUp(self):
        super().setUp()
        write_retargeted(self.motion, lifted())

    def test_a_bank_marks_them_and_does_not_count_them_as_frames(self):
        def held(_scene, _names, pos, quat, *_, **__):
            """The brick stays in the air, where the gripper can reach it."""
            return pos, quat, np.ones(len(pos), dtype=bool)

        self.enterContext(patch("xreset.resets.filter.settled_poses", held))
        weak = make_bank(lifted(), ROBOT, BRICK, lift=LiftConfig(grasps=2))
        self.assertIsNone(weak.lifting, "without squeezing no grasp carries the brick")
        options = ("--lift.grasps", "2", "--lift.heights", "0", "0.02", "--squeeze.force", "2.5")
        bank, told = self.resets(*options)
        assert bank.lifting is not None
        self.assertEqual(bank.frame_index.tolist(), [0] * 5 + [1, 2, 3, 4, 5])
        self.assertEqual(np.flatnonzero(bank.lifting).tolist(), [1, 2, 3, 4])
        self.assertTrue(bank.post_contact[bank.lifting].all())
        self.assertEqual(bank.num_pressing, 9, "all but the first frame")
        self.assertEqual(bank.accounts()[-1].total, 6)
        for words in (
            "10 states of 10 kept",
            "4 lift states were added, from 1 of 1 demonstrations",
        ):
            self.assertIn(words, told)
        height = bank.object_pos[bank.lifting][:, 2] - bank.start_pos[0, 2]
        assert_allclose(height, [0, 0, 0.02, 0.02], atol=1e-3)
        assert_array_equal(bank.with_states(bank.lifting).lifting, True)
        _, told = self.resets("--lift.grasps", "2")
        for words in ("0 lift states were added", "add --squeeze.force 5"):
            self.assertIn(words, told)

    def test_the_file_states_the_options(self):
        self.resets("--lift.grasps", "2", "--lift.heights", "0", "0.02")
        with np.load(self.bank) as file:
            config = json.loads(str(file["meta"]))["config"]
        self.assertEqual(config["lift"], {"grasps": 2, "heights": [0.0, 0.02]})

    def test_without_them_a_bank_is_as_before(self):
        squeeze = SqueezeConfig(force=2.5)
        plain = make_bank(lifted(), ROBOT, BRICK, squeeze=squeeze)
        off = make_bank(lifted(), ROBOT, BRICK, lift=LiftConfig(), squeeze=squeeze)
        self.assertIsNone(plain.lifting)
        for name, value in vars(plain).items():
            assert_array_equal(getattr(off, name), value, name)
        lift = LiftConfig(grasps=2)
        apart = make_bank(lifted(toy_grasp.OPEN + 0.02), ROBOT, BRICK, lift=lift, squeeze=squeeze)
        self.assertIsNone(apart.lifting, "no frame has a grasp")
        self.assertIsNone(toy_bank(ROBOT).lifting)

    def test_bad_heights_are_refused(self):
        words = "heights is .2.0,., expected one height or more, from 0 to 1 m"
        with self.assertRaisesRegex(ValueError, words):
            LiftConfig(heights=(2.0,))
        self.assertRaisesRegex(ValueError, "heights is", LiftConfig, heights=())
