"""Numbers that are not finite in a world of every engine: that world reports them, and no other changes by a bit."""

from __future__ import annotations

import unittest

import torch

from tests.test_conformance_engines import BACKENDS, make_local
from xreset.backends.conformance.harness import Bench, Worlds, state_errors
from xreset.backends.conformance.scene import scene
from xreset.plugins import backend_status

BROKEN = 1
SOUND = [0, 2, 3]


class NotFinite(unittest.TestCase):
    def test_a_broken_world_harms_no_other_and_begins_again(self):
        for name in BACKENDS:
            with self.subTest(name):
                reason = backend_status(name).reason
                if reason is not None:
                    self.skipTest(f"{name}: {reason}")
                bench = Bench(make_local(name), scene())
                with bench.other(bench.scene, bench.which) as worlds, bench.other(bench.scene, bench.which) as same:
                    self.check(bench, worlds, same)

    def check(self, bench: Bench, worlds: Worlds, same: Worlds) -> None:
        start = bench.start()
        worlds.advance(start, 4)
        same.advance(start, 4)
        for field, value in (("object_linvel", torch.nan), ("object_pos", torch.inf), ("joint_vel", torch.nan)):
            bad = start.clone()
            getattr(bad, field)[BROKEN] = value
            worlds.set(bad, [BROKEN])
            same.set(start, [BROKEN])
            worlds.step(4)
            same.step(4)
            self.assertEqual(worlds.nonfinite().tolist(), [False, True, False, False], field)
            for what, error in state_errors(worlds.state()[SOUND], same.state()[SOUND]).items():
                self.assertFalse(error.any(), f"{field} = {value}: {what} of another world")
            forces = worlds.contacts().table_force[SOUND]
            self.assertTrue(torch.equal(forces, same.contacts().table_force[SOUND]), f"{field} = {value}")
            for both in (worlds, same):
                both.set(start, [BROKEN])
                both.step(4)
            self.assertFalse(worlds.nonfinite().any(), field)
            for what, error in state_errors(worlds.state(), same.state()).items():
                self.assertLess(float(error.abs().max()), 1e-5, f"{what} after a new start")


if __name__ == "__main__":
    unittest.main()
