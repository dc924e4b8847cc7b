"""Options of a reset bank: limits of the physics filter, and states and targets beyond it.

The defaults are those of the headline results (docs/results.md)."""

from __future__ import annotations

from xreset.files.checks import (
    Checked,
    Length,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    frozen,
)


@frozen
class FilterConfig(Checked):
    """Limits of the physics filter (:mod:`xreset.resets.filter`); the velocities are those after the last step."""

    steps: PositiveInt = 8
    """Control steps of 1/60 s with the drives holding. The published paper has 48, and 240 for a parallel jaw."""
    linear_velocity: PositiveFloat = 0.10
    """Largest speed of the object's center of mass [m/s]; published 0.5."""
    angular_velocity: PositiveFloat = 1.0
    """Largest angular speed of the object [rad/s]; published 15."""
    joint_velocity: PositiveFloat = 2.0
    """Largest joint speed [rad/s or m/s]; published 10."""


@frozen
class ClosingConfig(Checked):
    """More states where a hand closes in on an object (:mod:`xreset.resets.closing`)."""

    spacing: Length | None = 0.005
    """Farthest that any fingertip moves from one state to the next [m]. None: no states are added."""


@frozen
class SqueezeConfig(Checked):
    """Drive targets that press (:func:`xreset.resets.fingers.squeeze_targets`)."""

    force: NonNegativeFloat | None = None
    """Normal force of each finger that presses [N]; None: 5, or 20 for a hand with two fingertips, whose two contacts
    alone carry the object's weight and its torque about the line between them. 0: no finger presses, and targets are
    the joints' positions."""

    def newtons(self, fingertips: int) -> float:
        """Return the force for a hand with this number of fingertips [N]."""
        if self.force is not None:
            return self.force
        # With 5 N and the weight 55 % of the Robotiq's lifted states hold the object for a second, with 20 N 98 %.
        return 20.0 if fingertips == 2 else 5.0


@frozen
class TransferConfig(Checked):
    """More states, in grasps of other demonstrations of the same object (:mod:`xreset.resets.transfer`)."""

    per_pose: NonNegativeInt = 8
    """Most states at each pose. 0: no states are added."""
