"""Options of a reset bank beyond the paper's filter; all are off by default."""

from __future__ import annotations

from dataclasses import dataclass

from xreset.checks import Checked, Finite, NotNegative, Positive


@dataclass(frozen=True, kw_only=True)
class ClosingConfig(Checked):
    """More states where a hand closes in on an object (:mod:`xreset.resets.closing`)."""

    spacing: Positive[Finite[float]] | None = None
    """Farthest that any fingertip moves from one state to the next [m], such as 0.005. None: no states are added."""
    within: Positive[Finite[float]] = 0.10
    """Only between frames of which one has a finger nearer than this to the object [m]."""


@dataclass(frozen=True, kw_only=True)
class SqueezeConfig(Checked):
    """Drive targets that press (:func:`xreset.resets.fingers.squeeze_targets`)."""

    force: NotNegative[float] = 0.0
    """Normal force of each finger that is at the object [N]. 0: targets are the joints' positions."""
    reach: Positive[Finite[float]] = 0.005
    """A finger nearer than this to the object is at it [m]."""
