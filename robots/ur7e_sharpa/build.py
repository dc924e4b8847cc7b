"""Writes ``robot.urdf`` from the makers' published figures: ``python -m xreset.robots.ur7e_sharpa.build``.

Sources: Universal Robots' ROS 2 description of the UR7e (kinematics, masses, limits), and Sharpa's own description of the Wave right hand
(HA4, release V2.2.3: kinematics, masses, ranges). Neither gives primitive shapes: those are sized here from link lengths and radii. The
hand's description gives no effort limits; they are figures published elsewhere for the same hand and approximate.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from xreset.geometry.urdf import Joint, Link, RobotTree
from xreset.geometry.urdf_writer import ArmLink, box, capsule, cylinder, pose, urdf_text
from xreset.robots.parts import ROTOR_INERTIA, Frame, Vector, robot
from xreset.spec import Shape

URDF = Path(__file__).parent / "robot.urdf"

COMMENT = """UR7e with the Sharpa Wave right hand. Written by xreset.robots.ur7e_sharpa.build: change that, not this file.
Figures: Universal Robots' ROS 2 description; Sharpa's description of the Wave (HA4) right hand, release V2.2.3.
Shapes are primitives sized from link lengths and radii (capsule: length of the cylindrical part).
Every moving hand link carries 0.002 kg m^2 of rotor inertia on its diagonal, which stands in for joint armature."""

AXLE_MASS = 1e-3
"""Mass [kg] of the links between the two axes of a joint; the maker has 1e-6, too small beside the others for single precision."""
HAND_MOUNT = 0.02
"""Thickness [m] of the adapter between the arm's flange and the hand's root. Not a published figure."""
HAND_SPEED = 10.0
"""Speed limit [rad/s] that a URDF must state; none is published for the hand."""

# The arm -----------------------------------------------------------------------------------------------------------------------------


_TURN, _HALF, _QUARTER = 6.283185, 3.141592654, 1.570796327
_ARM_SPEED = 3.141593

ARM_BASE = Link(
    name="base_link",
    mass=4.0,
    com=np.array([0, 0, 0.05]),
    inertia=np.diag(
        [4.0 * (3 * 0.075**2 + 0.1**2) / 12] * 2 + [4.0 * 0.075**2 / 2]
    ),  # a solid cylinder: no figure is published
    collisions=(cylinder((0, 0, 0), (0, 0, 0.10), 0.075),),
)

ARM = (
    ArmLink(
        name="shoulder_link", joint="shoulder_pan_joint", xyz=(0, 0, 0.1625), range=(-_TURN, _TURN),
        velocity=_ARM_SPEED, effort=150.0, mass=3.761, com=(0, -0.00193, -0.02561), inertia_roll=_QUARTER,
        inertia=(0.00700210, 0.00000073, -0.00001053, 0.00648091, 0.00049994, 0.00657286),
        shapes=(capsule((0, 0, -0.02), (0, 0, 0.002), 0.06), capsule((0, -0.005, 0), (0, -0.03, 0), 0.06)),
    ),
    ArmLink(
        name="upper_arm_link", joint="shoulder_lift_joint", xyz=(0, 0, 0), rpy=(_QUARTER, 0, 0), range=(-_TURN, _TURN),
        velocity=_ARM_SPEED, effort=150.0, mass=8.058, com=(-0.2125, 0, 0.11336),
        inertia=(0.01505885, -0.00005400, 0.00000563, 0.33388086, -0.00000181, 0.33247207),
        shapes=(
            capsule((0, 0, 0.115), (0, 0, 0.140), 0.06),
            capsule((0, 0, 0.138), (-0.425, 0, 0.138), 0.054),
            capsule((-0.425, 0, 0.105), (-0.425, 0, 0.140), 0.055),
        ),
    ),
    ArmLink(
        name="forearm_link", joint="elbow_joint", xyz=(-0.425, 0, 0), range=(-3.141593, 3.141593),
        velocity=_ARM_SPEED, effort=150.0, mass=2.846, com=(-0.2422, 0, 0.0265),
        inertia=(0.00399632, -0.00001365, 0.00137272, 0.07879254, -0.00000660, 0.07848510),
        shapes=(
            capsule((0, 0, 0.007), (0, 0, 0.035), 0.06),
            capsule((0, 0, 0.007), (-0.3922, 0, 0.007), 0.04),
            capsule((-0.3922, 0, 0.007), (-0.3922, 0, 0.055), 0.045),
        ),
    ),
    ArmLink(
        name="wrist_1_link", joint="wrist_1_joint", xyz=(-0.3922, 0, 0.1333), range=(-_TURN, _TURN),
        velocity=_ARM_SPEED, effort=28.0, mass=1.37, com=(0, -0.01634, -0.0018), inertia_roll=_QUARTER,
        inertia=(0.00165491, -0.00000282, -0.00000438, 0.00135962, 0.00010157, 0.00126279),
        shapes=(capsule((0, 0, -0.02), (0, 0, 0.005), 0.045), capsule((0, 0, 0), (0, -0.04, 0), 0.045)),
    ),
    ArmLink(
        name="wrist_2_link", joint="wrist_2_joint", xyz=(0, -0.0997, 0), rpy=(_QUARTER, 0, 0), range=(-_TURN, _TURN),
        velocity=_ARM_SPEED, effort=28.0, mass=1.3, com=(0, 0.01634, -0.0018), inertia_roll=-_QUARTER,
        inertia=(0.00135617, -0.00000274, 0.00000444, 0.00127827, -0.00005048, 0.00096614),
        shapes=(capsule((0, 0, -0.02), (0, 0, 0.005), 0.045), capsule((0, 0, 0), (0, 0.04, 0), 0.045)),
    ),
    ArmLink(
        name="wrist_3_link", joint="wrist_3_joint", xyz=(0, 0.0996, 0), rpy=(_QUARTER, _HALF, _HALF), range=(-_TURN, _TURN),
        velocity=_ARM_SPEED, effort=28.0, mass=0.365, com=(0, 0, -0.001159),
        inertia=(0.00018694, 0.00000006, -0.00000017, 0.00018908, -0.00000092, 0.00025756),
        shapes=(cylinder((0, 0, -0.035), (0, 0, 0), 0.0375),),
    ),
)  # fmt: skip


# The hand ----------------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class HandLink:
    """A moving link of the hand and the joint before it, which turns about +z of the link; flexion is positive."""

    name: str
    """Without the prefix ``right_``."""
    joint: str
    """Without the prefix ``right_``."""
    parent: str
    """Without the prefix ``right_``."""
    range: tuple[float, float]
    """[rad]"""
    effort: float
    """[N m]"""
    pos: Vector
    """Link frame in the parent at angle 0 [m]."""
    quat: Vector
    mass: float = AXLE_MASS
    """[kg]"""
    com: Vector = (0, 0, 0)
    """[m]"""
    com_quat: Vector = (1, 0, 0, 0)
    """Orientation of the principal axes."""
    diag: Vector = (1e-7, 1e-7, 1e-7)
    """Principal moments of inertia, without the rotor [kg m^2]."""
    shapes: tuple[Shape, ...] = ()

    def below(self, parent: str) -> tuple[Joint, Link]:
        """The joint that hangs it below another link, and the link."""
        R = pose(quat=self.com_quat)[:3, :3]
        inertia = R @ np.diag(self.diag) @ R.T + ROTOR_INERTIA * np.eye(3)
        joint = Joint(
            name=f"right_{self.joint}", type="revolute", parent=parent, child=f"right_{self.name}",
            T_parent_joint=pose(self.pos, quat=self.quat), axis=np.array([0.0, 0, 1]), lower=self.range[0], upper=self.range[1],
            velocity=HAND_SPEED,
        )  # fmt: skip
        return joint, Link(
            name=joint.child, mass=self.mass, com=np.array(self.com), inertia=inertia, collisions=self.shapes
        )


CMC_EFFORT, MCP_EFFORT, PIP_EFFORT, DIP_EFFORT = 3.3, 1.864, 0.638, 0.638

HAND_ROOT = Link(
    name="right_hand_C_MC",
    mass=0.72045,
    com=np.array([0.0060282, 0.00091891, 0.038914]),
    inertia=np.diag([0.00071328, 0.00081371, 0.00020795]),
    collisions=(box((0.040, 0.060, 0.040), (0.0, 0.0, 0.020)), box((0.028, 0.060, 0.058), (0.0, 0.010, 0.062))),
)

FINGERS = ("index", "middle", "ring", "pinky")
FINGER_LENGTH, THUMB_LENGTH = 0.023, 0.027
"""From the last joint's axis to the tip [m], estimated from the centres of mass: the source gives it only in meshes."""
PALM_CENTER = (0.014, 0.003, 0.060)
"""Middle of the palm's inner surface in the hand's root [m]."""

_AXLE = (0.707105, -0.707108, 0, 0)
_FINGER_BASE = (0.499998, -0.500002, -0.5, -0.5)

HAND_BASE = (
    HandLink(
        name="thumb_CMC_VL", joint="thumb_CMC_FE", parent="hand_C_MC", range=(-0.1745, 1.9199), effort=CMC_EFFORT,
        pos=(0.01, 0.026, 0.0212), quat=(-2.59734e-06, 0.707105, 0.707108, -2.59735e-06),
    ),
    HandLink(
        name="thumb_MC", joint="thumb_CMC_AA", parent="thumb_CMC_VL", range=(-0.3491, 0.3491), effort=CMC_EFFORT,
        pos=(0, -0.005, 0), quat=(0.65328, -0.653282, 0.270598, 0.270599), mass=0.116, com=(0.0378875, -0.0105001, 0.00999649),
        com_quat=(-0.224946, 0.690249, -0.156115, 0.669764), diag=(3.87084e-05, 3.37238e-05, 1.64399e-05),
        shapes=(capsule((0.014, -0.008, 0.009), (0.056, -0.008, 0.010), 0.013),),
    ),
    HandLink(
        name="thumb_MCP_VL", joint="thumb_MCP_FE", parent="thumb_MC", range=(-0.5236, 1.3963), effort=MCP_EFFORT,
        pos=(0.065, -0.006, 0.010392), quat=(0.965926, 0.25882, 0, 0),
    ),
    HandLink(
        name="thumb_PP", joint="thumb_MCP_AA", parent="thumb_MCP_VL", range=(-0.3491, 0.3491), effort=MCP_EFFORT,
        pos=(0, 0, 0), quat=_AXLE, mass=0.04955, com=(0.0219649, -0.000155785, -0.00149071),
        com_quat=(0.47361, 0.526063, 0.5236, 0.474125), diag=(4.63211e-06, 4.39424e-06, 2.59479e-06),
        shapes=(capsule((0.004, 0, 0), (0.036, 0, 0), 0.0105),),
    ),
    HandLink(
        name="thumb_DP", joint="thumb_IP", parent="thumb_PP", range=(0, 1.7453), effort=PIP_EFFORT,
        pos=(0.039, 0, 0), quat=(0.707105, 0.707108, 0, 0), mass=0.005987, com=(0.009858, -0.0101251, 0.00044685),
        com_quat=(0.650084, 0.202839, -0.647252, 0.342507), diag=(8.79951e-07, 8.08527e-07, 2.50483e-07),
        shapes=(capsule((0, 0, 0), (THUMB_LENGTH - 0.0095, 0, 0), 0.0095),),
    ),
    HandLink(
        name="index_MCP_VL", joint="index_MCP_FE", parent="hand_C_MC", range=(-0.17453293, 1.5708), effort=MCP_EFFORT,
        pos=(0.001, 0.0303, 0.0957), quat=_FINGER_BASE,
    ),
    HandLink(
        name="middle_MCP_VL", joint="middle_MCP_FE", parent="hand_C_MC", range=(-0.17453293, 1.5708), effort=MCP_EFFORT,
        pos=(0, 0.01, 0.0987), quat=_FINGER_BASE,
    ),
    HandLink(
        name="ring_MCP_VL", joint="ring_MCP_FE", parent="hand_C_MC", range=(-0.17453293, 1.5708), effort=MCP_EFFORT,
        pos=(0.0015, -0.0103, 0.0927), quat=_FINGER_BASE,
    ),
    HandLink(
        name="pinky_MC", joint="pinky_CMC", parent="hand_C_MC", range=(0, 0.2618), effort=CMC_EFFORT,
        pos=(0.01136, -0.0263, 0.0867), quat=(-3.67321e-06, 0, 0, 1), mass=0.12541, com=(0.0107985, 0.00598801, -0.0335125),
        com_quat=(0.709657, -0.106152, -0.0812795, 0.691746), diag=(3.57685e-05, 2.46485e-05, 2.14424e-05),
        shapes=(capsule((0.0100, 0.0048, -0.052), (0.0100, 0.0048, -0.010), 0.0105),),
    ),
    HandLink(
        name="pinky_MCP_VL", joint="pinky_MCP_FE", parent="pinky_MC", range=(-0.17453293, 1.5708), effort=MCP_EFFORT,
        pos=(0.00836, 0.0048, 0), quat=(0.499998, 0.5, -0.5, 0.500002),
    ),
)  # fmt: skip


def finger_tail(finger: str) -> tuple[HandLink, ...]:
    """The links that index, middle, ring and pinky share, from the knuckle's second axis to the tip."""
    return (
        HandLink(
            name=f"{finger}_PP", joint=f"{finger}_MCP_AA", parent=f"{finger}_MCP_VL", range=(-0.3491, 0.3491), effort=MCP_EFFORT,
            pos=(0, 0, 0), quat=_AXLE, mass=0.04138, com=(0.0243772, 1.00263e-06, -0.000755901),
            com_quat=(0.479204, 0.519977, 0.519877, 0.479286), diag=(6.82371e-06, 6.54097e-06, 2.16753e-06),
            shapes=(capsule((0.004, 0, 0), (0.044, 0, 0), 0.009),),
        ),
        HandLink(
            name=f"{finger}_MP", joint=f"{finger}_PIP", parent=f"{finger}_PP", range=(0, 1.7453), effort=PIP_EFFORT,
            pos=(0.047, 0, 0), quat=(0.707105, 0.707108, 0, 0), mass=0.02509, com=(0.015316, -0.00138561, 6.28778e-08),
            com_quat=(-0.0196261, 0.706839, 0.0195184, 0.706832), diag=(2.28516e-06, 2.26758e-06, 9.99868e-07),
            shapes=(capsule((0.002, 0, 0), (0.0295, 0, 0), 0.0082),),
        ),
        HandLink(
            name=f"{finger}_DP", joint=f"{finger}_DIP", parent=f"{finger}_MP", range=(0, 1.3963), effort=DIP_EFFORT,
            pos=(0.0315, 0, 0), quat=(1, 0, 0, 0), mass=0.004103, com=(0.00931268, -0.00769378, 0.000111581),
            com_quat=(0.64397, 0.245697, -0.649334, 0.321406), diag=(4.23752e-07, 3.85411e-07, 1.37217e-07),
            shapes=(capsule((0, 0, 0), (FINGER_LENGTH - 0.0078, 0, 0), 0.0078),),
        ),
    )  # fmt: skip


# Putting it together -----------------------------------------------------------------------------------------------------------------


FRAMES: tuple[Frame, ...] = (
    ("palm", HAND_ROOT.name, PALM_CENTER, (0, 0, 1), (1, 0, 0)),
    *(
        (f"{finger}_tip", f"right_{finger}_DP", (length, 0, 0), (1, 0, 0), (0, 1, 0))
        for finger, length in (("thumb", THUMB_LENGTH), *((finger, FINGER_LENGTH) for finger in FINGERS))
    ),
)


def tree() -> tuple[RobotTree, dict[str, float]]:
    """The robot's tree, and the effort limit of each moving joint."""
    links = (*HAND_BASE, *(link for finger in FINGERS for link in finger_tail(finger)))
    hand = [(f"right_{link.parent}", link) for link in links]
    return robot("ur7e_sharpa", ARM_BASE, ARM, pose((0, 0, HAND_MOUNT)), HAND_ROOT, hand, FRAMES)


def text() -> str:
    """What ``robot.urdf`` must hold."""
    return urdf_text(*tree(), comment=COMMENT)


if __name__ == "__main__":
    URDF.write_text(text())
    print(f"wrote {URDF}")
