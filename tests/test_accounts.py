"""Accounts of what is kept and lost."""

import unittest

import numpy as np

from xreset.accounts import accounts, described


class AccountsTest(unittest.TestCase):
    def setUp(self):
        rng = np.random.default_rng(0)
        self.names = rng.choice(["can", "box"], 200)
        self.post = rng.random(200) < 0.4
        self.reason = rng.choice(
            ["", "jump", "limit", "not annotated"], 200, p=[0.5, 0.3, 0.1, 0.1]
        )
        self.rows = accounts(self.names, self.post, self.reason)

    def test_every_item_is_kept_or_lost_for_one_reason(self):
        phases = ("pre-contact", "post-contact")
        rows = self.rows
        expected = [(name, phase) for name in ("box", "can") for phase in phases]
        self.assertEqual(
            [(r.object_name, r.phase) for r in rows],
            [*expected, *(("all", p) for p in (*phases, "both"))],
        )
        for row in rows:
            mine = (self.names == row.object_name) | (row.object_name == "all")
            mine &= (self.post == (row.phase == "post-contact")) | (row.phase == "both")
            self.assertEqual(
                (row.total, row.kept), (mine.sum(), (mine & (self.reason == "")).sum())
            )
            for reason, number in row.lost.items():
                self.assertEqual(number, (mine & (self.reason == reason)).sum())
        annotated = rows[-1].without("not annotated")
        self.assertEqual(annotated.total, (self.reason != "not annotated").sum())
        self.assertRegex(described(rows[-1].lost), r"^jump \d+, ")
