"""Constants of hand retargeting."""

from __future__ import annotations

from xreset.files.checks import frozen


@frozen
class HandWeights:
    """Weights and limits of hand retargeting; weights are the paper's (appendix D.b) unless a field says otherwise.

    They are no options, because one set serves every hand. Tests and benchmarks vary them.
    """

    local_weight: float = 10.0
    """Weight of bone vectors and bone directions, averaged over the pairs of keypoints."""
    global_weight: float = 1.0
    """Weight of each keypoint's position."""
    tip_factor: float = 10.0
    """Factor on the weight of a fingertip's position (not the paper's)."""
    contact_weight: float = 5.0
    """Weight of each contact point."""
    contact_margin: float = 0.01
    """Distance between contact link and contact point that costs nothing [m]."""
    contact_knee: float = 0.002
    """Excess over the margin below which the contact cost is quadratic [m]."""
    clearance_weight: float = 2000.0
    """Weight of the hand's depth in the object, the table and itself beyond the allowed depth (not the paper's)."""
    object_clearance: float = 0.0005
    """Distance that the hand keeps from the object [m]. Physics pushes deeper grasps apart."""
    self_depth: float = 0.002
    """Allowed depth of the hand's links in one another [m]."""
    pad_weight: float = 1000.0
    """Weight of the distance of a jaw's pads from the held object, averaged over each pad (not the paper's). Other
    hands have no pads."""
    pad_reach: float = 0.015
    """Distance from the object beyond which a point of a pad is not attracted [m]."""
    smoothness_weight: float = 2.0
    """Weight of the change of joints and root between neighboring frames. It must be positive, because it alone
    determines joints that no keypoint depends on."""
    jump_limit: float = 0.17
    """Change of a hand joint between neighboring frames beyond which ``jump_weight`` applies [rad or m] (not the
    paper's)."""
    jump_weight: float = 1000.0
    """Weight of a hand joint's change between neighboring frames beyond ``jump_limit``."""
    length_scale: float = 0.10
    """Length that counts as much as one radian [m]: about a finger's length."""
    iterations: int = 40
    """Largest number of Levenberg-Marquardt steps with the full weight of the clearance."""
    tolerance: float = 1e-3
    """A sequence is done when a step lowers its cost by less than this fraction."""
