"""What MuJoCo-Warp publishes is the engine's own memory, on every device that is there: no copies, nothing passes through the host."""

from __future__ import annotations

import unittest
from dataclasses import fields

import torch
from torch import Tensor

from xreset.backends.conformance.scene import scene
from xreset.backends.mujoco_warp import MujocoWarpBackend


class SharedMemory(unittest.TestCase):
    def published(self, backend: MujocoWarpBackend) -> dict[str, Tensor]:
        """Every tensor of the getters that a control step writes, by its name in the engine's arrays."""
        state, links, contacts = backend.state(), backend.links(), backend.contacts()
        tensors = {f.name: getattr(state, f.name) for f in fields(state)}
        tensors |= {f"link_{f.name}": getattr(links, f.name) for f in fields(links)}
        tensors |= {f.name: getattr(contacts, f.name) for f in fields(contacts)}
        return tensors | {"nonfinite": backend.health().nonfinite}

    def each(self):
        for device in MujocoWarpBackend.devices():
            with self.subTest(device=device):
                backend = MujocoWarpBackend(scene(), 3, device=device)
                yield backend
                backend.close()

    def test_getters_are_views_of_the_engines_arrays(self):
        for backend in self.each():
            arrays = {**backend._out, "joint_target": backend._data.ctrl}
            tensors = self.published(backend)
            self.assertEqual(set(arrays), set(tensors))
            for name, tensor in tensors.items():
                self.assertEqual(tensor.data_ptr(), arrays[name].ptr, name)
                self.assertEqual(tensor.device, backend.device, name)

    def test_a_step_shows_in_tensors_that_were_read_before(self):
        for backend in self.each():
            before = self.published(backend)
            start = {name: tensor.clone() for name, tensor in before.items()}
            backend.set_joint_targets(backend.state().joint_target + 0.05)
            backend.step()
            for name, tensor in self.published(backend).items():
                self.assertEqual(tensor.data_ptr(), before[name].data_ptr(), name)
            for name in (
                "joint_pos",
                "joint_vel",
                "joint_target",
                "object_pos",
                "link_pos",
                "link_linvel",
                "table_force",
            ):
                self.assertFalse(torch.equal(before[name], start[name]), name)

    @unittest.skipUnless(torch.cuda.is_available(), "no CUDA device")
    def test_no_control_step_goes_through_the_host(self):
        from torch.profiler import ProfilerActivity, profile

        backend = MujocoWarpBackend(scene(), 3, device="cuda")
        self.addCleanup(backend.close)
        targets = backend.state().joint_target + 0.05

        def control_step() -> None:
            backend.set_joint_targets(targets)
            backend.step()
            self.published(backend)

        def device_work(action) -> list[str]:
            with profile(activities=[ProfilerActivity.CUDA]) as trace:
                action()
                torch.cuda.synchronize()
            return [event.key for event in trace.key_averages()]

        control_step()
        names = device_work(control_step)
        self.assertTrue(
            [name for name in names if "read_state" in name], f"the profiler saw no kernel that publishes: {names}"
        )
        self.assertEqual([name for name in names if "DtoH" in name or "HtoD" in name], [])
        self.assertTrue(
            [name for name in device_work(lambda: targets.cpu()) if "DtoH" in name], "a copy to the host must show"
        )


if __name__ == "__main__":
    unittest.main()
