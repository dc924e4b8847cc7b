"""Exploration along a hand's synergies."""

from __future__ import annotations

import tempfile
import unittest
from pathlib import Path

import torch
from torch.distributions import MultivariateNormal, kl_divergence

from tests.toy_robot import toy_hand_arm
from xreset.learning.synergies import SynergyGaussian, hand_synergies
from xreset.task.actions import ActionSpace
from xreset.task.config import ActionConfig


def gaussian(seed: int, joints: int = 5, directions: int = 2) -> SynergyGaussian:
    g = torch.Generator().manual_seed(seed)
    found = SynergyGaussian(
        joints, torch.randn(joints, directions, generator=torch.Generator().manual_seed(0)), 0.4, init_std=0.3
    )
    with torch.no_grad():
        found.log_std_param += 0.3 * torch.randn(joints, generator=g)
        found.log_synergy_param += 0.3 * torch.randn(directions, generator=g)
    found.update(torch.randn(6, joints, generator=g))
    return found


def reference(d: SynergyGaussian) -> MultivariateNormal:
    spread = d.directions * d.log_synergy_param.exp()
    return MultivariateNormal(d.mean, torch.diag(d.log_std_param.exp() ** 2) + spread @ spread.T)


class SynergyGaussianTest(unittest.TestCase):
    def test_it_is_the_multivariate_normal(self):
        d, value = gaussian(1), torch.randn(6, 5)
        expected = reference(d)
        torch.testing.assert_close(d.log_prob(value), expected.log_prob(value))
        torch.testing.assert_close(d.entropy, expected.entropy())
        torch.testing.assert_close(d.std, expected.variance.sqrt())

    def test_divergence_needs_only_the_old_parameters(self):
        old, new = gaussian(1), gaussian(2)
        expected = kl_divergence(reference(old), reference(new))
        torch.testing.assert_close(new.kl_divergence(old.params, new.params), expected)
        torch.testing.assert_close(old.kl_divergence(old.params, old.params), torch.zeros(6), atol=1e-5, rtol=0)

    def test_samples_have_its_covariance(self):
        d = gaussian(3)
        d.update(torch.zeros(200_000, 5))
        torch.manual_seed(0)
        torch.testing.assert_close(d.sample().T.cov(), reference(d).covariance_matrix[0], atol=0.02, rtol=0.05)

    def test_gradients_reach_both_spreads(self):
        d = gaussian(4)
        (d.log_prob(torch.randn(6, 5)).sum() + d.entropy.sum()).backward()
        for parameter in (d.log_std_param, d.log_synergy_param):
            assert parameter.grad is not None
            self.assertGreater(float(parameter.grad.abs().min()), 0.0)


class HandSynergiesTest(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.actions = ActionSpace.of(toy_hand_arm(Path(folder.name)), ActionConfig())

    def states(self, hand: torch.Tensor) -> torch.Tensor:
        """Joints [L, J] whose hand stands at the actions [L, H]."""
        action = torch.zeros(len(hand), 7)  # fingers a and b, and the jaws
        action[:, 3:] = hand
        return self.actions.targets(action, torch.zeros(len(hand), 7), torch.zeros(len(hand), 7))

    def test_a_hand_that_closes_has_one_direction(self):
        closing = torch.linspace(-0.5, 0.5, 21)[:, None] * torch.tensor([0.6, 0.8, 0.0, 0.0])
        found = hand_synergies(self.states(closing), self.actions)
        self.assertEqual(tuple(found.shape), (7, 1))
        expected = torch.tensor([0, 0, 0, 0.6, 0.8, 0, 0]) * closing.norm(dim=-1).square().sum().div(20).sqrt()
        torch.testing.assert_close(found[:, 0] * found[3, 0].sign(), expected, atol=1e-5, rtol=0)

    def test_a_hand_that_does_not_move_has_none(self):
        self.assertEqual(hand_synergies(self.states(torch.zeros(5, 4)), self.actions).shape[1], 0)
        self.assertEqual(hand_synergies(self.states(torch.zeros(1, 4)), self.actions).shape[1], 0)


if __name__ == "__main__":
    unittest.main()
