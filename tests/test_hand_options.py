"""The options of hand retargeting that are off by default: the user's hand brought to the robot's size, and grasps that are held."""

import dataclasses
import tempfile
import unittest
from pathlib import Path
from unittest import mock

import numpy as np
import torch
import tyro

from tests.test_retarget import FAR_OBJECT, FLOAT
from tests.toy_robot import toy_hand_arm, toy_motion
from xreset import robots
from xreset.geometry.rotations import quat_from_axis_angle, quat_multiply, quat_rotate, quat_rotate_inverse
from xreset.retarget.hand import cost
from xreset.retarget.hand import solve as hand
from xreset.retarget.hand.cost import system
from xreset.retarget.hand.hold import hold
from xreset.retarget.hand.model import HandModel, finger_keypoints
from xreset.retarget.hand.problem import HandState
from xreset.retarget.hand.scale import hand_scale, resized
from xreset.retarget.hand.solve import HandConfig, HandTargets, retarget_hand
from xreset.spec import KEYPOINTS

S, T = 3, 12
BOTH = HandConfig(user_scale=True, hold_weight=10.0)


class Scene(unittest.TestCase):
    """Three motions of the toy hand, a human hand that moves just so, and an object that flies and turns with it."""

    @classmethod
    def setUpClass(cls):
        cls.robot = toy_hand_arm(Path(cls.enterClassContext(tempfile.TemporaryDirectory())))
        cls.model = HandModel(cls.robot)
        cls.generator = torch.Generator().manual_seed(3)
        cls.state = toy_motion(cls.model, cls.generator, margin=0.2, turn=0.6)
        cls.keypoints = cls.model.keypoints(**vars(cls.state))
        cls.tips = [cls.model.names.index(name) for name in ("thumb4", "index4")]

    def targets(self, **changes) -> HandTargets:
        """What the hand should follow: fingertips touch in frames 3 to 9; the object goes with the root, and turns."""
        turn = quat_from_axis_angle(torch.tensor([0.1, 0.05, -0.08], dtype=FLOAT) * torch.arange(T, dtype=FLOAT)[:, None])
        touches = torch.zeros(S, T, len(self.model.names), dtype=torch.bool)
        touches[:, 3:10, self.tips] = True
        values = {
            "keypoints": self.keypoints,
            "annotated": torch.ones(S, T, dtype=torch.bool),
            "contact_points": self.keypoints,
            "in_contact": touches,
            "object_pos": self.state.root_pos + torch.tensor([0.4, 0.1, 0.0], dtype=FLOAT),
            "object_quat": turn.expand(S, T, 4),
            "object_index": torch.zeros(S, dtype=torch.long),
            "fields": FAR_OBJECT.field,
        }
        return HandTargets(**(values | changes))

    def shaky(self) -> torch.Tensor:
        """The keypoints, each 3 mm off in every frame in a direction of its own."""
        generator = torch.Generator().manual_seed(4)
        return self.keypoints + 0.003 * torch.randn(self.keypoints.shape, dtype=FLOAT, generator=generator)


class OptionsTest(Scene):
    def test_both_are_off_unless_asked_for_and_then_nothing_of_them_runs(self):
        with mock.patch.object(cost, "hold", side_effect=AssertionError), mock.patch.object(hand, "hand_scale", side_effect=AssertionError):
            retarget_hand(self.model, self.targets())
            for config in (HandConfig(hold_weight=1.0), HandConfig(user_scale=True)):
                with self.assertRaises(AssertionError):
                    retarget_hand(self.model, self.targets(), config)

    def test_the_command_line_has_them(self):
        self.assertEqual(tyro.cli(HandConfig, args=["--user-scale", "--hold-weight", "10"]), BOTH)

    def test_order_and_company_of_sequences_do_not_matter(self):
        size = torch.tensor([0.8, 1.0, 1.2], dtype=FLOAT)[:, None, None, None]
        targets = self.targets(keypoints=self.shaky() * size)
        together = retarget_hand(self.model, targets, BOTH)
        order = torch.tensor([2, 0, 1])
        permuted = retarget_hand(self.model, targets.select(order), BOTH)
        torch.testing.assert_close(permuted.joints, together.joints[order], atol=1e-9, rtol=0)
        for i in range(S):
            alone = retarget_hand(self.model, targets.select(torch.tensor([i])), BOTH)
            torch.testing.assert_close(alone.joints[0], together.joints[i], atol=1e-9, rtol=0)

    def test_they_move_with_the_scene(self):
        """A rigid motion of everything moves the hand with it, far above the table, which does not move."""
        turn = quat_from_axis_angle(torch.tensor([0.4, 0.2, -1.0], dtype=FLOAT))
        shift = torch.tensor([0.3, -0.1, 1.2], dtype=FLOAT)
        here = self.targets(keypoints=1.1 * self.shaky())
        there = dataclasses.replace(
            here,
            keypoints=quat_rotate(turn, here.keypoints) + shift,
            contact_points=quat_rotate(turn, here.contact_points) + shift,
            object_pos=quat_rotate(turn, here.object_pos) + shift,
            object_quat=quat_multiply(turn.expand_as(here.object_quat), here.object_quat),
        )
        still, moved = retarget_hand(self.model, here, BOTH), retarget_hand(self.model, there, BOTH)
        torch.testing.assert_close(still.cost, moved.cost, atol=0, rtol=1e-6)
        torch.testing.assert_close(still.joints, moved.joints, atol=1e-6, rtol=0)
        torch.testing.assert_close(quat_rotate(turn, still.root_pos) + shift, moved.root_pos, atol=1e-6, rtol=0)

    @unittest.skipUnless(torch.cuda.is_available(), "needs a CUDA device")
    def test_a_gpu_finds_the_same_motion(self):
        targets = self.targets(keypoints=1.1 * self.shaky())
        cpu, gpu = (retarget_hand(HandModel(self.robot, device=device), targets, BOTH) for device in ("cpu", "cuda"))
        torch.testing.assert_close(gpu.joints, cpu.joints, atol=1e-4, rtol=0)


class UserScaleTest(Scene):
    FACTORS = torch.tensor([0.8, 1.0, 1.3], dtype=FLOAT)

    def users(self) -> torch.Tensor:
        """Keypoints of users whose hands are that many times smaller than the toy's, about the wrist."""
        wrist = self.keypoints[:, :, :1]
        return wrist + (self.keypoints - wrist) / self.FACTORS[:, None, None, None]

    def test_recovers_a_known_scale_whatever_the_posture_and_the_frames_without_annotation(self):
        annotated = torch.ones(S, T, dtype=torch.bool)
        annotated[:, :2] = annotated[1, 7:] = False
        users = self.users()
        users[~annotated] = 1e3 * torch.randn(users[~annotated].shape, dtype=FLOAT, generator=self.generator)
        torch.testing.assert_close(hand_scale(self.model, users, annotated), self.FACTORS, atol=1e-9, rtol=0)
        users[:, :, self.model.names.index("index4")] += 0.05  # the toy has no index3: what is between index2 and index4 may bend
        torch.testing.assert_close(hand_scale(self.model, users, annotated), self.FACTORS, atol=1e-9, rtol=0)

    def test_fingertips_stay_and_bones_grow_where_they_point(self):
        names = KEYPOINTS
        hand21 = torch.randn(S, T, 21, 3, dtype=FLOAT, generator=self.generator)
        larger = resized(hand21, self.FACTORS, names)
        fingers = finger_keypoints(names)
        for finger in fingers:
            torch.testing.assert_close(larger[:, :, finger[-1]], hand21[:, :, finger[-1]], atol=0, rtol=0)
            bones, grown = (points[:, :, finger].diff(dim=2) for points in (hand21, larger))
            torch.testing.assert_close(grown, self.FACTORS[:, None, None, None] * bones)
        tips = hand21[:, :, [finger[-1] for finger in fingers]].mean(dim=2)
        wrist = names.index("wrist")
        torch.testing.assert_close(larger[:, :, wrist], tips + self.FACTORS[:, None, None] * (hand21[:, :, wrist] - tips))

    def test_a_hand_without_bones_stays_as_it_is(self):
        jaw = tuple(spec for spec in self.robot.keypoints if spec.keypoint in ("wrist", "thumb4", "index4"))
        model = HandModel(dataclasses.replace(self.robot, keypoints=jaw))
        users = self.users()[:, :, [self.model.names.index(name) for name in model.names]]
        scale = hand_scale(model, users, torch.ones(S, T, dtype=torch.bool))
        torch.testing.assert_close(scale, torch.ones(S, dtype=FLOAT), atol=0, rtol=0)
        torch.testing.assert_close(resized(users, scale, model.names), users, atol=0, rtol=0)


class SharpaUserScaleTest(unittest.TestCase):
    """Users whose hands are the Sharpa hand, smaller or larger."""

    FACTORS = UserScaleTest.FACTORS

    @classmethod
    def setUpClass(cls):
        cls.model = HandModel(robots.load("ur7e-sharpa"))
        frames, generator = 8, torch.Generator().manual_seed(0)
        low, high = cls.model.kinematics.lower, cls.model.kinematics.upper
        first, last = 0.25 + 0.5 * torch.rand(2, S, 1, len(low), dtype=FLOAT, generator=generator)
        q = low + (high - low) * (first + (last - first) * torch.linspace(0, 0.5, frames, dtype=FLOAT)[:, None])
        cls.upright = torch.tensor([1.0, 0, 0, 0], dtype=FLOAT).expand(S, frames, 4)
        keypoints = cls.model.keypoints(q, torch.ones(S, frames, 3, dtype=FLOAT), cls.upright)
        wrist = keypoints[:, :, :1]
        cls.users = wrist + (keypoints - wrist) / cls.FACTORS[:, None, None, None]
        cls.annotated = torch.ones(S, frames, dtype=torch.bool)

    def test_recovers_a_known_scale_to_two_percent_from_noisy_keypoints(self):
        generator = torch.Generator().manual_seed(1)
        noisy = self.users + 0.001 * torch.randn(self.users.shape, dtype=FLOAT, generator=generator)
        torch.testing.assert_close(hand_scale(self.model, noisy, self.annotated), self.FACTORS, atol=0, rtol=0.02)

    def test_fingertips_of_users_of_another_size_are_followed_better(self):
        targets = HandTargets(
            keypoints=self.users,
            annotated=self.annotated,
            contact_points=torch.zeros_like(self.users),
            in_contact=torch.zeros(self.users.shape[:3], dtype=torch.bool),
            object_pos=torch.full_like(self.users[:, :, 0], 9.0),
            object_quat=self.upright,
            object_index=torch.zeros(S, dtype=torch.long),
            fields=FAR_OBJECT.field,
        )
        errors = []
        for asked in (False, True):
            motion = retarget_hand(self.model, targets, HandConfig(clearance_weight=0.0, user_scale=asked))
            errors.append((motion.keypoints - self.users)[:, :, self.model.is_tip].norm(dim=-1).mean(dim=(1, 2)))
        without, scaled = errors
        self.assertLess((scaled / without)[[0, 2]].max().item(), 0.5)
        torch.testing.assert_close(scaled[1], without[1], atol=1e-6, rtol=0)  # a hand of the robot's size


class HoldTest(Scene):
    WEIGHT, LENGTH = 7.0, 0.1

    def term(self, state: HandState, targets: HandTargets | None = None):
        return hold(targets or self.targets(), self.model.tip_joints, state, self.WEIGHT, self.LENGTH)

    def carried(self) -> HandState:
        """A hand that keeps its posture and its place on the object."""
        targets = self.targets()
        offset = torch.tensor([0.05, -0.02, 0.1], dtype=FLOAT).expand(S, T, 3)
        grip = quat_from_axis_angle(torch.tensor([0.3, 0.1, 0.2], dtype=FLOAT)).expand(S, T, 4)
        return HandState(
            joints=self.state.joints[:, :1].expand(S, T, -1),
            root_pos=targets.object_pos + quat_rotate(targets.object_quat, offset),
            root_quat=quat_multiply(targets.object_quat, grip),
        )

    @staticmethod
    def moved(state: HandState, shift: torch.Tensor) -> HandState:
        count = state.joints.shape[-1]
        return HandState(
            joints=state.joints + shift[..., :count],
            root_pos=state.root_pos + shift[..., count : count + 3],
            root_quat=quat_multiply(quat_from_axis_angle(shift[..., count + 3 :]), state.root_quat),
        )

    def slopes(self, energy, state: HandState, frame: int) -> torch.Tensor:
        """[S, n] half the numerical derivative of an energy by the variables of a frame."""
        step, found = 1e-6, []
        for k in range(state.joints.shape[-1] + 6):
            shift = torch.zeros(S, T, state.joints.shape[-1] + 6, dtype=FLOAT)
            shift[:, frame, k] = step
            found.append((energy(self.moved(state, shift)) - energy(self.moved(state, -shift))) / (4 * step))
        return torch.stack(found, dim=-1)

    def test_half_gradients_are_half_the_numerical_derivative(self):
        found = self.term(self.state)
        self.assertGreater(found.cost[:, 3:9].min().item(), 1e-3)
        for frame in (3, 4, 7, 9):
            exact = self.slopes(lambda state: self.term(state).cost.sum(1), self.state, frame)
            torch.testing.assert_close(found.later[:, frame - 1] + found.earlier[:, frame], exact, atol=1e-7, rtol=1e-6)

    def test_the_whole_cost_has_it_and_its_gradient(self):
        targets = self.targets()
        without = HandConfig(clearance_weight=0.0)
        config = dataclasses.replace(without, hold_weight=self.WEIGHT)
        plain, found = system(self.model, targets, without, self.state), system(self.model, targets, config, self.state)
        torch.testing.assert_close(found.cost - plain.cost, self.term(self.state).cost.sum(1))
        frame = 6
        exact = self.slopes(lambda state: system(self.model, targets, config, state).cost, self.state, frame)
        exact -= self.slopes(lambda state: system(self.model, targets, without, state).cost, self.state, frame)
        torch.testing.assert_close((found.gradient - plain.gradient)[:, frame], exact, atol=1e-6, rtol=1e-5)

    def test_the_curvature_is_the_second_derivative_where_the_object_does_not_turn(self):
        upright = torch.tensor([1.0, 0, 0, 0], dtype=FLOAT).expand(S, T, 4)
        targets = self.targets(object_quat=upright)
        still = HandState(self.state.joints, self.state.root_pos, upright)  # no turn: d of rotations is linear
        config = HandConfig(clearance_weight=0.0, hold_weight=self.WEIGHT)
        systems = [system(self.model, targets, dataclasses.replace(config, hold_weight=w), still) for w in (self.WEIGHT, 0.0)]
        diagonal, coupling = systems[0].diagonal - systems[1].diagonal, systems[0].coupling - systems[1].coupling
        frame, step, n = 6, 1e-5, diagonal.shape[-1]
        for k in range(n):
            shift = torch.zeros(S, T, n, dtype=FLOAT)
            shift[:, frame, k] = step
            ahead, behind = (self.term(self.moved(still, sign * shift), targets) for sign in (1.0, -1.0))
            own = (ahead.later[:, frame - 1] + ahead.earlier[:, frame] - behind.later[:, frame - 1] - behind.earlier[:, frame]) / (2 * step)
            torch.testing.assert_close(diagonal[:, frame, k], own, atol=1e-4, rtol=1e-6)
            next_frame = (ahead.later[:, frame] - behind.later[:, frame])[:, k] / (2 * step)
            torch.testing.assert_close(coupling[:, frame, k], next_frame, atol=1e-4, rtol=1e-6)

    def test_a_hand_that_goes_with_the_object_costs_nothing_and_one_that_stays_does(self):
        targets, carried = self.targets(), self.carried()
        self.assertLess(self.term(carried, targets).cost.max().item(), 1e-12)
        left_behind = HandState(**{name: value[:, :1].expand(S, T, -1) for name, value in vars(carried).items()})
        self.assertGreater(self.term(left_behind, targets).cost[:, 3:9].min().item(), 1e-3)

    def test_only_fingers_that_touch_in_both_frames_are_held_and_the_root_by_two(self):
        names = self.model.kinematics.joint_names
        index = {names.index("finger_a1"), names.index("finger_a2")}
        touches = torch.zeros(S, T, len(self.model.names), dtype=torch.bool)
        touches[:, 3:6, self.tips[1]] = True
        touches[:, 4, self.tips[0]] = True  # one frame: no change to hold
        touches[:, 3:6, self.model.names.index("index2")] = True  # no fingertip
        curvature = self.term(self.state, self.targets(in_contact=touches)).curvature
        held = {(frame, k) for _, frame, k in (curvature > 0).nonzero().tolist()}
        self.assertEqual(held, {(frame, k) for frame in (3, 4) for k in index})
        unseen = torch.ones(S, T, dtype=torch.bool)
        unseen[:, 5] = False
        curvature = self.term(self.state, self.targets(annotated=unseen)).curvature
        held_pairs = set((curvature[..., -1] > 0).nonzero()[:, 1].tolist())
        self.assertEqual(held_pairs, {3, 6, 7, 8})

    def test_the_tips_joints_are_those_that_move_it(self):
        names = self.model.kinematics.joint_names
        rows = {name: row.nonzero()[:, 0].tolist() for name, row in zip(self.model.names, self.model.tip_joints, strict=True)}
        moving = {name: {names[j] for j in row} for name, row in rows.items() if row}
        self.assertEqual(moving, {"thumb4": {"finger_b1"}, "index4": {"finger_a1", "finger_a2"}})

    def test_fingertips_move_less_on_the_object_while_they_touch(self):
        carried = self.model.keypoints(**vars(self.carried()))
        generator = torch.Generator().manual_seed(4)
        shaky = carried + 0.003 * torch.randn(carried.shape, dtype=FLOAT, generator=generator)
        targets = self.targets(keypoints=shaky, contact_points=shaky)
        slips, errors = [], []
        for weight in (0.0, 10.0, 100.0):
            motion = retarget_hand(self.model, targets, HandConfig(hold_weight=weight))
            tips = motion.keypoints[:, 3:10, self.tips]
            pos, quat = targets.object_pos[:, 3:10, None], targets.object_quat[:, 3:10, None].expand(*tips.shape[:-1], 4)
            slips.append(quat_rotate_inverse(quat, tips - pos).diff(dim=1).norm(dim=-1).mean().item())
            errors.append((motion.keypoints - carried)[:, :, self.tips].norm(dim=-1).mean().item())
        self.assertLess(slips[1], 0.8 * slips[0])
        self.assertLess(slips[2], 0.5 * slips[0])
        self.assertLess(errors[2], errors[0] + 0.001)  # held where the human holds, not anywhere


class RealHandTest(unittest.TestCase):
    def test_one_user_has_one_size_in_every_sequence_and_users_differ(self):
        from tests.data import data_dir
        from xreset.demos import read_demos

        demos = read_demos(data_dir() / "dexycb_right_9x20.npz").select(max_per_object=5)
        model = HandModel(robots.load("ur7e-sharpa"))
        by_user: dict[str, list[float]] = {}
        for i, user in enumerate(demos.subject.tolist()):
            rows = demos.frames(i)
            seen = torch.as_tensor(demos.hand_valid[rows])
            keypoints = np.nan_to_num(demos.hand_keypoints[rows][:, model.keypoint_indices].astype(np.float64))
            by_user.setdefault(user, []).append(hand_scale(model, torch.as_tensor(keypoints)[None], seen[None]).item())
        spread = max(max(found) / min(found) for found in by_user.values())
        users = [float(np.median(found)) for found in by_user.values()]
        self.assertLess(spread, 1.01)
        self.assertGreater(max(users) / min(users), 1.05)


if __name__ == "__main__":
    unittest.main()
