"""Starts at rest: recorded start poses come to rest on the table before episodes begin there."""

from dataclasses import replace
from functools import partial
from unittest import TestCase, mock

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from tests.toy_bank import SOUP, SPAM, toy_bank
from xreset import load_object, load_policy, load_robot, make_backend, synthesize
from xreset.eval.rollout import load_trial
from xreset.resets.settle import settle_starts


def tilted(degrees):
    """Quaternion (w, x, y, z) of a turn about x."""
    half = np.radians(degrees) / 2
    return np.array([np.cos(half), np.sin(half), 0, 0], dtype=np.float32)


class SettleTest(TestCase):
    @classmethod
    def setUpClass(cls):
        in_this_process = mock.patch(
            "xreset.resets.probe.make_backend", partial(make_backend, workers=0)
        )
        cls.enterClassContext(in_this_process)
        cls.robot = load_robot("ur7e-sharpa")
        cls.objects = [load_object(name) for name in (SOUP, SPAM)]
        cls.height = -cls.objects[0].vertices[:, 2].min()

    def test_objects_come_to_rest_on_the_table_or_start_as_recorded(self):
        z = self.height
        pos = np.float32([[0.5, 0.3, z + 0.01], [0.57, 2.0, 0.3], [0.55, 0.25, z + 0.005]])
        quat = np.float32([tilted(0), tilted(0), tilted(6)])
        bank = toy_bank(self.robot, start_pos=pos, start_quat_wxyz=quat)
        settled, at_rest = settle_starts(bank, self.robot, self.objects)
        self.assertEqual(at_rest.tolist(), [True, False, True])
        assert_array_equal(settled.start_pos[1], pos[1])  # it left the table
        assert_allclose(settled.start_pos[[0, 2], 2], z, atol=2e-3)
        axis = Rotation.from_quat(settled.start_quat_wxyz[2], scalar_first=True).apply([0, 0, 1])
        self.assertLess(np.degrees(np.arccos(axis[2])), 1, "it leaned by 6 degrees")
        assert_array_equal(settled.goal_pos, bank.goal_pos)
        assert_array_equal(settled.joint_pos, bank.joint_pos)

    def test_an_evaluation_says_that_its_starts_were_settled(self):
        demos = synthesize([SOUP], 1, seed=0)
        turn = Rotation.from_quat(tilted(6), scalar_first=True)
        recorded = Rotation.from_quat(demos.object_quat_wxyz, scalar_first=True)
        from_upright = turn * recorded * recorded[0].inv()
        leaning = replace(demos, object_quat_wxyz=from_upright.as_quat(scalar_first=True))
        policy = load_policy("zero", robot="ur7e-sharpa")
        recorded = load_trial(policy, leaning)
        settled = load_trial(policy, leaning, settle=True)
        self.assertNotIn("starts", recorded.inputs)
        self.assertEqual(settled.inputs["starts"], "settled")
        lean = []
        for trial in (recorded, settled):
            axis = Rotation.from_quat(trial.bank.start_quat_wxyz[0], scalar_first=True).apply(
                [0, 0, 1]
            )
            lean.append(np.degrees(np.arccos(axis[2])))
        self.assertAlmostEqual(lean[0], 6, delta=0.1)
        self.assertLess(lean[1], 1)
