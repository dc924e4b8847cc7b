"""Goal sets: starts at rest, goals of each family within reach, and what is refused."""

from dataclasses import replace
from unittest import TestCase, mock
from unittest.mock import patch

import numpy as np
import torch
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from tests.command import succeeds
from tests.data import InFolder, InOneFolder, refuses
from tests.toy_bank import SOUP, SPAM, in_this_process, shifted, toy_retargeted
from tests.toy_goals import toy_goals
from tests.toy_robot import toy_robot
from xreset import load_object, load_policy, load_robot
from xreset.errors import DemoError, FileFormatError, GoalError, ObjectError
from xreset.eval.rollout import engine, load_trial, roll_out
from xreset.files.progress import unseen
from xreset.files.records import npz_schema
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.shapes import turn_of
from xreset.objects.rest import rest_height
from xreset.resets.bank import starts_and_goals
from xreset.resets.goals import (
    FAMILIES,
    SCHEMA,
    checked_goals,
    drawn_goals,
    read_goals,
    with_goals,
    write_goals,
)
from xreset.resets.inputs import load_inputs
from xreset.resets.reach import Reach
from xreset.resets.verbs import make_goals

BANANA = "011_banana"


class MadeTest(InOneFolder):
    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        cls.enterClassContext(in_this_process())
        cls.robot = load_robot("ur7e-sharpa")
        cls.banana = load_object(BANANA)
        zeros = {"START_OFFSET": np.zeros(3), "GOAL_OFFSET": np.zeros(4)}
        with patch.multiple("xreset.resets.goals", **zeros):
            cls.exact = make_goals(["banana"], robot=cls.robot, per_family=1)

    def centers(self, goals, which):
        """[S, 3] centres of mass."""
        turn = turn_of(getattr(goals, f"{which}_quat_wxyz"))
        return getattr(goals, f"{which}_pos") + turn.apply(self.banana.com)

    def test_starts_are_at_rest_and_goals_are_what_their_family_says(self):
        goals = self.exact
        self.assertEqual(goals.family.tolist(), list(FAMILIES))
        self.assertEqual(
            (goals.num_states, goals.object_names, goals.robot), (0, (BANANA,), "ur7e-sharpa")
        )
        assert_allclose(
            goals.start_pos[:, 2], rest_height(self.banana, goals.start_quat_wxyz), atol=2e-3
        )
        ups = turn_of(goals.start_quat_wxyz).inv().apply([0.0, 0.0, 1.0])
        self.assertLess((ups @ ups.T).min(), 0.9, "the banana rests on one side only")
        shift = self.centers(goals, "goal") - self.centers(goals, "start")
        assert_allclose(shift[:4], np.tile([0.0, 0.0, 0.2], (4, 1)), atol=1e-5)
        turn = turn_of(goals.goal_quat_wxyz) * turn_of(goals.start_quat_wxyz).inv()
        expected = np.radians(60) * np.array([[0.0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0]])
        assert_allclose(np.abs(turn.as_rotvec()[:4]), expected, atol=1e-5)

    def test_offsets_are_those_of_the_published_paper(self):
        options = {"robot": self.robot, "families": ["lift"], "per_family": 8}
        goals = make_goals(["banana"], **options)
        shift = self.centers(goals, "goal") - self.centers(goals, "start") - [0.0, 0.0, 0.2]
        self.assertTrue((np.abs(shift) <= [0.05, 0.05, 0.05]).all(), shift)
        self.assertTrue((np.ptp(shift, axis=0) > 0.01).all(), shift)
        turn = turn_of(goals.goal_quat_wxyz) * turn_of(goals.start_quat_wxyz).inv()
        assert_allclose(turn.as_rotvec()[:, :2], 0.0, atol=1e-5)
        self.assertTrue(10 < np.degrees(turn.magnitude()).max() <= 55)
        with patch("xreset.resets.goals.START_OFFSET", np.zeros(3)):
            middle = make_goals(["banana"], **options)
        moved = self.centers(goals, "start") - self.centers(middle, "start")
        turn = turn_of(middle.start_quat_wxyz)
        moved[:, 2] = (turn_of(goals.start_quat_wxyz) * turn.inv()).as_rotvec(degrees=True)[:, 2]
        most = np.abs(moved).max(axis=0) / [0.02, 0.02, 25.0]
        self.assertTrue(((most > 0.5) & (most < 1.0001)).all(), most)
        self.assertEqual(len(np.unique(middle.start_quat_wxyz.round(3), axis=0)), 8, "any turn")

    def test_goals_are_above_the_table_and_grasps_turn_with_the_object(self):
        turns = []

        def holds(_, start, goal, turn):
            turns.append(turn)
            return np.ones(len(start), dtype=bool)

        self.enterContext(patch.object(Reach, "holds", holds))
        offsets = {"START_OFFSET": np.zeros(3), "GOAL_OFFSET": np.array([0.0, 0.0, 0.5, 0.0])}
        with patch.multiple("xreset.resets.goals", **offsets):
            goals = make_goals(["banana"], robot=self.robot, families="tilt-x", per_family=8)
        lowest = rest_height(self.banana, goals.goal_quat_wxyz)
        self.assertTrue((goals.goal_pos[:, 2] >= lowest - 1e-6).all())
        self.assertGreater(len(turns), 1, "some were drawn again")
        other = replace(goals, robot_fingerprint="another")
        checked_goals("goals", other, self.robot, [self.banana])
        for turn in turns:  # about the world's x axis
            expected = np.tile(np.radians([60.0, 0, 0]), (len(turn), 1))
            assert_allclose(np.abs(turn.as_rotvec()), expected, atol=1e-5)

    def test_the_origin_of_a_mesh_may_be_anywhere(self):
        shift = np.array([2.0, 1.0, -3.0])
        moved = shifted(self.banana, shift)
        options = {"per_family": 2, "upright": False, "seed": 0, "progress": unseen}
        found = drawn_goals([moved], self.robot, "yaw", (), **options)
        expected = drawn_goals([self.banana], self.robot, "yaw", (), **options)
        for which in ("start", "goal"):
            turn = turn_of(getattr(found, f"{which}_quat_wxyz"))
            place = self.centers(found, which) + turn.apply(shift)
            assert_allclose(place, self.centers(expected, which), atol=2e-3)

    def test_an_object_that_does_not_come_to_rest_is_refused(self):
        def falling(*given):
            return *given[3:], np.zeros(len(given[2]), dtype=bool)

        with (
            patch("xreset.resets.settle.settled", falling),
            self.assertRaisesRegex(GoalError, "banana does not come to rest on the table"),
        ):
            make_goals(["banana"], robot=self.robot)

    def test_impossible_goals_are_refused(self):
        for error, message, options in (
            (
                GoalError,
                "banana: the goal is .* cm inside the table",
                {"poses": [(0.5, 0.3, 0.0, 1, 0, 0, 0)]},
            ),
            (
                GoalError,
                r"cannot reach 1 of 1 goals .* own_000",
                {"poses": [(1.9, 0.3, 0.3, 1, 0, 0, 0)]},
            ),
            (GoalError, r"pose \(0.5, 0.3, 0.2\) is not a pose", {"poses": [(0.5, 0.3, 0.2)]}),
            (GoalError, "pose 0.5 is not a pose", {"poses": (0.5, 0.3, 0.2, 1, 0, 0, 0)}),
            (GoalError, "Unknown family 'turn'. Choose from: lift, ", {"families": "turn"}),
            (GoalError, "No family is named", {"families": []}),
        ):
            with (
                mock.patch("xreset.resets.goals._DRAWS", 2),
                refuses(self, message, error),
            ):
                make_goals(["banana"], robot=self.robot, **options)
        with self.assertRaisesRegex(ObjectError, "011_banana is given twice"):
            make_goals(["banana", "011_banana"], robot=self.robot)

    def test_a_given_goal_may_be_a_little_inside_the_table(self):
        low = rest_height(self.banana, np.array([1.0, 0, 0, 0])) - 0.004
        poses = np.array([[0.6, 0.25, low, 1, 0, 0, 0]])
        goals = make_goals(["banana"], robot=self.robot, poses=poses)
        assert_allclose(goals.goal_pos, poses[:, :3], atol=1e-6)

    def test_the_command_draws_what_its_options_say(self):
        pose = (0.6, 0.25, 0.3, 1, 0, 0, 0)
        file = self.folder / "goals.npz"
        options = ("--family yaw --family yaw --per-family 2 --seed 3 --pose", *pose)
        said = succeeds("goals banana --robot ur7e-sharpa --out", file, *options)
        self.assertIn("3 goals of 1 object (2 yaw, 1 own)", said)
        expected = make_goals(
            ["banana"], robot=self.robot, families=["yaw"], poses=[pose], per_family=2, seed=3
        )
        assert_allclose(read_goals(file).goal_pos, expected.goal_pos)
        own = np.concatenate((expected.goal_pos[2], expected.goal_quat_wxyz[2]))
        assert_allclose(own, pose, atol=1e-6)


class ReachTest(TestCase):
    def test_grasps_that_are_tried(self):
        """They hold the object between thumb and fingers, not below 5 cm, and turn with it."""
        robot = load_robot("ur7e-sharpa")
        hand = Kinematics(robot, root=robot.hand_root)
        thumb, *fingers = hand.points(hand.home, [tip.link for tip in robot.fingertips]).numpy()
        between = (thumb + np.mean(fingers, axis=0)) / 2
        roots = []

        def reach_poses(_model, root, *_):
            roots.append(root.numpy())
            return None, torch.zeros(len(root))

        start = np.array([[0.5, 0.3, 0.02]])
        goal = np.array([[0.6, 0.2, 0.3]])
        turn = Rotation.from_rotvec([[0.3, -0.2, 0.5]])
        with patch("xreset.resets.reach.reach_poses", reach_poses):
            self.assertTrue(Reach(robot).holds(start, goal, turn).all())
        at_start, at_goal = roots
        for root, place in ((at_start, [0.5, 0.3, 0.05]), (at_goal, goal[0])):
            found = root[:, :3, :3] @ between + root[:, :3, 3]
            assert_allclose(found, np.tile(place, (15, 1)), atol=1e-9)
        assert_allclose(at_goal[:, :3, :3], turn.as_matrix() @ at_start[:, :3, :3], atol=1e-9)
        heights = (at_start[::5, :3, :3] @ between)[:, 2]
        self.assertTrue(heights[1] < heights[0] < heights[2], "fingers further down, and up")

    def test_every_grasp_is_tried_for_every_object(self):
        """Fifteen grasps, of which the arm reaches none; two at a time for seven objects."""
        tried = []

        def reach_poses(_model, root, *_):
            tried.append(root.numpy().reshape(count, -1, 4, 4)[..., :3, :3])
            return None, torch.ones(len(root))

        with patch("xreset.resets.reach.reach_poses", reach_poses):
            for count in (1, 7):
                place = np.full((count, 3), 0.3)
                held = Reach(load_robot("ur7e-sharpa")).holds(
                    place, place, Rotation.identity(count)
                )
                self.assertFalse(held.any())
        alone = tried.pop(0)
        assert_allclose(np.concatenate(tried, axis=1), np.tile(alone, (7, 1, 1, 1)), atol=1e-9)

    def test_how_far_an_arm_stretches(self):
        """The toy's arm, whose last joint slides by up to 0.3 m, and its hand."""
        robot = toy_robot()
        hand = Kinematics(robot, root=robot.hand_root)
        thumb, finger = hand.points(hand.home, [tip.link for tip in robot.fingertips])
        center = float((thumb + finger).norm()) / 2
        links = sum(
            map(np.linalg.norm, ([0, 0, 0.2], [0.02, 0.05, 0], [0.3, 0, 0.1], [0, 0.1, 0.05]))
        )
        stretched = center + links + 0.3 + 0.02
        places = np.array(robot.base_pos) + np.outer(
            stretched + np.array([-1e-6, 1e-6]), [0, 0.6, 0.8]
        )
        self.assertEqual(Reach(robot).stretches_to(places).tolist(), [True, False])


class UsedTest(InFolder):
    robot = load_robot("ur7e-sharpa")

    def test_an_evaluation_plays_the_starts_and_goals_of_the_file(self):
        goals = toy_goals(self.robot)
        write_goals(f"{self.folder}/goals.npz", goals)
        self.assertEqual(npz_schema(f"{self.folder}/goals.npz"), SCHEMA)
        assert_array_equal(read_goals(f"{self.folder}/goals.npz").family, goals.family)
        policy = load_policy("zero", robot="ur7e-sharpa")
        trial = load_trial(policy, self.folder / "goals.npz", episode_seconds=0.1)
        rollouts = roll_out(policy.start(None), engine("mujoco", workers=0), trial, episodes=1)
        self.assertEqual([e.sequence_name for e in rollouts.episodes], goals.sequence_name.tolist())
        for i, trace in enumerate(rollouts.traces):
            assert_allclose(trace.object_pos[0], goals.start_pos[i], atol=1e-6)
            assert_allclose(trace.goal_pos, goals.goal_pos[i], atol=1e-6)
            assert_allclose(
                trace.object_pos[-1], goals.start_pos[i], atol=2e-3, err_msg="it is not at rest"
            )
        with self.assertRaisesRegex(DemoError, "is a goal set, which holds no motion"):
            load_trial(load_policy("ik", robot="ur7e-sharpa"), goals)

    def test_what_a_bank_says_of_its_objects_counts_before_what_goals_say(self):
        """The bank has the spam alone, which has no friction of its own."""
        spam = replace(load_object(SPAM), mass=0.5, friction=None)
        bank = starts_and_goals(toy_retargeted(self.robot, [SPAM], [0, 2]), self.robot, [spam])
        stated = {"object_mass": np.array([0.3, 0.4]), "object_friction": np.array([0.6, 0.7])}
        both = with_goals(bank, toy_goals(self.robot, **stated))
        self.assertEqual(both.object_names, (SOUP, SPAM))
        assert_array_equal((both.object_mass, both.object_friction), ([0.3, 0.5], [0.6, 0.0]))

    def test_another_robot_must_reach_the_goals_too(self):
        goals = load_inputs(toy_goals(load_robot("openarm")), robot=self.robot).data
        self.assertEqual((goals.robot, goals.joint_names), ("ur7e-sharpa", self.robot.joint_names))
        far = toy_goals(load_robot("openarm"))
        far.goal_pos[2] = (1.9, 0.3, 0.3)
        with self.assertRaisesRegex(
            GoalError,
            "1 of 2 goals of 010_potted_meat_can are out of the reach of ur7e-sharpa, such as .*lift_002",
        ):
            load_inputs(far, robot=self.robot)

    def test_what_does_not_fit_is_refused(self):
        low = toy_goals(self.robot).goal_pos - np.float32([0, 0, 0.25])
        high = toy_goals(self.robot).start_pos + np.float32([0, 0, 0.03])
        far = toy_goals(self.robot).goal_pos
        far[1] = (1.9, 0.3, 0.3)
        for error, message, changes in (
            (GoalError, f"{SOUP}/lift_000: the goal is 5.0 cm inside the table", {"goal_pos": low}),
            (GoalError, "starts 3.0 cm above the table", {"start_pos": high}),
            (
                GoalError,
                f"1 of 2 goals of {SOUP} are out of the reach of ur7e-sharpa, such as .*lift_001",
                {"goal_pos": far},
            ),
            (
                FileFormatError,
                "an imported mesh of 005_tomato_soup_can, .* or make it again",
                {"object_sources": ("abc", "stand-in")},
            ),
        ):
            with refuses(self, message, error):
                load_inputs(toy_goals(self.robot, **changes))
