"""The physics filter on the MuJoCo C engine: what stays put is kept, what moves is rejected, with its reason."""

from dataclasses import replace
from unittest import TestCase, mock

import numpy as np
import torch
from numpy.testing import assert_allclose

from tests.toy_bank import ONLY_FRAMES, SOUP, SPAM, in_this_process, shifted, toy_retargeted
from xreset import FilterConfig, SqueezeConfig, robots, synthesize
from xreset.errors import BackendUnavailableError, DemoError, XResetError
from xreset.geometry.kinematics import Kinematics
from xreset.objects.catalogue import load_objects
from xreset.objects.rest import rest_height
from xreset.physics import Health, State
from xreset.resets.filter import REASONS
from xreset.resets.probe import rejection
from xreset.resets.verbs import make_bank
from xreset.spec import TableSpec

UPRIGHT = np.array([1.0, 0, 0, 0])


def reasons(bank):
    """Why the candidates of a bank were rejected."""
    return [REASONS[reason] for reason in bank.rejected_reason]


class RejectionTest(TestCase):
    def test_each_limit_rejects_for_its_own_reason_and_the_last_one_counts(self):
        limits = FilterConfig(linear_velocity=0.1, angular_velocity=1.5, joint_velocity=2.0)
        com = np.array([-0.2, 0, 0])  # from the mesh's origin, which a turn moves
        none = [0, 0, 0]
        fast = ([9, 0, 0], none, [9, 0])
        worlds = (
            ("", [0, 0.06, -0.07], [1, 0, 0], [0, 0]),
            ("", [0, 0.28, 0], [0, 0, 1.4], [0, 0]),
            ("", none, none, [1.9, -1.9]),
            ("object linear velocity", [0, 0.08, -0.07], none, [0, 0]),
            ("object angular velocity", none, [1, -1, 0.6], [0, 0]),
            ("object angular velocity", [9, 0, 0], [9, 0, 0], [0, 0]),
            ("joint velocity", none, none, [0, 2.1]),
            ("joint velocity", none, none, [-2.1, 0]),
            ("joint velocity", *fast),
            ("not finite", *fast),
            ("overflow", *fast),
        )
        expected, *velocities = zip(*worlds, strict=True)
        linear, angular, joint = (torch.tensor(values).float() for values in velocities)
        count = len(worlds)
        above = torch.tensor([*TableSpec().center, 0.3]).expand(count, 3)
        upright = torch.tensor([1.0, 0, 0, 0]).expand(count, 4)
        still = State.at_rest(torch.zeros(count, 2), above, upright)
        number = torch.arange(count)
        backend = mock.Mock(object_index=torch.ones_like(number), num_worlds=count, device="cpu")
        backend.scene.table = TableSpec()
        backend.scene.objects = [mock.Mock(com=9 * com), mock.Mock(com=com)]
        backend.state.return_value = replace(
            still, object_linvel=linear, object_angvel=angular, joint_vel=joint
        )
        backend.health.return_value = Health(nonfinite=number > 8, overflow=number > 9)
        found = rejection(backend, still, limits).tolist()
        self.assertEqual([REASONS[i] if i >= 0 else "" for i in found], list(expected))


class FilterTest(TestCase):
    @classmethod
    def setUpClass(cls):
        cls.enterClassContext(in_this_process())
        cls.robot = robots.load("openarm")
        cls.objects = load_objects([SOUP, SPAM])
        cls.height = float(rest_height(cls.objects[0], UPRIGHT))

    def test_what_stays_is_accepted_and_what_moves_is_not(self):
        for pos, expected in (
            ((0.5, 0.3, self.height), []),
            ((0.5, 0.3, self.height + 0.2), []),  # gravity is off
            ((0.5, 0.3, self.height - 0.02), ["object linear velocity"]),
            ((2.0, 0.3, 0.3), ["out of bounds"]),
        ):
            motion = toy_retargeted(self.robot, [SOUP], [0, 1], object_pos=np.array([pos]))
            bank = make_bank(motion, self.robot, self.objects[:1], **ONLY_FRAMES)
            with self.subTest(pos):
                self.assertEqual(reasons(bank), expected)

    def test_the_origin_of_a_mesh_may_be_anywhere(self):
        soup = self.objects[0]
        for x, origin, expected in ((0.5, 2.0, []), (2.0, 0.5, ["out of bounds"])):
            shift = np.array([x - origin, 0.0, 0.0])
            pos = np.array([[x, 0.3, self.height]]) - shift
            motion = toy_retargeted(self.robot, [SOUP], [0, 1], object_pos=pos)
            bank = make_bank(motion, self.robot, [shifted(soup, shift)], **ONLY_FRAMES)
            with self.subTest(x):
                self.assertEqual(reasons(bank), expected)

    def retargeted(self, **changes):
        """Two demonstrations of three frames: soup (at rest, inside the table, at rest) and spam (not valid, at rest, at rest)."""
        spam_height = float(rest_height(self.objects[1], UPRIGHT))
        heights = [self.height, self.height - 0.02, self.height] + 3 * [spam_height]
        pos = np.array([[0.45 + 0.02 * i, 0.3, z] for i, z in enumerate(heights)])
        reason = np.array([0, 0, 0, 1, 0, 0])
        values = {
            "object_pos": pos,
            "valid": reason == 0,
            "reason": reason,
            "first_contact": np.array([2, -1]),
        }
        return toy_retargeted(self.robot, [SOUP, SPAM], [0, 3, 6], **(values | changes))

    def bank(self, engine="mujoco", **options):
        options = ONLY_FRAMES | options
        return make_bank(self.retargeted(), self.robot, self.objects, engine, **options)

    def test_the_bank_holds_what_was_accepted_and_why_the_rest_was_not(self):
        calls = []
        bank = self.bank(num_envs=2, progress=lambda *at: calls.append(at))
        self.assertEqual(bank.sequence_index.tolist(), [0, 0, 1, 1])
        self.assertEqual(bank.frame_index.tolist(), [0, 2, 1, 2])
        # first_contact is -1 where the hand never touches the object
        self.assertEqual(bank.post_contact.tolist(), [False, True, False, False])
        self.assertEqual(bank.object_name.tolist(), [SOUP, SOUP, SPAM, SPAM])
        self.assertEqual(reasons(bank), ["object linear velocity"])
        self.assertEqual(
            (bank.rejected_sequence_index.tolist(), bank.rejected_frame_index.tolist()), ([0], [1])
        )
        # frame 0 counts although it is not valid
        assert_allclose(bank.start_pos[1], self.retargeted().object_pos[3], atol=1e-6)
        assert_allclose(bank.goal_pos, self.retargeted().goal_pos, atol=1e-6)
        self.assertEqual(calls[-1], ("states stable in mujoco", 5, 5))
        accounts = bank.accounts()
        found = [(a.object_name, a.phase, a.kept, a.total) for a in accounts[:2]]
        self.assertEqual(found, [(SOUP, "pre-contact", 1, 2), (SOUP, "post-contact", 1, 1)])
        self.assertEqual(accounts[-1].lost, {"object linear velocity": 1})

    def test_a_state_with_the_robot_deep_in_the_object_is_not_tried(self):
        """The demonstration that loses its frames after contact, one for the depth and one in retargeting, is doubted."""
        reason = np.array([0, 0, 1, 0, 0, 0])
        first = np.array([1, 0])
        motion = self.retargeted(first_contact=first, valid=reason == 0, reason=reason)
        pos = motion.object_pos.copy()
        palm = Kinematics(self.robot).points(torch.as_tensor(self.robot.home), [self.robot.palm])
        pos[1] = palm[0].numpy()
        pressed = replace(motion, object_pos=pos, reason_names=("valid", "object collision"))
        notes = []
        bank = make_bank(pressed, self.robot, self.objects, note=notes.append, **ONLY_FRAMES)
        self.assertEqual(reasons(bank), ["object collision"])
        self.assertEqual(bank.object_depth.tolist(), [0.0] * 4)
        words = "^1 of 2 demon.* kept 0 of 2, .* 'object collision': xreset view FILE --sequence 0$"
        self.assertRegex("".join(notes), words)

    def tried(self, verdicts, **options):
        """The bank, and the objects, states and steps of each try; ``verdicts`` are the reasons that each try gives."""
        tries = []

        def probe(engine, scene, object_name, states, judge, **limits):
            tries.append((object_name.tolist(), states, limits["steps"]))
            limits["progress"](len(object_name))
            return np.array(verdicts[len(tries) - 1])

        def pressed(robot, fingers, joint_pos, force):
            return joint_pos + force / 80

        motion = self.retargeted(first_contact=np.array([2, 1]))
        with (
            mock.patch("xreset.resets.verbs.backend_class"),
            mock.patch("xreset.resets.probe.probe", probe),
            mock.patch("xreset.resets.filter.fingers_of"),
            mock.patch("xreset.resets.filter.grip_forces", lambda fingers, force: force),
            mock.patch("xreset.resets.filter.squeeze_targets", pressed),
        ):
            return make_bank(motion, self.robot, self.objects, **ONLY_FRAMES | options), tries

    def test_targets_that_press_are_tried_with_less_and_less_force(self):
        """Of the three states after contact, the first stays put with the whole force, the second with a quarter of it,
        and the third with none."""
        bank, tries = self.tried(
            [[-1] * 5, [-1, 0, 0], [2, 2], [-1, 1]],
            limits=FilterConfig(steps=3),
            squeeze=SqueezeConfig(),
        )
        self.assertEqual({steps for _, _, steps in tries}, {3})
        (names, plain, _), *pressing = tries
        self.assertEqual(names, [SOUP] * 3 + [SPAM] * 2)
        for number, share, tried in (
            (3, 1.0, pressing[0]),
            (2, 0.5, pressing[1]),
            (2, 0.25, pressing[2]),
        ):
            names, states, _ = tried
            self.assertEqual(names, [SOUP, SPAM, SPAM][-number:])
            assert_allclose(states.object_pos, plain.object_pos[-number:])
            assert_allclose(states.joint_target, states.joint_pos + share * 0.25, rtol=1e-6)
        pressed = np.array([0.0, 0.0, 0.25, 0.0625, 0.0])[:, None]
        assert_allclose(bank.targets, bank.joint_pos + pressed, rtol=1e-6)

    def test_an_engine_tries_what_the_one_before_accepts(self):
        calls = []
        options = {"engine": ("mujoco", "pybullet"), "progress": lambda *at: calls.append(at)}
        bank, tries = self.tried([[0, -1, 1, -1, -1], [-1, -1, 3]], **options)
        self.assertEqual(bank.engines, ("mujoco", "pybullet"))
        words = "states stable in mujoco, pybullet"
        self.assertEqual(calls, [(words, 5, 10), (words, 8, 10), (words, 10, 10)])
        self.assertEqual(
            [names for names, *_ in tries], [[SOUP] * 3 + [SPAM] * 2, [SOUP, SPAM, SPAM]]
        )
        assert_allclose(tries[1][1].object_pos, tries[0][1].object_pos[[1, 3, 4]])
        self.assertEqual(bank.rejected_reason.tolist(), [0, 1, 3])
        assert_allclose(bank.object_pos, tries[0][1].object_pos[[1, 3]])

    def test_loose_limits_accept_all_and_nothing_valid_is_an_error(self):
        loose = FilterConfig(linear_velocity=1e3, angular_velocity=1e3, joint_velocity=1e3)
        self.assertEqual(self.bank(num_envs=8, limits=loose).num_states, 5)
        none = self.retargeted(valid=np.zeros(6, dtype=bool), reason=np.ones(6, dtype=int))
        with self.assertRaisesRegex(DemoError, "no frame of the retargeted trajectories is valid"):
            make_bank(none, self.robot, self.objects, ["mujoco"])
        with self.assertRaisesRegex(DemoError, "objects that were not given"):
            make_bank(self.retargeted(), self.robot, self.objects[:0], ["mujoco"])
        no_spam = np.arange(6) < 3
        half = self.retargeted(valid=no_spam, reason=(~no_spam).astype(int))
        with self.assertRaisesRegex(DemoError, f"were not given: {SPAM}"):
            make_bank(half, self.robot, self.objects[:1])
        with self.assertRaisesRegex(XResetError, "retargeted is Demos.*expected the motion of"):
            make_bank(synthesize(["soup"], 1), self.robot)
        with self.assertRaisesRegex(XResetError, "No engine is named. Name one or several"):
            make_bank(self.retargeted(), self.robot, self.objects, [])  # would accept all states
        with (
            mock.patch("xreset.resets.filter.stable_states", side_effect=AssertionError),
            self.assertRaisesRegex(BackendUnavailableError, "Unknown engine 'bullet'"),
        ):
            make_bank(self.retargeted(), self.robot, self.objects, ["mujoco", "bullet"])
