"""A small training learns: what no other test would see is a change that leaves everything running, and nothing learned."""

import unittest

from tests.toy_learning import CONFIG, WORLDS, random_policy, scene, trained
from xreset.backends.mujoco import MujocoBackend

MARGIN = 0.4
"""Share of steps with a grasp above a random policy's. Measured with five seeds: docs/faults.md, "Does training still learn?"."""


class Learns(unittest.TestCase):
    def test_a_training_beats_a_random_policy(self):
        with MujocoBackend(scene(), WORLDS, workers=0) as backend:
            by_chance = random_policy(1, backend)
            learned, steps = trained(1, backend)
        self.assertEqual(steps, CONFIG.iterations * CONFIG.ppo.horizon * WORLDS, "it was stopped")
        self.assertGreater(
            learned["grasped"],
            by_chance["grasped"] + MARGIN,
            f"a random policy: {by_chance}; trained: {learned}",
        )
