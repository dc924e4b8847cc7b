"""The physics filter on the MuJoCo C engine: what stays put is kept, what moves is rejected, with its reason."""

from dataclasses import replace
from unittest import SkipTest, TestCase, mock

import numpy as np
import torch
from numpy.testing import assert_allclose

from tests.toy_bank import SOUP, SPAM, in_this_process, toy_retargeted
from xreset import FilterConfig, SceneSpec, robots
from xreset.errors import DemoError
from xreset.objects.catalogue import load_objects
from xreset.objects.rest import rest_height
from xreset.physics import State
from xreset.resets.filter import REASONS, make_bank, rejection

try:
    from xreset.backends.mujoco import MujocoBackend
except ImportError as error:
    raise SkipTest(str(error)) from error

UPRIGHT = np.array([1.0, 0, 0, 0])


class FilterTest(TestCase):
    @classmethod
    def setUpClass(cls):
        cls.enterClassContext(in_this_process())
        cls.robot = robots.load("openarm")
        cls.objects = load_objects([SOUP, SPAM])
        cls.height = float(rest_height(cls.objects[0], UPRIGHT))

    def try_one(self, pos, backend_class=MujocoBackend):
        """The reason (None: accepted) of one state with the soup can at ``pos``."""
        scene = SceneSpec(robot=self.robot, objects=self.objects[:1])
        rows = [torch.as_tensor(np.asarray(v)[None]) for v in (self.robot.home, pos, UPRIGHT)]
        with backend_class(scene, 1, workers=0) as backend:
            start = State.at_rest(*rows)
            backend.set_object_gravity(torch.zeros(1))
            backend.set_state(start)
            for _ in range(FilterConfig().steps):
                backend.step()
            reason = int(rejection(backend, start, FilterConfig()))
        return None if reason < 0 else REASONS[reason]

    def test_what_stays_is_accepted_and_what_moves_is_not(self):
        for pos, reason in (
            ((0.5, 0.3, self.height), None),
            ((0.5, 0.3, self.height + 0.2), None),  # gravity is off
            ((0.5, 0.3, self.height - 0.02), "object linear velocity"),
            ((2.0, 0.3, 0.3), "out of bounds"),
        ):
            with self.subTest(pos):
                self.assertEqual(self.try_one(pos), reason)

    def test_broken_and_overflowing_worlds_are_rejected(self):
        for field, reason in (("nonfinite", "not finite"), ("overflow", "overflow")):

            class Broken(MujocoBackend):
                def health(self, field=field):
                    return replace(
                        super().health(), **{field: torch.ones(self.num_worlds, dtype=torch.bool)}
                    )

            self.assertEqual(self.try_one([0.5, 0.3, self.height], backend_class=Broken), reason)

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
        return make_bank(self.retargeted(), self.robot, self.objects, engine, **options)

    def test_the_bank_holds_what_was_accepted_and_why_the_rest_was_not(self):
        calls = []
        bank = self.bank(num_envs=2, progress=lambda done, total: calls.append((done, total)))
        self.assertEqual(bank.sequence_index.tolist(), [0, 0, 1, 1])
        self.assertEqual(bank.frame_index.tolist(), [0, 2, 1, 2])
        # first_contact is -1 where the hand never touches the object
        self.assertEqual(bank.post_contact.tolist(), [False, True, False, False])
        self.assertEqual(bank.object_name.tolist(), [SOUP, SOUP, SPAM, SPAM])
        self.assertEqual([REASONS[r] for r in bank.rejected_reason], ["object linear velocity"])
        self.assertEqual(
            (bank.rejected_sequence_index.tolist(), bank.rejected_frame_index.tolist()), ([0], [1])
        )
        # frame 0 counts although it is not valid
        assert_allclose(bank.start_pos[1], self.retargeted().object_pos[3], atol=1e-6)
        assert_allclose(bank.goal_pos, self.retargeted().goal_pos, atol=1e-6)
        self.assertEqual(calls[-1], (5, 5))

    def test_accounts_by_object_and_phase(self):
        bank = self.bank(num_envs=4, device="cuda:0")  # a GPU is for engines that can use one
        found = [(a.object_name, a.phase, a.kept, a.total, a.lost) for a in bank.accounts()]
        self.assertEqual(
            found,
            [
                (SOUP, "pre-contact", 1, 2, {"object linear velocity": 1}),
                (SOUP, "post-contact", 1, 1, {}),
                (SPAM, "pre-contact", 2, 2, {}),
                (SPAM, "post-contact", 0, 0, {}),
                ("all", "pre-contact", 3, 4, {"object linear velocity": 1}),
                ("all", "post-contact", 1, 1, {}),
                ("all", "both", 4, 5, {"object linear velocity": 1}),
            ],
        )

    def test_several_engines_keep_what_all_accept(self):
        class Moves(MujocoBackend):
            """Finds that the states near x = 0.53 m move."""

            name = "moves"

            def state(self):
                state = super().state()
                return replace(
                    state,
                    joint_vel=state.joint_vel
                    + 9.0 * ((state.object_pos[:, :1] - 0.53).abs() < 0.005),
                )

        def made(name, *args, **options):
            return (Moves if name == "moves" else MujocoBackend)(*args, workers=0, **options)

        with (
            mock.patch("xreset.resets.probe.make_backend", made),
            mock.patch("xreset.resets.probe.device_for", lambda name, device: device),
        ):
            bank = self.bank(["mujoco", "moves"], num_envs=2)
        self.assertEqual(bank.backends, ("mujoco", "moves"))
        self.assertEqual(
            list(zip(bank.sequence_index.tolist(), bank.frame_index.tolist())),
            [(0, 0), (0, 2), (1, 2)],
        )
        rejected = list(
            zip(bank.rejected_frame_index.tolist(), (REASONS[r] for r in bank.rejected_reason))
        )
        self.assertEqual(rejected, [(1, "object linear velocity"), (1, "joint velocity")])

    def test_loose_limits_accept_all_and_nothing_valid_is_an_error(self):
        loose = FilterConfig(linear_velocity=1e3, angular_velocity=1e3, joint_velocity=1e3)
        self.assertEqual(self.bank(num_envs=8, limits=loose).num_states, 5)
        none = self.retargeted(valid=np.zeros(6, dtype=bool), reason=np.ones(6, dtype=int))
        with self.assertRaisesRegex(DemoError, "no frame of the retargeted trajectories is valid"):
            make_bank(none, self.robot, self.objects, ["mujoco"])
        with self.assertRaisesRegex(DemoError, "objects that were not given"):
            make_bank(self.retargeted(), self.robot, self.objects[:0], ["mujoco"])
