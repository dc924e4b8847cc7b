"""Grasps of other demonstrations: which poses and grasps are tried, what the arm reaches, what engines hold, and where the states show."""

import json
from dataclasses import replace
from unittest import TestCase
from unittest.mock import Mock, patch

import numpy as np
import torch
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from tests import toy_grasp
from tests.command import succeeds
from tests.data import InFolder
from tests.test_closing import ROBOT
from tests.toy_bank import in_this_process, shifted, toy_retargeted
from xreset import (
    SqueezeConfig,
    TransferConfig,
    make_bank,
    read_bank,
    write_bank,
    write_retargeted,
)
from xreset.backends.conformance.scene import objects
from xreset.files.progress import unseen
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.shapes import quat_of, turn_of
from xreset.physics import Health, State
from xreset.pictures.view.load import load_view
from xreset.resets.bank import starts_and_goals
from xreset.resets.distribution import ResetDistribution
from xreset.resets.grasps import losses
from xreset.resets.transfer import _lost, add_transfers
from xreset.retarget.file import read_retargeted
from xreset.robot_tools.verbs import judge
from xreset.task.config import ResetConfig

OBJECTS = objects()[:2]
BRICK, CAN = (spec.name for spec in OBJECTS)
LIFT, SWING, TURN, JAW = map(ROBOT.joint_names.index, ("lift", "swing", "turn", "jaw_a_slide"))
UPRIGHT = torch.tensor([1.0, 0, 0, 0])


def joints(lift, swing=0.0, turn=0.0):
    """The robot at home with its jaws around the brick, except for the arm, which has moved by these amounts."""
    moved = ROBOT.home.copy()
    moved[[LIFT, SWING, TURN]] += lift, swing, turn
    return moved


OTHER = [joints(*at) for at in ((0, -0.3), (0.05, -0.3, 0.1), (0.07, -0.3, 0.1), (0.09, -0.4, 0.2))]
"""Where the robot would hold the brick in the second demonstration, of which no frame is valid."""


def motion(*, first=(0.0, 0.04, 0.08)):
    """Three demonstrations: the robot lifts the brick; the robot does not follow the brick's second motion, nor the can.

    ``first`` is how far the brick is lifted in each frame of the first.
    """
    held = [joints(lift) for lift in first] + OTHER
    pos, quat = map(np.array, zip(*map(toy_grasp.brick_pose, held), strict=True))
    ends = np.cumsum([0, len(first), len(OTHER), 2])
    reason = np.ones(ends[-1], dtype=int)
    reason[: len(first)] = 0
    return toy_retargeted(
        ROBOT,
        [BRICK, BRICK, CAN],
        ends.tolist(),
        joint_pos=np.array([*held[: len(first)], *[ROBOT.home] * (len(OTHER) + 2)]),
        object_pos=np.vstack((pos, [[0.5, 0.3, 0.06], [0.5, 0.3, 0.26]])),
        object_quat_wxyz=np.vstack((quat, np.tile([1.0, 0, 0, 0], (2, 1)))),
        valid=reason == 0,
        reason=reason,
        first_contact=np.array([0, 0, 0]),
    )


def bank(data, jaw=(0.0, 0.0, 0.0), engines=("mujoco",)):
    """A bank of the frames of the first demonstration, whose jaws are told to go further in by ``jaw`` [m] in each."""
    count = len(jaw)
    targets = data.joint_pos[:count].copy()
    targets[:, JAW] -= jaw
    as_float = {
        "joint_pos": data.joint_pos[:count],
        "joint_target": targets,
        "object_pos": data.object_pos[:count],
        "object_quat_wxyz": data.object_quat_wxyz[:count],
    }
    return replace(
        starts_and_goals(data, ROBOT, OBJECTS),
        engines=engines,
        object_name=np.full(count, BRICK),
        sequence_index=np.zeros(count, dtype=np.int32),
        frame_index=np.arange(count, dtype=np.int32),
        post_contact=np.ones(count, dtype=bool),
        object_depth=np.zeros(count, dtype=np.float32),
        **{name: values.astype(np.float32) for name, values in as_float.items()},
    )


PRESSING = toy_grasp.OPEN - toy_grasp.CLOSED
"""Jaw targets this far in [m] press hard enough to hold the brick."""
FIRMLY = (PRESSING,) * 3


def added(base, data, *, progress=unseen, **config):
    """The bank with grasps of other demonstrations."""
    return add_transfers(
        base,
        data,
        ROBOT,
        OBJECTS,
        TransferConfig(**config),
        num_envs=64,
        device="cpu",
        progress=progress,
    )


def tried(base, data, *, verdicts=None, **config):
    """The new bank and every call of ``probe``; engines hold everything, or what ``verdicts`` tell, engine by engine."""
    calls = []

    def probe(engine, scene, object_name, states, judge, **options):
        calls.append((engine, scene, object_name, states, options))
        if verdicts is None:
            return np.full(len(object_name), -1)
        return np.where(verdicts[len(calls) - 1], -1, 0)

    with patch("xreset.resets.probe.probe", probe):
        return added(base, data, **config), calls


class TransferTest(TestCase):
    def setUp(self):
        self.data = motion()
        self.bank = bank(self.data, FIRMLY)

    def test_the_arm_carries_hand_and_object_to_poses_of_the_other_demonstration(self):
        found, _ = tried(self.bank, self.data)
        own = found.num_states - 6
        self.assertEqual(own, 3)
        for name in ("joint_pos", "joint_target", "object_pos", "frame_index", "sequence_index"):
            assert_array_equal(getattr(found, name)[:own], getattr(self.bank, name), name)
        self.assertEqual(found.transferred.tolist(), [False] * 3 + [True] * 6)
        new = found.with_states(~found.own_grasp)
        # two grasps in the air, at three poses; the first frame of the demonstration is not raised
        self.assertEqual(new.frame_index.tolist(), [1, 1, 2, 2, 3, 3])
        self.assertEqual(set(new.sequence_index.tolist()), {1})
        self.assertTrue(new.post_contact.all())
        self.assertEqual(set(new.object_name.tolist()), {BRICK})
        frames = 3 + new.frame_index
        assert_allclose(new.object_pos, self.data.object_pos[frames], atol=1e-6)
        assert_allclose(new.object_quat_wxyz, self.data.object_quat_wxyz[frames], atol=1e-6)
        assert_allclose(new.joint_pos, np.array(OTHER)[new.frame_index], atol=0.01)

    def test_targets_are_those_of_the_grasp_in_the_hand_and_joints_in_the_arm(self):
        base = bank(self.data, (0.001, 0.002, 0.003))
        base.targets[:, LIFT] += 0.1  # presses on nothing
        found, _ = tried(base, self.data)
        new = found.with_states(~found.own_grasp)
        arm = ROBOT.arm_indices
        assert_array_equal(new.targets[:, arm], new.joint_pos[:, arm])
        grasps = {base.targets[row, JAW] for row in (1, 2)}  # row 0 is not raised
        self.assertEqual(set(new.targets[:, JAW].tolist()), {float(jaw) for jaw in grasps})

    def test_poses_and_grasps_are_drawn_by_number_and_seed(self):
        for poses, per_pose, frames in (
            (1, 8, [1, 1]),
            (2, 1, [1, 3]),
            (99, 8, [1, 1, 2, 2, 3, 3]),
        ):
            with patch("xreset.resets.transfer._POSES", poses):
                found, _ = tried(self.bank, self.data, per_pose=per_pose)
            self.assertEqual(found.frame_index[3:].tolist(), frames)
        base = bank(self.data, (0.0, 0.002, 0.003))
        jaws = set()
        for seed in range(8):
            with patch.multiple("xreset.resets.transfer", _CANDIDATES=1, _SEED=seed):
                once, again = (tried(base, self.data)[0] for _ in range(2))
            self.assertEqual(once.num_states, 6)
            assert_array_equal(once.joint_target, again.joint_target)
            jaws.add(tuple(once.targets[3:, JAW].tolist()))
        self.assertGreater(len(jaws), 1)

    def test_each_demonstration_gets_grasps_of_the_others_only(self):
        """The second demonstration has grasps, too."""
        both = replace(self.bank, sequence_index=np.array([0, 1, 0], dtype=np.int32))
        found, _ = tried(both, self.data)
        new = found.with_states(~found.own_grasp)
        self.assertEqual(new.sequence_index.tolist(), [0, 0, 1, 1, 1])
        self.assertEqual(new.frame_index.tolist(), [1, 2, 1, 2, 3])

    def test_the_origin_of_a_mesh_may_be_anywhere(self):
        """This one goes down where the brick goes up and tilts."""
        shift = np.array([0.9, 0, 0])
        pos = self.data.object_pos - turn_of(self.data.object_quat_wxyz).apply(shift)
        self.assertLess(pos[6, 2], pos[3, 2])
        data = replace(self.data, object_pos=pos)
        plain, _ = tried(self.bank, self.data)
        with patch("tests.test_transfer.OBJECTS", [shifted(obj, shift) for obj in OBJECTS]):
            found, _ = tried(bank(data, FIRMLY), data)
        assert_array_equal(found.frame_index, plain.frame_index)
        assert_allclose(found.joint_pos, plain.joint_pos, atol=1e-5)

    def test_every_engine_of_the_bank_must_hold_it(self):
        base = replace(self.bank, engines=("one", "other"))
        first = [True, False, True, True, True, True]
        second = [False, True, False, True, True]
        found, calls = tried(base, self.data, verdicts=[first, second], per_pose=1)
        self.assertEqual([engine for engine, *_ in calls], ["one", "other"])
        states = calls[0][3]
        # the engines agree on the candidates 2, 4 and 5; 4 and 5 have one pose
        assert_array_equal(found.joint_pos[3:], states.joint_pos[[2, 4]])
        assert_array_equal(calls[1][3].joint_pos, states.joint_pos[first])
        self.assertEqual(found.frame_index[3:].tolist(), [2, 3])
        for _, scene, *_, options in calls:
            self.assertEqual([spec.name for spec in scene.objects], [BRICK])
            self.assertEqual((options["gravity"], options["steps"]), (1.0, 30))
        none, calls = tried(base, self.data, verdicts=[[False] * 6])
        self.assertEqual((none.num_states, len(calls)), (3, 1))
        self.assertFalse(none.transferred.any())

    def test_hardly_more_grasps_are_tried_than_a_pose_lacks(self):
        """The jaws of each grasp are a little deeper in the brick, which tells the grasps apart."""
        data = motion(first=(0.0, 0.03, 0.04, 0.05, 0.06, 0.07, 0.08))
        data.joint_pos[:7, JAW] -= 2e-4 + 1e-4 * np.arange(7)
        base = bank(data, (PRESSING,) * 7)
        found, calls = tried(base, data, per_pose=3)
        self.assertEqual([len(names) for _, _, names, *_ in calls], [15])  # 18 candidates
        self.assertEqual(found.frame_index[7:].tolist(), [1] * 3 + [2] * 3 + [3] * 3)
        progress = Mock()
        # of three candidates of each pose none holds, the last one, and each
        rounds = [[False] * 5 + [True] * 4, [False, True, True]]
        found, calls = tried(base, data, verdicts=rounds, per_pose=1, progress=progress)
        self.assertEqual(len(calls), 2, "only the first pose lacks a state after the first round")
        self.assertEqual(found.frame_index[7:].tolist(), [1, 2, 3])
        first, second = (states.joint_pos for *_, states, _ in calls)
        assert_array_equal(found.joint_pos[7:], torch.stack((second[1], first[5], first[6])))
        assert_allclose(found.object_depth[7:], 0.022 - 1.1 * found.joint_pos[7:, JAW], atol=1e-6)
        done = [call.args[0] for call in progress.call_args_list]
        self.assertEqual(done, sorted(done))

    def test_what_the_arm_does_not_reach_is_not_tried(self):
        pos = self.data.object_pos + np.array([0, 1, 0])
        found, calls = tried(self.bank, replace(self.data, object_pos=pos))
        self.assertEqual((found.num_states, calls), (3, []))
        column, wrist = Kinematics(ROBOT).points(torch.as_tensor(OTHER[2]), ["column", "wrist"])
        ahead = torch.nn.functional.normalize((wrist - column)[:2], dim=0).numpy()
        # the arm reaches no farther
        for off, frames in ((0.004, [1, 1, 2, 2, 3, 3]), (0.008, [1, 1, 3, 3])):
            pos = self.data.object_pos.copy()
            pos[5, :2] += off * ahead
            with patch("xreset.resets.transfer.object_depth", lambda *x: np.zeros(len(x[2]))):
                found, calls = tried(self.bank, replace(self.data, object_pos=pos))
            self.assertEqual(len(calls[0][2]), len(frames))
            self.assertEqual(found.frame_index[3:].tolist(), frames)

    def test_grasps_that_are_deep_in_the_object_are_not_tried(self):
        deep = self.bank.joint_pos.copy()
        deep[2, JAW] -= 0.003
        base = replace(self.bank, joint_pos=deep, object_depth=np.float32([0, 0, 0.003]))
        found, calls = tried(base, self.data)
        self.assertEqual(len(calls[0][2]), 3)
        self.assertEqual(found.frame_index[3:].tolist(), [1, 2, 3])
        self.assertEqual(found.object_depth.dtype, np.float32)
        assert_array_equal(found.object_depth[:3], base.object_depth)
        self.assertTrue((found.object_depth[3:] <= 0.002).all())

    def test_one_demonstration_of_each_object_gets_no_state(self):
        owners = np.array([BRICK, "bracket", CAN])
        data = replace(self.data, object_name=owners)
        found, calls = tried(replace(self.bank, sequence_object=owners), data)
        self.assertEqual((found.num_states, calls), (3, []))
        self.assertEqual(found.transferred.tolist(), [False] * 3)

    def test_none_are_added_without_a_grasp_in_the_air_that_presses(self):
        low = motion(first=(0.0, 0.019, 0.01))
        for name, base, data in (
            ("no state presses", bank(self.data), self.data),
            ("no object is raised", bank(low, FIRMLY), low),
        ):
            with self.subTest(name):
                self.assertIs(added(base, data), base)

    def test_a_grasp_that_does_not_hold_the_weight_is_left_out(self):
        """The grasp of frame 1 presses with a twentieth of the force of that of frame 2."""
        base = bank(self.data, (PRESSING, PRESSING / 20, PRESSING))
        progress = Mock()
        with in_this_process():
            found = added(base, self.data, progress=progress)
        new = found.with_states(~found.own_grasp)
        self.assertEqual(new.frame_index.tolist(), [1, 2, 3])
        assert_array_equal(new.targets[:, JAW], base.targets[[2, 2, 2], JAW])
        done, work = zip(*(call.args for call in progress.call_args_list), strict=True)
        self.assertEqual(list(done), sorted(done))
        self.assertEqual((done[-1], set(work)), (12, {12}))


class LossesTest(TestCase):
    def test_a_hand_that_is_no_jaw_has_the_grasps_of_the_bank(self):
        """The gripper could lift the brick in the second demonstration as in the first, and has no grasp of the can."""
        data = motion()
        own = bank(data, FIRMLY)
        found = losses(own, ROBOT, OBJECTS, progress=unseen)
        self.assertEqual(found.tolist(), ["", "", "no grasp"])
        transferred = replace(own, transferred=np.ones(3, dtype=bool))
        found = losses(transferred, ROBOT, OBJECTS, progress=unseen)
        self.assertEqual(found.tolist(), ["no grasp"] * 3)


class HeldTest(TestCase):
    def test_an_object_is_held_where_it_was(self):
        turned = quat_of(
            Rotation.from_rotvec(np.radians([0, 0, 14, 16, 0, 0, 0])[:, None] * [1, 0, 0])
        )
        moved = [0.019, 0.021, 0.0, 0.0, 0.0, 0.0, np.nan]
        pos = torch.zeros(7, 3)
        pos[:, 2] = torch.tensor(moved)
        com = np.array([0, 0.3, 0])  # from the mesh's origin, which a turn moves
        first = torch.tensor([0, -0.3, 0]).expand(7, 3)
        start = State.at_rest(torch.zeros(7, 1), first, UPRIGHT.expand(7, 4))
        pos -= torch.as_tensor(turn_of(turned).apply(com)).float()
        state = replace(start, object_pos=pos, object_quat=torch.as_tensor(turned).float())
        world = torch.arange(7)
        backend = Mock(object_index=torch.zeros(7, dtype=torch.long))
        backend.scene.objects = [Mock(com=com)]
        backend.state.return_value = state
        backend.health.return_value = Health(nonfinite=world == 4, overflow=world == 5)
        self.assertEqual(_lost(backend, start).tolist(), [-1, 0, -1, 0, 0, 0, 0])


class BankTest(InFolder):
    """A bank with transferred states, in a file and wherever its states are used."""

    def setUp(self):
        super().setUp()
        self.data = motion()
        self.bank = bank(self.data, FIRMLY)
        self.found, _ = tried(self.bank, self.data)

    def test_files_of_before(self):
        path = self.folder / "b.npz"
        self.assertEqual(self.found.own_grasp.tolist(), [True] * 3 + [False] * 6)
        write_bank(path, self.bank)
        with np.load(path) as file:
            arrays = dict(file)
        arrays["backends"] = arrays.pop("engines")  # as in files of 0.3
        np.savez(path, **arrays)
        old = read_bank(path)
        self.assertEqual(old.engines, self.bank.engines)
        self.assertIsNone(old.transferred)
        self.assertTrue(old.own_grasp.all())
        read, _ = tried(old, self.data)
        assert_array_equal(read.targets, self.found.targets)

    def test_states_between_frames_stay_marked(self):
        part = np.float32([0, 0.5, 0])
        found, _ = tried(replace(self.bank, frame_part=part), self.data)
        assert_array_equal(found.frame_part, [*part, *[0] * 6])
        self.assertEqual(found.frame_part.dtype, np.float32)
        self.assertIsNone(self.found.frame_part)

    def test_they_count_as_no_frames(self):
        self.assertEqual(self.found.accounts(), self.bank.accounts())
        self.assertEqual(self.found.accounts()[-1].kept, 3)

    def test_adaptive_resets_draw_them_for_the_demonstration_whose_pose_they_have(self):
        config = ResetConfig(demo_probability=1.0, adaptive_share=1.0)
        resets = ResetDistribution(self.found, ROBOT, (BRICK, CAN), config)
        drawn = resets.sample(torch.zeros(200, dtype=torch.long), torch.Generator().manual_seed(0))
        is_new = drawn.state >= 3
        self.assertEqual(set(drawn.sequence[is_new].tolist()), {1})
        self.assertEqual(set(drawn.sequence[~is_new].tolist()), {0})
        assert_allclose(drawn.goal_pos, self.bank.goal_pos[drawn.sequence], atol=1e-6)

    def test_a_robot_is_not_judged_by_them(self):
        with in_this_process():
            found, plain = (
                judge(each, ROBOT, OBJECTS, squeeze=SqueezeConfig(force=4.0))
                for each in (self.found, self.bank)
            )
        self.assertEqual([row.tried for row in found.rows], [row.tried for row in plain.rows])

    def test_the_viewer_names_them(self):
        write_bank(self.folder / "b.npz", self.found)
        with toy_grasp.found(OBJECTS):
            view = load_view(self.folder / "b.npz")
        self.assertNotIn("grasp of another demonstration", view.text(2))
        self.assertIn("grasp of another demonstration", view.text(3))


class CommandTest(InFolder):
    def setUp(self):
        super().setUp()
        self.enterContext(in_this_process())
        self.enterContext(toy_grasp.found(OBJECTS))
        self.motion = self.folder / "r.npz"
        write_retargeted(self.motion, motion())

    def resets(self, *options):
        path = self.folder / "b.npz"
        out = succeeds("resets", self.motion, "--out", path, *options)
        with np.load(path) as file:
            config = json.loads(str(file["meta"]))["config"]
        return read_bank(path), config, out

    def test_everything_at_once(self):
        press = "--closing.spacing None --squeeze.force 2.5"
        plain, config, out = self.resets(press, "--transfer.per-pose 0")
        self.assertNotIn("grasps of other", out)
        self.enterContext(patch("xreset.resets.transfer._POSES", 2))
        bank, config, out = self.resets(press, "--transfer.per-pose 1")
        self.assertEqual(config["transfer"], {"per_pose": 1})
        for words in (
            "3 states of 3 kept",
            "2 states in grasps of other demonstrations added, to 1 of 3 demonstrations",
            "in all states the robot is at most 0.0 mm deep in the object (0.0% over 2 mm)",
        ):
            self.assertIn(words, " ".join(out.split()))
        self.assertEqual(bank.frame_index[bank.transferred].tolist(), [1, 3])
        own = bank.with_states(bank.own_grasp)
        for name, values in vars(plain).items():
            if name != "transferred":
                assert_array_equal(getattr(own, name), values, name)
        data = read_retargeted(self.motion)
        again = make_bank(
            data,
            ROBOT,
            OBJECTS,
            closing=None,
            squeeze=SqueezeConfig(force=2.5),
            transfer=TransferConfig(per_pose=1),
        )
        assert_array_equal(again.joint_pos, bank.joint_pos)

    def test_the_defaults_are_those_of_the_headline_results(self):
        bank, config, _ = self.resets()
        self.assertEqual(config["closing"], {"spacing": 0.005})
        # the force for two fingertips; 5 N for more
        self.assertEqual(config["squeeze"], {"force": 20.0})
        transfer = {"per_pose": 8}
        self.assertEqual(config["transfer"], transfer)
        again = make_bank(read_retargeted(self.motion), ROBOT, OBJECTS)
        for name, values in vars(bank).items():
            assert_array_equal(getattr(again, name), values, name)
