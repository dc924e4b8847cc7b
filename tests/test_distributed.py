"""Two processes train together on the CPU, as ``torchrun`` starts them; and what a process finds out about itself."""

import os
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path
from unittest import mock

import numpy as np
import torch

from tests.toy_bank import toy_bank
from xreset import robots
from xreset.learning.distributed import Processes
from xreset.learning.run import checkpoints
from xreset.resets.bank import write_bank

try:
    import xreset.backends.mujoco  # noqa: F401
except ImportError as error:
    raise unittest.SkipTest(str(error)) from error

ROOT = Path(__file__).resolve().parents[1]
SMALL = (
    "--config.task.observation.cloud-points 16 --config.task.distance-points 64 --config.model.pointnet 8 6 "
    "--config.model.lstm 12 --config.model.mlp 16 --config.ppo.horizon 8 --config.ppo.mini-epochs 2 "
    "--config.ppo.minibatch-size 32 --config.save-interval 1"
)


class TwoProcesses(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.folder = Path(cls.enterClassContext(tempfile.TemporaryDirectory()))
        robot = robots.load("openarm")
        cls.bank = cls.folder / "bank.npz"
        home = np.tile(robot.home, (6, 1)).astype(np.float32)
        write_bank(cls.bank, toy_bank(robot, joint_pos=home), config={}, inputs={})
        cls.out = cls.folder / "run"
        new = f"--robot openarm --resets {cls.bank} --backend mujoco --device cpu --num-envs 8 --seed 3"
        cls.first = cls.train(f"--out {cls.out} --iterations 2 {new} {SMALL}")
        cls.made = sorted(path.name for path in cls.out.rglob("*") if path.is_file())
        cls.second = cls.train(f"--out {cls.out} --iterations 3 --resume")

    @classmethod
    def train(cls, arguments: str) -> list[dict]:
        """What the two processes end with."""
        torchrun = "-m torch.distributed.run --standalone --nproc-per-node 2 tests/train_worker.py"
        command = [sys.executable, *torchrun.split(), str(cls.folder), *arguments.split()]
        environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)
        if done.returncode:
            raise AssertionError(f"torchrun ended with {done.returncode}:\n{done.stdout}\n{done.stderr}")
        cls.output = done.stdout
        return [torch.load(cls.folder / f"{rank}.pt", weights_only=True) for rank in (0, 1)]

    def test_both_end_with_the_same_models(self):
        for one, two in (self.first, self.second):
            for model in ("actor", "critic"):
                for name, value in one[model].items():  # weights, and the normalisers' mean, variance and count
                    torch.testing.assert_close(value, two[model][name], rtol=0, atol=0, msg=f"{model} {name}")
            self.assertEqual(one["learning_rate"], two["learning_rate"])
        count = next(value for name, value in self.first[0]["actor"].items() if name.endswith("count"))
        self.assertEqual(int(count), 2 * 2 * 8 * 8)  # processes x iterations x horizon x worlds

    def test_each_simulates_other_episodes(self):
        for one, two in (self.first, self.second):
            self.assertFalse(torch.equal(one["policy_obs"], two["policy_obs"]))
            self.assertFalse(torch.equal(one["random"], two["random"]))

    def test_steps_of_all_are_counted(self):
        self.assertEqual(
            [end["env_steps"] for end in (*self.first, *self.second)], [2 * 2 * 8 * 8] * 2 + [3 * 2 * 8 * 8] * 2
        )

    def test_the_main_process_alone_writes(self):
        self.assertEqual(self.made.count("run.json"), 1)
        self.assertEqual([c.name for c in checkpoints(self.out)], ["000001.pt", "000002.pt", "000003.pt"])
        self.assertEqual(len([name for name in self.made if name.startswith("events.out")]), 1)
        self.assertTrue((self.out / "policy.onnx").is_file())
        self.assertEqual(self.output.count("continuing after iteration 2"), 1)

    def test_resume_goes_on_in_every_process(self):
        for before, after in zip(self.first, self.second, strict=True):
            for name, value in before["actor"].items():
                torch.testing.assert_close(value, after["start_actor"][name], rtol=0, atol=0, msg=name)


class Environment(unittest.TestCase):
    def of(self, **variables: str) -> Processes:
        with mock.patch.dict(os.environ, variables):
            return Processes.of_environment()

    def test_alone(self):
        alone = Processes.of_environment()
        self.assertEqual((alone, alone.is_main, alone.device("cuda"), alone.seed(5)), (Processes(), True, "cuda", 5))

    def test_one_of_several(self):
        fifth = self.of(RANK="5", LOCAL_RANK="1", WORLD_SIZE="8")
        self.assertEqual((fifth.is_main, fifth.device("cuda:0"), fifth.device("cpu")), (False, "cuda:1", "cpu"))
        self.assertNotEqual(fifth.seed(0), self.of(RANK="4", LOCAL_RANK="0", WORLD_SIZE="8").seed(0))


if __name__ == "__main__":
    unittest.main()
