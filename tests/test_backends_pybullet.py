"""The Bullet backend."""

import subprocess
import sys
from dataclasses import replace
from unittest import TestCase, mock

import numpy as np
import torch

from tests.data import PYBULLET
from tests.engine_checks import JOINT, EngineChecks
from xreset.backends.conformance.scene import objects, scene, shape
from xreset.backends.pybullet import PybulletBackend
from xreset.backends.rigid import mechanism
from xreset.spec import Geometry


@PYBULLET
class PybulletTest(EngineChecks, TestCase):
    backend_class = PybulletBackend
    module = "pybullet"
    one_step = mock.patch("xreset.backends.pybullet.INTERNAL_STEPS", 1)

    def test_a_hull_touches_where_it_is(self):
        """Round pads hold a box, its hull, and the hulls of its halves, all off their frames' origins, alike."""

        def round_pads(robot):
            made = mechanism(robot)
            bodies = []
            for body in made.bodies:
                shapes = []
                for item in body.shapes:
                    if item.shape.geometry.kind == "box":
                        ball = Geometry(kind="sphere", size=(min(item.shape.geometry.size),))
                        item = replace(item, shape=replace(item.shape, geometry=ball))
                    shapes.append(item)
                bodies.append(replace(body, shapes=tuple(shapes)))
            return replace(made, bodies=tuple(bodies))

        def hull(size, T):
            return replace(shape("hull", tuple(size)), T_body_shape=T)

        def opening(*pieces):
            held = replace(brick, pieces=pieces)
            with mock.patch("xreset.backends.pybullet.mechanism", round_pads):
                backend, _ = self.grasp(replace(scene(), objects=(held,)))
            backend.set_object_gravity(torch.zeros(1))
            backend.step(240)
            return float(backend.state().joint_pos[0, JOINT["jaw_a_slide"]])

        brick = objects()[0]
        self.assertGreater(np.abs(brick.com).max(), 0.0)
        (whole,) = brick.pieces
        T = whole.T_body_shape
        box = opening(whole)
        self.assertAlmostEqual(opening(hull(whole.geometry.size, T)), box, delta=5e-5)
        for axis in range(3):
            with self.subTest(axis=axis):
                half = np.array(whole.geometry.size)
                half[axis] /= 2
                pieces = []
                for side in (half[axis], -half[axis]):
                    moved = T.copy()
                    moved[:3, 3] += side * T[:3, axis]
                    pieces.append(hull(half, moved))
                self.assertAlmostEqual(opening(*pieces), box, delta=5e-5)

    def test_the_engine_prints_nothing(self):
        """It prints its build time, and a warning for each rounded axis of a robot: the LEAP hand has some."""
        code = (
            "from dataclasses import replace\n"
            "import xreset\n"
            "from xreset.backends.conformance.scene import scene\n"
            "from xreset.backends.pybullet import PybulletBackend\n"
            "print(PybulletBackend.engine_version())\n"
            "robot = xreset.load_robot('xarm7-leap')\n"
            "PybulletBackend(replace(scene(), robot=robot), 1).close()\n"
        )
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, timeout=120
        )
        self.assertEqual((done.returncode, done.stderr), (0, ""))
        self.assertRegex(done.stdout, r"^[\d.]+\n$")
