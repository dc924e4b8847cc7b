"""Writes ``robot.urdf`` from published figures: ``python -m xreset.robots.xarm7_leap.build``.

Sources: UFACTORY's ``xarm_description`` of the xArm7 (kinematics, masses, limits); the LEAP hand's description (Shaw et al. 2023:
kinematics, masses, ranges). Shapes are primitives: the arm's sized from link lengths and the housings' radii, the hand's from link lengths
and its motors, 20 x 26 x 34 mm. The hand's description has every centre of mass at a joint: here it is the middle of the link's shapes.
"""

from __future__ import annotations

from math import pi
from pathlib import Path

import numpy as np

from xreset.geometry.urdf import Link, RobotTree
from xreset.geometry.urdf_writer import ArmLink, box, capsule, cylinder, inertia_matrix, pose, urdf_text
from xreset.robots.parts import Frame, Vector, chained, robot, with_rotor
from xreset.spec import Shape

URDF = Path(__file__).parent / "robot.urdf"

COMMENT = """xArm7 with the LEAP right hand. Written by xreset.robots.xarm7_leap.build: change that, not this file.
Figures: xarm_description; the LEAP hand's description. Shapes are primitives sized from link lengths, housings and motors
(capsule: length of the cylindrical part). Every moving hand link carries 0.002 kg m^2 of rotor inertia, in place of armature."""

ADAPTER = 0.01
"""[m] Thickness of the plate between flange and hand. Not a published figure."""
TORQUE, SPEED = 0.95, 8.48
"""[N m], [rad/s] of every joint of the hand."""

BASE = Link(
    name="link_base",
    mass=0.88556,
    com=np.array([-0.021131, -0.0016302, 0.056488]),
    inertia=inertia_matrix(0.0030595, 0.00012259, -0.00062705, 0.0037783, 0.00027023, 0.0020125),
    collisions=(cylinder((0, 0, 0), (0, 0, 0.155), 0.063),),
)


def _arm(
    number: int, xyz: Vector, roll: float, limits: tuple[float, float], effort: float, mass: float, com: Vector, inertia: Vector,
    *shapes: Shape,
) -> ArmLink:  # fmt: skip
    return ArmLink(
        name=f"link{number}", joint=f"joint{number}", xyz=xyz, rpy=(roll, 0, 0), range=limits, velocity=pi, effort=effort,
        mass=mass, com=com, inertia=inertia, shapes=shapes,
    )  # fmt: skip


_TURN = (-2 * pi, 2 * pi)
ARM = (
    _arm(1, (0, 0, 0.267), 0, _TURN, 50.0, 2.382, (-0.0002, 0.02905, -0.01233),
         (0.0056905, -1.579e-05, 5.125e-06, 0.0049566, -0.000873378, 0.003316654),
         capsule((0, 0, -0.064), (0, 0, 0), 0.048), capsule((0, 0, 0), (0, 0.027, 0), 0.048)),
    _arm(2, (0, 0, 0), -pi / 2, (-2.059, 2.0944), 50.0, 1.869, (0.00022, -0.12856, 0.01735),
         (0.0095989, 1.541e-06, 5.56e-06, 0.00382472, -0.00317156, 0.007565669),
         capsule((0, 0, 0.005), (0, 0, 0.072), 0.047), capsule((0, -0.005, 0.072), (0, -0.145, 0.005), 0.045),
         capsule((0, -0.145, 0), (0, -0.147, 0), 0.043)),
    _arm(3, (0, -0.293, 0), pi / 2, _TURN, 30.0, 1.6383, (0.0466, -0.02463, -0.00768),
         (0.00310955, 0.00030837, -0.00058453, 0.00264483, 0.000338893, 0.0026624),
         capsule((0, 0, -0.059), (0, 0, 0), 0.042), capsule((0.0525, -0.025, 0), (0.0525, 0.027, 0), 0.042),
         capsule((0, 0, 0), (0.0525, -0.02, 0), 0.042)),
    _arm(4, (0.0525, 0, 0), pi / 2, (-0.19198, 3.927), 30.0, 1.7269, (0.07047, -0.11575, 0.012),
         (0.005889, 0.00137112, 0.00088143, 0.00359703, -0.001762155, 0.00543244),
         capsule((0, 0, 0), (0, 0, 0.065), 0.042), capsule((0, 0, 0.065), (0.0775, -0.09, 0.02), 0.042),
         capsule((0.0775, -0.09, 0), (0.0775, -0.127, 0), 0.042)),
    _arm(5, (0.0775, -0.3425, 0), pi / 2, _TURN, 30.0, 1.3203, (-0.00032, 0.01604, -0.026),
         (0.00534665, 1.5117e-05, -3.69e-07, 0.0049779, -0.00022132, 0.0013624),
         capsule((0, 0, -0.131), (0, 0.03, -0.03), 0.042), capsule((0, -0.001, -0.005), (0, 0.044, -0.005), 0.042)),
    _arm(6, (0, 0, 0), pi / 2, (-1.69297, pi), 20.0, 1.325, (0.06469, 0.03278, 0.02141),
         (0.0014745, -0.000488, 0.0002953, 0.0019037, 0.00014749, 0.0023652),
         capsule((0, 0, 0), (0.076, 0, 0.02), 0.037), capsule((0.076, 0, 0.02), (0.076, 0.031, 0), 0.037)),
    _arm(7, (0.076, 0.097, 0), -pi / 2, _TURN, 20.0, 0.17, (0, -0.00677, -0.01098),
         (9.3e-05, 0, 0, 5.87e-05, -3.6e-06, 0.000132), cylinder((0, 0, -0.027), (0, 0, 0), 0.038)),
)  # fmt: skip

HAND_ROOT = Link(
    name="palm_body",
    mass=0.237,
    com=np.array([-0.05, -0.035, -0.011]),
    inertia=inertia_matrix(0.000354094, -1.193e-06, -2.445e-06, 0.000260915, -2.905e-06, 0.000529257),
    collisions=(
        box((0.079, 0.120, 0.046), (-0.0605, -0.035, -0.011)),
        *(box((0.022, 0.026, 0.034), (-0.009, y, -0.011)) for y in (0.008, -0.037, -0.082)),
    ),
)
_MOTOR = box((0.034, 0.026, 0.022), (0.0075, 0, -0.011))
_MOTOR_INERTIA = (4.798e-06, 1.2e-08, 4e-09, 2.862e-06, 1.1e-08, 4.234e-06)


def _link(
    name: str, xyz: Vector, rpy: Vector, limits: tuple[float, float], mass: float, inertia: Vector, *shapes: Shape
) -> ArmLink:
    return ArmLink(
        name=name, joint=f"{name}_joint", xyz=xyz, rpy=rpy, axis=(0, 0, -1), range=limits, velocity=SPEED, effort=TORQUE,
        mass=mass, com=np.mean([shape.T_body_shape[:3, 3] for shape in shapes], axis=0), inertia=with_rotor(inertia), shapes=shapes,
    )  # fmt: skip


def _finger(finger: str, y: float) -> tuple[ArmLink, ...]:
    return (
        _link(f"{finger}_mcp", (-0.007, y, -0.0187), (pi / 2, pi / 2, 0), (-0.314, 2.23), 0.044,
              (1.1499e-05, 3.049e-06, 1.21e-07, 7.796e-06, 1.12e-07, 1.4759e-05),
              box((0.018, 0.026, 0.034), (0, 0.008, 0.015)), box((0.030, 0.040, 0.024), (-0.027, 0.042, 0.016))),
        _link(f"{finger}_side", (-0.0122, 0.0381, 0.0145), (-pi / 2, 0, pi / 2), (-1.047, 1.047), 0.032, _MOTOR_INERTIA, _MOTOR),
        _link(f"{finger}_pip", (0.015, 0.0143, -0.013), (pi / 2, -pi / 2, 0), (-0.506, 1.885), 0.037,
              (5.542e-06, -6.07e-07, -1.7e-08, 5.727e-06, -2.3e-08, 6.682e-06),
              box((0.018, 0.024, 0.034), (0, -0.006, 0.015)), box((0.034, 0.022, 0.026), (0.007, -0.035, 0.015))),
        _link(f"{finger}_dip", (0, -0.0361, 0.0002), (0, 0, 0), (-0.366, 2.042), 0.016,
              (3.368e-06, 1.15e-07, 0, 1.556e-06, 0, 2.863e-06),
              box((0.014, 0.022, 0.034), (0, -0.006, 0.015)), capsule((0, -0.022, 0.0145), (0, -0.0395, 0.0145), 0.0105)),
    )  # fmt: skip


THUMB = (
    _link("thumb_cmc", (-0.0693, -0.0012, -0.0216), (0, pi / 2, 0), (-0.349, 2.094), 0.032, _MOTOR_INERTIA, _MOTOR),
    _link("thumb_axis", (0, 0.0143, -0.013), (pi / 2, -pi / 2, 0), (-0.47, 2.443), 0.003,
          (5.93e-07, 0, 0, 5.49e-07, 0, 2.24e-07), box((0.018, 0.034, 0.023), (0, 0, -0.0115))),
    _link("thumb_mcp", (0, 0.0145, -0.017), (-pi / 2, 0, 0), (-1.2, 1.9), 0.038,
          (8.474e-06, 2.41e-07, 2.6e-08, 3.841e-06, 2.5e-08, 7.679e-06),
          box((0.020, 0.040, 0.024), (0, 0.010, -0.014)), box((0.014, 0.023, 0.034), (0, 0.0405, -0.014))),
    _link("thumb_ip", (0, 0.0466, 0.0002), (0, 0, pi), (-1.34, 1.88), 0.049,
          (2.0372e-05, -4.89e-07, -3e-08, 4.336e-06, -9.7e-08, 1.9845e-05),
          box((0.020, 0.035, 0.024), (0, -0.009, -0.015)), capsule((0, -0.030, -0.0145), (0, -0.0515, -0.0145), 0.0105)),
)  # fmt: skip
FINGERS = (THUMB, _finger("index", 0.0230), _finger("middle", -0.0224), _finger("ring", -0.0678))

_PALM = ((1, 0, 0), (0, 0, -1))
"""x and z axes of palm and wrist in the hand's root: along the fingers, and out of the inner side."""
FRAMES: tuple[Frame, ...] = (
    ("palm", HAND_ROOT.name, (-0.047, -0.037, -0.034), *_PALM),
    ("wrist", HAND_ROOT.name, (-0.102, -0.037, -0.0187), *_PALM),
    ("thumb_tip", "thumb_ip", (0, -0.062, -0.0145), (0, -1, 0), (1, 0, 0)),
    ("thumb_last", "thumb_ip", (0, 0, -0.0145), (0, -1, 0), (1, 0, 0)),
    *(
        (f"{finger}_{name}", f"{finger}_{link}", (0, y, 0.0145), (0, -1, 0), (-1, 0, 0))
        for finger in ("index", "middle", "ring")
        for name, link, y in (
            ("knuckle", "mcp", 0.0),
            ("middle", "pip", 0.0),
            ("last", "dip", 0.0),
            ("tip", "dip", -0.05),
        )
    ),
)


def tree() -> tuple[RobotTree, dict[str, float]]:
    """The robot's tree, and the effort limit of each moving joint."""
    mount = pose((0, 0, ADAPTER)) @ pose((0, 0.038, 0.098), rpy=(0, -pi / 2, 0))  # the description's base, on the plate
    return robot("xarm7_leap", BASE, ARM, mount, HAND_ROOT, chained(HAND_ROOT, FINGERS), FRAMES)


def text() -> str:
    """What ``robot.urdf`` must hold."""
    return urdf_text(*tree(), comment=COMMENT)


if __name__ == "__main__":
    URDF.write_text(text())
    print(f"wrote {URDF}")
