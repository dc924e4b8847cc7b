"""Starts at rest: recorded start poses come to rest on the table before episodes begin there."""

from dataclasses import replace
from unittest import TestCase

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from tests.toy_bank import SOUP, SPAM, in_this_process, toy_bank
from xreset import load_object, load_policy, load_robot, synthesize
from xreset.eval.rollout import load_trial
from xreset.geometry.shapes import quat_of, turn_of
from xreset.resets.settle import settle_starts


def tilted(degrees):
    """A turn about x."""
    return Rotation.from_euler("x", degrees, degrees=True)


def lean(quat):
    """Angle between an object's z axis and the vertical [degrees]."""
    return np.degrees(np.arccos(turn_of(quat).apply([0, 0, 1])[2]))


class SettleTest(TestCase):
    @classmethod
    def setUpClass(cls):
        cls.enterClassContext(in_this_process())
        cls.robot = load_robot("ur7e-sharpa")
        cls.objects = [load_object(name) for name in (SOUP, SPAM)]
        cls.height = -cls.objects[0].vertices[:, 2].min()

    def test_objects_come_to_rest_on_the_table_or_start_as_recorded(self):
        z = self.height
        pos = np.float32([[0.5, 0.3, z + 0.01], [0.57, 2.0, 0.3], [0.55, 0.25, z + 0.005]])
        quat = quat_of(tilted([[0], [0], [6]]))
        bank = toy_bank(self.robot, start_pos=pos, start_quat_wxyz=quat)
        settled, at_rest = settle_starts(bank, self.robot, self.objects)
        self.assertEqual(at_rest.tolist(), [True, False, True])
        assert_array_equal(settled.start_pos[1], pos[1])  # it left the table
        assert_allclose(settled.start_pos[[0, 2], 2], z, atol=2e-3)
        self.assertLess(lean(settled.start_quat_wxyz[2]), 1, "it leaned by 6 degrees")
        assert_array_equal(settled.goal_pos, bank.goal_pos)
        assert_array_equal(settled.joint_pos, bank.joint_pos)

    def test_an_evaluation_says_that_its_starts_were_settled(self):
        demos = synthesize([SOUP], 1, seed=0)
        recorded = turn_of(demos.object_quat_wxyz)
        from_upright = tilted(6) * recorded * recorded[0].inv()
        leaning = replace(demos, object_quat_wxyz=quat_of(from_upright))
        policy = load_policy("zero", robot="ur7e-sharpa")
        recorded = load_trial(policy, leaning)
        settled = load_trial(policy, leaning, settle=True)
        self.assertNotIn("starts", recorded.inputs)
        self.assertEqual(settled.inputs["starts"], "settled")
        self.assertAlmostEqual(lean(recorded.bank.start_quat_wxyz[0]), 6, delta=0.1)
        self.assertLess(lean(settled.bank.start_quat_wxyz[0]), 1)
