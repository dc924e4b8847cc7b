"""The Bullet backend."""

from __future__ import annotations

import sys
import unittest
from unittest import mock

import numpy as np
from scipy.spatial.transform import Rotation

from tests.engine_checks import EngineChecks
from xreset.backends.conformance.scene import gripper, scene
from xreset.backends.pybullet import PybulletBackend, PybulletSettings, PybulletWorld, _origin
from xreset.errors import BackendUnavailableError, ObjectError
from xreset.robots.dynamics import mass_matrix


class PybulletTest(EngineChecks, unittest.TestCase):
    backend_class = PybulletBackend
    one_step_options = {"settings": PybulletSettings(internal_steps=1)}  # noqa: RUF012

    def test_bullets_mass_matrix_is_the_robots(self):
        world = PybulletWorld(scene(), 0)
        self.addCleanup(world.close)
        robot = gripper()
        q = robot.home + np.array([0.02, -0.1, 0.3, 0.2, 0.005])
        drives = world._drives
        full = drives._mass_matrix(drives._all(q, drives._offset))
        # Mimic joints move with their source: M = S^T M_all S with q_all = S q + constant.
        S = np.stack([drives._all(e, np.zeros(1)) for e in np.eye(5)], axis=1)
        np.testing.assert_allclose(S.T @ full @ S, mass_matrix(robot, q), rtol=1e-6, atol=1e-9)

    def test_roll_pitch_yaw(self):
        rotations = [*Rotation.random(50, random_state=0), Rotation.from_euler("xyz", [0.3, np.pi / 2, -0.2]), Rotation.identity()]
        for rotation in rotations:
            T = np.eye(4)
            T[:3, :3] = rotation.as_matrix()
            rpy = [float(x) for x in _origin(T).split('rpy="')[1].split('"')[0].split()]
            np.testing.assert_allclose(Rotation.from_euler("xyz", rpy).as_matrix(), T[:3, :3], atol=1e-7)

    def test_an_impossible_object_is_refused(self):
        from dataclasses import replace

        bad = replace(scene().objects[0], inertia=np.diag([1e-4, 1e-4, 1e-3]))
        with self.assertRaisesRegex(ObjectError, "'brick' has principal moments"):
            PybulletBackend(replace(scene(), objects=(bad,)), 1)

    def test_a_missing_engine_says_how_to_get_it(self):
        with mock.patch.dict(sys.modules, {"pybullet": None}), self.assertRaisesRegex(BackendUnavailableError, r"xreset\[pybullet\]"):
            PybulletBackend.engine_version()


if __name__ == "__main__":
    unittest.main()
