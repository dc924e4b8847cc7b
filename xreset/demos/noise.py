"""Demonstrations as a worse hand tracker would have recorded them, to see what retargeting and training tolerate.

The noise is the published paper's (arXiv 2609.35715, Table A5): in each demonstration the whole hand is shifted by one
offset, and its fingers wander around their places, slower than from frame to frame. Object poses stay as they are.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from xreset.demos.archive import Demos
from xreset.demos.hand import PARENTS
from xreset.geometry.shapes import turn_of

MEMORY = math.exp(-1 / 8)
"""Correlation of a finger's error with its error in the frame before."""

TIERS = {
    "low": {"wrist": 0.010, "finger": 0.0015, "cap": 0.003},
    "medium": {"wrist": 0.020, "finger": 0.003, "cap": 0.006},
    "high": {"wrist": 0.040, "finger": 0.006, "cap": 0.012},
}
"""The paper's tiers: options of :func:`with_noise` [m]."""


def with_noise(demos: Demos, *, wrist: float, finger: float, cap: float, seed: int = 0) -> Demos:
    """Return demonstrations with errors of the hand's keypoints [F, 21, 3]; bones keep their lengths.

    Args:
        demos: demonstrations of right or left hands.
        wrist: the offset of a demonstration is uniform within this bound along each axis of the table frame [m].
        finger: standard deviation of a keypoint's error along each axis of the palm [m].
        cap: largest error of a keypoint [m], before the bones get their lengths back. A fingertip moves with the bones
            before it, so it may end up farther away.
        seed: chooses the errors.
    """
    random = np.random.default_rng(seed)
    keypoints = demos.hand_keypoints.astype(float)
    for sequence in range(demos.num_sequences):
        frames = demos.frames(sequence)
        count = frames.stop - frames.start
        offset = random.uniform(-wrist, wrist, 3)
        errors = _wandering(random.normal(0.0, finger, (count, 20, 3)))
        size = np.linalg.norm(errors, axis=-1, keepdims=True)
        errors *= np.minimum(1.0, cap / np.maximum(size, 1e-12))
        valid = demos.hand_valid[frames]
        hand = keypoints[frames][valid]
        palm = turn_of(demos.wrist_quat_wxyz[frames][valid]).as_matrix()
        moved = _with_bones(hand, np.einsum("fij,fkj->fki", palm, errors[valid]))
        keypoints[frames][valid] = moved + offset
    return replace(demos, hand_keypoints=keypoints.astype(demos.hand_keypoints.dtype))


def _wandering(steps: np.ndarray) -> np.ndarray:
    """Return errors [F, ...] that remember the frame before, with the standard deviation of the steps [F, ...]."""
    steps = steps.copy()
    steps[1:] *= math.sqrt(1.0 - MEMORY**2)
    return np.asarray(lfilter([1.0], [1.0, -MEMORY], steps, axis=0))


def _with_bones(hand: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """Move keypoints 1 to 20 of hands [F, 21, 3] by errors [F, 20, 3], and give each bone its length again."""
    wanted = hand.copy()
    wanted[:, 1:] += errors
    moved = hand.copy()
    for child, parent in enumerate(PARENTS, start=1):
        length = np.linalg.norm(hand[:, child] - hand[:, parent], axis=-1, keepdims=True)
        bone = wanted[:, child] - wanted[:, parent]
        moved[:, child] = moved[:, parent] + bone * (
            length / np.linalg.norm(bone, axis=-1, keepdims=True)
        )
    return moved
