"""The environment as Gymnasium knows it."""

from dataclasses import replace

import numpy as np
import torch
from numpy.testing import assert_array_equal, assert_equal

from tests.data import refuses
from tests.test_env import TASK, BreakableBackend, N, WithEnv
from xreset import VectorEnv, XResetError
from xreset.env.stable_baselines import StableBaselinesEnv
from xreset.task.config import ResetConfig, TerminationConfig


class VectorEnvTest(WithEnv):
    def vector_env(self, seconds):
        envs = VectorEnv(
            self.make(replace(TASK, termination=TerminationConfig(episode_seconds=seconds)))
        )
        self.addCleanup(envs.close)
        return envs

    def test_truncated_episodes_are_reset_a_step_later(self):
        env = self.vector_env(0.1)
        env.reset(seed=1)
        first, _ = env.reset(seed=0)
        again, _ = env.reset(seed=0)
        assert_equal(again, first)
        self.assertTrue(env.observation_space.contains(first))
        length = env.env.max_episode_length
        for step in range(1, 2 * length + 2):
            seen, reward, terminated, truncated, _ = env.step(env.action_space.sample())
            self.assertTrue(env.observation_space.contains(seen))
            self.assertFalse(terminated.any())
            self.assertEqual(truncated.tolist(), [step in (length, 2 * length + 1)] * N)
            if step == length + 1:
                assert_array_equal(reward, 0.0)
                assert_array_equal(env.env.episode_length_buf, 0)

    def test_what_is_no_environment_is_refused(self):
        for made in (VectorEnv, StableBaselinesEnv):
            with refuses(self, "env is 'Lift-v0', expected an environment", XResetError, made):
                made("Lift-v0")

    def test_a_seed_gives_the_same_episodes_whatever_has_succeeded_before(self):
        """The demonstrations that fail most are drawn most often."""
        reset = ResetConfig(adaptive_share=1.0)
        inner = self.make(replace(TASK, reset=reset))
        env = VectorEnv(inner)
        self.addCleanup(env.close)
        succeeded = torch.zeros(100, dtype=torch.long)
        sequences = []
        for _ in range(2):
            drawn = []
            for seed in range(8):
                env.reset(seed=seed)
                drawn.append(inner.sequence.tolist())
                every = torch.ones_like(succeeded, dtype=torch.bool)
                inner.resets.record(succeeded, every, every)
            sequences.append(drawn)
        self.assertEqual(*sequences)

    def test_an_episode_counts_once(self):
        """A broken world is counted in the step that ends it, and not again in the one that resets it."""
        task = replace(
            TASK,
            reset=ResetConfig(demo_probability=1.0),
            termination=TerminationConfig(episode_seconds=0.1),
        )
        inner = self.make(task, kind=BreakableBackend)
        env = VectorEnv(inner)
        still = np.zeros((N, inner.num_actions), np.float32)
        before, *_ = env.step(still)
        inner.backend.broken[0] = True
        seen, reward, terminated, truncated, infos = env.step(still)
        self.assertEqual(
            (terminated.tolist(), infos["faulty"].tolist()), ([True, False, False],) * 2
        )
        self.assertEqual(env.log["health/nonfinite_total"], 1)
        self.assertFalse(truncated.any(), "a fault is no truncation: nobody may bootstrap from it")
        self.assertEqual(reward[0], 0.0)
        for name, value in seen.items():
            self.assertTrue(np.isfinite(value).all(), name)
            assert_array_equal(value[0], before[name][0])
        _, _, terminated, truncated, infos = env.step(still)
        self.assertFalse(terminated.any() or truncated.any() or infos["faulty"].any())
        self.assertEqual(inner.nonfinite_count, 1)
        for _ in range(inner.max_episode_length - 3):
            *_, truncated, _ = env.step(still)
        self.assertEqual(truncated.tolist(), [False, True, True])
        env.step(still)
        inner.backend.overflow[1] = True
        _, reward, terminated, _, infos = env.step(still + 0.1)
        self.assertEqual(
            (terminated.tolist(), infos["faulty"].tolist()), ([False, True, False],) * 2
        )
        self.assertEqual([bool(value) for value in reward], [True, False, True])
        env.close()

    def test_actions_of_another_shape_or_kind_are_refused(self):
        env = self.vector_env(0.5)
        joints = env.env.num_actions
        right = np.zeros((N, joints))
        for wrong in (
            0.0,
            right[:1],
            right[:, :1],
            right + 1j,
            right.astype(bool),
            [["left"] * joints] * N,
        ):
            with (
                refuses(self, rf"of shape \({N}, {joints}\)", XResetError, np.shape(wrong)),
            ):
                env.step(wrong)
        for taken in (right, right.astype(int), right.tolist(), torch.zeros(N, joints)):
            env.step(taken)
