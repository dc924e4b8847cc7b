"""Numbers that are not finite, put into a world of every engine while it runs: that world says so, and no other notices, bit for bit."""

from __future__ import annotations

import unittest
from dataclasses import fields

import torch

from tests.test_conformance_engines import BACKENDS, make_local
from xreset.backends.conformance.scene import scene
from xreset.physics import State
from xreset.plugins import backend_status

WORLDS, BROKEN = 4, 1
SOUND = [0, 2, 3]


class NotFinite(unittest.TestCase):
    def test_a_broken_world_harms_no_other_and_begins_anew(self):
        for name in BACKENDS:
            with self.subTest(name):
                if (reason := backend_status(name).reason) is not None:
                    self.skipTest(f"{name}: {reason}")
                self.check(name)

    def check(self, name: str) -> None:
        spec = scene()
        index = torch.arange(WORLDS) % len(spec.objects)
        start = State.initial(spec, index)
        with (
            make_local(name)(spec, WORLDS, object_index=index) as backend,
            make_local(name)(spec, WORLDS, object_index=index) as same,
        ):
            begin = start.to(backend.device)
            for worlds in (backend, same):
                worlds.set_state(begin)
                worlds.step(4)
            for field, value in (("object_linvel", torch.nan), ("object_pos", torch.inf), ("joint_vel", torch.nan)):
                state = State(**{f.name: getattr(start, f.name).clone() for f in fields(State)})
                getattr(state, field)[BROKEN] = value
                one = torch.tensor([BROKEN], device=backend.device)
                backend.set_state(state[[BROKEN]].to(backend.device), one)
                same.set_state(start[[BROKEN]].to(backend.device), one)
                for worlds in (backend, same):
                    worlds.step(4)
                self.assertEqual(
                    backend.health().nonfinite.tolist(), [world == BROKEN for world in range(WORLDS)], field
                )
                for f in fields(State):
                    found, expected = (getattr(worlds.state(), f.name).cpu()[SOUND] for worlds in (backend, same))
                    self.assertTrue(torch.equal(found, expected), f"{field} = {value}: {f.name} of another world")
                found, expected = (worlds.contacts().table_force.cpu()[SOUND] for worlds in (backend, same))
                self.assertTrue(torch.equal(found, expected), f"{field} = {value}: contact forces of another world")
                for worlds in (backend, same):
                    worlds.set_state(start[[BROKEN]].to(backend.device), one)
                    worlds.step(4)
                self.assertFalse(backend.health().nonfinite.any(), field)
                for f in fields(State):
                    found, expected = (getattr(worlds.state(), f.name).cpu() for worlds in (backend, same))
                    torch.testing.assert_close(
                        found, expected, rtol=0, atol=1e-5, msg=lambda m, f=f: f"{f.name} after a new start: {m}"
                    )


if __name__ == "__main__":
    unittest.main()
