"""Weights and effort of the arm's inverse kinematics. This module imports no torch, so the command line can show them
quickly."""

from __future__ import annotations

from xreset.checks import (
    Checked,
    FiniteFloat,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveInt,
    frozen,
)


@frozen
class ArmConfig(Checked):
    """Weights and effort of the arm's inverse kinematics; the first two weights are the paper's."""

    position_weight: NonNegativeFloat = 50.0
    """Squared distance of the hand root [1/m^2]."""
    orientation_weight: NonNegativeFloat = 10.0
    """Squared angle of the hand root [1/rad^2]."""
    smoothness_weight: NonNegativeFloat = 0.02
    """Squared change of the joints since the frame before [1/rad^2]; the paper's lambda_s, whose value it does not
    give."""
    collision_weight: NonNegativeFloat = 1000.0
    """Squared intrusion into the margin above the table [1/m^2]."""
    table_margin: FiniteFloat = 0.002
    """Height that the robot keeps above the table [m]."""
    restarts: PositiveInt = 32
    """Starts of the first and of the last frame: the home configuration, then random ones."""
    branches: PositiveInt = 4
    """Distinct solutions of the first and of the last frame that are followed; the one that home leads to is always one
    of them."""
    detour_cost: NonNegativeFloat = 1.0
    """Valid frames that a path loses per rad^2 of its mean squared distance from home. A policy starts at home: it
    cannot use states in another branch of the arm's solutions, because the way there leads through half a turn of the
    shoulder."""
    reseeds: NonNegativeInt = 2
    """Frames of a sequence whose wrist is still missed that are solved like a first frame and followed both ways."""
    switch_cost: NonNegativeFloat = 0.5
    """Valid frames that each change from one of the followed paths to another must gain."""
    first_iterations: NonNegativeInt = 60
    """Most steps for the frame that a path starts from."""
    iterations: NonNegativeInt = 12
    """Most steps for every other frame."""
    seed: NonNegativeInt = 0
    """Seed of the random starts."""


QUICK = ArmConfig(restarts=4, branches=2, first_iterations=40, reseeds=0)
"""Effort of a search that tries thousands of single frames to see what the arm can reach."""
