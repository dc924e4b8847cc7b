"""Every engine of the project keeps the contracts, with the suite's own robot and with another one."""

import unittest
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from tests.data import PYBULLET
from xreset.backends.conformance import CHECKS, run
from xreset.geometry.dynamics import drive_inertia
from xreset.plugins import backend_status, make_backend
from xreset.spec import DriveSpec, FingertipSpec, JointSpec, KeypointSpec, MimicSpec, RobotSpec

BACKENDS = ("mujoco", "mujoco-warp", "pybullet", "sapien")


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
    """The Franka Panda of the package ``pybullet_data``, standing beside the table, with critically damped drives."""
    import pybullet_data

    joints = []
    for i, q in enumerate((0.0, -0.6, 0.0, -2.2, 0.0, 1.6, 0.8), start=1):
        strong = i <= 4
        drive = DriveSpec(
            kp=1500.0 if strong else 300.0, kd=0.0, effort=87.0 if strong else 12.0, armature=0.1
        )
        joints.append(JointSpec(name=f"panda_joint{i}", group="arm", home=q, drive=drive))
    drive = DriveSpec(kp=1000.0, kd=0.0, effort=20.0)
    joints.append(JointSpec(name="panda_finger_joint1", group="hand", home=0.02, drive=drive))
    tips = []
    for name, link in (("thumb", "panda_leftfinger"), ("index", "panda_rightfinger")):
        tips.append(FingertipSpec(name=name, link=link, contact_links=(link,), keypoint=f"{name}4"))
    robot = RobotSpec(
        name="panda",
        urdf=Path(pybullet_data.getDataPath()) / "franka_panda" / "panda.urdf",
        joints=tuple(joints),
        mimics=(MimicSpec(joint="panda_finger_joint2", source="panda_finger_joint1"),),
        base_pos=(0.57, -0.35, 0.0),
        base_quat=(0.70710678, 0.0, 0.0, 0.70710678),
        palm="panda_grasptarget",
        fingertips=tuple(tips),
        keypoints=(KeypointSpec(keypoint="wrist", link="panda_hand"),),
        hand_root="panda_hand",
        table_exclude=("panda_link0",),
    )
    damped = []
    for joint, inertia in zip(robot.joints, drive_inertia(robot, robot.home), strict=True):
        kd = 2.0 * float(np.sqrt(joint.drive.kp * inertia))
        damped.append(replace(joint, drive=replace(joint.drive, kd=kd)))
    return replace(robot, joints=tuple(damped))


class EveryBackend(unittest.TestCase):
    def passes(self, backend, **options):
        status = backend_status(backend)
        if status.reason is not None:
            self.skipTest(f"{backend}: {status.reason}")
        results = run(make_local(backend), **options)
        self.assertEqual(
            [explain(r) for r in results if r.verdict not in ("passed", "known difference")], []
        )

    def test_every_backend_passes(self):
        for backend in BACKENDS:
            with self.subTest(backend=backend):
                self.passes(backend)

    @PYBULLET  # whose data package has the robot
    def test_a_robot_from_outside(self):
        robot_dependent = [
            c.name for c in CHECKS if c.group in ("state", "robot") and not c.own_robot_only
        ]
        for backend in BACKENDS:
            with self.subTest(backend=backend):
                self.passes(backend, robot=panda(), only=robot_dependent)
        own = [check.name for check in CHECKS if check.own_robot_only]
        results = run(make_local("mujoco"), robot=panda(), only=own)
        self.assertEqual({result.verdict for result in results}, {"skipped"})
