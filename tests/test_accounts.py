"""Accounts of what is kept and lost."""

import unittest
from itertools import product

import numpy as np

from xreset.retarget.accounts import accounts, described


class AccountsTest(unittest.TestCase):
    def test_every_item_is_kept_or_lost_for_one_reason(self):
        rng = np.random.default_rng(0)
        names = rng.choice(["can", "box"], 200)
        post = rng.random(200) < 0.4
        reason = rng.choice(["", "jump", "limit", "not annotated"], 200, p=[0.5, 0.3, 0.1, 0.1])
        rows = accounts(names, post, reason)
        phases = ("pre-contact", "post-contact")
        expected = [*product(("box", "can", "all"), phases), ("all", "both")]
        self.assertEqual([(row.object_name, row.phase) for row in rows], expected)
        for row in rows:
            mine = (names == row.object_name) | (row.object_name == "all")
            mine &= (post == (row.phase == "post-contact")) | (row.phase == "both")
            self.assertEqual(row.total, mine.sum())
            for name, number in (row.lost | {"": row.kept}).items():
                self.assertEqual(number, (mine & (reason == name)).sum())
        annotated = rows[-1].without("not annotated")
        self.assertEqual(annotated.total, (reason != "not annotated").sum())
        self.assertRegex(described(rows[-1].lost), r"^jump \d+, ")
