"""Worlds that break are counted and not learned from, and a run with too many of them ends."""

import tempfile
import unittest
from contextlib import redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict

from tests.toy_bank import SOUP, SPAM, toy_bank
from tests.toy_robot import toy_hand_arm
from xreset.env import ManipulationEnv, make_scene
from xreset.errors import RunError
from xreset.learning.config import ModelConfig, PpoConfig, TrainConfig, rsl_rl_config
from xreset.learning.faults import MAX_SHARE, WINDOW, FaultBudget
from xreset.learning.ppo import SequencePpo
from xreset.learning.run import checkpoints
from xreset.learning.runner import TrainingRunner
from xreset.objects.catalogue import load_objects
from xreset.resets.distribution import ResetDistribution
from xreset.task.config import ObservationConfig, TaskConfig

try:
    from xreset.backends.mujoco import MujocoBackend
except ImportError as error:
    raise unittest.SkipTest(str(error)) from error

N = 4
CONFIG = TrainConfig(
    task=TaskConfig(observation=ObservationConfig(cloud_points=16), distance_points=64),
    model=ModelConfig(pointnet=(8, 6), lstm=12, mlp=(16,)),
    ppo=PpoConfig(horizon=8, mini_epochs=2, minibatch_size=16),
    iterations=3,
    save_interval=1,
)


class FaultyBackend(MujocoBackend):
    """An engine whose worlds break when they are told to, until they are set again."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.nonfinite, self.overflow = (torch.zeros(self.num_worlds, dtype=torch.bool) for _ in range(2))
        self.plan: dict[int, tuple[str, int]] = {}
        """Number of the step -> which of the two, and the world."""
        self.steps = 0

    def step(self, substeps=None):
        super().step(substeps)
        self.steps += 1
        if self.steps in self.plan:
            kind, world = self.plan[self.steps]
            getattr(self, kind)[world] = True

    def set_state(self, state, worlds=None):
        for broken in (self.nonfinite, self.overflow):
            broken[slice(None) if worlds is None else worlds] = False
        super().set_state(state, worlds)

    def state(self):
        state = super().state()
        return replace(state, object_pos=torch.where(self.nonfinite[:, None], torch.nan, state.object_pos))

    def health(self):
        health = super().health()
        return replace(health, nonfinite=health.nonfinite | self.nonfinite, overflow=health.overflow | self.overflow)


class Budget(unittest.TestCase):
    def test_the_share_of_a_window(self):
        budget = FaultBudget(1000)
        self.assertAlmostEqual(budget.allowed, MAX_SHARE * WINDOW * 1000)
        self.assertIsNone(budget.add(150, 50))
        self.assertRegex(budget.add(1, 0) or "", "151 worlds were not finite and 50 dropped .* 0.1%")

    def test_old_faults_are_forgotten(self):
        budget = FaultBudget(1000)
        budget.add(200, 0)
        for _ in range(WINDOW - 1):
            self.assertIsNone(budget.add(0, 0))
        self.assertIsNone(budget.add(0, 200))


class WithEnv(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.folder = Path(cls.enterClassContext(tempfile.TemporaryDirectory()))
        cls.robot = toy_hand_arm(cls.folder)
        cls.objects = load_objects((SOUP, SPAM))
        home = np.tile(cls.robot.home, (6, 1)).astype(np.float32)
        cls.bank = toy_bank(cls.robot, joint_pos=home)

    def make(self, plan: dict[int, tuple[str, int]]) -> ManipulationEnv:
        backend = FaultyBackend(make_scene(self.robot, self.objects, CONFIG.task), N, workers=0)
        self.addCleanup(backend.close)
        backend.plan = plan
        torch.manual_seed(0)
        return ManipulationEnv(
            backend, CONFIG.task, ResetDistribution(self.bank, self.robot, (SOUP, SPAM), CONFIG.task.reset), seed=0
        )


class Environment(WithEnv):
    def test_a_world_that_drops_contacts_begins_anew_and_is_counted_once(self):
        env = self.make({2: ("overflow", 1)})
        _, _, done, _ = env.step(torch.zeros(N, 7))
        self.assertEqual(done.tolist(), [0] * N)
        _, reward, done, extras = env.step(torch.zeros(N, 7))
        self.assertEqual((done.tolist(), extras["time_outs"].tolist()), ([0, 1, 0, 0], [0.0, 1.0, 0.0, 0.0]))
        self.assertTrue(bool(reward.isfinite().all()))
        _, _, done, extras = env.step(torch.zeros(N, 7))
        self.assertEqual((done.tolist(), extras["faulty"].any().item()), ([0] * N, False))
        self.assertEqual((int(env.overflow_count), int(env.nonfinite_count)), (1, 0))


class Learning(unittest.TestCase):
    def updated(self, faulty_reward: float, *, marked: bool) -> dict[str, torch.Tensor]:
        """Weights after one update in which world 1's step 2 had that reward, and was the last of its episode."""

        class Nothing:
            num_envs = N
            num_actions = 3
            device = "cpu"

        def observations(seed: int) -> TensorDict:
            g = torch.Generator().manual_seed(seed)
            widths = {"policy": (7,), "proprio": (9,), "perception": (1, 10, 3), "privileged": (4,)}
            return TensorDict({k: torch.randn(N, *w, generator=g) for k, w in widths.items()}, batch_size=[N])

        torch.manual_seed(0)
        alg = SequencePpo.construct_algorithm(
            observations(0), Nothing(), rsl_rl_config(CONFIG, N) | {"multi_gpu": None}, "cpu"
        )
        with torch.no_grad():
            for t in range(8):
                alg.act(observations(t))
                reward = torch.linspace(-1, 1, N)
                done = torch.zeros(N)
                faulty = torch.zeros(N, dtype=torch.bool)
                if t == 2:
                    reward[1] = faulty_reward
                    done[1] = 1.0
                    faulty[1] = marked
                alg.process_env_step(observations(t + 1), reward, done, {"time_outs": done * 0, "faulty": faulty})
            alg.compute_returns(observations(8))
        torch.manual_seed(1)
        alg.update()
        return alg.actor.state_dict() | {f"critic.{k}": v for k, v in alg.critic.state_dict().items()}

    def test_nothing_is_learned_from_a_faulty_step(self):
        one = self.updated(0.0, marked=True)
        two = self.updated(1000.0, marked=True)
        for name, value in one.items():
            torch.testing.assert_close(value, two[name], rtol=0, atol=0, msg=name)

    def test_without_the_mark_it_would_be(self):
        one = self.updated(0.0, marked=False)
        two = self.updated(1000.0, marked=False)
        self.assertTrue(any(not torch.equal(value, two[name]) for name, value in one.items()))


class Run(WithEnv):
    def train(self, name: str, plan: dict[int, tuple[str, int]]) -> TrainingRunner:
        folder = self.folder / name
        runner = TrainingRunner(self.make(plan), CONFIG, folder)
        with redirect_stdout(StringIO()):
            runner.learn(CONFIG.iterations)
        return runner

    def test_few_faults_do_no_harm(self):
        runner = self.train("few", {5: ("nonfinite", 0), 6: ("overflow", 3), 20: ("nonfinite", 1)})
        self.assertEqual(runner.iteration, 3)
        for name, value in runner.alg.actor.state_dict().items():
            self.assertTrue(bool(value.isfinite().all()), name)

    def test_too_many_end_the_run(self):
        plan = {
            step: ("nonfinite" if step % 2 else "overflow", step % N) for step in range(9, 17)
        }  # all in the second iteration
        self.assertGreater(len(plan), FaultBudget(8 * N).allowed)
        with self.assertRaisesRegex(RunError, "4 worlds were not finite and 4 dropped contacts.*--resume"):
            self.train("many", plan)
        self.assertEqual([c.name for c in checkpoints(self.folder / "many")], ["000001.pt"])


if __name__ == "__main__":
    unittest.main()
