"""Settings that change during a run."""

import unittest
from types import SimpleNamespace

import numpy as np

from xreset.learning.config import TrainConfig
from xreset.learning.runner import TrainingRunner
from xreset.learning.schedules import ScheduleConfig, value_at


class ScheduleTest(unittest.TestCase):
    def test_values_lie_on_straight_lines_between_the_points(self):
        points = ((0.2, 0.9), (0.6, 0.5), (1.0, 0.1))
        for progress, value in ((0.0, 0.9), (0.2, 0.9), (0.4, 0.7), (0.8, 0.3), (1.0, 0.1), (1.5, 0.1)):
            with self.subTest(progress=progress):
                self.assertAlmostEqual(value_at(points, progress), value)

    def test_a_schedule_that_ends_before_it_begins_is_refused(self):
        for points in (((0.5, 0.9), (0.2, 0.1)), ((0.0, 0.9), (0.0, 0.1)), ((0.0, 1.2),), ((-0.1, 0.5),)):
            with (
                self.subTest(points=points),
                self.assertRaisesRegex(ValueError, "each share greater than the one before"),
            ):
                ScheduleConfig(faults=points)

    def test_a_training_moves_its_limit_of_success_and_its_faults(self):
        set_to = []
        world = SimpleNamespace(
            set_success_position=set_to.append, variation=SimpleNamespace(set_fault_scale=set_to.append)
        )
        schedule = ScheduleConfig(success_position=((0.0, 0.05), (1.0, 0.01)), faults=((0.0, 0.0), (0.5, 1.0)))
        runner = SimpleNamespace(world=world, train_config=TrainConfig(schedule=schedule))
        for progress in (0.25, 1.0):
            TrainingRunner._follow_schedule(runner, progress)
        np.testing.assert_allclose(set_to, (0.04, 0.5, 0.01, 1.0))


if __name__ == "__main__":
    unittest.main()
