"""Trainings that take seconds: a small network, and a robot at home in every state of its bank."""

import io
from contextlib import contextmanager, redirect_stdout
from unittest.mock import Mock, patch

import numpy as np

from tests.command import refused, succeeds
from tests.data import InOneFolder
from tests.toy_bank import in_this_process, toy_bank
from xreset import TaskConfig, robots, write_bank
from xreset.learning.config import ModelConfig, PpoConfig, TrainConfig
from xreset.task.config import ObservationConfig

CONFIG = TrainConfig(
    task=TaskConfig(observation=ObservationConfig(cloud_points=16), distance_points=64),
    model=ModelConfig(pointnet=(8, 6), lstm=12, mlp=(16,)),
    ppo=PpoConfig(horizon=8, mini_epochs=2, minibatch_size=16),
    iterations=2,
    save_interval=1,
)
OPTIONS = {"engine": "mujoco", "device": "cpu", "num_envs": 4, "seed": 3}


class WithBank(InOneFolder):
    """Tests that share a robot and its bank."""

    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        cls.robot = robots.load("openarm")
        home = np.tile(cls.robot.home, (6, 1)).astype(np.float32)
        cls.states = toy_bank(cls.robot, joint_pos=home)
        cls.bank = cls.folder / "bank.npz"
        write_bank(cls.bank, cls.states)

    def assert_resumed(self, command, problem):
        """A command continues a run or, if there is a problem, prints it and does not."""
        run = refused if problem else succeeds
        with patch("xreset.learning.train.resume") as resumed:
            self.assertRegex(run(command), problem or "^$")
        self.assertEqual(resumed.called, not problem)


@contextmanager
def quickly():
    """Leave out what takes longer than all the rest: processes for the engine, and the export at the end. Yields what is printed."""
    without_export = patch.multiple(
        "xreset.learning.train", export_checkpoint=Mock(), _export_if_missing=Mock()
    )
    with in_this_process(), without_export, redirect_stdout(io.StringIO()) as said:
        yield said
