"""What is drawn at each reset: physical parameters (the paper's Table IX), as pure functions."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from xreset.task.config import RandomizationConfig


def pair_friction(
    material: Tensor, c: RandomizationConfig, link: Tensor | float | None = None
) -> Tensor:
    """[M, 3] :meth:`RandomizationConfig.pair_friction` of materials [M] and of links [M]."""
    return torch.stack(c.pair_friction(material, link), dim=-1)


MATERIALS = 250
"""Number of distinct materials of objects (Table IX)."""


def sample_friction(count: int, c: RandomizationConfig, generator: torch.Generator) -> Tensor:
    """[M, 3] pair friction of objects, each of one of :data:`MATERIALS` evenly spaced materials.

    Without randomization it is the material in the middle.
    """
    low, high = c.friction
    if not c.enabled:
        return pair_friction(torch.full((count,), (low + high) / 2, device=generator.device), c)
    bucket = torch.randint(MATERIALS, (count,), generator=generator, device=generator.device)
    material = low + (high - low) * (bucket + 0.5) / MATERIALS
    link = None
    if c.hand_friction is not None:
        link = sample_range(count, c.hand_friction, generator)
    return pair_friction(material, c, link)


def own_friction(materials: Sequence[float | None], c: RandomizationConfig) -> Tensor:
    """[n, 1] offset of the pair friction of objects whose material is known; 0 for the others.

    The known coefficient replaces the middle of the range, and a pair's coefficient is the mean of two materials.
    """
    middle = sum(c.friction) / 2
    offsets = [0.0 if material is None else (material - middle) / 2 for material in materials]
    return torch.tensor(offsets)[:, None]


def uniform(shape: Sequence[int], generator: torch.Generator) -> Tensor:
    """Return uniform numbers in [0, 1)."""
    return torch.rand(shape, generator=generator, device=generator.device)


def symmetric(shape: Sequence[int], generator: torch.Generator) -> Tensor:
    """Return uniform numbers in [-1, 1)."""
    return 2.0 * uniform(shape, generator) - 1.0


def sample_range(count: int, limits: tuple[float, float], generator: torch.Generator) -> Tensor:
    """[M] uniform numbers of a range."""
    low, high = limits
    return low + (high - low) * uniform((count,), generator)


def sample_offset(count: int, limits: tuple[float, float], generator: torch.Generator) -> Tensor:
    """[M, 3] vectors in any direction, of uniform lengths of a range."""
    normal = torch.randn(count, 3, generator=generator, device=generator.device)
    direction = torch.nn.functional.normalize(normal, dim=-1)
    return sample_range(count, limits, generator)[:, None] * direction


def sample_drives(
    is_arm: Tensor, count: int, c: RandomizationConfig, generator: torch.Generator
) -> Tensor:
    """[M, 3, J] factors on the drives' stiffness, damping and effort limit.

    Args:
        is_arm: [J] bool.
        count: M.
        c: ranges of the factors.
        generator: random numbers.
    """
    rows = []
    for arm, hand in (
        (c.arm_stiffness, c.hand_stiffness),
        (c.arm_damping, c.hand_damping),
        (c.effort, c.effort),
    ):
        of_arm = sample_range(count, arm, generator)[:, None]
        of_hand = sample_range(count, hand, generator)[:, None]
        rows.append(torch.where(is_arm, of_arm, of_hand))
    return torch.stack(rows, dim=1)
