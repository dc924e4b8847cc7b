"""Options of a reset bank: limits of the physics filter, and states and targets beyond it.

The defaults are those of the headline results (docs/results.md)."""

from __future__ import annotations

from dataclasses import replace

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
    """Largest speed of the object's origin [m/s]; published 0.5."""
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
    alone carry the object's weight and its torque about the line between them. If this and ``weight`` are 0, targets
    are the joints' positions."""
    weight: NonNegativeFloat = 1.0
    """Further force, as a share of the object's weight. With one force for all objects, heavy ones slip and light ones
    tilt."""
    balanced: bool = True
    """Whether the forces on an object nearly cancel: the thumb presses as hard as all fingers that oppose it together.
    The mean force stays the same."""
    reach: PositiveFloat = 0.005
    """A finger presses if it is nearer than this to the object [m]."""

    @property
    def presses(self) -> bool:
        """Whether there is any force."""
        return self.force is None or self.force > 0 or self.weight > 0

    def for_hand(self, fingertips: int) -> SqueezeConfig:
        """Return the configuration with the force for a hand with this number of fingertips."""
        if self.force is not None:
            return self
        # With 5 N and the weight 55 % of the Robotiq's lifted states hold the object for a second, with 20 N 98 %.
        return replace(self, force=20.0 if fingertips == 2 else 5.0)


JUDGE_SQUEEZE = SqueezeConfig(weight=0.0, balanced=False, reach=0.01)
"""How fingers press when a robot is judged (``xreset robots judge``): with the same force on every object."""


@frozen
class TransferConfig(Checked):
    """More states, in grasps of other demonstrations of the same object (:mod:`xreset.resets.transfer`)."""

    per_pose: NonNegativeInt = 8
    """Most states at each pose. 0: no states are added."""


@frozen
class GoalConfig(Checked):
    """How a goal set is drawn (:mod:`xreset.resets.goals`)."""

    per_family: PositiveInt = 20
    """Goals of each object and family."""
    upright: bool = False
    """Whether objects start in the resting pose in which their mesh's z axis points up. Otherwise they start in any of
    their resting poses, on a broad face more often than on a narrow one."""
    seed: NonNegativeInt = 0
    """The same seed gives the same goals."""
