"""Settings that change during a run."""

import unittest
from unittest import mock

import torch

from xreset.learning.config import ScheduleConfig, TrainConfig
from xreset.learning.runner import TrainingRunner


class ScheduleTest(unittest.TestCase):
    def test_a_schedule_that_ends_before_it_begins_is_refused(self):
        for points in (
            ((0.5, 0.9), (0.2, 0.1)),
            ((0.0, 0.9), (0.0, 0.1)),
            ((0.0, 1.2),),
            ((-0.1, 0.5),),
        ):
            with (
                self.subTest(points=points),
                self.assertRaisesRegex(ValueError, "each share greater than the one before"),
            ):
                ScheduleConfig(faults=points)

    def test_a_training_moves_its_limit_of_success_and_its_faults(self):
        """On straight lines between the points."""
        env = mock.Mock(success_position=torch.zeros(()))
        env.drawn.fault_scale = torch.zeros(())
        schedule = ScheduleConfig(
            success_position=((0.2, 0.05), (1.0, 0.01)), faults=((0.0, 0.0), (0.5, 1.0))
        )
        runner = mock.Mock(env=env, config=TrainConfig(schedule=schedule))
        for progress, limit, scale in (
            (0.1, 0.05, 0.2),
            (0.25, 0.0475, 0.5),
            (0.6, 0.03, 1.0),
            (1.5, 0.01, 1.0),
        ):
            TrainingRunner._follow_schedule(runner, progress)
            self.assertAlmostEqual(float(env.success_position), limit)
            self.assertAlmostEqual(float(env.drawn.fault_scale), scale)


if __name__ == "__main__":
    unittest.main()
