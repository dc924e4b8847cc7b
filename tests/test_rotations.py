"""Quaternions and rotations against scipy's."""

import unittest

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch.testing import assert_close

from xreset.geometry.rotations import quat_angle, quat_multiply, quat_rotate, quat_to_matrix


class AgainstScipy(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        rng = np.random.default_rng(0)
        cls.a = Rotation.random(500, rng)
        cls.b = Rotation.random(500, rng)
        cls.points = rng.normal(size=(500, 3))

    def assert_near(self, function, expected, *arguments):
        """In double precision as scipy, in single precision to four units of the last place."""
        for dtype, atol in ((torch.float64, 1e-15), (torch.float32, 2.4e-7)):
            with self.subTest(function.__name__, dtype=dtype):
                found = function(*(torch.as_tensor(x, dtype=dtype) for x in arguments))
                assert_close(
                    found.double(), torch.as_tensor(expected), rtol=4 * atol, atol=4 * atol
                )

    def test_single_functions(self):
        a, b = (r.as_quat(scalar_first=True) for r in (self.a, self.b))
        product = (self.a * self.b).as_quat(scalar_first=True)
        found = quat_multiply(*map(torch.as_tensor, (a, b))).numpy()
        product *= np.sign((product * found).sum(axis=1, keepdims=True))  # q is -q
        self.assert_near(quat_multiply, product, a, b)
        self.assert_near(quat_to_matrix, self.a.as_matrix(), a)
        self.assert_near(quat_rotate, self.a.apply(self.points), a, self.points)
        self.assert_near(quat_angle, (self.a.inv() * self.b).magnitude(), a, b)

    def test_both_arguments_broadcast(self):
        a, b = (torch.as_tensor(r.as_quat(scalar_first=True)[:5]) for r in (self.a, self.b))
        for function, other in ((quat_multiply, b), (quat_rotate, b[:, 1:])):
            every = function(a[:, None], other[None, :3])
            self.assertEqual(every.shape[:2], (5, 3))
            assert_close(every[4, 1], function(a[4], other[1]))
