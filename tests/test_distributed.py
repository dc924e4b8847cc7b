"""Two processes train together on the CPU, as ``torchrun`` starts them; and what a process finds out about itself."""

import os
import subprocess
import sys
from pathlib import Path
from unittest import SkipTest, TestCase, mock

import torch
from torch.testing import assert_close

from tests.toy_training import WithBank
from xreset.learning.distributed import Processes
from xreset.learning.run import checkpoints

try:
    import xreset.backends.mujoco  # noqa: F401
except ImportError as error:
    raise SkipTest(str(error)) from error

ROOT = Path(__file__).resolve().parents[1]
SMALL = (
    "--config.task.observation.cloud-points 16 --config.task.distance-points 64 --config.model.pointnet 8 6 "
    "--config.model.lstm 12 --config.model.mlp 16 --config.ppo.horizon 8 --config.ppo.mini-epochs 2 "
    "--config.ppo.minibatch-size 32 --config.save-interval 1 --config.task.reset.adaptive-share 0.5"
)


class TwoProcesses(WithBank):
    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        cls.out = cls.folder / "run"
        new = f"--robot openarm --resets {cls.bank} --engine mujoco --device cpu --num-envs 8 --seed 3"
        cls.first = cls.train(f"--out {cls.out} --iterations 2 {new} {SMALL}")
        cls.made = sorted(path.name for path in cls.out.rglob("*") if path.is_file())
        cls.second = cls.train(f"--out {cls.out} --iterations 3 --resume")

    @classmethod
    def train(cls, arguments):
        """What the two processes end with."""
        torchrun = "-m torch.distributed.run --standalone --nproc-per-node 2 tests/train_worker.py"
        command = [sys.executable, *torchrun.split(), str(cls.folder), *arguments.split()]
        environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
        done = subprocess.run(
            command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=900
        )
        if done.returncode:
            raise AssertionError(
                f"torchrun ended with {done.returncode}:\n{done.stdout}\n{done.stderr}"
            )
        cls.output = done.stdout
        return [torch.load(cls.folder / f"{rank}.pt", weights_only=True) for rank in (0, 1)]

    def test_both_learn_the_same_from_other_episodes(self):
        for one, two in (self.first, self.second):
            for model in (
                "actor",
                "critic",
            ):  # weights, and the normalisers' mean, variance and count
                assert_close(one[model], two[model], rtol=0, atol=0, msg=model)
            self.assertEqual(one["learning_rate"], two["learning_rate"])
            self.assertFalse(torch.equal(one["policy_obs"], two["policy_obs"]))
            self.assertFalse(torch.equal(one["random"], two["random"]))
        steps = 2 * 8 * 8  # processes x horizon x worlds
        count = next(
            value for name, value in self.first[0]["actor"].items() if name.endswith("count")
        )
        self.assertEqual(count, 2 * steps)
        self.assertEqual(
            [end["env_steps"] for end in (*self.first, *self.second)],
            [2 * steps] * 2 + [3 * steps] * 2,
        )
        for before, after in zip(self.first, self.second, strict=True):
            assert_close(before["actor"], after["start_actor"], rtol=0, atol=0)

    def test_demonstrations_have_the_same_rates_of_success_in_both(self):
        """The processes begin with rates of 0 and 1; a resumed run begins with those of the checkpoint."""
        one, two = self.first
        assert_close(one["success_rate"], two["success_rate"], rtol=0, atol=0)
        assert_close(one["success_rate"], torch.full((3,), 0.5), rtol=0, atol=0.2)
        for end in self.second:
            assert_close(end["start_success_rate"], one["success_rate"], rtol=0, atol=0)

    def test_the_main_process_alone_writes(self):
        self.assertEqual(self.made.count("run.json"), 1)
        self.assertEqual(
            [c.name for c in checkpoints(self.out)], ["000001.pt", "000002.pt", "000003.pt"]
        )
        self.assertEqual(len([name for name in self.made if name.startswith("events.out")]), 1)
        self.assertTrue((self.out / "policy.onnx").is_file())
        self.assertEqual(self.output.count("continuing after iteration 2"), 1)


class Environment(TestCase):
    def test_what_a_process_knows(self):
        alone = Processes.of_environment()
        self.assertEqual(
            (alone, alone.is_main, alone.device("cuda"), alone.seed(5)),
            (Processes(), True, "cuda", 5),
        )
        with mock.patch.dict(os.environ, {"RANK": "5", "LOCAL_RANK": "1", "WORLD_SIZE": "8"}):
            fifth = Processes.of_environment()
        self.assertEqual(
            (fifth.is_main, fifth.device("cuda:0"), fifth.device("cpu")), (False, "cuda:1", "cpu")
        )
        self.assertNotEqual(fifth.seed(0), alone.seed(0))
