"""Which fingertips can meet pad to pad: a thumb can meet fingers, fingers cannot meet each other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from xreset.geometry.kinematics import Kinematics
from xreset.spec import RobotSpec

_SAMPLES = 400
_NEAR = 0.04
"""[m] Distance of fingertips that can hold something small between them."""
_FACING = -0.3
"""Largest product of the directions in which two fingertips close, as unit vectors, where they face each other."""
_STEP = 0.02
"""[rad or m] Step of the joints that gives this direction."""
_LOPSIDED = 0.4
"""Distance of the middle of a joint's range from its position nearest to 0, as a share of half the range, beyond which
the joint bends a finger and does not spread it."""


def closing_range(lower: float, upper: float) -> float | None:
    """Return how far a joint goes from 0, or from the limit nearest to 0, as a finger bends; None for a joint that
    spreads, which goes about as far to either side."""
    zero = float(np.clip(0.0, lower, upper))
    if upper <= lower or abs(upper + lower - 2 * zero) / (upper - lower) <= _LOPSIDED:
        return None
    far = upper if upper - zero > zero - lower else lower
    return far - zero


def opposition(robot: RobotSpec, links: Sequence[str], offsets: np.ndarray) -> np.ndarray:
    """Return for each pair of fingertips [E, E] the share of random joint positions in which they are near each other
    and close towards each other.

    The sum of the square roots of a row measures how much a fingertip opposes the others; it is larger if the fingertip
    opposes many of them.

    Args:
        robot: the robot; only what is below its hand root counts.
        links: link of each fingertip (length E).
        offsets: [E, 3] fingertips in their links' frames [m].
    """
    kinematics = Kinematics(robot, root=robot.hand_root)
    q = _random_positions(kinematics)
    ranges = [
        closing_range(*ends)
        for ends in zip(kinematics.lower.tolist(), kinematics.upper.tolist(), strict=True)
    ]
    step = q.new_tensor([_STEP * np.sign(closing or 0.0) for closing in ranges])
    tips = torch.as_tensor(offsets)
    here = kinematics.points(q, links, tips)
    closing = torch.nn.functional.normalize(kinematics.points(q + step, links, tips) - here, dim=-1)
    meetings = np.zeros((len(links), len(links)))
    for i in range(len(links)):
        for j in range(i):
            near = torch.cdist(here[:, i], here[:, j]) < _NEAR
            facing = closing[:, i] @ closing[:, j].T < _FACING
            meetings[i, j] = meetings[j, i] = float((near & facing).double().mean())
    return meetings


def heights_over_palm(robot: RobotSpec) -> np.ndarray:
    """Return how far each fingertip [E] is on the palm's inner side, at the median of random joint positions [m]."""
    kinematics = Kinematics(robot, root=robot.hand_root)
    links = [robot.palm, *(tip.link for tip in robot.fingertips)]
    poses = kinematics.link_poses(_random_positions(kinematics), links).numpy()
    inner = poses[:, 0, :3, 2]
    tips = poses[:, 1:, :3, 3] - poses[:, :1, :3, 3]
    return np.median(np.einsum("fj,fej->fe", inner, tips), axis=0)


def _random_positions(kinematics: Kinematics) -> torch.Tensor:
    """[_SAMPLES, J] joint positions within the limits."""
    generator = torch.Generator().manual_seed(0)
    draw = torch.rand(
        _SAMPLES, len(kinematics.joint_names), generator=generator, dtype=torch.float64
    )
    return kinematics.lower + draw * (kinematics.upper - kinematics.lower)
