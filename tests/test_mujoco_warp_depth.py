"""Contacts of MuJoCo-Warp are as many and as deep as MuJoCo's where shapes are across an edge."""

import subprocess
import sys
import warnings
from unittest import TestCase
from unittest.mock import patch

import mujoco
import mujoco_warp as mjw
import numpy as np
import trimesh
import warp as wp
from mujoco_warp._src import collision_convex
from numpy.testing import assert_allclose

from xreset.backends import mujoco_warp_depth, mujoco_warp_step
from xreset.backends.conformance.scene import scene
from xreset.backends.mujoco_warp import MujocoWarpBackend
from xreset.backends.mujoco_warp_setup import CPU_FLAGS, correct_engine, engine_step
from xreset.physics.torch_warp import quiet

WORLDS = 200


def across_an_edge():
    """A free capsule, and a can as a mesh of 24 sides, across whose edges it can be."""
    can = trimesh.creation.cylinder(0.033, 0.1, sections=24)
    spec = mujoco.MjSpec()
    spec.add_mesh(
        name="can",
        uservert=can.vertices.ravel(),
        userface=can.faces.ravel(),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX,
    )
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="can")
    body = spec.worldbody.add_body()
    body.add_freejoint()
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=(0.009, 0.02, 0.0), mass=0.1)
    return spec.compile()


def poses(rng):
    """[N, 7] the capsule at the can, up to 1 mm deep and inclined by some hundredths, as fingertips are."""
    out = np.zeros((WORLDS, 7), dtype=np.float32)
    azimuth = rng.uniform(0, 2 * np.pi, WORLDS)
    radius = 0.033 + 0.009 - rng.uniform(0.0, 1e-3, WORLDS)
    out[:, 0] = radius * np.cos(azimuth)
    out[:, 1] = radius * np.sin(azimuth)
    out[:, 2] = rng.uniform(-0.03, 0.03, WORLDS)
    out[:, 3] = 1.0
    out[:, 4:] = rng.uniform(-0.04, 0.04, (WORLDS, 3))
    out[:, 3:] /= np.linalg.norm(out[:, 3:], axis=1, keepdims=True)
    return out


class Depth(TestCase):
    def test_contacts_that_were_clipped_to_one_are_as_deep_as_in_mujoco(self):
        correct_engine()  # tested is the engine as the backend leaves it, with its kernels
        self.enterContext(patch.object(wp.config, "cpu_compiler_flags", CPU_FLAGS))
        model = across_an_edge()
        qpos = poses(np.random.default_rng(0))
        with wp.ScopedDevice("cpu"):
            m = mjw.put_model(model)
            # as the backend has it, so that its kernel need not be compiled again
            m.opt.warn_overflow = 0
            d = mjw.make_data(model, nworld=WORLDS, nconmax=8, njmax=32)
            d.qpos = wp.array(qpos, dtype=float)
            for stage in (mjw.kinematics, mjw.com_pos, mjw.collision):
                stage(m, d)
        found = int(d.nacon.numpy()[0])
        world = d.contact.worldid.numpy()[:found]
        dist = d.contact.dist.numpy()[:found]

        data = mujoco.MjData(model)
        elsewhere = 0
        for i in range(WORLDS):
            data.qpos[:] = qpos[i]
            mujoco.mj_forward(model, data)
            expected = np.sort(data.contact.dist)
            assert_allclose(
                np.sort(dist[world == i]), expected, atol=2e-6, err_msg=f"pose {qpos[i]}"
            )
            deepest = mujoco.mj_geomDistance(model, data, 0, 1, 1.0, None)
            elsewhere += len(expected) == 1 and expected[0] > deepest + 2e-5
        self.assertGreater(
            elsewhere, 10, "the deepest point must often be elsewhere, or this shows nothing"
        )


class OtherVersions(TestCase):
    def test_an_engine_that_finds_contacts_in_another_way_is_announced(self):
        with (
            patch.object(mujoco_warp_depth, "KNOWN_SOURCE", "another"),
            patch.object(mujoco_warp_depth, "correct_depths") as correct,
            self.assertWarnsRegex(
                UserWarning, r"finds contacts in another way.*Install mujoco-warp==4\.0\.0"
            ),
        ):
            correct_engine()
        correct.assert_not_called()

    def test_what_is_corrected_depends_on_the_code_and_not_on_the_version(self):
        with patch.object(mjw, "__version__", "4.0.1"), warnings.catch_warnings():
            warnings.simplefilter("error")
            correct_engine()
            self.assertIs(engine_step(wp.get_device("cpu")).func, mujoco_warp_step.forked_step)
        self.assertIs(collision_convex.multicontact, mujoco_warp_depth.multicontact_with_depth)

    def test_the_engines_source_is_parsed_once(self):
        engine_step(wp.get_device("cpu"))
        with patch("inspect.getsource") as parse:
            engine_step(wp.get_device("cpu"))
        parse.assert_not_called()

    def test_another_step_is_left_to_the_engine_and_said(self):
        with (
            patch.object(mujoco_warp_step, "KNOWN_SOURCE", "another"),
            self.assertWarnsRegex(UserWarning, "objects that slide hop"),
        ):
            self.assertIs(engine_step(wp.get_device("cpu")), mjw.step)

    def test_the_log_level_of_the_process_stays_as_it_was(self):
        level = wp.config.log_level
        with quiet():
            self.assertEqual(wp.config.log_level, wp.LOG_WARNING)
        self.assertEqual(wp.config.log_level, level)
        MujocoWarpBackend(scene(), 1).close()
        self.assertEqual(wp.config.log_level, level)


class MessagesTest(TestCase):
    def test_a_machine_without_a_gpu_is_not_warned_of_it(self):
        code = "from xreset.physics.torch_warp import quiet\nwith quiet():\n    print('begun')"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        self.assertEqual((done.stdout, done.stderr), ("begun\n", ""))
