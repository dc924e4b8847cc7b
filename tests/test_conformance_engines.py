"""Every engine of the project keeps the contracts, with the suite's own robot and with another one."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from unittest import TestCase

import numpy as np

from tests.data import PYBULLET
from tests.toy_robot import ROBOTS
from xreset.backends.conformance import CHECKS, run
from xreset.geometry.description import load_robot, read_description
from xreset.geometry.dynamics import drive_inertia
from xreset.physics.plugins import backend_status, make_backend

ROBOT_DEPENDENT = [check.name for check in CHECKS if check.group == "state"]
ROBOT_DEPENDENT += ["mass_properties", "joint_limits", "gravity_compensation"]
"""Checks of what an engine reads from a robot's description. How its drives pull does not depend on the robot."""


def make_local(name):
    """A maker of the backend with its worlds in this process, where it has a choice."""
    options = {"workers": 0} if name in ("mujoco", "pybullet", "sapien") else {}
    return lambda scene, num_worlds, *, object_index=None: make_backend(
        name, scene, num_worlds, object_index=object_index, **options
    )


def explain(result):
    wrong = []
    for m in result.measures:
        if m.verdict == "failed":
            wrong.append(f"{m.what} {m.measured:.3g} > {m.tolerance:.3g} {m.unit} {m.where}")
    return f"{result.name}: {result.check.statement}: {result.problem or '; '.join(wrong)}"


@cache
def panda():
    """The Franka Panda of the package ``pybullet_data``, next to the table, with critically damped drives."""
    import pybullet_data

    urdf = Path(pybullet_data.getDataPath()) / "franka_panda" / "panda.urdf"
    robot = replace(read_description(ROBOTS / "panda.toml"), urdf=urdf)
    joints = []
    for joint, inertia in zip(robot.joints, drive_inertia(robot, robot.home), strict=True):
        kd = 2.0 * float(np.sqrt(joint.drive.kp * inertia))
        joints.append(replace(joint, drive=replace(joint.drive, kd=kd)))
    return replace(robot, joints=tuple(joints))


class EngineChecks:
    """The checks of one engine."""

    engine: str

    def setUp(self):
        if reason := backend_status(self.engine).reason:
            self.skipTest(reason)

    def passes(self, **options):
        results = run(make_local(self.engine), **options)
        self.assertEqual(
            [explain(r) for r in results if r.verdict not in ("passed", "known difference")], []
        )

    def test_it_passes(self):
        self.passes()

    def test_couplings_below_their_source_make_no_work(self):
        self.passes(robot=load_robot("ur7e-robotiq"), only=["coupled_jaw"])

    @PYBULLET  # whose data package has the robot
    def test_a_robot_of_another_package(self):
        self.passes(robot=panda(), only=ROBOT_DEPENDENT)


class MujocoTest(EngineChecks, TestCase):
    engine = "mujoco"

    @PYBULLET  # whose data package has the robot
    def test_checks_of_the_suite_s_own_robot_are_skipped(self):
        own = [check.name for check in CHECKS if check.own_robot_only]
        results = run(make_local("mujoco"), robot=panda(), only=own)
        self.assertEqual({result.verdict for result in results}, {"skipped"})


class MujocoWarpTest(EngineChecks, TestCase):
    engine = "mujoco-warp"
    test_a_robot_of_another_package = None

    def test_couplings_below_their_source_make_no_work(self):
        """And the checks for another robot: kernels are compiled for each."""
        self.passes(robot=load_robot("ur7e-robotiq"), only=["coupled_jaw", *ROBOT_DEPENDENT])


class PybulletTest(EngineChecks, TestCase):
    engine = "pybullet"


class SapienTest(EngineChecks, TestCase):
    engine = "sapien"
