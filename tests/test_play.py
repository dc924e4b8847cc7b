"""A live episode, without a browser: every way in which a user can interfere."""

from contextlib import nullcontext
from unittest.mock import patch

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from tests.data import InFolder, refuses
from tests.test_view import send_value
from xreset.backends.mujoco import MujocoBackend
from xreset.backends.single import SingleWorld, _BatchWorld
from xreset.errors import XResetError
from xreset.eval.play.page import Page
from xreset.eval.play.record import write_film
from xreset.eval.play.session import AWAY, Session
from xreset.geometry.shapes import quat_of, turn_of
from xreset.geometry.urdf import link_meshes
from xreset.physics.plugins import backend_names, backend_status


class Played(InFolder):
    @classmethod
    def setUpClass(cls):
        cls.session = Session("many-objects")
        cls.addClassCleanup(lambda: cls.session.close())

    def setUp(self):
        super().setUp()
        self.session.random = np.random.default_rng(3)
        self.session.begin()

    def steps(self, seconds):
        """Let time pass; returns the last moment."""
        for _ in range(round(seconds / self.session.control_dt)):
            moment = self.session.step()
        return moment

    def test_the_object_follows_the_goal_beyond_the_time_limit(self):
        session = self.session
        moment = self.steps(4.0)
        self.assertLess(moment.distance, 0.05)
        session.move_goal(moment.goal_pos + np.array((0.08, 0.0, 0.0)), moment.goal_quat)
        self.assertGreater(session.step().distance, 0.05)
        moment = self.steps(3.0)
        self.assertGreater(moment.time - session.history[0].time, 6.5)  # trainings end after 6.4 s
        self.assertLess(moment.distance, 0.05)
        self.assertFalse(session.dropped)

    def test_the_object_is_at_its_goal_as_the_policy_s_task_has_it(self):
        """This one has the origin of an object in its middle, here far from the mesh's."""
        session = self.session
        middle = np.full(3, 0.2)
        with patch.dict(session.known, center=middle):
            session.begin()
        for angle in (0.25, 0.27):
            moment = session.step()
            turn = turn_of(moment.object_quat)
            turned = Rotation.from_rotvec((0.0, 0.0, angle)) * turn
            shift = turn.apply(middle) - turned.apply(middle)
            session.move_goal(moment.object_pos + shift + (0.0, 0.0, 0.019), quat_of(turned))
            moment = session.step()
            self.assertAlmostEqual(moment.distance, 0.019, delta=1e-3)
            self.assertEqual(moment.success, angle < 0.26)

    def test_a_goal_stays_above_the_table_and_within_reach(self):
        session = self.session
        obj = session.scene.objects[0]
        for pos in ((0.5, 0.3, -1.0), (9.0, -9.0, 9.0)):
            session.move_goal(pos, (2.0, 0.0, 0.0, 0.0))
            goal = session.goal_pos
            self.assertGreater(goal[2] + obj.vertices[:, 2].min(), -1e-6)
            self.assertLess(np.abs(goal).max(), 1.5)
        self.assertAlmostEqual(np.linalg.norm(session.goal_quat), 1.0, delta=1e-12)

    def test_the_object_is_pulled_and_let_go(self):
        session = self.session
        start = session.step().object_pos
        session.grab(None, start)
        session.pull(start + np.array((0.0, -0.1, 0.2)))
        self.assertGreater(self.steps(0.7).object_pos[2], start[2] + 0.1)
        session.release()
        top = np.add(self.steps(0.7).object_pos, (0.0, 0.0, 0.05))
        self.assertLess(top[2], start[2] + 0.1)
        session.grab(None, top)
        session.pull(np.add(top, (0.1, 0.0, 0.0)))
        _, force, torque = session._pulled()
        self.assertGreater(min(force[0], torque[1]), 0.0, "about y, from z to x")
        session.release()

    def test_a_force_at_the_arm_moves_it_as_far_as_its_drives_give_way(self):
        session = self.session
        link = "wrist_2_link"
        session.choose_policy("zero", robot=session.policy.robot.name)
        self.addCleanup(session.choose_policy, "many-objects")
        places = []
        for pull in ((0.0, 0.0, 0.0), (0.0, 0.2, 0.0)):
            at = session._kinematics.jacobian(self.steps(1.0).joint_pos, [link])
            session.grab(link, at.pos[0])
            session.pull(at.pos[0] + pull)
            self.steps(1.0)
            now = session.history[-1].joint_pos
            places.append(session._kinematics.points(now, [link])[0] - at.pos[0])
        self.assertLess(np.linalg.norm(places[0]), 1e-3)
        jacobian = at.linear[0]
        compliance = jacobian @ np.diag(1 / session._stiffness) @ jacobian.T
        spring = 500.0 * (np.array(pull) - places[1])
        assert_allclose(places[1], compliance @ spring, atol=3e-3, rtol=0.1)
        session.release()

    def test_the_object_is_taken_away_and_put_back(self):
        session = self.session
        self.steps(0.5)
        session.take_away()
        moment = self.steps(4.0)
        assert_allclose(moment.object_pos, AWAY, atol=1e-3)
        self.assertTrue(session.away and session.lost and not session.dropped)
        goal = moment.goal_pos + np.array((0.03, 0.0, 0.0))
        session.move_goal(goal, moment.goal_quat)
        session.begin(keep_goal=True)
        assert_allclose(session.step().goal_pos, goal, atol=1e-6)
        self.assertFalse(session.away or session.lost)
        self.assertLess(self.steps(4.0).distance, 0.1)  # 0.36 m in the beginning

    def test_what_falls_off_the_table_is_caught(self):
        session = self.session
        session.grab(None, session.step().object_pos)
        session.pull((0.57, -0.6, 0.3))
        self.steps(2.0)
        session.release()
        self.assertTrue(session.lost)
        self.steps(1.5)
        self.assertTrue(session.away and session.dropped)
        session.begin()
        self.assertFalse(session.away or session.lost)

    def test_another_engine_goes_on_at_the_same_state(self):
        session = self.session
        self.addCleanup(session.choose_engine, "mujoco")
        self.steps(2.0)
        for engine in (name for name in backend_names() if name not in ("mujoco", "mujoco-warp")):
            if backend_status(engine).reason:
                continue
            with self.subTest(engine=engine):
                before = session.world.state
                memory = session._controller._given["memory_in"]
                session.choose_engine(engine)
                for name, value in session.world.state.items():
                    assert_allclose(value, before[name], atol=1e-5, rtol=0, err_msg=name)
                self.assertIs(session._controller._given["memory_in"], memory)
                self.assertEqual(session.step().engine, engine)

    def test_the_only_world_of_an_engine_of_many_acts_as_a_world_in_numpy(self):
        session = self.session
        force = np.array((0.0, 0.5, 8.0))
        alone = SingleWorld("mujoco", session.scene, session.world.state)
        many = SingleWorld("mujoco", session.scene, session.world.state)
        self.addCleanup(alone.close)
        many.close()
        many._world = _BatchWorld(MujocoBackend(session.scene, 1))
        many.set_state(alone.state)
        self.addCleanup(many.close)
        for world in (alone, many):
            world.set_object_gravity(0.5)
            for _ in range(5):
                world.step(session.target, session.scene.substeps, force, 0.01 * force)
        self.assertGreater(alone.state["object_linvel"][2], 0.1)
        for name, value in alone.state.items():
            assert_allclose(many.state[name], value, atol=1e-4, rtol=0, err_msg=name)
        assert_allclose(many.tip_force, alone.tip_force, atol=1e-3)

    def test_what_cannot_be_used_changes_nothing(self):
        session = self.session
        self.steps(0.1)
        before = session.world.state
        goal = session.goal_pos
        for choose, name, words in (
            (session.choose_engine, "nosuch", "Unknown engine 'nosuch'"),
            (session.choose_object, "nosuch", "Unknown object 'nosuch'"),
            (session.choose_policy, "nosuch", "Unknown policy 'nosuch'"),
        ):
            with (
                patch("xreset.eval.play.session.Controller", side_effect=AssertionError),
                refuses(self, words, XResetError),
            ):
                choose(name)
        for name, value in session.world.state.items():
            assert_array_equal(value, before[name])
        assert_array_equal(session.goal_pos, goal)
        session.step()

    def test_a_broken_simulation_is_reset(self):
        session = self.session
        session.step()
        broken = np.full_like(session.world.state["joint_vel"], np.nan)
        session.world.set_state(session.world.state | {"joint_vel": broken})
        self.assertRaisesRegex(XResetError, "broke down. A new episode has begun", session.step)
        self.assertLess(self.steps(0.1).distance, 1.0)

    def test_no_message_of_a_visitor_ends_the_page(self):
        page = Page(self.session, port=8960)
        self.addCleanup(page.close)
        for control, value in (
            (page._speed, 0.0),
            (page._object, "nonsense"),
            (page._engine, "nonsense"),
            (page._policy, "/etc"),
            (page._robot_name, "/etc"),
        ):
            with self.subTest(value=value, control=control), patch.object(page, "_notify") as told:
                send_value(page, control, value)
                self.session.step()
                page._write()
                page.tick()
                told.assert_not_called()
        with patch.object(page, "_notify") as told:
            page._enqueue(self.session.grab, "no link", "nowhere")
            page._enqueue(page._move_goal, np.zeros(7), np.zeros(2))
            page.tick()
        self.assertEqual(told.call_count, 2)
        self.session.step()

    def test_another_robot_begins_with_its_own_policy_and_shape(self):
        """If no policy ships for the robot, it rests."""
        page = Page(self.session, port=8965)
        self.addCleanup(page.close)
        self.addCleanup(self.session.choose_policy, "many-objects")
        for robot, name in (
            ("openarm", "openarm"),
            ("panda-allegro", "panda-allegro"),
            ("openarm", "zero"),
            ("ur7e-sharpa", "many-objects"),
        ):
            rests = name == "zero"
            none = patch("xreset.eval.play.page.shipped_name", return_value=None)
            with self.subTest(robot, rests=rests):
                page._robot_name.value = robot
                with none if rests else nullcontext():
                    page._open_chosen()
                spec = self.session.policy.robot
                self.assertEqual((spec.name, self.session.policy.name), (robot, name))
                self.assertEqual(set(page._robot.links), set(link_meshes(spec)))
                self.assertEqual(page._policy.value, name)
                self.steps(0.5)
                targets = [moment.joint_target for moment in self.session.history]
                self.assertEqual(np.shape(targets)[1], len(spec.joints))
                self.assertEqual(np.ptp(targets, axis=0).any(), not rests)

    def test_film(self):
        session = self.session
        path = self.folder / "play.mp4"
        words = "Nothing has happened yet"
        self.assertRaisesRegex(XResetError, words, write_film, path, session)
        self.steps(0.5)
        write_film(path, session, seconds=0.2)
        self.assertEqual(path.read_bytes()[4:8], b"ftyp")
