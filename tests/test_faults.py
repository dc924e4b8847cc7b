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
from xreset.errors import RunError
from xreset.learning.distributed import Processes
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
            RunError, "4 worlds were not finite and 4 dropped contacts.*xreset train --out"
        ):
            self.train(folder / "many", plan)
        self.assertEqual([c.name for c in checkpoints(folder / "many")], ["000001.pt"])
