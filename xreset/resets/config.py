"""What a reset bank may be made with beyond the paper's filter; all of it is off by default."""

from __future__ import annotations

from dataclasses import dataclass

from xreset.checks import check_numbers


@dataclass(frozen=True, kw_only=True)
class ClosingConfig:
    """More states where a hand closes in on an object (:mod:`xreset.resets.closing`)."""

    spacing: float | None = None
    """Farthest that any fingertip moves from one state to the next [m], such as 0.005. None: no states are added."""
    within: float = 0.10
    """Only between frames of which one has a finger nearer than this to the object [m]."""

    def __post_init__(self) -> None:
        check_numbers(self, positive=("within",), finite=("within",))
        if self.spacing is not None:
            check_numbers(self, positive=("spacing",), finite=("spacing",))


@dataclass(frozen=True, kw_only=True)
class SqueezeConfig:
    """Drive targets that press (:mod:`xreset.resets.squeeze`)."""

    force: float = 0.0
    """Normal force of each finger that is at the object [N]. 0: targets are the joints' positions."""
    reach: float = 0.005
    """A finger nearer than this to the object is at it [m]."""

    def __post_init__(self) -> None:
        check_numbers(self, not_negative=("force",), positive=("reach",), finite=("reach",))


@dataclass(frozen=True, kw_only=True)
class HoldConfig:
    """When a lifted state counts as a grasp that holds (:mod:`xreset.resets.hold`)."""

    seconds: float = 1.0
    """Time at full gravity with the targets unchanged [s]."""
    distance: float = 0.02
    """Farthest that the object's origin may then be from where it was [m]."""
    angle: float = 0.5235987755982988
    """Largest angle by which it may then be turned [rad], 30 degrees."""
    lift: float = 0.01
    """Height of the object's origin above the demonstration's start from which a state is lifted [m]."""

    def __post_init__(self) -> None:
        check_numbers(self, positive=("seconds", "distance", "angle", "lift"), finite=("seconds", "distance", "angle", "lift"))
