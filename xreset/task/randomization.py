"""Physical parameters that are drawn anew at each reset (the paper's Table IX), as pure functions."""

from __future__ import annotations

import torch
from torch import Tensor

from xreset.task.config import RandomizationConfig


def pair_friction(material: Tensor, c: RandomizationConfig) -> Tensor:
    """[M, 3] friction of the pairs object-fingertip, object-link, object-table.

    Args:
        material: [M] the object material's coefficient. A pair's coefficient is the mean of its two materials.
    """
    return torch.stack([(material + other) / 2 for other in (c.elastomer, c.metal, c.table)], dim=-1)


def sample_friction(count: int, c: RandomizationConfig, generator: torch.Generator) -> Tensor:
    """[M, 3] pair friction of objects whose material is one of ``friction_buckets`` evenly spaced ones; the middle one if disabled."""
    low, high = c.friction
    if not c.enabled:
        return pair_friction(torch.full((count,), (low + high) / 2, device=generator.device), c)
    bucket = torch.randint(c.friction_buckets, (count,), generator=generator, device=generator.device)
    return pair_friction(low + (high - low) * (bucket + 0.5) / c.friction_buckets, c)


def sample_mass_scale(count: int, c: RandomizationConfig, generator: torch.Generator) -> Tensor:
    """[M] factor on the object's mass; 1 if disabled."""
    low, high = c.mass_scale if c.enabled else (1.0, 1.0)
    return low + (high - low) * torch.rand(count, generator=generator, device=generator.device)
