"""Reset banks beyond the paper's filter: states between frames where a hand closes in, targets that press, grasps that hold."""

import json
from dataclasses import replace
from unittest import TestCase
from unittest.mock import patch

import numpy as np
import torch
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation, Slerp
from torch import tensor
from torch.testing import assert_close

from tests import toy_grasp
from tests.command import succeeds
from tests.data import InFolder
from tests.engine_checks import with_drive
from tests.toy_bank import in_this_process, shifted, toy_bank, toy_retargeted
from tests.toy_robot import toy_robot
from xreset import ClosingConfig, SqueezeConfig, read_bank
from xreset.backends.conformance.scene import objects
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.shapes import quat_of, turn_of
from xreset.geometry.surface import prepared_surface
from xreset.resets.closing import closing_states, positions_between, rotations_between
from xreset.resets.distribution import bank_starts
from xreset.resets.fingers import Fingers, _balance, fingers_of, grip_forces, squeeze_targets
from xreset.retarget.file import write_retargeted

ROBOT = toy_grasp.robot()
JAW = ROBOT.joint_names.index("jaw_a_slide")
LIFT = ROBOT.joint_names.index("lift")
WIDE = toy_grasp.OPEN + 0.03
"""A jaw position 30.1 mm from the brick."""


def grasp_and_lift():
    """Three frames of gripper and brick: jaws 30.1 mm from it; 0.1 mm from it; and that 4 cm higher."""
    joints = np.tile(ROBOT.home, (3, 1))
    joints[:, JAW] = WIDE, toy_grasp.OPEN, toy_grasp.OPEN
    joints[2, LIFT] += toy_grasp.RAISED
    pos, quat = toy_grasp.brick_pose()
    links = [tip.link for tip in ROBOT.fingertips]
    return toy_retargeted(
        ROBOT,
        ["brick"],
        [0, 3],
        joint_pos=joints,
        fingertip_pos=Kinematics(ROBOT).points(torch.as_tensor(joints), links).numpy(),
        object_pos=pos + np.array([[0, 0, 0], [0, 0, 0], [0, 0, toy_grasp.RAISED]]),
        object_quat_wxyz=np.tile(quat, (3, 1)),
        first_contact=np.array([1]),
    )


def toy_fingers(states, links, **changes):
    """Fingers of one link each that touch the object; ``changes`` replace fields."""
    none = torch.zeros(states, links, 3)
    values = dict.fromkeys(("point", "inward", "lever"), none) | {
        "links": tuple("abcde"[:links]),
        "finger": torch.arange(links),
        "gap": none[..., 0],
        "weight": torch.ones(states),
    }
    return Fingers(**(values | changes))


class ClosingTest(TestCase):
    """Two demonstrations of five frames in which the first finger moves by 12 mm a frame and the second by 4. The brick
    turns about its center of mass, which is 0.5 m from the origin of its mesh."""

    def setUp(self):
        joints = ROBOT.home + 0.01 * np.random.default_rng(0).normal(size=(10, len(ROBOT.joints)))
        tips = np.arange(10)[:, None, None] * [[0.012, 0, 0], [0, 0.004, 0]]
        turned = quat_of(Rotation.from_rotvec(0.2 * np.arange(10)[:, None] * [0, 0, 1]))
        changes = {"joint_pos": joints, "fingertip_pos": tips, "object_quat_wxyz": turned}
        places = np.repeat([[0.5, 0.3, 0.1], [0.6, 0.2, 0.1]], 5, axis=0)
        changes["object_pos"] = places - turn_of(turned).apply([0.5, 0, 0])
        self.data = toy_retargeted(ROBOT, ["brick", "brick"], [0, 5, 10], **changes)
        self.gap = np.full((10, 2), 0.03)

    def states(self, data=None, **config):
        fingers = toy_fingers(10, 2, gap=torch.as_tensor(self.gap))
        config = ClosingConfig(**({"spacing": 0.005} | config))
        brick = toy_grasp.brick()
        moved = shifted(brick, [0.5, 0, 0] - brick.com)
        with patch("xreset.resets.closing.fingers_of", lambda *_: fingers):
            return closing_states(data or self.data, ROBOT, (moved,), config)[:2]

    def bridged(self, data=None, **config):
        """Frames that states between follow."""
        frame, part = self.states(data, **config)
        return sorted(set(frame[part > 0].tolist()))

    def test_a_spacing_without_sense_is_refused(self):
        with self.assertRaisesRegex(ValueError, "spacing is 1e-300, expected a number from 1e-5"):
            ClosingConfig(spacing=1e-300)

    def test_fingertips_move_by_no_more_than_the_spacing(self):
        frame, part = self.states()
        self.assertEqual(len(frame), 26, "12 mm are three steps of 4 mm")
        self.assertEqual(frame[:8].tolist(), [0, 0, 0, 1, 1, 1, 2, 2])
        assert_allclose(part[:5], [0, 1 / 3, 2 / 3, 0, 1 / 3])
        self.assertEqual(frame[part == 0].tolist(), list(range(10)))
        still = replace(self.data, fingertip_pos=np.zeros((10, 2, 3)))
        self.assertEqual(self.states(still)[0].tolist(), list(range(10)))

    def test_between_two_frames_positions_are_straight_and_rotations_even(self):
        frame, part = self.states()
        old = self.data.joint_pos
        found = positions_between(old, frame, part)
        following = old[np.minimum(frame + 1, 9)]
        assert_allclose(found, old[frame] + part[:, None] * (following - old[frame]), atol=1e-12)
        self.assertEqual(found[part == 0].tobytes(), old.tobytes())
        quat = rotations_between(self.data.object_quat_wxyz, frame, part)
        self.assertEqual(quat[part == 0].tobytes(), self.data.object_quat_wxyz.tobytes())
        turns = Rotation.random(10, np.random.default_rng(1))
        between = turn_of(rotations_between(quat_of(turns), frame, part))
        expected = Slerp(np.arange(10), turns)(frame + part)
        assert_allclose((between.inv() * expected).magnitude(), 0.0, atol=1e-7)

    def test_sequences_are_not_mixed_and_nothing_invalid_is_bridged(self):
        valid = np.ones(10, dtype=bool)
        valid[[2, 7]] = False
        invalid = replace(self.data, valid=valid, reason=(~valid).astype(int))
        # not 1 and 6 to an invalid frame, 2 and 7 from it, 4 to 5
        self.assertEqual(self.bridged(invalid), [0, 3, 5, 8])

    def test_only_near_the_object(self):
        self.gap[:, :] = np.array([0.3, 0.12, 0.09, 0.2, 0.2] * 2)[:, None]
        self.assertEqual(self.bridged(), [1, 2, 6, 7])
        with patch("xreset.resets.closing.WITHIN", 0.15):
            self.assertEqual(self.bridged(), [0, 1, 2, 5, 6, 7])
        self.gap[:, 0] = 0.3
        self.assertEqual(self.bridged(), [1, 2, 6, 7], "where any finger is near")

    def test_only_until_thumb_and_finger_touch_or_the_object_is_moved(self):
        self.gap[:] = 0.0021
        self.assertEqual(self.bridged(), [0, 1, 2, 3, 5, 6, 7, 8], "near is no touch")
        self.gap[:, 0] = 0.001
        self.assertEqual(self.bridged(), [0, 1, 2, 3, 5, 6, 7, 8], "a thumb alone")
        self.gap[:, 0] = 0.0021
        self.gap[1:, 1] = 0.001  # a finger alone
        self.gap[2, 0] = 0.001
        self.gap[8, 0] = 0.001
        self.assertEqual(self.bridged(), [0, 1, 5, 6, 7], "also where the thumb lets go again")
        pos = self.data.object_pos.copy()
        pos[6, 0] += 0.0099
        self.assertEqual(self.bridged(replace(self.data, object_pos=pos)), [0, 1, 5, 6, 7])
        pos[6, 0] += 0.0002
        self.assertEqual(self.bridged(replace(self.data, object_pos=pos)), [0, 1, 5])
        self.gap[5] = 0.001  # the second sequence begins with a grasp
        self.assertEqual(self.bridged(), [0, 1])


class FingersTest(TestCase):
    """The gripper's jaws are flat, parallel to the brick's sides, and slide along their normal."""

    def fingers(self, *jaw):
        joints = np.tile(ROBOT.home, (len(jaw), 1))
        joints[:, JAW] = jaw
        pos, quat = (np.tile(value, (len(jaw), 1)) for value in toy_grasp.brick_pose())
        return fingers_of(
            ROBOT, (toy_grasp.brick(),), np.full(len(jaw), "brick"), joints, pos, quat
        ), joints

    def wrist_axis(self, joints):
        """[M, 3] direction of the wrist's x axis, along which the jaws slide."""
        return Kinematics(ROBOT).link_poses(torch.as_tensor(joints), ["wrist"])[:, 0, :3, 0]

    def test_gaps_and_directions(self):
        jaws = np.array([0.0201, 0.0251, 0.0501])
        fingers, joints = self.fingers(*jaws)
        self.assertEqual(
            (fingers.links, fingers.finger.tolist()), (("jaw_a", "pad_b", "finger_b"), [0, 1, 1])
        )
        assert_allclose(fingers.gap[:, 0], jaws - 0.02, atol=3e-4)
        assert_allclose(fingers.gap[:, 1], 1.1 * jaws - 0.002 - 0.02, atol=3e-4)
        assert_allclose(fingers.gap.amin(dim=-1), jaws - 0.02, atol=3e-4)
        self.assertEqual(
            fingers.leading.tolist(), [[True, True, False]] * 3, "finger_b has no shape of its own"
        )
        for within, rows in ((0.005, [True, False, False]), (0.010, [True, True, False])):
            pressing = fingers.pressing(within)
            self.assertEqual(pressing[:, 0].tolist(), rows)
            self.assertFalse(pressing[:, 2].any())
        wrist = self.wrist_axis(joints)
        assert_close(fingers.inward[:, 0], -wrist, atol=0.02, rtol=0)
        assert_close(fingers.inward[:, 1], wrist, atol=0.02, rtol=0)
        # the jaw's inner side
        assert_allclose(fingers.point[:, 0, 0], -0.005, atol=1e-3)

    def test_each_state_has_its_own_object(self):
        """The toy robot's fingers are balls of 1 cm."""
        robot = toy_robot()
        brick, can = objects()[:2]
        place = np.array([[0.3, 0.2, 0.4], [0.1, 0.1, 0.2]])
        turn = Rotation.from_rotvec([[0.4, -0.3, 0.2], [0.1, 0.9, 0.0]])
        joints = np.stack((robot.home, robot.home + 0.3))
        names = np.array(["can", "brick"])
        fingers = fingers_of(robot, (brick, can), names, joints, place, quat_of(turn))
        centers = Kinematics(robot).points(torch.as_tensor(joints), fingers.links)
        touching = centers + 0.01 * fingers.inward
        assert_close(fingers.weight, 9.81 * tensor([can.mass, brick.mass], dtype=torch.float64))
        for state, obj in enumerate((can, brick)):
            local = turn[state].inv().apply(centers[state].numpy() - place[state])
            distance = prepared_surface(obj).signed_distance(local)
            assert_allclose(fingers.gap[state], distance - 0.01, atol=1e-3)
            lever = touching[state].numpy() - place[state] - turn[state].apply(obj.com)
            assert_allclose(fingers.lever[state], lever, atol=1e-9)

    def test_a_grip_has_the_force_and_the_weight_of_the_object(self):
        fingers, _ = self.fingers(0.0201, 0.0261)
        weight = 9.81 * toy_grasp.brick().mass
        forces = grip_forces(fingers, 1.0)
        assert_allclose(forces.sum(dim=1), [2 * (1.0 + weight), 0.0], rtol=1e-3)
        assert_allclose(forces[0], [1.0 + weight, 1.0 + weight, 0.0], rtol=0.1)

    def test_two_fingertips_press_harder(self):
        self.assertEqual([SqueezeConfig().newtons(n) for n in (2, 3, 5)], [20.0, 5.0, 5.0])
        self.assertEqual(SqueezeConfig(force=1.0).newtons(2), 1.0)
        self.assertEqual(SqueezeConfig(force=0.0).newtons(2), 0.0)

    def test_balanced_forces_nearly_cancel(self):
        """A thumb against four fingers; a thumb that nothing opposes; two fingers, one of them farther from it."""
        x = torch.tensor([1.0, 0, 0], dtype=torch.float64)
        inward = torch.stack((x, -x, -x, -x, -x)).expand(3, 5, 3)
        height = torch.tensor([0.0, 0.03, 0.01, -0.01, -0.03], dtype=torch.float64)
        lever = -0.04 * inward
        lever[..., 2] = height
        pressing = torch.ones(3, 5, dtype=torch.bool)
        pressing[1, 1:] = False
        pressing[2, [2, 4]] = False
        factor = _balance(toy_fingers(3, 5, inward=inward, lever=lever), pressing)
        thumb = float(factor[0, 0])
        others = factor[0, 1:]
        self.assertAlmostEqual(float(factor[0].mean()), 1.0)
        self.assertAlmostEqual(thumb, float(others.sum()), delta=0.1)
        assert_allclose(others, others.mean().expand(4), atol=1e-6)
        self.assertEqual(factor[1].tolist(), [1, 0, 0, 0, 0])
        self.assertGreater(factor[2, 3], 2 * factor[2, 1], "no torque remains")

    def test_targets_of_a_squeeze_press_with_its_force(self):
        fingers, joints = self.fingers(0.0201, 0.0501)

        def squeezed(force, robot=ROBOT):
            return squeeze_targets(robot, fingers, joints, force * fingers.pressing(0.005))

        for force in (1.0, 2.5):
            target = squeezed(force)
            # jaw_b mimics jaw_a
            pressed = -(force + 1.1 * force) / 800
            self.assertAlmostEqual(target[0, JAW] - joints[0, JAW], pressed, delta=2e-5)
            assert_array_equal(target[1], joints[1], "30 mm away nothing is pressed on")
            arm = ROBOT.arm_indices
            assert_array_equal(target[:, arm], joints[:, arm])
        far = squeezed(1e4)
        self.assertAlmostEqual(
            far[0, JAW], 0.002 / 1.1, places=9, msg="where jaw_b, which mimics it, has its limit"
        )
        bend = ROBOT.joint_names.index("finger_b_bend")
        self.assertLessEqual(abs(far[0, bend]), 0.8)
        assert_array_equal(squeezed(0.0), joints)
        bent = squeezed(1.0)[0, bend] - joints[0, bend]
        target = squeezed(50.0, with_drive(ROBOT, "jaw_a_slide", effort=0.8))
        self.assertAlmostEqual(target[0, JAW] - joints[0, JAW], -0.8 / 800, places=9)
        force = 0.8 / (1 + 1.1)  # of each finger: no drive's torque alone is cut off
        self.assertLess(bent, -1e-3)
        self.assertAlmostEqual(target[0, bend] - joints[0, bend], force * bent, delta=1e-5)


class TargetsTest(TestCase):
    """Episodes that begin with a bank state begin with its targets."""

    def pressing(self):
        bank = toy_bank(ROBOT)
        return replace(bank, joint_target=bank.joint_pos + 0.25)

    def test_targets(self):
        found = self.pressing()
        assert_array_equal(found.with_states(~found.post_contact).targets, found.targets[[0, 2, 4]])
        self.assertEqual(found.num_pressing, 6)
        plain = toy_bank(ROBOT)
        self.assertIs(plain.targets, plain.joint_pos)
        self.assertEqual(plain.num_pressing, 0)

    def test_starts(self):
        """Those that a training draws: tests/test_env.py."""
        chosen = bank_starts(self.pressing())[tensor([4, 1])]
        assert_close(chosen.joint_target, chosen.joint_pos + 0.25)


PLAIN = "--closing.spacing None --squeeze.force 0 --transfer.per-pose 0"
"""Options for a bank of frames that do not press."""


class CommandTest(InFolder):
    def setUp(self):
        super().setUp()
        self.enterContext(in_this_process())
        self.enterContext(toy_grasp.found())
        write_retargeted(f"{self.folder}/r.npz", grasp_and_lift())

    def resets(self, *options):
        out = succeeds("resets", f"{self.folder}/r.npz", "--out", f"{self.folder}/b.npz", *options)
        return read_bank(f"{self.folder}/b.npz"), out

    def test_everything_at_once(self):
        """Jaws close by 30 mm (33 mm on one side): five states between; held by 2.5 N a side, and not without."""
        plain, _ = self.resets(PLAIN)
        self.assertEqual((plain.num_states, plain.num_pressing), (3, 0))
        self.assertEqual((plain.joint_target, plain.frame_part), (None, None))
        bank, out = self.resets(PLAIN, "--closing.spacing 0.0056 --squeeze.force 2.5")
        assert bank.frame_part is not None
        assert_allclose(bank.frame_part * 6, [0, 1, 2, 3, 4, 5, 0, 0], atol=1e-5)
        self.assertEqual(bank.frame_index.tolist(), [0] * 6 + [1, 2])
        self.assertEqual(
            (bank.targets != bank.joint_pos).any(axis=1).tolist(), [False] * 6 + [True] * 2
        )
        self.assertEqual(bank.accounts()[-1].total, 3, "frames only")
        self.assertEqual(bank.num_pressing, 2)
        for words in (
            "2 of 2 states after contact press",
            "8 states of 8 kept in .*, 5 of them closing states",
        ):
            self.assertRegex(" ".join(out.split()), words)
        with np.load(f"{self.folder}/b.npz") as file:
            config = json.loads(str(file["meta"]))["config"]
        self.assertEqual(config["closing"], {"spacing": 0.0056})
        self.assertEqual(config["squeeze"]["force"], 2.5)
