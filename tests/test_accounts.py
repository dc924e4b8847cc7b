"""Accounts of what is kept and lost."""

import json
import tempfile
import unittest
from pathlib import Path

import numpy as np

from xreset.accounts import accounts, accounts_path, described, write_accounts


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

    def test_file(self):
        with tempfile.TemporaryDirectory() as folder:
            path = accounts_path(Path(folder) / "resets.npz")
            write_accounts(path, of="states", rows=self.rows)
            data = json.loads(path.read_text())
        self.assertEqual(path.name, "resets.accounts.json")
        self.assertEqual(
            (data["schema"], data["of"], len(data["rows"])), ("xreset-accounts/1", "states", 7)
        )
        self.assertEqual(data["rows"][-1]["kept"], int((self.reason == "").sum()))


if __name__ == "__main__":
    unittest.main()
