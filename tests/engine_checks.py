"""What the CPU engines must do beyond the conformance suite, compared with closed forms; a mix-in for their tests."""

import sys
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from typing import ClassVar
from unittest import mock

import numpy as np
import torch
from torch import tensor
from torch.testing import assert_close

from xreset.backends.conformance.grasp_checks import grasp
from xreset.backends.conformance.harness import Bench
from xreset.backends.conformance.scene import gripper, objects, scene
from xreset.backends.pool import PoolBackend
from xreset.errors import BackendUnavailableError
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.rotations import quat_rotate
from xreset.spec import GRAVITY

JOINT = {name: i for i, name in enumerate(gripper().joint_names)}
"""Index of each joint of the suite's gripper."""


def with_drive(robot, name, **changes):
    joints = list(robot.joints)
    joint = joints[JOINT[name]]
    joints[JOINT[name]] = replace(joint, drive=replace(joint.drive, **changes))
    return replace(robot, joints=tuple(joints))


class EngineChecks:
    """Mixed into a ``TestCase`` that names the backend."""

    backend_class: ClassVar[type[PoolBackend]]
    module: ClassVar[str | None] = None
    """What the engine is imported as; None: its backend's module imports it."""
    one_step: ClassVar[AbstractContextManager] = nullcontext()
    """Makes the engine take a single step per physics step, so that momentum can be balanced."""

    def make(self, what, num_worlds=1, **options):
        backend = self.backend_class(what, num_worlds, workers=0, **options)  # pyright: ignore
        self.addCleanup(backend.close)
        return backend

    def grasp(self, what=None, **options):
        """The suite's gripper with its jaws just around a brick in the air, about to close."""
        backend = self.make(what or scene(), 1, **options)
        state = grasp(Bench(self.backend_class, scene()))[0][[0]]
        backend.set_state(state)
        return backend, state

    def test_a_missing_engine_says_how_to_get_it(self):
        if self.module is not None:
            engine = sys.modules[self.backend_class.__module__]._engine
            with (
                mock.patch.dict(sys.modules, {self.module: None}),
                self.assertRaisesRegex(BackendUnavailableError, rf"xreset\[{self.module}\]"),
            ):
                getattr(engine, "__wrapped__", engine)()

    # Joints -----------------------------------------------------------------------------------------------------------

    def test_a_mimic_joint_shares_its_sources_force(self):
        backend, _ = self.grasp()
        backend.set_object_gravity(torch.zeros(1))
        backend.step(240)
        jaw = JOINT["jaw_a_slide"]
        state = backend.state()
        lag = float(state.joint_pos[0, jaw] - state.joint_target[0, jaw])
        drive = gripper().joints[jaw].drive.kp * lag
        along = (
            Kinematics(gripper())
            .link_poses(state.joint_pos[0].double(), ["wrist"])[0, :3, 0]
            .float()
        )
        force = (backend.contacts().tip_force[0] @ along).abs()
        # Both forces are equal, because the brick does not move: F + 1.1 F = drive.
        assert_close(force, torch.full((2,), drive / 2.1), rtol=0.03, atol=0.0)

    # Contacts ---------------------------------------------------------------------------------------------------------

    def test_contact_forces_explain_the_objects_motion(self):
        self.enterContext(self.one_step)
        backend, _ = self.grasp()
        brick = objects()[0]
        push = tensor([0.5, 0.3, 0.2])
        backend.set_object_wrench(push[None], torch.zeros(1, 3))
        targets = backend.state().joint_target.clone()

        def com_velocity():
            state = backend.state().map(torch.Tensor.double)
            arm = quat_rotate(state.object_quat[0], tensor(brick.com))
            return state.object_linvel[0] + torch.linalg.cross(state.object_angvel[0], arm)

        errors = []
        presses = []
        for i in range(60):
            targets[0, JOINT["lift"]] = 0.02 * np.sin(i / 5)
            backend.set_joint_targets(targets)
            before = com_velocity()
            backend.step(1)
            acceleration = (com_velocity() - before) * 240 + tensor([0, 0, GRAVITY])
            forces = backend.contacts().tip_force[0]
            errors.append((forces.sum(0) - brick.mass * acceleration + push).abs().max())
            presses.append(float(forces[0].norm()))
        self.assertGreater(max(presses), 3.0)
        self.assertLess(max(errors), 0.01 * max(presses))
