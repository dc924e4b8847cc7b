"""MuJoCo-Warp publishes the engine's own memory on every device: no copies, and nothing passes through the host."""

import unittest

import torch

from xreset.backends.conformance.scene import scene
from xreset.backends.mujoco_warp import MujocoWarpBackend


def published(backend):
    """Every tensor of the getters that a control step writes, by name."""
    tensors = {"nonfinite": backend.health().nonfinite}
    for bundle in (backend.state(), backend.links(), backend.contacts()):
        tensors |= vars(bundle)
    return tensors


class SharedMemory(unittest.TestCase):
    def each(self):
        for device in MujocoWarpBackend.devices():
            with (
                self.subTest(device=device),
                MujocoWarpBackend(scene(), 3, device=device) as backend,
            ):
                yield backend

    def test_a_step_shows_in_tensors_that_were_read_before(self):
        for backend in self.each():
            before = published(backend)
            start = {name: tensor.clone() for name, tensor in before.items()}
            backend.set_joint_targets(backend.state().joint_target + 0.05)
            backend.step()
            for name, tensor in published(backend).items():
                self.assertEqual(tensor.data_ptr(), before[name].data_ptr(), name)
                self.assertEqual(tensor.device, backend.device, name)
            written = {name for name in before if not torch.equal(before[name], start[name])}
            expected = {"joint_pos", "joint_vel", "joint_target", "object_pos", "table_force"}
            self.assertLessEqual(expected | {"pos", "linvel"}, written)

    @unittest.skipUnless(torch.cuda.is_available(), "no CUDA device")
    def test_no_control_step_goes_through_the_host(self):
        from torch.profiler import ProfilerActivity, profile

        backend = MujocoWarpBackend(scene(), 3, device="cuda")
        self.addCleanup(backend.close)
        targets = backend.state().joint_target + 0.05

        def control_step():
            backend.set_joint_targets(targets)
            backend.step()
            published(backend)

        def device_work(action):
            with profile(activities=[ProfilerActivity.CUDA]) as trace:
                action()
                torch.cuda.synchronize()
            return " ".join(event.key for event in trace.key_averages())

        control_step()
        names = device_work(control_step)
        self.assertIn("read_state", names, "the profiler saw no kernel that publishes")
        self.assertNotRegex(names, "DtoH|HtoD")
        self.assertIn("DtoH", device_work(lambda: targets.cpu()), "a copy to the host must show")
