"""The environment as Stable-Baselines3 knows it."""

import warnings
from dataclasses import replace

import numpy as np
import torch
from numpy.testing import assert_allclose, assert_array_equal
from stable_baselines3 import PPO

from tests.command import succeeds
from tests.data import InOneFolder
from tests.test_env import TASK, BreakableBackend, N, WithEnv
from tests.toy_bank import SOUP, toy_bank
from xreset import load_object, load_robot, make_env
from xreset.env.stable_baselines import StableBaselinesEnv
from xreset.eval.results import read_evaluation
from xreset.live.deploy import deployed_graph
from xreset.live.engine import GraphPolicy
from xreset.runtime import Controller
from xreset.task.config import TerminationConfig, evaluation_task


def rest(env):
    """Take a step in which no joint moves."""
    return env.step(np.zeros((N, env.env.num_actions), np.float32))


class StableBaselinesTest(WithEnv):
    def wrapped(self, seconds, **options):
        task = replace(TASK, termination=TerminationConfig(episode_seconds=seconds))
        env = StableBaselinesEnv(self.make(task, **options))
        self.addCleanup(env.close)
        return env

    def test_the_last_observation_of_a_truncated_episode_is_given(self):
        env = self.wrapped(0.1)
        env.seed(3)
        first = env.reset()["policy"]
        for step in range(1, 2 * env.env.max_episode_length + 1):
            observations, _, done, infos = rest(env)
            ends = step % env.env.max_episode_length == 0
            self.assertEqual(done.tolist(), [ends] * N)
            for world, info in enumerate(infos):
                self.assertEqual(bool(info), ends)
                if ends:
                    self.assertEqual((info["TimeLimit.truncated"], info["faulty"]), (True, False))
                    last = info["terminal_observation"]["policy"]
                    self.assertFalse(
                        np.array_equal(last, observations["policy"][world]),
                        "it is the old episode's",
                    )
        self.assertEqual(env.env.episode_length_buf.tolist(), [0] * N)
        for seed, is_same in ((3, True), (4, False)):
            env.seed(seed)
            self.assertEqual(np.array_equal(env.reset()["policy"], first), is_same)

    def test_a_world_that_fails_is_terminated_and_the_others_go_on(self):
        env = self.wrapped(1.0, kind=BreakableBackend)
        env.reset()
        before, *_ = rest(env)
        env.env.backend.broken[0] = True
        observations, reward, done, infos = rest(env)
        self.assertEqual(done.tolist(), [True] + [False] * (N - 1))
        self.assertEqual((infos[0]["TimeLimit.truncated"], infos[0]["faulty"]), (False, True))
        self.assertEqual(reward[0], 0.0)
        self.assertEqual(env.log["health/nonfinite_total"], 1)
        for name, value in observations.items():
            self.assertTrue(np.isfinite(value).all(), name)
            assert_array_equal(infos[0]["terminal_observation"][name], before[name][0])
        self.assertEqual(env.env.episode_length_buf.tolist(), [0] + [2] * (N - 1))
        env.env.backend.overflow[0] = True
        _, reward, *_ = env.step(np.full((N, env.env.num_actions), 0.1))
        self.assertEqual([bool(value) for value in reward], [False] + [True] * (N - 1))

    def test_an_attribute_that_the_environment_lacks_is_refused(self):
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # of a missing render_mode
            env = self.wrapped(1.0)
        self.assertEqual(env.get_attr("num_actions", 0), [env.env.num_actions])
        self.assertTrue(env.has_attr("num_actions"))
        self.assertFalse(env.has_attr("action_masks"))
        for get in (env.get_attr, env.env_method):
            self.assertRaisesRegex(AttributeError, "num_action", get, "num_action")

    def test_no_network_gets_what_is_for_critics(self):
        env = self.wrapped(0.1)
        groups = {"policy", "proprio", "perception"}
        self.assertLessEqual(groups, set(env.observation_space))
        self.assertIn("privileged", env.env.get_observations().keys())
        seen = [env.reset()]
        while len(seen) < 3:
            observations, _, done, infos = rest(env)
            if done.any():
                seen += [observations, infos[0]["terminal_observation"]]
        for each in seen:
            self.assertEqual(set(each), set(env.observation_space) - {"privileged"})

    def test_a_learner_takes_steps(self):
        env = self.wrapped(0.2)
        learner = PPO(
            "MultiInputPolicy", env, n_steps=8, batch_size=8, n_epochs=1, device="cpu", seed=0
        )
        learner.learn(16 * N)
        actions, _ = learner.predict(env.reset())
        self.assertEqual(actions.shape, (N, env.env.num_actions))


class PlayedTest(InOneFolder):
    """What another learner trained, as a graph."""

    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        robot = load_robot("openarm")
        soup = load_object(SOUP)
        task = evaluation_task(TASK)
        bank = toy_bank(robot, object_name=np.full(6, SOUP), sequence_object=np.full(3, SOUP))
        cls.env = StableBaselinesEnv(make_env(robot, (soup,), bank, task, num_envs=1))
        cls.addClassCleanup(cls.env.close)
        cls.model = PPO("MultiInputPolicy", cls.env, n_steps=2, batch_size=2, device="cpu", seed=0)
        cls.network = Network(cls.model)
        cls.graph = deployed_graph(cls.network, robot, task, (soup,))

    def test_the_graph_gives_the_targets_of_the_policy(self):
        self.assertNotIn("privileged", self.env.observation_space)
        self.assertTrue(self.network.training, "its learner may go on")
        graph = GraphPolicy(Controller(self.graph))
        world = self.env.env
        world.reset()
        graph.begin(world)
        for _ in range(5):
            seen = world.get_observations()
            seen = {name: seen[name].numpy() for name in self.env.observation_space}
            action = torch.as_tensor(self.model.predict(seen, deterministic=True)[0])
            joints = world.backend.state().joint_pos
            expected = world.actions.targets(action, world.joint_target, joints)
            action = graph.act(world.get_observations())
            world.goal_pos += 0.2  # for the next step
            world.advance(action)
            assert_allclose(world.joint_target, expected, atol=1e-5)

    def test_commands_play_it(self):
        file = self.folder / "mine.onnx"
        file.write_bytes(self.graph)
        demos = self.folder / "demos.npz"
        succeeds("demos synth --objects", SOUP, "--per-object 1 --out", demos)
        options = ("--demos", demos, "--engine mujoco --episodes 1")
        succeeds("eval", file, *options, "--out", self.folder / "eval")
        (found,) = read_evaluation(self.folder / "eval")
        self.assertEqual((found.policy, found.robot, len(found.episodes)), ("mine", "openarm", 1))
        options += ("--property pose-delay=0.2",)
        succeeds("stress", file, *options, "--out", self.folder / "stress")
        (found,) = read_evaluation(self.folder / "stress")
        self.assertEqual(found.changed["property"].tolist(), ["pose-delay"])


class Network(torch.nn.Module):
    """The actor, as docs/gymnasium.md wraps it."""

    def __init__(self, model):
        super().__init__()
        self.policy = model.policy.cpu()
        space = model.observation_space
        self.widths = [space["policy"].shape[0], space["proprio"].shape[0]]

    def forward(self, flat, cloud):
        policy, proprio = flat.split(self.widths, dim=1)
        observations = {"policy": policy, "proprio": proprio, "perception": cloud}
        features = self.policy.extract_features(observations)
        return self.policy.action_net(self.policy.mlp_extractor.forward_actor(features))
