"""Base placement: wrist poses that are within reach by construction are found so, and a robot that stands wrong is moved."""

import dataclasses
import os
import shutil
import tempfile
import unittest
from itertools import product
from pathlib import Path
from unittest import mock

import numpy as np
import torch

from xreset import robots
from xreset.description import DESCRIPTION
from xreset.description import load_robot as load
from xreset.errors import RobotError
from xreset.geometry.rotations import matrix_to_quat, quat_multiply
from xreset.plugins import robot_folder
from xreset.retarget.arm.config import ArmConfig
from xreset.retarget.arm.model import ArmModel, ArmTargets
from xreset.retarget.arm.paths import splice, spread_over
from xreset.retarget.arm.solve import track
from xreset.retarget.validity import Thresholds, classify
from xreset.robot_tools.check import check_description
from xreset.robot_tools.placement import Finalist, PlaceConfig, Placement, Reach, Search, write_placement

try:
    from xreset.robot_tools import place as placing
except ImportError as error:
    raise unittest.SkipTest(str(error)) from error

CONFIG = PlaceConfig(
    x=(0.2, 0.7), y=(0.4, 0.8), z=(0.4, 0.7), frames=10, final_frames=20, candidates=8, rounds=2, elite=1
)


def wrists_around_home(robot, count: int) -> ArmTargets:
    """Hand root poses that the robot takes with arm joints near home: all of them within reach."""
    model = ArmModel(robot)
    generator = torch.Generator().manual_seed(0)
    joints = torch.as_tensor(robot.home).repeat(count, 1)
    spread = torch.randn(count, len(robot.arm_indices), generator=generator, dtype=joints.dtype)
    joints[:, model.arm] = (joints[:, model.arm] + 0.15 * spread).clamp(model.lower, model.upper)
    root = model.kinematics.link_poses(joints, [robot.hand_root])
    return ArmTargets(
        root_pos=root[:, :, :3, 3],
        root_quat=matrix_to_quat(root[:, :, :3, :3]),
        hand_joints=joints[:, None, robot.hand_indices],
        annotated=torch.ones(count, 1, dtype=torch.bool),
        hand_error=torch.zeros(count, 1, dtype=joints.dtype),
        hand_clearance=torch.ones(count, 1, dtype=joints.dtype),
    )


def _die(_trial, status: int) -> None:
    os._exit(status)


class PlaceTest(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.robot = robots.load("openarm")
        cls.own = Placement(pos=cls.robot.base_pos, quat=cls.robot.base_quat)
        cls.wrists = wrists_around_home(cls.robot, 40)

    def test_reach_of_poses_within_reach_and_out_of_it(self):
        here = placing.reach(self.robot, self.own, self.wrists, CONFIG)
        self.assertGreater(here.reached, 0.95)
        self.assertGreater(here.dexterity, 0.1)
        far = Placement(pos=(0.45, 0.6, 3.0), quat=self.robot.base_quat)
        self.assertEqual(placing.reach(self.robot, far, self.wrists, CONFIG), Reach(reached=0.0, dexterity=0.0))

    def test_reach_moves_with_the_scene(self):
        """Turned about the vertical together, base and wrists keep their reach; the table's top is everywhere at the same height."""
        turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
        half = np.sqrt(0.5)
        quat = torch.tensor([half, 0, 0, half], dtype=torch.float64)
        moved = dataclasses.replace(
            self.wrists,
            root_pos=self.wrists.root_pos @ turn.T,
            root_quat=quat_multiply(quat.expand_as(self.wrists.root_quat), self.wrists.root_quat),
        )
        base = torch.tensor(self.own.pos, dtype=torch.float64)
        there = Placement(
            pos=tuple((turn @ base).tolist()),
            quat=tuple(quat_multiply(quat, torch.tensor(self.own.quat, dtype=torch.float64)).tolist()),
        )
        here = placing.reach(self.robot, self.own, self.wrists, CONFIG)
        self.assertAlmostEqual(placing.reach(self.robot, there, moved, CONFIG).reached, here.reached, delta=0.03)

    def test_a_robot_that_stands_wrong_is_moved_to_where_it_reaches(self):
        lost = dataclasses.replace(self.robot, base_pos=(0.45, 0.6, 3.0))
        seen = []
        avoid = self.wrists.root_pos[:, 0].numpy()
        found = placing.place(lost, [self.wrists], avoid, CONFIG, lambda done, best: seen.append((done, best.rank)))
        self.assertEqual((found.own.reach.reached, found.own.followed), (0.0, 0.0))
        self.assertGreater(found.best.reach.reached, 0.2)
        self.assertAlmostEqual(
            found.best.followed, found.best.reach.reached, delta=0.2
        )  # here, every path is one frame long
        self.assertEqual(found.frames, 40)
        self.assertGreaterEqual(np.linalg.norm(avoid - found.best.placement.pos, axis=1).min(), CONFIG.clear)
        self.assertEqual(seen, sorted(seen))  # the best yet never gets worse
        self.assertIsNone(found.home)  # home held the hand three metres up

    def test_a_placement_that_keeps_home_is_preferred(self):
        def home(robot, placement):
            homes.append(placement)
            return None if len(homes) == 1 else robot.home[robot.arm_indices]

        homes = []
        lost = dataclasses.replace(self.robot, base_pos=(0.45, 0.6, 3.0))
        with mock.patch.object(placing, "_home", home):
            config = dataclasses.replace(CONFIG, elite=2, candidates=16, rounds=1)
            found = placing.place(lost, [self.wrists], np.zeros((0, 3)), config)
        self.assertEqual(len(homes), 2)
        self.assertEqual(found.best.placement, homes[1])
        self.assertIsNotNone(found.home)

    def test_the_same_seed_finds_the_same_in_any_number_of_processes(self):
        small = dataclasses.replace(CONFIG, candidates=2, rounds=2)
        first, second = (placing.place(self.robot, [self.wrists], np.zeros((0, 3)), small, processes=n) for n in (1, 2))
        self.assertEqual((first.best, first.own), (second.best, second.own))

    def test_a_process_that_is_killed_is_an_error(self):
        trial = placing._Trial(
            robot=self.robot, config=CONFIG, tried=self.wrists, kept=self.wrists, paths=[self.wrists]
        )
        with self.assertRaisesRegex(RobotError, "was killed; is there memory"), placing._mapper(trial, 2) as each:
            list(each(_die, [9]))

    def test_a_candidate_that_cannot_come_in_is_given_up(self):
        whole = placing.reach(self.robot, self.own, self.wrists, CONFIG)
        self.assertEqual(placing.reach(self.robot, self.own, self.wrists, CONFIG, whole.rank[0]).rank[0], whole.rank[0])
        far = Placement(pos=(0.45, 0.6, 3.0), quat=self.robot.base_quat)
        given_up = placing.reach(self.robot, far, self.wrists, CONFIG, whole.rank[0])
        self.assertEqual(
            given_up.reached, 1 - placing._FIRST / 40
        )  # what was tried fails, what was not counts as reached
        self.assertLess(given_up.rank[0], whole.rank[0])

    def test_without_a_round_the_own_placement_is_measured(self):
        found = placing.place(self.robot, [self.wrists], np.zeros((0, 3)), dataclasses.replace(CONFIG, rounds=0))
        self.assertEqual((found.best, found.best.placement), (found.own, self.own))
        np.testing.assert_array_equal(found.home, self.robot.home[self.robot.arm_indices])

    def test_home_holds_the_hand_where_it_did(self):
        near = Placement(pos=(0.46, 0.61, 0.56), quat=self.robot.base_quat)
        home = placing._home(self.robot, near)
        moved = dataclasses.replace(self.robot, base_pos=near.pos)
        q = torch.tensor(self.robot.home)
        before = ArmModel(self.robot).kinematics.link_poses(q, ["palm"])
        q[self.robot.arm_indices] = torch.as_tensor(home)
        torch.testing.assert_close(ArmModel(moved).kinematics.link_poses(q, ["palm"]), before, atol=5e-3, rtol=0)

    def test_nothing_to_reach_is_an_error(self):
        none = self.wrists[torch.arange(0)]
        with self.assertRaisesRegex(RobotError, "no frame to reach"):
            placing.place(self.robot, [none], np.zeros((0, 3)), CONFIG)

    def test_a_search_without_room_ends(self):
        avoid = self.wrists.root_pos.numpy().reshape(-1, 3)
        with self.assertRaisesRegex(RobotError, "no place in the searched ranges is 9 m away.*Lower --search.clear"):
            placing.place(self.robot, [self.wrists], avoid, dataclasses.replace(CONFIG, clear=9.0))

    def test_parameters_of_a_placement_come_back(self):
        rng = np.random.default_rng(0)
        for _ in range(20):
            placement = placing._placement(
                np.array([*rng.uniform(-1, 1, 3), rng.uniform(-180, 180), rng.uniform(0, 180), rng.uniform(-180, 180)])
            )
            again = placing._placement(placing._parameters(placement))
            np.testing.assert_allclose(again.pos, placement.pos)
            self.assertAlmostEqual(abs(np.dot(again.quat, placement.quat)), 1.0, places=9)

    def test_single_frames_are_those_that_the_hand_follows(self):
        path = ArmTargets(**{name: value.view(2, 20, *value.shape[2:]) for name, value in vars(self.wrists).items()})
        error = torch.zeros(2, 20, dtype=torch.float64)
        error[0, 3] = 0.05
        annotated = torch.ones(2, 20, dtype=torch.bool)
        annotated[1, 19] = False
        frames = placing.single_frames([dataclasses.replace(path, hand_error=error, annotated=annotated)], 0.03)
        self.assertEqual(frames.root_pos.shape, (38, 1, 3))
        torch.testing.assert_close(frames.root_pos[3], self.wrists.root_pos[4])


class DirectionTest(unittest.TestCase):
    """Motions that the arm can follow from one of their ends, and not from the other."""

    @classmethod
    def setUpClass(cls):
        robot = robots.load("openarm")
        cls.model = ArmModel(robot)
        start = torch.as_tensor(robot.home)
        goal = start.clone()
        goal[cls.model.arm] += torch.tensor([0.9, -0.5, 0.6, 0.7, -1.2, 0.5, 0.6], dtype=start.dtype)
        way = torch.linspace(0, 1, 16, dtype=start.dtype)[:, None]
        joints = start + way * (goal - start)
        joints[:, cls.model.arm] = joints[:, cls.model.arm].clamp(cls.model.lower, cls.model.upper)
        root = cls.model.kinematics.link_poses(joints, [robot.hand_root])[:, 0]
        pos, quat = root[:, :3, 3].clone(), matrix_to_quat(root[:, :3, :3])
        pos[:6] += torch.tensor(
            [0.0, 1.0, -1.5], dtype=start.dtype
        )  # out of reach, where the arm gets stuck at its limits
        quat[:6] = torch.tensor([0.0, 0.0, 1.0, 0.0], dtype=start.dtype)
        cls.targets = ArmTargets(
            root_pos=pos[None],
            root_quat=quat[None],
            hand_joints=joints[None, :, robot.hand_indices],
            annotated=torch.ones(1, 16, dtype=torch.bool),
            hand_error=torch.zeros(1, 16, dtype=start.dtype),
            hand_clearance=torch.ones(1, 16, dtype=start.dtype),
        )

    def valid(self, targets: ArmTargets) -> int:
        thresholds = Thresholds(table_depth=1e9, self_depth=1e9)
        _, measures = track(self.model, targets, thresholds, ArmConfig(restarts=4, branches=1, collision_weight=0.0))
        return int((classify(measures, thresholds) == 0).sum())

    def test_both_ends_are_tried(self):
        self.assertGreaterEqual(self.valid(self.targets), 8)  # forwards alone: none
        self.assertGreaterEqual(self.valid(self.targets.reversed()), 8)

    def test_frames_between_two_bad_ends_are_found_from_the_middle(self):
        back = self.targets.root_pos.shape[1]
        pieces = (self.targets, self.targets.reversed())
        both = ArmTargets(
            **{
                name: torch.cat((getattr(pieces[0], name), getattr(pieces[1], name)), dim=1)
                for name in vars(self.targets)
            }
        )
        thresholds = Thresholds(table_depth=1e9, self_depth=1e9)
        valid = []
        for reseeds in (0, 2):
            config = ArmConfig(restarts=4, branches=1, collision_weight=0.0, reseeds=reseeds)
            _, measures = track(self.model, both, thresholds, config)
            valid.append(classify(measures, thresholds) == 0)
        self.assertEqual(int(valid[0].sum()), 0)
        self.assertGreaterEqual(int(valid[1].sum()), 16)
        self.assertTrue(bool(valid[1][0, back - 4 : back + 4].all()))


class SpliceTest(unittest.TestCase):
    """Two paths of one joint: one is good early, the other late."""

    def spliced(self, distance: float, **changes) -> list[float]:
        paths = torch.zeros(1, 2, 6, 1, dtype=torch.float64)
        paths[0, 1] = distance
        worth = torch.tensor([[[1.0, 1, 1, 0, 0, 0], [0, 0, 0, 1, 1, 1]]], dtype=torch.float64)
        annotated = torch.ones(1, 6, dtype=torch.bool)
        arguments = {
            "worth": worth,
            "cost": torch.zeros_like(worth),
            "annotated": annotated,
            "jump": 0.35,
            "switch_cost": 0.5,
        }
        return splice(paths, **(arguments | changes))[0, :, 0].tolist()

    def test_each_path_is_followed_where_it_is_good(self):
        self.assertEqual(self.spliced(0.2), [0, 0, 0, 0.2, 0.2, 0.2])

    def test_a_jump_is_worth_nothing_but_allows_the_rest(self):
        self.assertIn(self.spliced(1.0), ([0, 0, 0, 1, 1, 1], [0, 0, 1, 1, 1, 1]))
        self.assertEqual(len(set(self.spliced(1.0, switch_cost=2.5))), 1)

    def test_cost_counts_in_every_frame(self):
        cost = torch.zeros(1, 2, 6, dtype=torch.float64)
        cost[0, 1] = 0.9  # following the second one for three frames brings 3, and costs 2.7 and the switch
        self.assertEqual(self.spliced(0.2, cost=cost), [0.0] * 6)

    def test_against_all_combinations(self):
        generator = torch.Generator().manual_seed(0)
        paths = torch.rand(3, 3, 5, 2, generator=generator, dtype=torch.float64)
        worth = (torch.rand(3, 3, 5, generator=generator, dtype=torch.float64) > 0.5).double()
        cost = 0.3 * torch.rand(3, 3, 5, generator=generator, dtype=torch.float64)
        annotated = torch.rand(3, 5, generator=generator) > 0.3
        found = splice(paths, worth=worth, cost=cost, annotated=annotated, jump=0.5, switch_cost=0.2)
        for s in range(3):
            best, way = -np.inf, ()
            for chosen in product(range(3), repeat=5):
                value = 0.0
                for t, k in enumerate(chosen):
                    jumps = t > 0 and bool(
                        annotated[s, t - 1] & ((paths[s, k, t] - paths[s, chosen[t - 1], t - 1]).abs().max() > 0.5)
                    )
                    value += (
                        float(worth[s, k, t]) * (not jumps)
                        - float(cost[s, k, t])
                        - 0.2 * (t > 0 and chosen[t - 1] != k)
                    )
                if value > best:
                    best, way = value, chosen
            torch.testing.assert_close(
                found[s], torch.stack([paths[s, k, t] for t, k in enumerate(way)]), atol=0, rtol=0
            )

    def test_chosen_frames_are_spread_over_those_that_are_set(self):
        flags = torch.zeros(3, 20, dtype=torch.bool)
        flags[0, 4:14], flags[2, 7] = True, True
        rows, frames = spread_over(flags, 2)
        self.assertEqual((rows.tolist(), frames.tolist()), ([0, 0, 2], [6, 11, 7]))


class WritePlacementTest(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name) / "arm"
        shutil.copytree(robot_folder("openarm"), self.folder)
        self.file = self.folder / DESCRIPTION
        best = Finalist(
            placement=Placement(pos=(0.1, 0.2, 0.3), quat=(0.6, 0.0, 0.8, 0.0)),
            reach=Reach(reached=0.9123, dexterity=0.5),
            followed=0.8765,
        )
        own = Finalist(
            placement=Placement(pos=(0.45, 0.60, 0.55), quat=(0.38268343, 0.92387953, 0.0, 0.0)),
            reach=Reach(reached=0.8, dexterity=0.5),
            followed=0.75,
        )
        self.found = Search(best=best, own=own, home=np.linspace(-0.3, 0.4, 7), frames=321)

    def test_the_description_reads_back(self):
        before = load(self.folder)
        for _ in range(2):  # the second one replaces the first
            write_placement(self.file, before, self.found, 'xreset robots place openarm --demos "my demos.npz"')
            after = load(self.folder)
            self.assertEqual(
                (after.base_pos, after.base_quat), (self.found.best.placement.pos, self.found.best.placement.quat)
            )
            np.testing.assert_allclose(after.home[after.arm_indices], self.found.home, atol=1e-3)
            np.testing.assert_allclose(after.home[after.hand_indices], before.home[before.hand_indices])
            self.assertEqual(
                (after.placement.reached, after.placement.followed, after.placement.frames), (0.912, 0.876, 321)
            )
            self.assertIn('"my demos.npz"', after.placement.command)
        self.assertEqual([joint.drive for joint in after.joints], [joint.drive for joint in before.joints])

    def test_where_the_own_placement_is_best_only_its_figure_is_written(self):
        before, text = load(self.folder), self.file.read_text()
        write_placement(self.file, before, dataclasses.replace(self.found, best=self.found.own), r"a \\g<1> \b")
        after = load(self.folder)
        self.assertEqual(after.fingerprint, before.fingerprint)
        self.assertEqual((after.placement.followed, after.placement.command), (0.75, r"a \\g<1> \b"))
        without = "".join(
            line for line in self.file.read_text().splitlines(keepends=True) if not line.startswith("placement")
        )
        self.assertEqual(
            without, "".join(line for line in text.splitlines(keepends=True) if not line.startswith("placement"))
        )

    def test_the_figure_is_no_part_of_the_fingerprint(self):
        before = load(self.folder)
        stated = dataclasses.replace(before, placement=None).fingerprint
        lines = [line for line in self.file.read_text().splitlines() if not line.startswith("placement")]
        lines.insert(
            lines.index("[base]") + 1, "placement = { reached = 0.5, followed = 0.4, frames = 3, command = 'x' }"
        )
        self.file.write_text("\n".join(lines))
        self.assertEqual(load(self.folder).fingerprint, stated)
        findings = [finding.message for finding in check_description(self.folder)[1] if finding.topic == "placement"]
        self.assertEqual(findings, ["reaches 50.0% and follows 40.0% of 3 frames, says robot.toml: x"])

    def test_refusals(self):
        robot = load(self.folder)
        with self.assertRaisesRegex(RobotError, "Change the home of the arm's joints"):
            write_placement(self.file, robot, dataclasses.replace(self.found, home=None), "x")
        self.file.write_text(self.file.read_text().replace("pos = [", "position = ["))
        with self.assertRaisesRegex(RobotError, "edit it by hand"):
            write_placement(self.file, robot, self.found, "x")


if __name__ == "__main__":
    unittest.main()
