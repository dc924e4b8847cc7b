"""Quaternions and rotations against scipy's."""

import unittest

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch.testing import assert_close

from xreset.geometry.rotations import (
    matrix_to_axis_angle,
    matrix_to_quat,
    quat_angle,
    quat_from_axis_angle,
    quat_multiply,
    quat_normalize,
    quat_rotate,
    quat_rotate_inverse,
    quat_to_axis_angle,
    quat_to_matrix,
    relative_pose,
)


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

    def test_conversions(self):
        a = self.a.as_quat(scalar_first=True)
        positive = self.a.as_quat(canonical=True, scalar_first=True)
        self.assert_near(quat_normalize, positive, 3 * a)
        self.assert_near(quat_to_axis_angle, self.a.as_rotvec(), a)
        self.assert_near(quat_from_axis_angle, positive, self.a.as_rotvec())
        self.assert_near(matrix_to_quat, positive, self.a.as_matrix())
        half_turns = np.diag([1.0, 1, 1, 1])[1:]
        self.assert_near(
            matrix_to_quat,
            half_turns,
            Rotation.from_quat(half_turns, scalar_first=True).as_matrix(),
        )
        for tiny in (0.0, 1e-10):
            vector = np.array([[0.0, tiny, 0.0]])
            self.assert_near(quat_to_axis_angle, vector, [[1.0, 0.0, tiny / 2, 0.0]])

    def test_rotation_vectors_of_matrices_up_to_half_turns(self):
        for size in (0.0, 1e-10, 1e-6, 1.0, 3.0, np.pi - 4e-3, np.pi - 1e-9, np.pi):
            axes = self.points / np.linalg.norm(self.points, axis=1, keepdims=True)
            matrices = Rotation.from_rotvec(size * axes).as_matrix()
            turned = Rotation.from_rotvec(matrix_to_axis_angle(torch.as_tensor(matrices)).numpy())
            difference = turned.inv() * Rotation.from_rotvec(size * axes)
            self.assertLess(difference.magnitude().max(), 1e-12, size)

    def test_pose_in_a_frame(self):
        a, b = (torch.as_tensor(r.as_quat(scalar_first=True)) for r in (self.a, self.b))
        points = torch.as_tensor(self.points)
        self.assert_near(quat_rotate_inverse, self.a.inv().apply(self.points), a, points)
        pos, quat = relative_pose(points, b, points.flip(0), a)
        expected = self.a.inv().apply(self.points - self.points[::-1])
        assert_close(pos, torch.as_tensor(expected))
        self.assertLess(quat_angle(quat_multiply(a, quat), b).max(), 1e-14)

    def test_both_arguments_broadcast(self):
        a, b = (torch.as_tensor(r.as_quat(scalar_first=True)[:5]) for r in (self.a, self.b))
        for function, other in ((quat_multiply, b), (quat_rotate, b[:, 1:])):
            every = function(a[:, None], other[None, :3])
            self.assertEqual(every.shape[:2], (5, 3))
            assert_close(every[4, 1], function(a[4], other[1]))
