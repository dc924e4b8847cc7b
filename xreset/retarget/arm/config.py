"""Weights and effort of the arm's inverse kinematics. Imports no torch, so that the command line can show them at once."""

from __future__ import annotations

from dataclasses import dataclass

from xreset.checks import check_numbers


@dataclass(frozen=True, kw_only=True)
class ArmConfig:
    """Weights and effort of the arm's inverse kinematics; the first two weights as in the paper."""

    position_weight: float = 50.0
    """Squared distance of the hand root [1/m^2]."""
    orientation_weight: float = 10.0
    """Squared angle of the hand root [1/rad^2]."""
    smoothness_weight: float = 0.02
    """Squared change of the joints since the frame before [1/rad^2]; the paper's lambda_s, whose value it does not give."""
    collision_weight: float = 1000.0
    """Squared intrusion into the margins [1/m^2]."""
    table_margin: float = 0.002
    """Height that the robot keeps above the table [m]."""
    self_margin: float = 0.010
    """Distance that the robot's links keep from each other [m]."""
    restarts: int = 32
    """Random starts of the first and of the last frame (the first of them is the home configuration)."""
    branches: int = 4
    """Distinct solutions of the first and of the last frame that are followed; the one that home leads to is always among them."""
    detour_cost: float = 1.0
    """Valid frames that a path is worth less for each rad^2 of its mean squared distance from home. A policy starts at home: states in
    another branch of the arm's solutions are of no use to it, because the way there leads through half a turn of the shoulder."""
    reseeds: int = 2
    """Frames of a sequence, of those whose wrist is still missed, that are solved like a first frame and followed both ways; 0: none."""
    switch_cost: float = 0.5
    """Valid frames that each change from one of the followed paths to another must bring."""
    first_iterations: int = 60
    """Most steps for the frame that a path starts from."""
    iterations: int = 12
    """Most steps for every other frame."""
    seed: int = 0
    """Of the restarts."""

    def __post_init__(self) -> None:
        check_numbers(
            self,
            positive=("restarts", "branches"),
            not_negative=(
                "position_weight", "orientation_weight", "smoothness_weight", "collision_weight", "detour_cost", "reseeds", "switch_cost",
                "first_iterations", "iterations", "seed",
            ),
            finite=("table_margin", "self_margin"),
        )  # fmt: skip
