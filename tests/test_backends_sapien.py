"""The PhysX backend."""

import itertools
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from unittest import TestCase, mock

import numpy as np
from numpy.testing import assert_allclose

from tests.engine_checks import EngineChecks
from xreset.backends.conformance import run
from xreset.backends.conformance.scene import gripper, objects, scene, shape, solid
from xreset.backends.rigid import friction_forces, mechanism
from xreset.backends.sapien import _PARTING_SPEED, SapienBackend, SapienWorld
from xreset.backends.sapien_robot import _couple, self_collision_bits
from xreset.errors import RobotError
from xreset.geometry.description import load_robot
from xreset.spec import GRAVITY, MimicSpec, SceneSpec


class SapienTest(EngineChecks, TestCase):
    backend_class = SapienBackend
    module = "sapien"

    def test_the_configuration_of_the_process_stays_as_it_was(self):
        from sapien import physx

        def configuration():
            scene_config = physx.get_scene_config()
            body = physx.get_body_config()
            shape = physx.get_shape_config()
            return (
                scene_config.gravity.tolist(),
                scene_config.enable_enhanced_determinism,
                body.solver_position_iterations,
                body.sleep_threshold,
                shape.contact_offset,
            )

        before = configuration()
        backend = self.make(scene())
        backend.step()
        backend.set_state(backend.state())
        self.assertEqual(configuration(), before)

    def test_a_mimic_joint_far_below_its_source_follows_it(self):
        robot = gripper()
        far = replace(
            robot,
            joints=tuple(j for j in robot.joints if j.name != "finger_b_bend"),
            mimics=(
                *robot.mimics,
                MimicSpec(joint="finger_b_bend", source="swing", multiplier=0.5),
            ),
        )
        (result,) = run(SapienBackend, robot=far, only=["mimic_joints"])
        # 0.002 rad through three links; alone it would stay
        self.assertLess(max(measure.measured for measure in result.measures), 4e-3)

    def world(self, what, robot=None):
        """A world with an object, without gravity."""
        world = SapienWorld(SceneSpec(robot=robot or gripper(), objects=(what,)), 0)
        world.force = world.torque = np.zeros(3)
        return world

    def put(self, world, pos):
        """Put the object at rest at a place."""
        home = world._mechanism.robot.home
        state = {"joint_pos": home, "joint_target": home, "joint_vel": np.zeros(len(home))}
        state["object_pos"] = np.array(pos)
        state["object_quat"] = np.array([1.0, 0.0, 0.0, 0.0])
        state["object_linvel"] = state["object_angvel"] = np.zeros(3)
        world.set_state(state)
        world.step(1)

    def test_rims_of_hulls_are_missed_in_metres(self):
        """By PhysX. Another unit of length hides this, and the suite finds it."""
        with (
            mock.patch("xreset.backends.sapien.LENGTH", 1.0),
            mock.patch("xreset.backends.sapien_robot.LENGTH", 1.0),
        ):
            (result,) = run(partial(SapienBackend, workers=0), only=["pressing"])
        failed = [measure.what for measure in result.measures if measure.verdict == "failed"]
        self.assertEqual(failed, ["rims that are missed"])

    def test_the_number_of_steps_before_a_reset_changes_no_bit(self):
        world = self.world(objects()[0], load_robot("openarm"))
        found = set()
        for before in (4, 5, 6):
            self.put(world, [0.6, 0.2, 0.3])
            world.step(3)
            found.add(world.get_state()["joint_vel"].tobytes())
            world.step(before)
        self.assertEqual(len(found), 1)

    def test_an_object_deep_in_the_table_rises_at_the_limit_and_comes_to_rest(self):
        world = self.world(solid("box", 0.4, (shape("box", (0.03, 0.02, 0.025)),)))
        world.force = np.array([0.0, 0.0, -0.4 * GRAVITY])
        self.put(world, [0.4, 0.0, 0.005])  # 20 mm too deep
        rise = world.get_state()["object_pos"][2] - 0.005
        self.assertLess(abs(rise / (_PARTING_SPEED * SceneSpec.timestep) - 1.0), 0.1)
        world.step(239)
        self.assertLess(abs(world.get_state()["object_pos"][2] - 0.025), 1e-5)

    def test_a_mimic_joint_on_another_branch_than_its_source_is_refused(self):
        def joint(parent, child):
            return SimpleNamespace(parent_link=parent, child_link=child, type="fixed")

        def link(name, parent):
            return SimpleNamespace(name=name, parent=parent)

        palm = link("palm", None)
        first = link("first", palm)
        second = link("second", palm)
        joints = {"a": joint(first, link("a", first)), "b": joint(second, link("b", second))}
        with self.assertRaisesRegex(RobotError, "'b' mimics 'a', but neither is below"):
            _couple(None, joints, MimicSpec(joint="b", source="a"), 1e-4)


class CollisionBitsTest(TestCase):
    def test_exactly_the_pairs_of_the_rule(self):
        robot = replace(
            gripper(),
            self_collision_links=("base", "column", "wrist", "jaw_a", "pad_b"),
            collision_exclude=(("base", "jaw_a"),),
        )
        mech = mechanism(robot)
        bits = self_collision_bits(mech)
        hits = []
        for a, b in itertools.permutations(robot.self_collision_links, 2):
            for partners in bits[b][1:]:  # of the copies of b
                if bits[a][0] & partners:
                    hits.append(frozenset((a, b)))
        # base and column are neighbours, wrist and jaw_a too; jaw_b is between wrist and pad_b.
        expected = {("base", "wrist"), ("base", "pad_b"), ("column", "wrist"), ("column", "jaw_a"), ("column", "pad_b"),
                    ("wrist", "pad_b"), ("jaw_a", "pad_b")}  # fmt: skip
        self.assertCountEqual(hits, {frozenset(pair) for pair in expected})
        self.assertCountEqual(map(frozenset, mech.colliding_links), hits)


class FrictionTest(TestCase):
    def test_forces_of_known_contacts_are_found(self):
        rng = np.random.default_rng(0)
        arms = rng.normal(size=(3, 3)) * 0.03
        normals = rng.normal(size=(3, 3))
        tangential = np.cross(normals, rng.normal(size=(3, 3)))
        force = tangential.sum(0)
        torque = np.cross(arms, tangential).sum(0)
        found = friction_forces(arms, normals, np.full(3, 0.8), force, torque)
        # three contacts: six unknowns, six equations
        assert_allclose(found, tangential, atol=1e-6)
