"""Grasps of a jaw on an object's shape, and the demonstrations that a rigid grasp can follow."""

from unittest import TestCase
from unittest.mock import patch

import numpy as np
import torch

from tests.toy_bank import toy_bank
from tests.toy_retarget import box_object
from xreset import robots
from xreset.geometry.surface import prepared_surface
from xreset.resets.grasps import losses, planned_grasps
from xreset.retarget.hand.model import HandModel

UPRIGHT = np.array([1.0, 0, 0, 0])
ABOVE = np.array([0.45, 0.30, 0.0])
"""A place on the table in reach of the robot."""


def block(*size):
    return box_object(((0, 0, 0), size))


@patch("xreset.resets.grasps._MOST", 60)
class GraspsTest(TestCase):
    @classmethod
    @patch("xreset.resets.grasps._MOST", 60)
    def setUpClass(cls):
        cls.robot = robots.load("ur7e-robotiq")
        cls.hand = HandModel(cls.robot)
        cls.block = block(0.05, 0.12, 0.13)
        cls.grasps = planned_grasps(cls.hand, cls.block)

    def test_pads_meet_the_two_sides_that_are_near_enough(self):
        grasps = self.grasps
        self.assertGreater(len(grasps.joints), 50)
        tips = self.hand.kinematics.points(
            grasps.joints, ["thumb_tip", "index_tip"], base=grasps.root
        )
        thumb, finger = tips.unbind(1)
        across = torch.nn.functional.normalize(finger - thumb, dim=-1)
        self.assertGreater(float(across[:, 0].abs().min()), np.cos(np.radians(25.0)))
        width = (finger - thumb).norm(dim=-1)
        # points in the flat sides of a box: a line aslant is longer
        self.assertTrue(((width > 0.05) & (width < 0.058)).all())

    def test_the_hand_is_clear_of_the_object_open_and_closed(self):
        grasps = self.grasps
        surface = prepared_surface(self.block)
        for joints in (grasps.joints, grasps.opened):
            poses = grasps.root[:, None] @ self.hand.kinematics.link_poses(
                joints, self.hand.balls.links
            )
            own = poses[:, self.hand.balls.link]
            centers = (own[..., :3, :3] @ self.hand.balls.centers[..., None])[..., 0]
            centers = (centers + own[..., :3, 3]).numpy()
            depth = self.hand.balls.radii.numpy() - surface.signed_distance(centers)
            self.assertLess(depth.max(), 0.0021)

    def test_an_object_wider_than_the_jaw_opens_has_no_grasp(self):
        grasps = planned_grasps(self.hand, block(0.10, 0.11, 0.12))
        self.assertEqual(grasps.missing, "too wide")
        self.assertEqual(len(grasps.joints), 0)

    def reasons(self, obj, start, goal):
        start = np.atleast_2d(start)
        count = len(start)
        names = np.full(count, obj.name)
        bank = toy_bank(
            self.robot,
            sequence_name=np.array([f"demo{i}" for i in range(count)]),
            sequence_object=names,
            object_names=(obj.name,),
            object_sources=("stand-in",),
            start_pos=start,
            start_quat_wxyz=np.tile(UPRIGHT, (count, 1)),
            goal_pos=np.atleast_2d(goal),
            goal_quat_wxyz=np.tile(UPRIGHT, (count, 1)),
        )
        return losses(bank, self.robot, (obj,), progress=lambda *_: None).tolist()

    def test_reasons(self):
        post = block(0.05, 0.06, 0.14)
        lift = ABOVE + np.array([0, 0, 0.07])
        far = lift + np.array([0, -2.0, 0])
        found = self.reasons(post, [lift, lift, far], [lift + np.array([0, 0, 0.15]), far, lift])
        self.assertEqual(found, ["", "goal out of reach", "grasps out of reach"])
        plate = block(0.20, 0.20, 0.02)
        low = ABOVE + np.array([0, 0, 0.01])
        # a jaw would have to come from the side, with a finger in the table
        self.assertEqual(self.reasons(plate, low, low + 0.1), ["no approach"])
        self.assertEqual(self.reasons(block(0.1, 0.1, 0.1), lift, lift), ["too wide"])
