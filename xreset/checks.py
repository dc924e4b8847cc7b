"""Numbers of a configuration that make no sense are refused when it is made, not met as NaN some minutes later."""

from __future__ import annotations

from collections.abc import Iterable
from math import inf, isfinite

import numpy as np


def check_numbers(
    config: object,
    *,
    positive: Iterable[str] = (),
    not_negative: Iterable[str] = (),
    finite: Iterable[str] = (),
    share: Iterable[str] = (),
    ranges: Iterable[str] = (),
) -> None:
    """Refuse fields that are out of range.

    Args:
        config: any dataclass.
        positive: fields that must be above 0; infinity will do, where it means that there is no limit.
        not_negative: fields that must be finite and at least 0.
        finite: fields that must be finite.
        share: fields that must be between 0 and 1.
        ranges: fields that hold two finite numbers, 0 or more, the lower one first.

    Raises:
        ValueError: says which field is what, and what was expected. NaN is never in range.
    """
    for name in positive:
        if not 0 < getattr(config, name) <= inf:
            raise ValueError(f"{name} is {getattr(config, name)}, expected a number above 0")
    for name in not_negative:
        if not 0 <= getattr(config, name) < inf:
            raise ValueError(f"{name} is {getattr(config, name)}, expected a finite number, 0 or more")
    for name in finite:
        if not isfinite(getattr(config, name)):
            raise ValueError(f"{name} is {getattr(config, name)}, expected a finite number")
    for name in share:
        if not 0 <= getattr(config, name) <= 1:
            raise ValueError(f"{name} is {getattr(config, name)}, expected a number from 0 to 1")
    for name in ranges:
        low, high = getattr(config, name)
        if not 0 <= low <= high < inf:
            raise ValueError(f"{name} is {low} to {high}, expected two finite numbers, 0 or more, the lower one first")


def is_rigid(T: np.ndarray) -> bool:
    """Whether a matrix [4, 4] is a rotation and a translation: right-handed, without scale, to three digits as people write them."""
    R = T[:3, :3]
    straight = np.isfinite(T).all() and np.allclose(R @ R.T, np.eye(3), atol=2e-3) and np.array_equal(T[3], (0, 0, 0, 1))
    return bool(straight and np.linalg.det(R) > 0)


class Options:
    """Base of dataclasses whose fields are options of a command, shown and checked as if they were its own."""
