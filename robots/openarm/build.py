"""Writes ``robot.urdf`` from the maker's published figures: ``python -m xreset.robots.openarm.build``.

Source: the OpenArm project's robot description (arm v10, right arm, parallel gripper): kinematics, masses, inertias, limits. It gives
shapes only as meshes: those here are primitives sized from link lengths, and the jaws' size is estimated.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from xreset.geometry.urdf import Link, RobotTree
from xreset.geometry.urdf_writer import ArmLink, box, capsule, cylinder, inertia_matrix, pose, urdf_text
from xreset.robots.parts import Frame, robot
from xreset.spec import MimicSpec

URDF = Path(__file__).parent / "robot.urdf"

COMMENT = """OpenArm v1.0, right arm with its parallel gripper. Written by xreset.robots.openarm.build: change that, not this file.
Figures: the OpenArm project's robot description (arm v10). Shapes are primitives sized from link lengths
(capsule: length of the cylindrical part). Each jaw carries 0.2 kg that stands in for the gripper motor's reflected inertia."""

ROTOR_MASS = 0.2
"""Reflected inertia [kg] of the gripper's motor, added to each jaw. A jaw alone (0.036 kg) on a stiff drive would be too fast for the
physics step; a real rotor slows it, and as a link's mass it means the same thing in every engine, which armature does not."""

BASE = Link(
    name="link0",
    mass=1.14323,
    com=np.array([-0.000948336, 0.000158021, 0.0307686]),
    inertia=inertia_matrix(0.001128, -4.0e-06, -3.3e-05, 0.000962, -7.0e-06, 0.00147),
    collisions=(cylinder((0, 0, 0), (0, 0, 0.055), 0.05),),
)

ARM = (
    ArmLink(
        name="link1", joint="joint1", xyz=(0, 0, 0.0625), axis=(0, 0, 1), range=(-1.396263, 3.490659), velocity=16.754666, effort=40.0,
        mass=1.14167, com=(0.00114677, 3.31999e-05, 0.0539528), inertia=(0.001567, -1.0e-06, -2.9e-05, 0.001273, 1.0e-06, 0.001016),
        shapes=(capsule((0, 0, 0.040), (0, 0, 0.060), 0.042),),
    ),
    ArmLink(
        name="link2", joint="joint2", xyz=(-0.0301, 0, 0.06), axis=(-1, 0, 0), range=(-1.745329, 1.745329), velocity=16.754666, effort=40.0,
        mass=0.277509, com=(0.00839629, -2.01451e-08, 0.0325665), inertia=(0.000359, 1.0e-06, -0.000109, 0.000376, 1.0e-06, 0.000232),
        shapes=(capsule((0.0301, 0, 0), (0.0301, 0, 0.050), 0.036),),
    ),
    ArmLink(
        name="link3", joint="joint3", xyz=(0.0301, 0, 0.06625), axis=(0, 0, 1), range=(-1.570796, 1.570796), velocity=5.445426, effort=27.0,
        mass=1.073863, com=(-0.00210475, 0.000554909, 0.0884747), inertia=(0.004372, 1.0e-06, 1.1e-05, 0.004319, -3.6e-05, 0.000661),
        shapes=(capsule((0, 0, 0.030), (0, 0, 0.140), 0.038),),
    ),
    ArmLink(
        name="link4", joint="joint4", xyz=(0, 0.0315, 0.15375), axis=(0, 1, 0), range=(0, 2.443461), velocity=5.445426, effort=27.0,
        mass=0.559853, com=(-0.00290068, -0.0303058, 0.0633964), inertia=(0.000623, -1.0e-06, -1.9e-05, 0.000511, 3.8e-05, 0.000334),
        shapes=(capsule((0, -0.0315, 0.010), (0, -0.0315, 0.080), 0.036),),
    ),
    ArmLink(
        name="link5", joint="joint5", xyz=(0, -0.0315, 0.0955), axis=(0, 0, 1), range=(-1.570796, 1.570796), velocity=20.943946, effort=7.0,
        mass=0.550659, com=(-0.00304967, 0.00088669, 0.0430798), inertia=(0.000423, -8.0e-06, 6.0e-06, 0.000445, -6.0e-06, 0.000324),
        shapes=(capsule((0, 0, 0.020), (0, 0, 0.095), 0.035),),
    ),
    ArmLink(
        name="link6", joint="joint6", xyz=(0.0375, 0, 0.1205), axis=(1, 0, 0), range=(-0.785398, 0.785398), velocity=20.943946, effort=7.0,
        mass=0.385203, com=(-0.0371366, 0.000332305, -9.49837e-05), inertia=(0.000143, 1.0e-06, 1.0e-06, 0.000157, 1.0e-06, 0.000159),
        shapes=(capsule((-0.0475, 0, 0), (-0.0275, 0, 0), 0.035),),
    ),
    ArmLink(
        name="link7", joint="joint7", xyz=(-0.0375, 0, 0), axis=(0, 1, 0), range=(-1.570796, 1.570796), velocity=20.943946, effort=7.0,
        mass=0.385977, com=(6.87551e-05, 0.0126618, 0.0695195), inertia=(0.000639, 1.0e-06, 1.0e-06, 0.000497, 8.9e-05, 0.000342),
        shapes=(capsule((0, 0.005, 0.030), (0, 0.005, 0.075), 0.033),),
    ),
)  # fmt: skip

GRIPPER_BODY = Link(
    name="gripper_body",
    mass=0.3,
    com=np.array([0, 0.002, 0.019]),
    inertia=inertia_matrix(0.0001, 1.0e-06, 1.0e-06, 0.00025, 1.0e-06, 0.00017),
    collisions=(box((0.050, 0.140, 0.040), (0, 0.0015, 0)),),
)
T_LINK7_BODY = pose((0, 0, 0.1))
"""Where the gripper's body sits on the last link: about 15 mm below the jaws' frames. An estimate."""

JAW_MASS = 0.0360255
JAW_COM = (0.0064528, 0.01702, 0.0219685)
"""Of the left jaw; y is negated for the right one [m]."""
JAW_INERTIA = (2.375e-06, 0.0, 0.0, 2.375e-06, 0.0, 7.5e-07)
"""ixx ixy ixz iyy iyz izz [kg m^2]. The source has 1e-6 in place of the three zeros. With them the largest principal moment exceeds
the sum of the others, which no body has; 1e-6 looks like a placeholder, so the diagonal stays and the rest is left out."""
JAW_TRAVEL = 0.044
"""Of each jaw [m]; closed is 0."""
JAW_EFFORT, JAW_SPEED = 333.0, 10.0
"""[N], [m/s]; as published."""
PAD = -0.0055
"""The left jaw's inner surface along y [m]: the jaws' frames are 12 mm apart when closed, which leaves a gap of 1 mm."""
JAW_END = 0.070
"""End of the jaws along z [m]. An estimate: the source gives it only in meshes."""
TIP_INSET = 0.008
"""Distance of the fingertip frame from the jaw's end [m]."""

MIMIC = MimicSpec(joint="finger_joint2", source="finger_joint1")


def _jaw(name: str, joint: str, y: float, side: float, effort: float) -> ArmLink:
    """A jaw: a carriage outside and a finger along z; ``side`` is 1 for the left one, -1 for the right one."""
    finger = box((0.020, 0.013, JAW_END - 0.006), (0, side * (PAD + 0.0065), (JAW_END + 0.006) / 2))
    carriage = box((0.024, 0.022, 0.022), (0, side * (PAD + 0.022), 0.017))
    return ArmLink(
        name=name, joint=joint, type="prismatic", xyz=(0, y, 0.1151), axis=(0, side, 0), range=(0.0, JAW_TRAVEL), velocity=JAW_SPEED,
        effort=effort, mass=JAW_MASS + ROTOR_MASS, com=(JAW_COM[0], side * JAW_COM[1], JAW_COM[2]), inertia=JAW_INERTIA,
        shapes=(finger, carriage),
    )  # fmt: skip


WRIST = ARM[-1].name
JAWS = (
    _jaw("right_finger", "finger_joint1", -0.0045, -1.0, JAW_EFFORT),
    _jaw("left_finger", MIMIC.joint, 0.0075, 1.0, 0.0),
)
FRAMES: tuple[Frame, ...] = (  # the palm's z points where a human's palm would, with the right jaw as the thumb
    ("palm", WRIST, (0, 0.0015, 0.125), (0, 0, 1), (-1, 0, 0)),
    ("thumb_tip", "right_finger", (0, -PAD, JAW_END - TIP_INSET), (0, 0, 1), (0, 1, 0)),
    ("index_tip", "left_finger", (0, PAD, JAW_END - TIP_INSET), (0, 0, 1), (0, -1, 0)),
)


def tree() -> tuple[RobotTree, dict[str, float]]:
    """The robot's tree, and the effort limit of each actuated joint."""
    return robot("openarm", BASE, ARM, T_LINK7_BODY, GRIPPER_BODY, [(WRIST, jaw) for jaw in JAWS], FRAMES)


def text() -> str:
    """What ``robot.urdf`` must hold."""
    return urdf_text(*tree(), mimics=(MIMIC,), comment=COMMENT)


if __name__ == "__main__":
    URDF.write_text(text())
    print(f"wrote {URDF}")
