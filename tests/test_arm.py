"""Base placement: wrist poses within reach are found to be, and a robot in a wrong place is moved."""

import shutil
from dataclasses import replace
from itertools import product
from unittest import TestCase
from unittest.mock import patch

import numpy as np
import torch
from numpy.testing import assert_allclose
from torch import tensor
from torch.testing import assert_close
from torch.utils._python_dispatch import TorchDispatchMode

from tests.command import succeeds, xreset
from tests.data import InFolder, refuses
from tests.toy_retarget import FLOAT, arm_targets, double
from xreset import robots, synthesize, write_demos
from xreset.errors import RobotError
from xreset.geometry.description import load_robot as load
from xreset.geometry.kinematics import Kinematics
from xreset.physics.plugins import DESCRIPTION, robot_folder
from xreset.physics.tensors import one_thread
from xreset.retarget.arm.config import ArmSearch
from xreset.retarget.arm.model import ArmModel, ArmTargets
from xreset.retarget.arm.solve import (
    branches,
    solve,
    splice,
    spread_over,
    track,
)
from xreset.retarget.validity import Thresholds, classify
from xreset.robot_tools import place as placing
from xreset.robot_tools.placement import Finalist, PlaceConfig, write_placement
from xreset.robot_tools.verbs import place_robot

CONFIG = PlaceConfig(x=(0.2, 0.7), y=(0.4, 0.8), z=(0.4, 0.7), rounds=2)
NOWHERE = np.zeros((0, 3))


def wrists_around_home(robot, count):
    """Hand root poses that the robot takes with arm joints near home: all of them within reach."""
    model = ArmModel(robot)
    generator = torch.Generator().manual_seed(0)
    joints = torch.as_tensor(robot.home).repeat(count, 1, 1)
    spread = torch.randn(count, len(robot.arm_indices), generator=generator, dtype=joints.dtype)
    joints[:, 0, model.arm] = (joints[:, 0, model.arm] + 0.15 * spread).clamp(
        model.lower, model.upper
    )
    return arm_targets(model, joints)


class PlaceTest(InFolder):
    @classmethod
    def setUpClass(cls):
        cls.enterClassContext(patch.multiple(placing, _FRAMES=10, _ELITE=1, _CANDIDATES=8))
        cls.robot = robots.load("openarm")
        cls.lost = replace(cls.robot, base_pos=(0.45, 0.6, 3.0))
        cls.wrists = wrists_around_home(cls.robot, 40)
        cls.reached = placing.reach(cls.robot, cls.wrists)

    def test_reach_of_poses_within_reach_and_out_of_it(self):
        self.assertGreater(self.reached[0], 0.95)
        self.assertGreater(self.reached[1], 0.1)
        self.assertEqual(placing.reach(self.lost, self.wrists), (0.0, 0.0))

    def test_a_pose_that_is_missed_is_not_solved_again(self):
        """Other paths and frames of a sequence may help; a frame alone has the same solutions again. Its distances
        between the robot's shapes do not matter. A second thread would wait in a busy loop."""
        model = ArmModel(self.lost)
        measured = set()

        def clearance(poses):
            measured.add((len(poses), torch.get_num_threads()))
            return np.zeros(len(poses))

        with (
            patch("xreset.retarget.arm.solve.solve", wraps=solve) as solved,
            patch.object(model.arm_collision, "clearance", clearance),
        ):
            _, measures = track(model, self.wrists[:2], Thresholds())
        self.assertTrue(classify(measures, Thresholds()).all())
        solved.assert_called_once()
        self.assertEqual(measured, {(0, 1)})

    def test_a_robot_in_a_wrong_place_is_moved_to_where_it_reaches(self):
        seen = []
        wrists = self.wrists[:12]
        avoid = wrists.root_pos[:, 0].numpy()
        told = lambda *at: seen.append(at)  # noqa: E731
        best, own = placing.place(self.lost, [wrists], avoid, CONFIG, told)
        self.assertEqual((own.robot, own.reached, own.followed), (self.lost, 0.0, 0.0))
        self.assertGreater(best.reached, 0.2)
        # Every path is one frame long here.
        self.assertAlmostEqual(best.followed, best.reached, delta=0.2)
        self.assertEqual(best.frames, 12)
        self.assertGreaterEqual(
            np.linalg.norm(avoid - best.robot.base_pos, axis=1).min(), CONFIG.clear
        )
        self.assertEqual(seen, sorted(seen))
        # home held the hand three metres up
        self.assertEqual(best.home_rule, "the joints as they were")
        self.assertEqual(best.robot.joints, self.lost.joints)

    def test_a_placement_with_a_home_is_preferred(self):
        homes = [(self.lost, "as described"), (self.robot, "")]
        few = replace(CONFIG, rounds=1, clear=0.0)
        with (
            patch.object(placing, "_with_home", side_effect=homes),
            patch.object(placing, "_candidates", return_value=[self.robot]),
        ):
            found = placing.place(self.lost, [self.wrists[:8]], NOWHERE, few)
        self.assertEqual([finalist.robot for finalist in found], [self.lost, self.robot])
        self.assertGreater(found[1].followed, found[0].followed)

    def test_a_candidate_that_cannot_be_among_the_best_is_given_up(self):
        least = placing._rank(self.reached)[0]
        self.assertEqual(placing._rank(placing.reach(self.robot, self.wrists, least))[0], least)
        # What was tried fails, what was not counts as reached.
        self.assertEqual(placing.reach(self.lost, self.wrists, least)[0], 1 - placing._FIRST / 40)

    def test_without_a_round_the_own_placement_is_measured(self):
        found = placing.place(self.robot, [self.wrists], NOWHERE, replace(CONFIG, rounds=0))
        self.assertEqual([finalist.robot for finalist in found], [self.robot])

    def test_home_holds_the_hand_where_it_did(self):
        near = replace(self.robot, base_pos=(0.46, 0.61, 0.56))
        placed, rule = placing._with_home(near, self.robot)
        self.assertEqual(rule, "the hand where it was")
        before, after = (
            Kinematics(spec).link_poses(tensor(spec.home), ["palm"])
            for spec in (self.robot, placed)
        )
        assert_close(after, before, atol=5e-3, rtol=0)

    def test_the_base_keeps_clear_of_demonstrations_that_are_not_tried(self):
        demos = synthesize(["soup"], 4, seed=0)
        file = self.folder / "demos.npz"
        write_demos(file, demos)
        self.enterContext(patch("xreset.retarget.pipeline.wrist_paths", return_value=[]))
        with patch.object(placing, "place", side_effect=RobotError("found")) as place:
            xreset("robots place openarm --demos", file)
        frames = demos.hand_valid.sum() + len(demos.object_pos)
        self.assertEqual(place.call_args.args[2].shape, (frames, 3))

    def test_a_search_without_wrists_or_without_room_ends(self):
        none = self.wrists[torch.arange(0)]
        with self.assertRaisesRegex(RobotError, "no frame to reach"):
            placing.place(self.robot, [none], NOWHERE, CONFIG)
        below = np.array([[0.45, 0.6, 0.0]])
        upright = replace(self.robot, base_quat=(1.0, 0.0, 0.0, 0.0))
        with self.assertRaisesRegex(RobotError, "no place .* 0.35 m away"):
            placing.place(upright, [self.wrists], below, replace(CONFIG, clear=0.35))
        avoid = self.wrists.root_pos.numpy().reshape(-1, 3)
        with self.assertRaisesRegex(
            RobotError, "no place in the searched ranges is 9 m away.*Lower --search.clear"
        ):
            placing.place(self.robot, [self.wrists], avoid, replace(CONFIG, clear=9.0))

    def test_a_search_that_cannot_be_made_is_refused(self):
        for changes, words in (
            ({"clear": -1.0}, "clear is -1.0, expected a number from 0 to 1e15"),
            ({"x": (1.0, 0.0)}, "x is .*two finite numbers, the lower one first"),
            ({"z": (0.0, np.nan)}, "z is"),
        ):
            with refuses(self, words, ValueError):
                PlaceConfig(**changes)

    def test_parameters_of_a_placement_come_back(self):
        for parameters in (
            (0.1, -0.2, 0.3, 170.0, 40.0, -100.0),
            (0.0, 0.5, 0.0, -20.0, 179.0, 3.0),
        ):
            placed = placing._placed(self.robot, np.array(parameters))
            assert_allclose(placing._parameters(placed), parameters, atol=1e-6)

    def test_single_frames_are_those_that_the_hand_follows(self):
        path = self.wrists.map(lambda x: x.view(2, 20, *x.shape[2:]))
        path.hand_error[0, 3] = 0.05
        path.annotated[1, 19] = False
        frames = placing.single_frames([path], 0.03)
        self.assertEqual(frames.root_pos.shape, (38, 1, 3))
        assert_close(frames.root_pos[3], self.wrists.root_pos[4])


class Sizes(TorchDispatchMode):
    """Notes the memory of every tensor that is made [bytes]."""

    def __init__(self):
        super().__init__()
        self.found = []

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        made = function(*args, **(kwargs or {}))
        if isinstance(made, torch.Tensor):
            self.found.append(made.untyped_storage().nbytes())
        return made


class DirectionTest(TestCase):
    """Motions that the arm can follow from one of their ends, and not from the other."""

    @classmethod
    def setUpClass(cls):
        robot = robots.load("openarm")
        cls.model = ArmModel(robot)
        start = torch.as_tensor(robot.home)
        goal = start.clone()
        goal[cls.model.arm] += double([0.9, -0.5, 0.6, 0.7, -1.2, 0.5, 0.6])
        joints = start + torch.linspace(0, 1, 16, dtype=FLOAT)[:, None] * (goal - start)
        joints[:, cls.model.arm] = joints[:, cls.model.arm].clamp(cls.model.lower, cls.model.upper)
        cls.targets = arm_targets(cls.model, joints[None])
        # The first frames are out of reach, where the arm gets stuck at its limits.
        cls.targets.root_pos[:, :6] += double([0.0, 1.0, -1.5])
        cls.targets.root_quat[:, :6] = double([0.0, 0.0, 1.0, 0.0])

    def valid(self, targets, **changes):
        """[T] which frames the arm follows."""
        thresholds = Thresholds(table_depth=1e9, self_depth=1e9)
        config = ArmSearch(restarts=4, branches=1, collision_weight=0.0, **changes)
        return classify(track(self.model, targets, thresholds, config)[1], thresholds)[0] == 0

    def test_both_ends_are_tried(self):
        for targets in (self.targets, self.targets.reversed()):  # forwards alone: none of the first
            self.assertGreaterEqual(self.valid(targets, reseeds=0).sum(), 8)

    def test_restarts_of_the_first_frame_do_not_copy_the_others(self):
        problem = self.model.problem(self.targets, Thresholds(), ArmSearch(branches=1))
        with one_thread(), Sizes() as sizes:
            branches(problem)
        self.assertLess(max(sizes.found), 8 * problem.hand_poses.nbytes)

    def test_frames_between_two_bad_ends_are_found_from_the_middle(self):
        both = ArmTargets.cat((self.targets, self.targets.reversed()), dim=1)
        self.assertFalse(self.valid(both, reseeds=0).any())
        found = self.valid(both, reseeds=2)
        self.assertGreaterEqual(found.sum(), 16)
        self.assertTrue(found[12:20].all())


class SpliceTest(TestCase):
    def test_against_all_combinations(self):
        generator = torch.Generator().manual_seed(0)
        paths = torch.rand(1, 3, 5, 2, generator=generator, dtype=FLOAT)
        worth = (torch.rand(1, 3, 5, generator=generator, dtype=FLOAT) > 0.5).double()
        cost = 0.3 * torch.rand(1, 3, 5, generator=generator, dtype=FLOAT)
        annotated = torch.rand(1, 5, generator=generator) > 0.3
        found = splice(
            paths, worth=worth, cost=cost, annotated=annotated, jump=0.5, switch_cost=0.2
        )

        def value(chosen):
            way = tensor(chosen)
            frames = torch.arange(5)
            jumps = (paths[0, way, frames].diff(dim=0).abs().amax(-1) > 0.5) & annotated[0, :-1]
            switches = 0.2 * (way.diff() != 0).sum()
            return float(
                (worth - cost)[0, way, frames].sum()
                - switches
                - (worth[0, way, frames][1:] * jumps).sum()
            )

        best = tensor(max(product(range(3), repeat=5), key=value))
        assert_close(found[0], paths[0, best, torch.arange(5)], atol=0, rtol=0)

    def test_chosen_frames_are_spread_over_those_that_are_set(self):
        flags = torch.zeros(3, 20, dtype=torch.bool)
        flags[0, 4:14] = True
        flags[2, 7] = True
        rows, frames = spread_over(flags, 2)
        self.assertEqual((rows.tolist(), frames.tolist()), ([0, 0, 2], [6, 11, 7]))


class WritePlacementTest(InFolder):
    def setUp(self):
        super().setUp()
        self.folder /= "arm"
        shutil.copytree(robot_folder("openarm"), self.folder)
        self.file = self.folder / DESCRIPTION
        self.robot = load(self.folder)
        joints = list(self.robot.joints)
        for index, home in enumerate(np.linspace(-0.3, 0.4, 7)):
            joints[index] = replace(joints[index], home=float(home))
        place = {"base_pos": (0.1, 0.2, 0.3), "base_quat": (0.6, 0.0, 0.8, 0.0)}
        moved = replace(self.robot, joints=tuple(joints), **place)
        shares = {"reached": 0.9123, "dexterity": 0.5, "followed": 0.8765}
        rule = "the hand where it was"
        self.best = Finalist(robot=moved, frames=321, sequences=9, home_rule=rule, **shares)
        self.own = replace(self.best, robot=self.robot, followed=0.75, home_rule="as described")

    def write(self, best, command="x"):
        write_placement(self.file, self.robot, best, command)

    def lines(self, of_placement):
        """Lines of the description that are the figure of its placement, or those that are not."""
        lines = self.file.read_text().splitlines()
        return [line for line in lines if line.startswith("# Placement") == of_placement]

    def test_the_description_reads_back(self):
        for _ in range(2):  # the second one replaces the first
            self.write(self.best, 'xreset robots place openarm --demos "my demos.npz"')
            after = load(self.folder)
            best = self.best.robot
            self.assertEqual((after.base_pos, after.base_quat), (best.base_pos, best.base_quat))
            assert_allclose(after.home, best.home, atol=1e-7)
        line = '# Placement: reaches 91.2 % and follows 87.6 % of 321 frames: xreset robots place openarm --demos "my demos.npz"'
        self.assertEqual(self.lines(True), [line])
        for joint, before in zip(after.joints, self.robot.joints, strict=True):
            self.assertEqual(joint.drive, before.drive)

    def test_where_the_own_placement_is_best_only_its_figure_is_written(self):
        lines = self.lines(False)
        self.write(self.own, r"a \\g<1> \b")
        self.assertEqual(load(self.folder).fingerprint, self.robot.fingerprint)
        self.assertEqual(self.lines(False), lines)
        line = r"# Placement: reaches 91.2 % and follows 75.0 % of 321 frames: a \\g<1> \b"
        self.assertIn(line, self.lines(True))

    def test_a_placement_of_an_earlier_version_is_ignored_and_replaced(self):
        stated = 'placement = { reached = 0.9, followed = 0.8, frames = 3, command = "x" }'
        self.file.write_text(self.file.read_text().replace("[base]", f"[base]\n{stated}"))
        self.assertEqual(load(self.folder), self.robot)
        self.write(self.own)
        self.assertNotIn(stated, self.file.read_text())

    def test_the_command_shows_and_writes_the_best_placement(self):
        write_demos(f"{self.folder}/demos.npz", synthesize(["soup"], 1, seed=0))
        found = [self.best, self.own]
        with (
            patch("xreset.retarget.pipeline.wrist_paths", return_value=[]),
            patch.object(placing, "place", return_value=found) as place,
        ):
            command = ("robots place", self.folder, "--demos", f"{self.folder}/demos.npz")
            said = succeeds(*command, "--write --search.rounds 1")
        self.assertEqual(place.call_args.args[3], PlaceConfig(rounds=1))
        rows = r"87\.6%\W+91\.2%\W+0\.500\W+0\.1000, 0\.2000, 0\.3000[\s\S]*75\.0%"
        self.assertRegex(said, rows)
        exact = f"{1e3 * placing._POSITION:g} mm and {np.degrees(placing._ORIENTATION):g} degrees"
        self.assertIn(f"sample of their wrist poses, each on its own, to {exact}", said)
        self.assertIn(
            "xreset robots judge counts demonstrations that a rigid grasp can follow", said
        )
        self.assertEqual(load(self.folder).base_pos, self.best.robot.base_pos)
        self.assertIn("--write --search.rounds 1", self.lines(True)[0])

    def test_an_installed_robot_is_not_placed_anew(self):
        expected = r"openarm is an installed robot, .*\(cp -r .*openarm mine\), .* place the copy"
        with self.assertRaisesRegex(RobotError, expected):
            place_robot("openarm", "demos.npz", write=True)

    def test_refusals(self):
        with self.assertRaisesRegex(
            RobotError, r"no placement has a home. Put base.pos = \[0.1, 0.2, 0.3\]"
        ):
            self.write(replace(self.best, home_rule=""))
        self.file.write_text(self.file.read_text().replace("pos = [", "position = ["))
        words = r"Put base.pos = \[0.1, 0.2, 0.3\] .* and the arm's home = \[-0.3, -0.18333333, "
        self.assertRaisesRegex(RobotError, words, self.write, self.best)
