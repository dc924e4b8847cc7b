"""Starts at rest: objects come to rest on the table before episodes begin there."""

from unittest import TestCase
from unittest.mock import patch

import numpy as np
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from tests.toy_bank import SOUP, SPAM, in_this_process
from xreset import load_object, load_robot
from xreset.backends.conformance.scene import ball
from xreset.geometry.shapes import quat_of, turn_of
from xreset.resets.probe import probe
from xreset.resets.settle import settled

UPRIGHT = np.array([[1.0, 0, 0, 0]])


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

    def test_objects_come_to_rest_on_the_table_or_not(self):
        """A soup can falls on the table, and another beside it; a spam can leans."""
        z = np.array([-obj.vertices[:, 2].min() for obj in self.objects])
        pos = np.array([[0.5, 0.3, z[0] + 0.5], [0.57, 2.0, 0.3], [0.55, 0.25, z[1] + 0.005]])
        quat = quat_of(tilted([[0], [0], [6]]))
        names = [SOUP, SOUP, SPAM]
        with patch("xreset.resets.settle.probe", wraps=probe) as tried:
            found, quats, at_rest = settled(self.robot, self.objects, names, pos, quat)
        held = tried.call_args.args[3].joint_pos
        assert_allclose(held, np.tile(self.robot.home, (3, 1)), rtol=1e-6)
        self.assertEqual(at_rest.tolist(), [True, False, True])
        assert_allclose(found[[0, 2], 2], z, atol=2e-3)
        self.assertLess(lean(quats[2]), 1, "it leaned by 6 degrees")
        for seconds, expected in ((0.05, False), (0.8, True)):
            with patch("xreset.resets.settle.SECONDS", seconds):
                *_, at_rest = settled(self.robot, self.objects, names, pos, quat)
            self.assertEqual(at_rest[0], expected, "it falls for 0.3 s")

    def test_an_object_that_rolls_on_is_at_rest_where_it_is(self):
        def rolling(engine, scene, names, states, *judge, **options):
            states.object_linvel[:, 0] = 0.05
            states.object_angvel[:, 1] = 0.05 / 0.03
            return probe(engine, scene, names, states, *judge, **options)

        start = np.array([[0.4, 0.3, 0.03]])
        with patch("xreset.resets.settle.probe", rolling):
            pos, _, at_rest = settled(self.robot, [ball()], ["ball"], start, UPRIGHT)
        self.assertTrue(at_rest.all())
        assert_allclose(pos, [[0.55, 0.3, 0.03]], atol=0.02)
