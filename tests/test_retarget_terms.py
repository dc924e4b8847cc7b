"""Every term of hand retargeting: its half gradient is half the derivative of its cost, its curvature is not
negative."""

import unittest

import torch

from tests.toy_retarget import FLOAT, slope
from xreset.retarget.hand import terms


class TermTest(unittest.TestCase):
    def setUp(self):
        generator = torch.Generator().manual_seed(0)
        self.x, self.target = torch.randn(2, 4, 3, 3, dtype=FLOAT, generator=generator)
        self.weight = torch.rand(4, 3, dtype=FLOAT, generator=generator)

    def check(self, term, x):
        """The term at x [B, ...], of which every row has a cost of its own."""
        found = term(x)
        for index in torch.ones_like(x[0]).nonzero().tolist():
            index = (slice(None), *index)
            half = slope(lambda x: term(x).cost, x, index) / 2
            torch.testing.assert_close(found.gradient[index], half, atol=1e-8, rtol=1e-6)
        return found

    def check_points(self, term, x):
        found = self.check(term, x)
        torch.testing.assert_close(found.curvature, found.curvature.mT)
        self.assertGreaterEqual(torch.linalg.eigvalsh(found.curvature).min().item(), -1e-12)
        return found

    def test_difference(self):
        found = self.check_points(lambda x: terms.difference(x, self.target, self.weight), self.x)
        torch.testing.assert_close(found.curvature[..., 0, 0], self.weight)

    def test_direction(self):
        found = self.check_points(lambda x: terms.direction(x, self.target, self.weight), self.x)
        along = found.curvature @ self.x[..., None]  # no change of length changes a direction
        torch.testing.assert_close(along, torch.zeros_like(along), atol=1e-12, rtol=0)

    def test_contact_within_the_margin_below_and_above_the_knee(self):
        gap = torch.tensor([0.05, 0.11, 0.5], dtype=FLOAT)[:, None] * torch.nn.functional.normalize(self.x, dim=-1)
        x = self.target + gap
        found = self.check_points(lambda x: terms.contact(x, self.target, self.weight, 0.1, 0.02), x)
        self.assertTrue((found.gradient[:, 0] == 0).all())
        cornered = terms.contact(x, self.target, self.weight, 0.1, 1e-9).cost
        beyond = torch.tensor([0.0, 0.01, 0.4], dtype=FLOAT)  # the paper's cost
        torch.testing.assert_close(cornered, self.weight @ beyond, atol=1e-8, rtol=0)

    def test_attraction(self):
        d = torch.tensor([[0.1, -0.3, 0.99, 1.2]], dtype=FLOAT)
        weight = torch.tensor([2.0, 3.0, 4.0, 5.0], dtype=FLOAT)
        found = self.check(lambda d: terms.attraction(d, weight, 1.0), d)
        self.assertEqual(found.gradient[0, 3].item(), 0.0)  # beyond its reach
        self.assertTrue((found.curvature >= 0).all())
        near = torch.full((1, 4), 1e-3, dtype=FLOAT)
        torch.testing.assert_close(terms.attraction(near, weight, 1.0).cost, near.square() @ weight, atol=0, rtol=1e-5)

    def test_change(self):
        d = torch.tensor([[0.1, -0.3, 0.5]], dtype=FLOAT)
        weight = torch.tensor([2.0, 3.0, 4.0], dtype=FLOAT)
        limit = torch.tensor([0.2, 0.2, torch.inf], dtype=FLOAT)
        found = self.check(lambda d: terms.change(d, weight, limit, 100.0), d)
        torch.testing.assert_close(found.curvature, torch.tensor([[2.0, 103.0, 4.0]], dtype=FLOAT))
        cost = 2 * 0.01 + 3 * 0.09 + 4 * 0.25 + 100 * 0.01
        torch.testing.assert_close(found.cost, torch.tensor([cost], dtype=FLOAT))


if __name__ == "__main__":
    unittest.main()
