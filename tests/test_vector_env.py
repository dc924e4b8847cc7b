"""The environment as Gymnasium knows it."""

import unittest
from dataclasses import replace
from importlib.util import find_spec

import numpy as np

from tests.test_env import TASK, WithEnv
from xreset.task.config import TerminationConfig


@unittest.skipUnless(find_spec("gymnasium"), "gymnasium is not installed")
class VectorEnvTest(WithEnv):
    def vector_env(self, seconds: float):
        from xreset.vector_env import VectorEnv

        return VectorEnv(self.make(replace(TASK, termination=TerminationConfig(episode_seconds=seconds))))

    def test_episodes_are_truncated_and_begin_anew_a_step_later(self):
        env = self.vector_env(0.1)
        first, _ = env.reset(seed=0)
        self.assertTrue(env.observation_space.contains(first))
        length = env.env.max_episode_length
        for step in range(1, 2 * length + 2):
            seen, reward, terminated, truncated, _ = env.step(env.action_space.sample())
            self.assertTrue(env.observation_space.contains(seen))
            self.assertFalse(terminated.any())
            self.assertEqual(truncated.all(), step in (length, 2 * length + 1))
            if step == length + 1:
                np.testing.assert_array_equal(reward, 0.0)
                np.testing.assert_array_equal(env.env.episode_length_buf.numpy(), 0)
        env.close()

    def test_the_seed_decides(self):
        runs = []
        for seed in (3, 3, 4):
            env = self.vector_env(0.5)
            env.reset(seed=seed)
            actions = np.zeros(env.action_space.shape, np.float32)
            runs.append(np.concatenate([env.step(actions)[0]["policy"] for _ in range(3)]))
            env.close()
        np.testing.assert_array_equal(runs[0], runs[1])
        self.assertFalse(np.array_equal(runs[0], runs[2]))


if __name__ == "__main__":
    unittest.main()
