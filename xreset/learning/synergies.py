"""Exploration along a hand's own synergies: the directions in which its joints move together in demonstrated states.

Noise that is independent from joint to joint shakes a grasp apart; noise along synergies opens and closes the hand. Actions are drawn from
a Gaussian whose covariance is diag(std)^2 + B diag(s)^2 B^T, with the directions B fixed and both std and s learned, so that
log-probability, entropy and KL divergence are exact. The idea is that of eigengrasps (Santello et al. 1998; Ciocarlie and Allen 2009) as
exploration noise (arXiv 2610.07681). Shape letters: N worlds, J actions, K directions, L states.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from rsl_rl.modules.distribution import GaussianDistribution
from torch import Tensor, nn

from xreset.task.actions import ActionSpace

EXPLAINED = 0.9
"""Share of the variance of the demonstrated hand poses that the directions span."""
MOST = 6
"""Most directions."""


def hand_synergies(joint_pos: Tensor, actions: ActionSpace) -> Tensor:
    """[J, K] principal directions of demonstrated hand poses, as absolute actions; a column's length is the standard deviation along it.

    Args:
        joint_pos: [L, J] robot states.
        actions: the mapping between hand joints and actions.

    Returns:
        K is the least number of directions that span :data:`EXPLAINED` of the variance, at most :data:`MOST`, and 0 where the hand does
        not move. Arm rows are 0.
    """
    pose = torch.where(actions.is_arm, 0.0, actions.within_limits(joint_pos).clamp(-1.0, 1.0))
    if len(pose) < 2:
        return pose.new_zeros(pose.shape[-1], 0)
    _, scale, directions = torch.linalg.svd(pose - pose.mean(dim=0), full_matrices=False)
    variance = scale.square() / (len(pose) - 1)
    moving = variance > 1e-8
    spanned = variance.cumsum(0) / variance.sum().clamp_min(1e-12)
    count = min(int((spanned < EXPLAINED).sum()) + 1, int(moving.sum()), MOST)
    return (directions[:count] * variance[:count].sqrt()[:, None]).T.contiguous()


class SynergyGaussian(GaussianDistribution):
    """A Gaussian with a state-independent covariance diag(std)^2 + B diag(s)^2 B^T.

    It keeps rsl-rl's contract of a distribution. Its parameters are (mean, log std, log s), each [N, ...], so that the divergence from an
    old distribution needs nothing else.
    """

    def __init__(self, output_dim: int, directions: Any, synergy_std: float, **options: Any) -> None:
        """Build.

        Args:
            output_dim: J.
            directions: [J, K] B.
            synergy_std: initial s.
            options: of rsl-rl's Gaussian.
        """
        settings: dict[str, Any] = options | {"std_type": "log"}
        super().__init__(output_dim, **settings)
        directions = torch.as_tensor(directions, dtype=torch.float32).reshape(output_dim, -1)
        self.directions: Tensor
        self.register_buffer("directions", directions)
        self.log_synergy_param = nn.Parameter(torch.full((directions.shape[1],), math.log(synergy_std)))
        self._mean: Tensor | None = None
        self._factor: Tensor | None = None

    def _cholesky(self, log_std: Tensor, log_synergy: Tensor) -> Tensor:
        """[J, J] lower triangular factor of the covariance."""
        spread = self.directions * log_synergy.exp()
        return torch.linalg.cholesky_ex(torch.diag(log_std.exp().square()) + spread @ spread.T).L

    def update(self, mlp_output: Tensor) -> None:
        """Take over a mean [..., J]."""
        self._mean = mlp_output
        self._factor = self._cholesky(self.log_std_param, self.log_synergy_param)

    def sample(self) -> Tensor:
        """[..., J]"""
        return self.mean + torch.randn_like(self.mean) @ self._scale.T

    @property
    def mean(self) -> Tensor:
        """[..., J]"""
        assert self._mean is not None, "update() comes first"
        return self._mean

    @property
    def _scale(self) -> Tensor:
        assert self._factor is not None, "update() comes first"
        return self._factor

    @property
    def std(self) -> Tensor:
        """[..., J] marginal standard deviations."""
        return self._scale.norm(dim=-1).expand_as(self.mean)

    @property
    def entropy(self) -> Tensor:
        """[...]"""
        constant = 0.5 * self.output_dim * (1 + math.log(2 * math.pi))
        return (constant + self._scale.diagonal().log().sum()).expand(self.mean.shape[:-1])

    @property
    def params(self) -> tuple[Tensor, ...]:
        """Mean [..., J], log std [..., J], log s [..., K]."""
        lead = self.mean.shape[:-1]
        return self.mean, self.log_std_param.expand(*lead, -1), self.log_synergy_param.expand(*lead, -1)

    def log_prob(self, outputs: Tensor) -> Tensor:
        """[...]"""
        z = (outputs - self.mean) @ _inverse(self._scale).T
        constant = 0.5 * self.output_dim * math.log(2 * math.pi) + self._scale.diagonal().log().sum()
        return -0.5 * z.square().sum(dim=-1) - constant

    def kl_divergence(self, old_params: tuple[Tensor, ...], new_params: tuple[Tensor, ...]) -> Tensor:
        """[...] KL(old || new); each one's covariance is the same in every row."""
        old, new = (self._cholesky(p[1].flatten(0, -2)[0], p[2].flatten(0, -2)[0]) for p in (old_params, new_params))
        inverse = _inverse(new)
        shift = (new_params[0] - old_params[0]) @ inverse.T
        volume = (inverse @ old).square().sum() - self.output_dim
        volume = volume + 2 * (new.diagonal().log().sum() - old.diagonal().log().sum())
        return 0.5 * (shift.square().sum(dim=-1) + volume)


def _inverse(factor: Tensor) -> Tensor:
    eye = torch.eye(len(factor), device=factor.device, dtype=factor.dtype)
    return torch.linalg.solve_triangular(factor, eye, upper=False)
