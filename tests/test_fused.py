"""The fused PointNet against the plain layers: on a GPU as it trains, elsewhere in float32 with Triton's interpreter.

The interpreter is chosen when Triton is imported: ``TRITON_INTERPRET=1 python -m unittest tests.test_fused``.
"""

import importlib.util
import os
from unittest import TestCase, mock, skipUnless

import torch

from xreset.learning.model import PointNet

ON_GPU = torch.cuda.is_available()


@skipUnless(
    importlib.util.find_spec("triton"),
    "Triton is not installed (it comes with PyTorch's CUDA builds)",
)
@skipUnless(
    ON_GPU or os.environ.get("TRITON_INTERPRET") == "1",
    "no GPU here, and TRITON_INTERPRET=1 is not set",
)
class FusedPointNetTest(TestCase):
    @classmethod
    def setUpClass(cls):
        from xreset.learning import fused

        cls.fused = fused
        cls.device = "cuda" if ON_GPU else "cpu"

    def compare(self, clouds, dims, points, width):
        """Relative differences of the embeddings and of every gradient."""
        torch.manual_seed(clouds[0])
        net = PointNet(dims, point_width=width).to(self.device)
        center = torch.linspace(0.5, 0.05, width, device=self.device)
        cloud = 0.05 * torch.randn(*clouds, points, width, device=self.device) + center
        weight = torch.randn(*clouds, dims[-1], device=self.device)
        parameters = list(net.parameters())
        with mock.patch.object(self.fused, "FACTORS", torch.bfloat16 if ON_GPU else torch.float32):
            fast = self.fused.fused_pointnet(cloud, *parameters)
            gradients = torch.autograd.grad(fast, parameters, weight)
        plain = net(cloud)
        expected = torch.autograd.grad(plain, parameters, weight)
        names = ["embedding", *(name for name, _ in net.named_parameters())]
        differences = {}
        for name, a, b in zip(names, (fast, *gradients), (plain, *expected), strict=True):
            differences[name] = float((a - b).detach().norm() / b.detach().norm())
        return differences

    def test_it_computes_what_the_plain_layers_compute(self):
        # bfloat16 factors move some maxima to another point, and some gradient with them: plain layers in bfloat16 differ as much.
        forward, backward = (6e-3, 8e-2) if ON_GPU else (1e-6, 1e-5)
        for clouds, dims, points, width in (
            ((5,), [64, 128, 64], 64, 3),
            ((5,), [64, 128, 64], 64, 9),
            ((2, 3), [16, 32, 16], 16, 3),
            ((300 if ON_GPU else 2,), [32, 32, 64], 32, 3),
        ):
            for name, difference in self.compare(clouds, dims, points, width).items():
                with self.subTest(clouds=clouds, dims=dims, what=name):
                    self.assertLess(difference, forward if name == "embedding" else backward)

    def test_what_the_kernels_cannot_take(self):
        self.assertTrue(self.fused.supports(64, (64, 128, 64)))
        for points, widths in (
            (48, (64, 128, 64)),
            (64, (64, 100, 64)),
            (64, (64, 64)),
            (64, (64, 256, 64)),
        ):
            self.assertFalse(self.fused.supports(points, widths), (points, widths))
