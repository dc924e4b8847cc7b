"""The constant offset between a hand and the object that it carries.

A hand that carries an object touches it with its thumb and with fingers, and is not inside of it. Where it misses the
surface in most frames, and would touch it if it was some centimeters elsewhere in all of them, the mesh has another
origin than the tracked one, or the positions of the hand are off.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from xreset.demos.causes import Recording
from xreset.demos.hand import FLESH, flesh

_FRAMES = 12
"""Frames of a recording that are looked at."""
_STEP = 0.02
"""Distance of the shifts that are tried [m]."""
_FARTHEST = 4
"""Longest shift that is tried, in steps."""
_SHARE = 25
"""Percentage of the frames in which the hand misses by less: in some frames it lets go, or was not tracked well."""
_GAIN = 0.0245
"""A shift that brings the hand closer by this much tells an offset [m]: 0.0224 at most in DexYCB."""
_AS_GOOD = 0.003
"""Shifts that are worse by less are as good as the best one, and the shortest of them counts [m]."""


class Offset(NamedTuple):
    """A shift of the hand with which it would touch the object that it carries."""

    shift: np.ndarray
    """[3] in the object's frame [m]."""
    miss: float
    """By how much the hand misses the surface where it is [m]; see :func:`_miss`."""
    left: float
    """By how much it would miss the surface with the shift [m]."""


def constant_offset(r: Recording) -> Offset | None:
    """Return the offset of a recording; None if there is none, the mesh is unknown, or the object is not carried."""
    frames = np.flatnonzero(r.moved & r.seen)
    if r.surface is None or not len(frames):
        return None
    frames = frames[np.unique(np.linspace(0, len(frames) - 1, _FRAMES).astype(int))]
    steps = np.moveaxis(np.indices((2 * _FARTHEST + 1,) * 3), 0, -1).reshape(-1, 3) - _FARTHEST
    lengths = np.linalg.norm(steps, axis=1)
    order = np.argsort(lengths, kind="stable")
    shifts = _STEP * steps[order[lengths[order] <= _FARTHEST]]
    points = flesh(r.in_object[frames]) + shifts[:, None, None]
    misses = _miss(r.surface.signed_distance(points))
    best = int(np.argmax(misses < misses.min() + _AS_GOOD))
    if misses[0] - misses[best] < _GAIN:
        return None
    return Offset(shift=shifts[best], miss=float(misses[0]), left=float(misses[best]))


def _miss(distance: np.ndarray) -> np.ndarray:
    """[S] by how much a hand misses the surface: the gaps of the thumb and of the two nearest other fingers, and the
    depth of the deepest point, together [m].

    Args:
        distance: [S, F, 40] signed distances of the points of the hand's flesh, negative inside [m].
    """
    gaps = (distance - FLESH).reshape(*distance.shape[:2], 2, 5, 4).min(axis=(2, 4)).clip(0.0)
    fingers = np.sort(gaps[..., 1:], axis=-1)
    depth = (-distance).clip(0.0).max(axis=-1)
    together = gaps[..., 0] + fingers[..., 0] + fingers[..., 1] + depth
    return np.percentile(together, _SHARE, axis=1)
