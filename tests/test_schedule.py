"""How items are shared among worlds."""

import unittest

import numpy as np
from numpy.testing import assert_array_equal

from xreset.errors import XResetError
from xreset.resets.schedule import schedule, shared_worlds

CASES = {
    "one world": ([0, 0, 0], 1),
    "more worlds than items": ([0, 1, 0, 1, 1], 64),
    "uneven objects": ([0] * 13 + [2] * 2 + [5], 6),
    "interleaved": ([i % 3 for i in range(20)], 5),
    "one of each of nine": (list(range(9)), 4),
    "a rare object and a common one": ([0] + [1] * 99, 10),
    "more objects than worlds, and a common one": ([*range(9), *[0] * 15], 4),
    "three rare objects": ([0, 1, 2] + [3] * 97, 10),
}


class ScheduleTest(unittest.TestCase):
    def test_every_item_is_fresh_once_in_a_world_of_its_object_and_no_round_is_wasted(self):
        for name, (items, worlds) in CASES.items():
            with self.subTest(name):
                items = np.array(items)
                plan = schedule(items, worlds)
                done = [row[fresh] for row, fresh in plan]
                self.assertEqual(sorted(np.concatenate(done)), list(range(len(items))))
                for row, fresh in plan:
                    assert_array_equal(items[row], plan.object_index)
                    self.assertTrue(fresh.any())
                kinds = len(set(items))  # each object needs a world of its own
                most = worlds if kinds <= worlds else 2 * kinds
                self.assertEqual(len(plan.object_index), min(most, len(items)))
                fewer = len(plan.rounds) - 1
                if fewer:
                    needed = sum(-(-count // fewer) for count in np.bincount(items))
                    self.assertGreater(
                        needed, len(plan.object_index), "one round fewer would have been possible"
                    )

    def test_a_world_without_work_repeats_an_item_of_its_object(self):
        plan = schedule(np.array([0, 0, 0]), 2)
        assert_array_equal(plan.rounds, [[0, 1], [2, 2]])
        assert_array_equal(plan.fresh, [[True, True], [True, False]])

    def test_objects_get_worlds_by_their_share(self):
        for names, worlds, share, expected in (
            ("abc", 10, {"b": 3.0}, [2, 6, 2]),
            ("abc", 9, {"a": 0.5, "c": 2.0}, [1, 3, 5]),  # of 1.3, 2.6 and 5.1
            ("ab", 7, {"a": 1.0}, [4, 3]),  # the first of equal remainders
            ("abcdefghijklmnopqrst", 30, {"a": 1.0}, [2] * 10 + [1] * 10),
        ):
            held = shared_worlds(names, worlds, share)
            assert_array_equal(held, np.repeat(np.arange(len(names)), expected))
        self.assertIsNone(shared_worlds("abc", 10, {}))
        with self.assertRaisesRegex(XResetError, "2 worlds cannot hold 3 objects"):
            shared_worlds("abc", 2, {})
