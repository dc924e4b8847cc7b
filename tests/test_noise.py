"""Errors of a worse hand tracker: one offset for a demonstration, wandering fingers, bones and objects as they were."""

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from tests.command import succeeds
from tests.data import InOneFolder
from xreset import read_demos, synthesize, write_demos
from xreset.demos.hand import PARENTS, bone_lengths
from xreset.demos.noise import MEMORY, TIERS, with_noise


class NoiseTest(InOneFolder):
    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        cls.demos = synthesize(["soup", "mustard"], 3, seed=0)
        cls.seen = cls.demos.hand_valid

    def test_a_demonstration_is_shifted_as_a_whole_within_the_bound(self):
        shifted = with_noise(self.demos, wrist=0.04, finger=0.0, cap=0.0)
        shifts = []
        for sequence in range(self.demos.num_sequences):
            frames = self.demos.frames(sequence)
            shift = (shifted.hand_keypoints - self.demos.hand_keypoints)[frames][self.seen[frames]]
            assert_allclose(shift, np.broadcast_to(shift[0, 0], shift.shape), atol=1e-6)
            shifts.append(shift[0, 0])
        self.assertLessEqual(np.abs(shifts).max(), 0.04)
        self.assertGreater(np.ptp(shifts, axis=0).min(), 0.01)
        self.assertLess(np.min(shifts), -0.01)

    def test_fingers_wander_and_keep_their_bones(self):
        noisy = with_noise(self.demos, wrist=0.0, finger=0.006, cap=0.012)
        before = self.demos.hand_keypoints[self.seen].astype(float)
        after = noisy.hand_keypoints[self.seen].astype(float)
        assert_allclose(bone_lengths(after), bone_lengths(before), atol=1e-6)
        assert_array_equal(after[:, 0], before[:, 0])
        moved = np.linalg.norm(after - before, axis=-1)[:, 1:]
        self.assertGreater(moved.mean(), 0.003)
        frames = self.demos.frames(0)
        path = (noisy.hand_keypoints - self.demos.hand_keypoints)[frames][self.seen[frames]][:, 4]
        still = np.corrcoef(path[1:].ravel(), path[:-1].ravel())[0, 1]
        self.assertGreater(still, MEMORY - 0.3)

    def errors(self, **options):
        """Errors [F, 5, 3] of the keypoints next to the wrist. Across their bones they are as drawn."""
        noisy = with_noise(self.demos, wrist=0.0, **options)
        roots = [child for child, parent in enumerate(PARENTS, start=1) if parent == 0]
        return (noisy.hand_keypoints.astype(float) - self.demos.hand_keypoints)[:, roots]

    def test_errors_have_the_stated_size_and_memory(self):
        errors = self.errors(finger=0.0005, cap=1.0)
        squares = (errors[self.seen] ** 2).sum(axis=-1)
        self.assertAlmostEqual(squares.mean() ** 0.5, 0.0005 * 2**0.5, delta=0.00005)
        pairs = []
        for sequence in range(self.demos.num_sequences):
            path = errors[self.demos.frames(sequence)]
            pairs.append(np.stack((path[1:], path[:-1])).reshape(2, -1))
        now, before = np.concatenate(pairs, axis=1)
        self.assertAlmostEqual(np.corrcoef(now, before)[0, 1], np.exp(-1 / 8), delta=0.03)
        large = np.linalg.norm(self.errors(finger=1.0, cap=0.003)[self.seen], axis=-1)
        self.assertLess(large.max(), 0.0031)
        self.assertGreater(large.mean(), 0.0015)

    def test_errors_turn_with_the_palm(self):
        turn = Rotation.from_rotvec([0.4, -1.0, 2.0])
        wrist = turn * Rotation.from_quat(self.demos.wrist_quat_wxyz, scalar_first=True)
        turned = replace(
            self.demos,
            hand_keypoints=self.demos.hand_keypoints @ turn.as_matrix().T,
            wrist_quat_wxyz=wrist.as_quat(scalar_first=True),
        )
        options = {"wrist": 0.0, "finger": 0.006, "cap": 0.012}
        expected = with_noise(self.demos, **options).hand_keypoints @ turn.as_matrix().T
        found = with_noise(turned, **options).hand_keypoints
        assert_allclose(found[self.seen], expected[self.seen], atol=1e-5)

    def test_tiers_are_those_of_the_published_paper(self):
        found = {name: (tier["wrist"], tier["cap"]) for name, tier in TIERS.items()}
        expected = {"low": (0.010, 0.003), "medium": (0.020, 0.006), "high": (0.040, 0.012)}
        self.assertEqual(found, expected)

    def test_objects_stay_and_a_seed_repeats(self):
        noisy = with_noise(self.demos, **TIERS["low"], seed=3)
        again = with_noise(self.demos, **TIERS["low"], seed=3)
        other = with_noise(self.demos, **TIERS["low"], seed=4)
        assert_array_equal(noisy.object_pos, self.demos.object_pos)
        assert_array_equal(noisy.hand_keypoints, again.hand_keypoints)
        self.assertGreater(np.nanmax(np.abs(noisy.hand_keypoints - other.hand_keypoints)), 1e-3)

    def test_the_command_adds_the_errors_of_a_tier(self):
        files = [self.folder / name for name in ("demos.npz", "noisy.npz")]
        write_demos(files[0], self.demos)
        succeeds("demos", "noise", files[0], "--out", files[1], "--tier", "high", "--seed", 5)
        expected = with_noise(self.demos, **TIERS["high"], seed=5)
        assert_array_equal(read_demos(files[1]).hand_keypoints, expected.hand_keypoints)
