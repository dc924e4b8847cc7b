"""How items are shared among worlds."""

import unittest

import numpy as np

from xreset.schedule import schedule

CASES = {
    "one world": ([0, 0, 0], 1),
    "more worlds than items": ([0, 1, 0, 1, 1], 64),
    "uneven objects": ([0] * 13 + [2] * 2 + [5], 6),
    "interleaved": ([i % 3 for i in range(20)], 5),
    "one of each of nine": (list(range(9)), 4),
    "a rare object beside a common one": ([0] + [1] * 99, 10),
    "three rare objects": ([0, 1, 2] + [3] * 97, 10),
}


class ScheduleTest(unittest.TestCase):
    def test_every_item_is_fresh_exactly_once(self):
        for name, (items, worlds) in CASES.items():
            with self.subTest(name):
                plan = schedule(np.array(items), worlds)
                done = [item for row, fresh in plan for item in row[fresh].tolist()]
                self.assertEqual(sorted(done), list(range(len(items))))

    def test_a_world_keeps_its_object(self):
        for name, (items, worlds) in CASES.items():
            with self.subTest(name):
                plan = schedule(np.array(items), worlds)
                for row, _ in plan:
                    np.testing.assert_array_equal(np.array(items)[row], plan.object_index)

    def test_uses_no_more_worlds_than_allowed_or_needed(self):
        for name, (items, worlds) in CASES.items():
            with self.subTest(name):
                number = len(schedule(np.array(items), worlds).object_index)
                kinds = len(set(items))
                self.assertLessEqual(number, max(worlds, kinds))  # each object needs a world of its own
                self.assertEqual(number, min(max(worlds, kinds), len(items)))

    def test_no_round_is_wasted(self):
        """Every round has fresh work, and no split of the worlds among the objects would need fewer rounds."""
        for name, (items, worlds) in CASES.items():
            with self.subTest(name):
                plan = schedule(np.array(items), worlds)
                self.assertTrue(plan.fresh.any(axis=1).all())
                counts = np.bincount(items)
                fewer = len(plan.rounds) - 1
                if fewer:
                    needed = sum(-(-count // fewer) for count in counts)
                    self.assertGreater(needed, len(plan.object_index), "one round fewer would have been possible")

    def test_a_world_without_work_repeats_an_item_of_its_object(self):
        plan = schedule(np.array([0, 0, 0]), 2)
        np.testing.assert_array_equal(plan.rounds, [[0, 1], [2, 2]])
        np.testing.assert_array_equal(plan.fresh, [[True, True], [True, False]])


if __name__ == "__main__":
    unittest.main()
