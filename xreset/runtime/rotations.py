"""Rotations in float32, equal bit for bit to those of the environment.

Products and sums are fused as torch fuses them on processors with AVX2.
"""

from __future__ import annotations

import numpy as np

Array = np.ndarray

UNIT_TOLERANCE = 0.01
"""How far the length of a quaternion may be from 1."""


def is_unit(quat: Array) -> Array:
    """[...] bool: whether quaternions [..., 4] have length 1, and no number that is not finite."""
    return np.abs(np.linalg.norm(quat, axis=-1) - 1.0) <= UNIT_TOLERANCE


def _fused_multiply_add(a: Array, b: Array, c: Array) -> Array:
    """Return a * b + c in float32, rounded once."""
    return (a.astype(np.float64) * b + c).astype(np.float32)


def _cross(a: Array, b: Array) -> Array:
    parts = []
    for i, j in ((1, 2), (2, 0), (0, 1)):
        parts.append(_fused_multiply_add(a[..., i], b[..., j], -(a[..., j] * b[..., i])))
    return np.stack(parts, axis=-1)


def rotate(quat: Array, vector: Array) -> Array:
    """[..., 3] vectors turned by unit quaternions [..., 4], in float32; both broadcast."""
    w = quat[..., :1]
    u, v = np.broadcast_arrays(quat[..., 1:], vector)
    t = np.float32(2.0) * _cross(u, v)
    return _fused_multiply_add(w, t, v) + _cross(u, t)


def multiply(a: Array, b: Array) -> Array:
    """[N, 4] product of quaternions [N, 4], in float32: rotation b first, then a."""
    u = a[:, 1:]
    v = b[:, 1:]
    products = a * b
    w = products[:, :1] - ((products[:, 1] + products[:, 2]) + products[:, 3])[:, None]
    return np.concatenate(
        (w, _fused_multiply_add(b[:, :1], u, _fused_multiply_add(a[:, :1], v, _cross(u, v)))),
        axis=1,
    )
