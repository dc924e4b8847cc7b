"""Options of a reset bank: limits of the physics filter, and states and targets beyond it, which are off by default."""

from __future__ import annotations

from dataclasses import dataclass

from xreset.checks import Checked, Finite, NotNegative, Positive


@dataclass(frozen=True, kw_only=True)
class FilterConfig(Checked):
    """Limits of the physics filter (:mod:`xreset.resets.filter`); the velocities are those after the last step."""

    steps: Positive[int] = 8
    """Control steps of 1/60 s with the drives holding. The published paper holds 48, a parallel jaw 240."""
    linear_velocity: Positive[Finite[float]] = 0.10
    """Largest speed of the object's origin [m/s]; published 0.5."""
    angular_velocity: Positive[Finite[float]] = 1.0
    """Largest angular speed of the object [rad/s]; published 15."""
    joint_velocity: Positive[Finite[float]] = 2.0
    """Largest joint speed [rad/s or m/s]; published 10."""


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
