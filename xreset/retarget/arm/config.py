"""Constants of the arm's inverse kinematics."""

from __future__ import annotations

from xreset.files.checks import frozen


@frozen
class ArmSearch:
    """Weights and effort of the arm's inverse kinematics; the first two weights are the paper's.

    They are no options, because one set serves every robot. Searches that look at thousands of frames make less effort.
    """

    position_weight: float = 50.0
    """Weight of the squared distance of the hand root from its target [1/m^2]."""
    orientation_weight: float = 10.0
    """Weight of the squared angle of the hand root to its target [1/rad^2]."""
    smoothness_weight: float = 0.02
    """Weight of the squared change of the joints since the frame before [1/rad^2]: lambda_s of the paper, which does
    not state its value."""
    jump_limit: float = 0.34
    """Change of a joint since the frame before beyond which ``jump_weight`` applies [rad or m] (not the paper's). Next
    to a singularity the hand lags behind for some frames; a larger change would make the frame invalid."""
    jump_weight: float = 20.0
    """Weight of a joint's change since the frame before beyond ``jump_limit`` [1/rad^2]."""
    collision_weight: float = 1000.0
    """Weight of the squared depth in the margin above the table [1/m^2]."""
    table_margin: float = 0.002
    """Height that the robot keeps above the table [m]."""
    restarts: int = 32
    """Number of starts for the first and for the last frame: the home configuration, and random ones."""
    branches: int = 4
    """Number of distinct solutions of the first and of the last frame that are followed. The one that is found from
    home is always followed."""
    detour_cost: float = 1.0
    """Number of valid frames that a path counts less per rad^2 of its mean squared distance from home. A policy starts
    at home, and cannot use states in another branch of the arm's solutions, half a turn of the shoulder away."""
    reseeds: int = 2
    """Number of frames of a sequence with a missed wrist that are solved again, like a first frame, and followed both
    ways."""
    switch_cost: float = 0.5
    """Number of valid frames that each change from one of the followed paths to another must gain."""
    first_iterations: int = 60
    """Largest number of steps for the first frame of a path."""
    iterations: int = 12
    """Largest number of steps for every other frame."""
    seed: int = 0
    """Seed of the random starts."""


QUICK = ArmSearch(restarts=4, branches=2, first_iterations=40, reseeds=0)
"""Effort of a search that tries thousands of single frames to see what the arm can reach."""
