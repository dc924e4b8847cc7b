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
    """Weight of the squared distance of the hand root from its target [1/m^2]."""
    orientation_weight: NonNegativeFloat = 10.0
    """Weight of the squared angle of the hand root to its target [1/rad^2]."""
    smoothness_weight: NonNegativeFloat = 0.02
    """Weight of the squared change of the joints since the frame before [1/rad^2]: lambda_s of the paper, which does
    not state its value."""
    collision_weight: NonNegativeFloat = 1000.0
    """Weight of the squared depth in the margin above the table [1/m^2]."""
    table_margin: FiniteFloat = 0.002
    """Height that the robot keeps above the table [m]."""
    restarts: PositiveInt = 32
    """Number of starts for the first and for the last frame: the home configuration, and random ones."""
    branches: PositiveInt = 4
    """Number of distinct solutions of the first and of the last frame that are followed. The one that is found from
    home is always followed."""
    detour_cost: NonNegativeFloat = 1.0
    """Number of valid frames that a path counts less per rad^2 of its mean squared distance from home. A policy starts
    at home, and cannot use states in another branch of the arm's solutions, half a turn of the shoulder away."""
    reseeds: NonNegativeInt = 2
    """Number of frames of a sequence with a missed wrist that are solved again, like a first frame, and followed both
    ways."""
    switch_cost: NonNegativeFloat = 0.5
    """Number of valid frames that each change from one of the followed paths to another must gain."""
    first_iterations: NonNegativeInt = 60
    """Largest number of steps for the first frame of a path."""
    iterations: NonNegativeInt = 12
    """Largest number of steps for every other frame."""
    seed: NonNegativeInt = 0
    """Seed of the random starts."""


QUICK = ArmConfig(restarts=4, branches=2, first_iterations=40, reseeds=0)
"""Effort of a search that tries thousands of single frames to see what the arm can reach."""
