"""Accounts of what is kept and lost."""

import json
import tempfile
import unittest
from pathlib import Path

import numpy as np

from xreset.accounts import accounts, accounts_path, described, with_totals, write_accounts


class AccountsTest(unittest.TestCase):
    def setUp(self):
        rng = np.random.default_rng(0)
        self.names = rng.choice(["can", "box"], 200)
        self.post = rng.random(200) < 0.4
        self.reason = rng.choice(["", "jump", "limit", "not annotated"], 200, p=[0.5, 0.3, 0.1, 0.1])
        self.rows = accounts(self.names, self.post, self.reason)

    def test_every_item_is_kept_or_lost_for_one_reason(self):
        self.assertEqual(
            [(r.object_name, r.phase) for r in self.rows][:2], [("box", "pre-contact"), ("box", "post-contact")]
        )
        for row in with_totals(self.rows):
            self.assertEqual(row.total, row.kept + sum(row.lost.values()))
        for row in self.rows:
            mine = (self.names == row.object_name) & (self.post == (row.phase == "post-contact"))
            self.assertEqual((row.total, row.kept), (mine.sum(), (mine & (self.reason == "")).sum()))
            self.assertEqual(row.lost["jump"], (mine & (self.reason == "jump")).sum())

    def test_totals(self):
        *_, before, after, both = with_totals(self.rows)
        self.assertEqual((before.phase, after.phase, both.phase), ("pre-contact", "post-contact", "both"))
        self.assertEqual((after.total, both.total), (self.post.sum(), 200))
        self.assertEqual(both.kept, (self.reason == "").sum())
        annotated = both.without("not annotated")
        self.assertEqual(annotated.total, (self.reason != "not annotated").sum())
        self.assertEqual(annotated.share, both.kept / annotated.total)

    def test_reasons_are_listed_by_frequency(self):
        self.assertRegex(described(with_totals(self.rows)[-1].lost), r"^jump \d+, ")
        self.assertEqual(described({}), "")

    def test_file(self):
        with tempfile.TemporaryDirectory() as folder:
            path = accounts_path(Path(folder) / "resets.npz")
            write_accounts(path, of="states", rows=self.rows)
            data = json.loads(path.read_text())
        self.assertEqual(path.name, "resets.accounts.json")
        self.assertEqual((data["schema"], data["of"], len(data["rows"])), ("xreset-accounts/1", "states", 7))
        self.assertEqual(data["rows"][-1]["kept"], int((self.reason == "").sum()))


if __name__ == "__main__":
    unittest.main()
