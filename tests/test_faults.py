"""Worlds that break are counted and not learned from, and a run with too many of them ends."""

from collections import deque
from contextlib import redirect_stdout
from dataclasses import replace
from io import StringIO
from unittest import TestCase, mock

import torch

from tests import toy_training
from tests.data import InFolder
from tests.test_env import TASK, BreakableBackend, N, WithEnv
from tests.test_learning import observations
from xreset.errors import RunError
from xreset.learning.distributed import Processes
from xreset.learning.ppo import SequencePpo
from xreset.learning.run import checkpoints
from xreset.learning.runner import FAULT_WINDOW, MAX_FAULTY_SHARE, TrainingRunner

CONFIG = replace(toy_training.CONFIG, task=TASK, iterations=3)


class PlannedBackend(BreakableBackend):
    """Worlds break in given steps."""

    steps = 0

    def step(self, substeps=None):
        super().step(substeps)
        self.steps += 1
        if self.steps in self.plan:
            kind, world = self.plan[self.steps]
            getattr(self, kind)[world] = True


class Budget(TestCase):
    def test_the_share_of_a_window(self):
        def counted(*faults):
            env = mock.Mock(nonfinite_count=torch.tensor(0), overflow_count=torch.tensor(0))
            runner = mock.Mock(
                env=env,
                processes=Processes(),
                _fault_totals=deque([[0, 0]], maxlen=FAULT_WINDOW),
            )
            for nonfinite, overflow in faults:
                env.nonfinite_count = env.nonfinite_count + nonfinite
                env.overflow_count = env.overflow_count + overflow
                TrainingRunner._check_faults(runner, 1000)

        counted((150, 50))
        counted((200, 0), *[(0, 0)] * (FAULT_WINDOW - 1), (0, 200))  # old faults are forgotten
        with self.assertRaisesRegex(RunError, "151 worlds were not finite and 50 dropped .* 0.1%"):
            counted((150, 50), (1, 0))


class Environment(WithEnv):
    def test_a_world_that_drops_contacts_is_reset_and_counted_once(self):
        env = self.make(kind=BreakableBackend)
        env.backend.overflow[1] = True
        for world_ends in (True, False):
            _, reward, done, extras = env.step(torch.zeros(N, 7))
            self.assertEqual(done.tolist(), [0, int(world_ends), 0])
            self.assertEqual(extras["faulty"].tolist(), [False, world_ends, False])
            self.assertTrue(reward.isfinite().all())
        self.assertEqual((int(env.overflow_count), int(env.nonfinite_count)), (1, 0))


class Learning(TestCase):
    def updated(self, faulty_reward, *, marked):
        """Weights after one update in which world 1's step 2 had that reward, and was the last of its episode."""
        torch.manual_seed(0)
        alg = SequencePpo(observations(N), 3, CONFIG, "cpu", Processes())
        with torch.no_grad():
            for t in range(8):
                alg.act(observations(N, seed=t))
                reward = torch.linspace(-1, 1, N)
                done = torch.zeros(N)
                faulty = torch.zeros(N, dtype=torch.bool)
                if t == 2:
                    reward[1] = faulty_reward
                    done[1] = 1.0
                    faulty[1] = marked
                alg.process_env_step(
                    observations(N, seed=t + 1),
                    reward,
                    done,
                    {"time_outs": done * 0, "faulty": faulty},
                )
            alg.compute_returns(observations(N, seed=8))
        torch.manual_seed(1)
        alg.update()
        return alg.actor.state_dict() | {
            f"critic.{k}": v for k, v in alg.critic.state_dict().items()
        }

    def test_nothing_is_learned_from_a_faulty_step(self):
        """Without the mark it would be."""
        for marked in (True, False):
            one, two = (self.updated(reward, marked=marked) for reward in (0.0, 1000.0))
            self.assertEqual(
                all(torch.equal(value, two[name]) for name, value in one.items()), marked
            )


class Run(WithEnv, InFolder):
    def train(self, folder, plan):
        env = self.make(kind=PlannedBackend)
        env.backend.plan = plan
        torch.manual_seed(0)
        runner = TrainingRunner(env, CONFIG, folder)
        with redirect_stdout(StringIO()):
            runner.learn(CONFIG.iterations)
        return runner

    def test_few_faults_do_no_harm_and_too_many_end_the_run(self):
        folder = self.folder
        runner = self.train(
            folder / "few", {5: ("broken", 0), 6: ("overflow", 2), 20: ("broken", 1)}
        )
        self.assertEqual(runner.iteration, 3)
        for name, value in runner.alg.actor.state_dict().items():
            self.assertTrue(value.isfinite().all(), name)
        # all in the second iteration
        plan = {step: ("broken" if step % 2 else "overflow", step % N) for step in range(9, 17)}
        self.assertGreater(len(plan), MAX_FAULTY_SHARE * FAULT_WINDOW * 8 * N)
        with self.assertRaisesRegex(
            RunError, "4 worlds were not finite and 4 dropped contacts.*--resume"
        ):
            self.train(folder / "many", plan)
        self.assertEqual([c.name for c in checkpoints(folder / "many")], ["000001.pt"])
