"""The MuJoCo model of a scene, and what the two MuJoCo backends do beyond the conformance suite."""

from __future__ import annotations

import gc
import tempfile
import unittest
import weakref
from dataclasses import fields, replace
from pathlib import Path
from unittest import mock

import mujoco
import mujoco_warp
import numpy as np
import torch
import warp
from scipy.spatial.transform import Rotation

from tests.toy_robot import toy_hand_arm
from xreset.backends import mujoco_warp as mujoco_warp_backend
from xreset.backends.conformance.grasp_checks import grasp
from xreset.backends.conformance.harness import Bench, snapshot
from xreset.backends.conformance.scene import gripper, objects, scene, shape, solid
from xreset.backends.mjcf import compile_scene
from xreset.backends.mjcf_model import OBJECT, OTHER_LINK, TABLE, SceneModel
from xreset.backends.mujoco import MujocoBackend, MujocoWorld
from xreset.backends.mujoco_warp import MujocoWarpBackend
from xreset.backends.mujoco_warp_setup import differing_fields
from xreset.errors import BackendUnavailableError, ObjectError, RobotError, XResetError
from xreset.geometry.urdf import robot_tree
from xreset.physics import Backend
from xreset.plugins import device_for
from xreset.spec import FingertipSpec


def colliding_geoms(model: mujoco.MjModel) -> set[frozenset[str]]:
    """Pairs of geoms that the engine lets touch: all are made into large spheres that overlap, and it says what touches what."""
    model.geom_type[:] = mujoco.mjtGeom.mjGEOM_SPHERE
    model.geom_size[:, 0] = model.geom_rbound[:] = model.geom_aabb[:, 3:] = 10.0
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    names = [model.geom(i).name for i in range(model.ngeom)]
    return {frozenset(names[i] for i in pair) for pair in data.contact.geom}


def worlds(backend: MujocoBackend) -> list[MujocoWorld]:
    """The worlds of a backend without worker processes."""
    return backend._team._worlds


def plain_links(world: MujocoWorld) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Position, rotation matrix, velocity and angular velocity of the tracked links, one by one."""
    at, data, rows = world._at, world._data, []
    for body, pos, quat in zip(at.link_body, at.link_pos, at.link_quat, strict=True):
        R, velocity = data.xmat[body].reshape(3, 3), np.zeros(6)
        mujoco.mj_objectVelocity(world._model, data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity, 0)
        angvel, linvel = velocity[:3], velocity[3:]
        own = Rotation.from_quat(quat, scalar_first=True).as_matrix()
        rows.append((data.xpos[body] + R @ pos, R @ own, linvel + np.cross(angvel, R @ pos), angvel))
    pos, rotation, linvel, angvel = (np.array(column) for column in zip(*rows, strict=True))
    return pos, rotation, linvel, angvel


def plain_contacts(world: MujocoWorld) -> tuple[np.ndarray, list[bool], np.ndarray]:
    """Tip forces, tip touch and table force on the object, contact by contact."""
    at, data = world._at, world._data
    tips = len(at.link_body) - 1
    tip_force, touch, table_force = np.zeros((tips, 3)), [False] * tips, np.zeros(3)
    for i in range(data.ncon):
        contact, local = data.contact[i], np.zeros(6)
        mujoco.mj_contactForce(world._model, data, i, local)
        force = contact.frame.reshape(3, 3).T @ local[:3]  # on the second geom
        roles = at.geom_role[contact.geom]
        if OBJECT not in roles:
            continue
        other, on_object = (roles[0], force) if roles[1] == OBJECT else (roles[1], -force)
        if other == TABLE:
            table_force += on_object
        if other >= 0:
            tip_force[other] += on_object
            touch[other] |= local[0] > 0
    return tip_force, touch, table_force


class Model(unittest.TestCase):
    at: SceneModel

    @classmethod
    def setUpClass(cls):
        cls.scene = scene()
        cls.at = compile_scene(cls.scene, 0)

    def test_fused_bodies_keep_the_mass_and_the_inertia(self):
        model = self.at.model
        tree = robot_tree(self.scene.robot)
        moving = sum(link.mass for link in tree.links if link.name != tree.root)
        self.assertAlmostEqual(float(model.body_mass[1:-1].sum()), moving)
        # wrist and palm are one body: the mass matrix of the joint that turns it must see both, about the joint's axis
        wrist, palm = tree.link("wrist"), tree.link("palm")
        mount = tree.joint("palm_mount").T_parent_joint
        body = model.body("robot/wrist")
        com = (wrist.mass * wrist.com + palm.mass * (mount[:3, :3] @ palm.com + mount[:3, 3])) / (
            wrist.mass + palm.mass
        )
        np.testing.assert_allclose(body.ipos, com, atol=1e-12)

    def test_actuators_are_drives_in_joint_order(self):
        model, robot = self.at.model, self.scene.robot
        for i, joint in enumerate(robot.joints):
            self.assertEqual(model.actuator(i).name, joint.name)
            self.assertEqual(model.actuator(i).gainprm[0], joint.drive.kp)
            np.testing.assert_array_equal(model.actuator(i).biasprm[1:3], (-joint.drive.kp, -joint.drive.kd))
            np.testing.assert_array_equal(model.actuator(i).forcerange, (-joint.drive.effort, joint.drive.effort))
            self.assertEqual(model.dof_armature[self.at.joint_dof[i]], joint.drive.armature)
            self.assertEqual(model.jnt_qposadr[model.joint(joint.name).id], self.at.joint_qpos[i])

    def test_a_drive_at_its_target_rests_and_off_it_pulls_with_its_stiffness_where_joints_are_coupled_too(self):
        at, robot, data = self.at, self.scene.robot, mujoco.MjData(self.at.model)
        q = robot.home + 0.01
        data.qpos[at.joint_qpos], data.qpos[at.mimic_qpos] = (
            q,
            at.mimic_multiplier * q[at.mimic_source] + at.mimic_offset,
        )
        off = np.linspace(-1e-4, 1e-4, len(q))
        data.ctrl[:] = q + off
        mujoco.mj_forward(at.model, data)
        np.testing.assert_allclose(data.actuator_force, off * [joint.drive.kp for joint in robot.joints], atol=1e-9)

    def test_gravity_compensation_takes_the_weight_of_the_robot_only(self):
        model, data = self.at.model, mujoco.MjData(self.at.model)
        data.qpos[self.at.joint_qpos] = (0.1, 0.4, 0.2, -0.5, 0.03)
        data.qpos[self.at.object_qpos + 2] = 2.0
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(data.qacc[self.at.object_dof : self.at.object_dof + 3], (0, 0, -9.81), atol=1e-9)
        weightless = data.qfrc_bias - data.qfrc_passive
        np.testing.assert_allclose(weightless[self.at.joint_dof], 0.0, atol=1e-9)
        heavy = replace(self.scene, robot=replace(self.scene.robot, gravity_compensated=False))
        model = compile_scene(heavy, 0).model
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        self.assertGreater(np.abs((data.qfrc_bias - data.qfrc_passive)[self.at.joint_dof]).max(), 1.0)

    def test_what_may_collide(self):
        pairs = colliding_geoms(compile_scene(self.scene, 0).model)
        base, column, wrist, jaw_a, pad_b = (
            f"robot/{body}/0" for body in ("base", "column", "wrist", "jaw_a", "finger_b")
        )  # the pad is fixed to finger_b
        thing = "object/box/0"
        expected = {frozenset((thing, other)) for other in ("table", base, column, wrist, jaw_a, pad_b)}
        expected |= {frozenset(("table", link)) for link in (column, wrist, jaw_a, pad_b)}  # the base is excluded
        expected |= {
            frozenset((jaw_a, pad_b)),
            frozenset((column, pad_b)),
        }  # jaw_a and column are excluded, the wrist not listed
        self.assertEqual(pairs, expected)

    def test_links_of_one_body_are_told_apart(self):
        # finger_b has no shape; its pad may collide with jaw_a, a second fixed link of the same body may not
        with tempfile.TemporaryDirectory() as folder:
            text = gripper().urdf.read_text()
            box = '<collision><geometry><box size="0.01 0.01 0.01"/></geometry></collision>'
            text = text.replace('<link name="tip_b"/>', f'<link name="tip_b">{box}</link>')
            urdf = Path(folder) / "robot.urdf"
            urdf.write_text(text)
            robot = replace(
                gripper(),
                urdf=urdf,
                self_collision_links=("jaw_a", "pad_b", "tip_b"),
                collision_exclude=(("jaw_a", "tip_b"),),
            )
            pairs = colliding_geoms(compile_scene(replace(self.scene, robot=robot), 0).model)
        own = {pair for pair in pairs if all(name.startswith("robot/") for name in pair)}
        self.assertEqual(own, {frozenset(("robot/jaw_a/0", "robot/finger_b/0"))})

    def test_neighbours_of_a_base_that_stands_still_never_collide(self):
        robot = replace(self.scene.robot, self_collision_links=("base", "column", "wrist"), collision_exclude=())
        pairs = colliding_geoms(compile_scene(replace(self.scene, robot=robot), 0).model)
        own = {pair for pair in pairs if all(name.startswith("robot/") for name in pair)}
        self.assertEqual(
            own, {frozenset(("robot/base/0", "robot/wrist/0")), frozenset(("robot/column/0", "robot/wrist/0"))}
        )

    def test_roles(self):
        names = [self.at.model.geom(i).name for i in range(self.at.model.ngeom)]
        role = dict(zip(names, self.at.geom_role.tolist(), strict=True))
        self.assertEqual(role["table"], TABLE)
        self.assertEqual(role["robot/jaw_a/0"], 0)
        self.assertEqual(role["robot/finger_b/0"], 1)
        self.assertEqual(role["robot/wrist/0"], OTHER_LINK)
        self.assertEqual(role["object/box/0"], OBJECT)

    def test_slots_hold_any_of_the_objects(self):
        models = [compile_scene(self.scene, i, slots_for=range(3)) for i in range(3)]
        kinds = [m.model.geom_type.tolist() for m in models]
        self.assertEqual(kinds[0], kinds[1])
        self.assertEqual(kinds[0], kinds[2])
        self.assertEqual([int(m.parked.sum()) for m in models], [3, 3, 2])  # of one box, one cylinder and two hulls
        for field in ("mesh_vert", "mesh_graph", "geom_contype", "geom_bodyid", "geom_condim", "dof_parentid"):
            for other in models[1:]:
                np.testing.assert_array_equal(getattr(models[0].model, field), getattr(other.model, field), field)
        differing = differing_fields([m.model for m in models])
        for field in ("geom_size", "geom_pos", "geom_aabb", "geom_rbound", "body_mass", "body_ipos", "body_iquat", "body_inertia",
                      "body_invweight0", "dof_invweight0", "geom_dataid"):  # fmt: skip
            self.assertIn(field, differing)

    def test_bad_objects_and_robots(self):
        brick = objects()[0]
        for bad, message in (
            (replace(brick, pieces=()), "no collision piece"),
            (replace(brick, mass=0.0), "mass"),
            (replace(brick, inertia=np.diag((1e-4, 1e-4, 3e-4))), "moments of inertia"),
        ):
            with self.assertRaisesRegex(ObjectError, message):
                compile_scene(replace(self.scene, objects=(bad,)), 0)
        robot = self.scene.robot
        tip = FingertipSpec(name="thumb", link="nowhere", contact_links=("jaw_a",), keypoint="thumb4")
        with self.assertRaisesRegex(RobotError, "nowhere"):
            compile_scene(replace(self.scene, robot=replace(robot, fingertips=(tip,))), 0)
        with self.assertRaisesRegex(RobotError, "jaw_b_slide"):
            compile_scene(replace(self.scene, robot=replace(robot, mimics=())), 0)

    def test_another_robot(self):
        with tempfile.TemporaryDirectory() as folder:
            at = compile_scene(replace(self.scene, robot=toy_hand_arm(Path(folder))), 1)
        self.assertEqual(len(at.joint_qpos), 7)
        self.assertEqual(at.model.body("robot/fore").id, at.link_body[0])  # the palm is fixed to the forearm


class BothBackends(unittest.TestCase):
    """MuJoCo C is the reference for MuJoCo-Warp. The worlds are built once: compiling kernels takes about a minute."""

    @classmethod
    def setUpClass(cls):
        cls.scene = scene()
        index = torch.tensor([0, 1, 2, 0])
        cls.warp = MujocoWarpBackend(cls.scene, 4, object_index=index)
        cls.c = MujocoBackend(cls.scene, 4, object_index=index, workers=0)
        cls.bench = Bench(lambda *_, **__: cls.c, cls.scene)

    @classmethod
    def tearDownClass(cls):
        cls.warp.close()
        cls.c.close()

    def both(self) -> tuple[Backend, Backend]:
        return self.warp, self.c

    def test_start(self):
        home = torch.as_tensor(self.scene.robot.home, dtype=torch.float32)
        for backend in (MujocoBackend(self.scene, 1, workers=0), MujocoWarpBackend(self.scene, 1)):
            state = backend.state()
            torch.testing.assert_close(state.joint_pos[0], home)
            torch.testing.assert_close(state.joint_target[0], home)
            torch.testing.assert_close(state.object_pos[0], torch.tensor([0.57, 0.30, 0.029]))

    def test_same_motion(self):
        """Closing jaws, a swinging arm and objects at rest, for half a second."""
        start = self.bench.start()
        target = start.joint_pos + torch.tensor([0.05, 0.3, 0.2, -0.3, -0.02])
        for backend in self.both():
            backend.set_state(start)
            backend.set_joint_targets(target)
            for _ in range(30):
                backend.step()
        a, b = snapshot(self.warp.state()), snapshot(self.c.state())
        torch.testing.assert_close(a.joint_pos, b.joint_pos, atol=1e-5, rtol=0.0)
        torch.testing.assert_close(a.object_pos, b.object_pos, atol=1e-4, rtol=0.0)
        torch.testing.assert_close(self.warp.links().linvel, self.c.links().linvel, atol=1e-4, rtol=0.0)
        torch.testing.assert_close(self.warp.contacts().table_force, self.c.contacts().table_force, atol=0.05, rtol=0.0)

    def test_a_grasp_holds_for_two_seconds(self):
        """Grasps have changed between versions of MuJoCo-Warp."""
        state, _ = grasp(self.bench)
        for backend in self.both():
            with self.subTest(backend=backend.name):
                backend.set_state(state)
                for _ in range(120):
                    backend.step()
                fallen = (state.object_pos - backend.state().object_pos)[[0, 3], 2]
                self.assertLess(float(fallen.abs().max()), 5e-3)
                self.assertTrue(bool(backend.contacts().tip_touch[[0, 3]].all()))
                self.assertFalse(bool(backend.health().nonfinite.any()))

    def test_held_forces_agree(self):
        """Their means, once the grip has settled: single precision makes each sway by 0.03 N about them."""
        state, _ = grasp(self.bench)
        means = []
        for backend in self.both():
            backend.set_state(state)
            backend.step(160)
            forces = []
            for _ in range(60):
                backend.step()
                forces.append(backend.contacts().tip_force.clone())
            means.append(torch.stack(forces).mean(dim=0)[[0, 3]])
        torch.testing.assert_close(*means, atol=0.02, rtol=0.0)
        torch.testing.assert_close(self.warp.contacts().tip_touch, self.c.contacts().tip_touch)

    def test_readings_are_those_of_a_plain_computation(self):
        """The engine's sensors against loops over links and contacts: while a grasped box is swung about, and right after a set."""
        state, _ = grasp(self.bench)
        moving = replace(
            state, joint_vel=state.joint_vel + 0.3, object_angvel=state.object_angvel + torch.tensor([0.5, -1.0, 2.0])
        )
        touched, plain, sense = set(), {}, mujoco.mj_sensorAcc

        def sense_and_look(model, data):
            """The next step's contacts will soon replace those of this one."""
            sense(model, data)
            plain.update({i: plain_contacts(world) for i, world in enumerate(worlds(self.c)) if world._data is data})

        for steps in (0, 1, 5, 30):
            self.c.set_state(moving)
            self.c.set_joint_targets(state.joint_target + torch.tensor([0.1, 0.2, 0.1, 0.0, 0.0]))
            plain.update(dict.fromkeys(range(4), (np.zeros((2, 3)), [False, False], np.zeros(3))))
            with mock.patch.object(mujoco, "mj_sensorAcc", sense_and_look):
                for _ in range(steps):
                    self.c.step()
                links, contacts = self.c.links(), self.c.contacts()
            for i in range(4):
                pos, rotation, linvel, angvel = plain_links(worlds(self.c)[i])
                np.testing.assert_allclose(links.pos[i], pos, atol=1e-6)
                np.testing.assert_allclose(links.linvel[i], linvel, atol=1e-6)
                np.testing.assert_allclose(links.angvel[i], angvel, atol=1e-6)
                turned = Rotation.from_quat(links.quat[i].numpy(), scalar_first=True).as_matrix()
                np.testing.assert_allclose(turned, rotation, atol=1e-6)
                tip_force, touch, table_force = plain[i]
                np.testing.assert_allclose(contacts.tip_force[i], tip_force, rtol=1e-5, atol=1e-6)
                np.testing.assert_allclose(contacts.table_force[i], table_force, rtol=1e-5, atol=1e-6)
                self.assertEqual(contacts.tip_touch[i].tolist(), touch)
                touched |= {("tip", tip) for tip in np.flatnonzero(touch)} | (
                    {("table",)} if table_force.any() else set()
                )
        self.assertEqual(touched, {("tip", 0), ("tip", 1), ("table",)}, "nothing was compared")

    def test_looking_changes_no_motion(self):
        """Links take the first half of the next step in advance: whoever looks must end up where one goes who does not."""
        state, _ = grasp(self.bench)
        friction = torch.tensor(
            [[self.scene.friction.tip, self.scene.friction.link, self.scene.friction.table]]
        ).expand(4, 3)
        self.addCleanup(self.c.set_friction, friction)
        for looks in ((), ("links",), ("contacts", "links"), ("links", "contacts")):
            ends = []
            for seen in (looks, ()):
                self.c.set_friction(friction)
                self.c.set_state(state)
                for step in range(6):
                    self.c.step(1 + step % 2)
                    for look in seen:
                        getattr(self.c, look)()
                    self.c.set_friction(friction * (1.0 + 0.1 * (step % 2)))
                ends.append((self.c.state(), self.c.links(), self.c.contacts()))
                ends[-1] = [getattr(part, f.name).clone() for part in ends[-1] for f in fields(part)]
            for a, b in zip(*ends, strict=True):
                torch.testing.assert_close(a, b, rtol=0, atol=0)
        self.assertTrue(bool(self.c.contacts().tip_touch.any()), "nothing was touched")

    def test_sensors_change_no_motion(self):
        plain, sensing = compile_scene(self.scene, 0).model, compile_scene(self.scene, 0, sensors=True).model
        self.assertEqual(plain.nsensordata, 0)
        results = []
        for model in (plain, sensing):
            data = mujoco.MjData(model)
            data.qvel[:] = 0.2
            mujoco.mj_step(model, data, 50)
            results.append(data.qpos.copy())
        np.testing.assert_array_equal(*results)

    def test_every_broken_number_is_noticed(self):
        for bad in (np.nan, np.inf, -np.inf):
            for array in ("qpos", "qvel"):
                world = MujocoWorld(self.scene, 0)
                self.assertFalse(world.health(world.get_state())[0])
                getattr(world._data, array)[[0, 3]] = bad, 1.0
                self.assertTrue(world.health(world.get_state())[0], f"{bad} in {array}")

    def test_bad_shapes_are_named(self):
        state = self.bench.start()
        for backend in self.both():
            with self.assertRaisesRegex(ValueError, r"joint_pos.*\(3, 5\).*\(4, 5\)"):
                backend.set_state(replace(state, joint_pos=state.joint_pos[:3]))
            with self.assertRaisesRegex(ValueError, "joint_target"):
                backend.set_joint_targets(state.joint_pos[:, :2])
            with self.assertRaisesRegex(ValueError, "substeps"):
                backend.step(0)
            with self.assertRaises(ValueError):
                backend.set_object_mass(torch.ones(3))
            with self.assertRaises(ValueError):
                backend.set_friction(torch.ones(4, 2))

    def test_setting_no_world_does_nothing(self):
        for backend in self.both():
            backend.set_state(self.bench.start())
            before = snapshot(backend.state())
            backend.set_state(self.bench.start()[[]], torch.tensor([], dtype=torch.long))
            torch.testing.assert_close(backend.state().object_pos, before.object_pos)


class Steps(unittest.TestCase):
    def test_the_forked_step_is_the_engine_s_in_either_order(self):
        """What runs beside each other may end in either order."""
        from xreset.backends.mujoco_warp_step import ForkedStep, constraints, finish, smooth_dynamics

        def reversed_step(m, d):
            constraints(m, d)
            smooth_dynamics(m, d)
            finish(m, d)

        results = []
        for step in (mujoco_warp.step, ForkedStep(warp.get_device("cpu")), reversed_step):
            with (
                mock.patch.object(mujoco_warp_backend, "engine_step", return_value=step),
                MujocoWarpBackend(scene(), 8) as backend,
            ):
                state = snapshot(backend.state())
                backend.set_state(replace(state, object_linvel=state.object_linvel + torch.tensor([0.3, 0.0, -0.5])))
                backend.set_object_com(
                    torch.tensor([0.01, 0.0, 0.0]).expand(8, 3)
                )  # a parameter that moves what positions lead to
                for target in torch.linspace(0.0, 0.3, 40):
                    backend.set_joint_targets(state.joint_target + target)
                    backend.step(2)
                now, contacts = snapshot(backend.state()), backend.contacts()
                results.append(
                    [getattr(now, f.name) for f in fields(now)]
                    + [contacts.tip_force.clone(), contacts.table_force.clone()]
                )
        self.assertGreater(float(results[0][-1].abs().max()), 0.1, "something touches")
        for other in results[1:]:
            for a, b in zip(results[0], other, strict=True):
                torch.testing.assert_close(a, b, rtol=0, atol=0)


class Limits(unittest.TestCase):
    def test_a_closed_backend_keeps_no_scene_alive(self):
        held = scene()
        seen = weakref.ref(held)
        with MujocoBackend(held, 2, workers=0) as backend:
            first, second = worlds(backend)
            self.assertIs(first._at, MujocoWorld(held, 0)._at)  # what is in use is compiled once
            self.assertIsNot(first._at, second._at)
        del held, backend, first, second
        gc.collect()
        self.assertIsNone(seen())

    def test_warp_counts_contacts_that_found_no_room(self):
        backend = MujocoWarpBackend(scene(), 4, object_index=torch.zeros(4, dtype=torch.long), contacts_per_world=1)
        backend.step(8)
        self.assertTrue(bool(backend.health().overflow.all()))  # the pool is everyone's
        state = snapshot(backend.state())
        state = replace(state, object_pos=state.object_pos + torch.tensor([0.0, 0.0, 1.0]))  # no contacts
        backend.set_state(state[[2]], torch.tensor([2]))
        self.assertEqual(backend.health().overflow.tolist(), [True, True, False, True])
        backend.set_state(state)
        backend.step(1)
        self.assertFalse(bool(backend.health().overflow.any()))

    def test_an_object_of_many_pieces_has_room_for_its_contacts(self):
        """Sixteen feet on the table: 256 rows of constraints."""
        feet = [
            shape("box", (0.002, 0.002, 0.005), (x, y, 0.0))
            for x in (-0.03, -0.01, 0.01, 0.03)
            for y in (-0.03, -0.01, 0.01, 0.03)
        ]
        standing = replace(scene(), objects=(solid("feet", 0.4, tuple(feet)),))
        for options, overflows in (({}, False), ({"constraints_per_world": 220}, True)):
            with MujocoWarpBackend(standing, 2, **options) as backend:
                backend.step(8)
                self.assertEqual(backend.health().overflow.tolist(), [overflows] * 2, options)

    def test_c_reports_the_engine_s_warnings_of_a_full_buffer(self):
        backend = MujocoBackend(scene(), 1, workers=0)
        step = mujoco.mj_step2

        def full(model, data):
            step(model, data)
            data.warning[int(mujoco.mjtWarning.mjWARN_CNSTRFULL)].number += 1

        with mock.patch.object(mujoco, "mj_step2", full):
            backend.step(1)
        self.assertTrue(bool(backend.health().overflow[0]))
        backend.step(1)
        self.assertTrue(bool(backend.health().overflow[0]), "it stays until the state is set")
        backend.set_state(snapshot(backend.state()))
        backend.step(1)
        self.assertFalse(bool(backend.health().overflow[0]))

    def test_closed(self):
        backend = MujocoWarpBackend(scene(), 1)
        backend.close()
        backend.close()
        for call in (backend.state, backend.step, backend.links, backend.contacts, backend.health):
            with self.assertRaisesRegex(XResetError, "closed"):
                call()

    @unittest.skipIf(torch.cuda.is_available(), "there is a CUDA device")
    def test_no_such_device(self):
        self.assertEqual(MujocoWarpBackend.devices(), ["cpu"])
        with self.assertRaisesRegex(BackendUnavailableError, "cpu"):
            MujocoWarpBackend(scene(), 1, device="cuda")

    def test_where_an_engine_runs(self):
        with mock.patch.object(MujocoWarpBackend, "devices", return_value=["cuda", "cpu"]):
            for device in ("cpu", "cuda", "cuda:1"):
                self.assertEqual(device_for("mujoco-warp", device), device)
                self.assertEqual(device_for("mujoco", device), "cpu")
            with self.assertRaisesRegex(BackendUnavailableError, "no device 'gpu'; expected cpu, cuda"):
                device_for("mujoco", "gpu")


if __name__ == "__main__":
    unittest.main()
