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
from xreset.retarget.validity import REASONS

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
        # the points are in the flat sides of a box: a line aslant is longer
        line = 0.05 / across[:, 0].abs()
        gap = (finger - thumb).norm(dim=-1) - line
        self.assertTrue(((gap > 0.0009) & (gap < 0.0014)).all(), "0.5 mm on each side")
        opened = self.hand.kinematics.points(grasps.opened, ["thumb_tip", "index_tip"])
        self.assertGreater((opened[:, 1] - opened[:, 0]).norm(dim=-1).min(), 0.08)
        _, y, z = grasps.retreat.abs().unbind(1)
        self.assertTrue((y.max() > 0.9) & (z.max() > 0.9) & ((y - z).abs().min() < 0.1), "any side")

    def test_the_ends_of_the_fingers_may_hold_an_object(self):
        """A rod of 5 cm, between its ends."""
        with patch("xreset.resets.grasps._DEPTHS", (1.0,)):
            grasps = planned_grasps(self.hand, block(0.05, 0.006, 0.006))
        far = (grasps.joints - grasps.opened).abs()[:, 0]
        grasps = grasps[far < far.min() + 0.05]
        balls = self.hand.balls
        pads = self.hand.pad_balls
        own = (grasps.joints, [balls.links[link] for link in balls.link[pads]], balls.centers[pads])
        centers = self.hand.kinematics.points(*own, base=grasps.root)
        beyond = (centers * -grasps.retreat[:, None]).sum(-1) + balls.radii[pads]
        self.assertLess(beyond.amax(dim=1).abs().max(), 0.003)

    def test_the_hand_is_clear_of_the_object_closed_and_open_on_its_way(self):
        """Two walls next to a block leave room for closed fingers."""
        walls = [((x, 0, 0), (0.01, 0.1, 0.1)) for x in (-0.054, 0.054)]
        walled = box_object(((0, 0, 0), (0.05, 0.1, 0.1)), *walls)
        grasps = planned_grasps(self.hand, walled)
        surface = prepared_surface(walled)
        balls = self.hand.balls
        links = [balls.links[link] for link in balls.link]
        opened = [(grasps.opened, distance) for distance in (0.0, 0.03, 0.08)]
        for joints, distance in ((grasps.joints, 0.0), *opened):
            root = grasps.root.clone()
            root[:, :3, 3] += distance * grasps.retreat
            centers = self.hand.kinematics.points(joints, links, balls.centers, base=root)
            depth = balls.radii.numpy() - surface.signed_distance(centers.numpy())
            self.assertLess(depth.max(), 0.0021)

    def test_a_plate_thinner_than_the_grid_of_distances_has_grasps(self):
        self.assertGreater(len(planned_grasps(self.hand, block(0.10, 0.11, 0.002)).joints), 0)

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

    def test_the_most_frequent_reason_counts_and_every_grasp_is_tried(self):
        """Sixty grasps, 24 at a time. The arm does not carry them to the goal, 3 m above the start."""
        start = ABOVE + np.array([0, 0, 1.0])
        for reasons, expected in (
            (["table collision", "joint limit", "table collision"] * 20, "table at the goal"),
            (["joint limit", "wrist position", "wrist position"] * 20, "goal out of reach"),
            (["joint limit"] * 60, "joint limit"),
            (["self collision"] * 60, "collision at the goal"),
            (["self collision"] * 59 + ["valid"], ""),
        ):
            left = [REASONS.index(reason) for reason in reasons]

            def reach_poses(_arm, root, joints, *_, left=left):
                count = len(root)
                if root[0, 2, 3] < 2.0:
                    return None, torch.zeros(count, dtype=torch.long)
                self.assertTrue(torch.isin(joints, self.grasps.joints).all(), "not opened")
                found = torch.tensor(left[:count])
                del left[:count]
                return None, found

            with (
                patch("xreset.resets.grasps.planned_grasps", lambda *_: self.grasps),
                patch("xreset.resets.grasps.reach_poses", reach_poses),
            ):
                found = self.reasons(self.block, start, start + np.array([0, 0, 3.0]))
            self.assertEqual((found, left), ([expected], []))
