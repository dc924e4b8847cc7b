"""Writes ``robot.urdf`` from published figures: ``python -m xreset.robots.panda_allegro.build``.

Sources: Franka Emika's ``franka_description`` (kinematics, limits, the capsules of its self-collision model), with the masses and inertias
that it takes from Gaz et al., "Dynamic Identification of the Franka Emika Panda Robot" (2019); Wonik's description of the Allegro right
hand (kinematics, masses, ranges, boxes), with its data sheet's torque, 0.7 N m, in place of the description's 10.
"""

from __future__ import annotations

from math import pi
from pathlib import Path

import numpy as np

from xreset.geometry.urdf import Link, RobotTree
from xreset.geometry.urdf_writer import ArmLink, box, capsule, inertia_matrix, pose, urdf_text
from xreset.robots.parts import Frame, Vector, chained, robot, with_rotor
from xreset.spec import Shape

URDF = Path(__file__).parent / "robot.urdf"

COMMENT = """Franka Panda with the Allegro right hand. Written by xreset.robots.panda_allegro.build: change that, not this file.
Figures: franka_description; Wonik's description of the Allegro right hand v4. (Capsule: length of the cylindrical part.)
Every moving hand link carries 0.002 kg m^2 of rotor inertia on its diagonal, which stands in for joint armature."""

FLANGE = 0.107
"""[m] From the last joint's axes to the flange."""
ADAPTER = 0.01
"""[m] Thickness of the plate between flange and hand. Not a published figure."""
HAND_LENGTH = 0.0952
"""[m] From the hand's lower end to its frame, between the knuckles."""
TORQUE, SPEED = 0.7, 7.0
"""[N m], [rad/s] of every joint of the hand; the speed is that of 60 degrees in 0.15 s, which the data sheet states."""
TIP_RADIUS = 0.012
"""[m] Fingertips are spheres at 0.0267 m (thumb: 0.0423 m)."""

BASE = Link(
    name="panda_link0",
    mass=0.629769,
    com=np.array([-0.041018, -0.00014, 0.049974]),
    inertia=inertia_matrix(0.00315, 8.2904e-07, 0.00015, 0.00388, 8.2299e-06, 0.004285),
    collisions=(capsule((-0.09, 0, 0.06), (-0.06, 0, 0.06), 0.06),),
)


def _arm(
    number: int,
    xyz: Vector,
    roll: float,
    limits: tuple[float, float],
    mass: float,
    com: Vector,
    inertia: Vector,
    *shapes: Shape,
) -> ArmLink:
    velocity, effort = (2.175, 87.0) if number <= 4 else (2.61, 12.0)
    return ArmLink(
        name=f"panda_link{number}", joint=f"panda_joint{number}", xyz=xyz, rpy=(roll, 0, 0), range=limits, velocity=velocity, effort=effort,
        mass=mass, com=com, inertia=inertia, shapes=shapes,
    )  # fmt: skip


_DIAGONAL = 0.5**0.5
ARM = (
    _arm(1, (0, 0, 0.333), 0, (-2.8973, 2.8973), 4.970684, (0.003875, 0.002081, -0.04762),
         (0.70337, -0.000139, 0.006772, 0.70661, 0.019169, 0.009117), capsule((0, 0, -0.333), (0, 0, -0.05), 0.06)),
    _arm(2, (0, 0, 0), -pi / 2, (-1.7628, 1.7628), 0.646926, (-0.003141, -0.02872, 0.003495),
         (0.007962, -0.003925, 0.010254, 0.02811, 0.000704, 0.025995), capsule((0, 0, -0.06), (0, 0, 0.06), 0.06)),
    _arm(3, (0, -0.316, 0), pi / 2, (-2.8973, 2.8973), 3.228604, (0.027518, 0.039252, -0.066502),
         (0.037242, -0.004761, -0.011396, 0.036155, -0.012805, 0.01083), capsule((0, 0, -0.22), (0, 0, -0.07), 0.06)),
    _arm(4, (0.0825, 0, 0), pi / 2, (-3.0718, -0.0698), 3.587895, (-0.05317, 0.104419, 0.027454),
         (0.025853, 0.007796, -0.001332, 0.019552, 0.008641, 0.028323), capsule((0, 0, -0.06), (0, 0, 0.06), 0.06)),
    _arm(5, (-0.0825, 0.384, 0), -pi / 2, (-2.8973, 2.8973), 1.225946, (-0.011953, 0.041065, -0.038437),
         (0.035549, -0.002117, -0.004037, 0.029474, 0.000229, 0.008627),
         capsule((0, 0, -0.31), (0, 0, -0.21), 0.06), capsule((0, 0.08, -0.2), (0, 0.08, -0.06), 0.025)),
    _arm(6, (0, 0, 0), pi / 2, (-0.0175, 3.7525), 1.666555, (0.060149, -0.014117, -0.010517),
         (0.001964, 0.000109, -0.001158, 0.004354, 0.000341, 0.005433), capsule((0, 0, -0.07), (0, 0, 0.01), 0.05)),
    _arm(7, (0.088, 0, 0), pi / 2, (-2.8973, 2.8973), 0.735522, (0.010517, -0.004252, 0.061597),
         (0.012516, -0.000428, -0.001196, 0.010027, -0.000741, 0.004815), capsule((0, 0, -0.06), (0, 0, 0.08), 0.04),
         capsule((0.055 * _DIAGONAL, 0.055 * _DIAGONAL, 0.082), (0.065 * _DIAGONAL, 0.065 * _DIAGONAL, 0.082), 0.03)),
)  # fmt: skip

HAND_ROOT = Link(
    name="palm_body",
    mass=0.4154,
    com=np.array([-0.009, 0, -0.0475]),  # of the boxes: the description has the frame's origin
    inertia=np.diag(
        [0.4154 * (a**2 + b**2) / 12 for a, b in ((0.112, 0.0945), (0.0414, 0.0945), (0.0414, 0.112))]
    ),  # of a solid box
    collisions=(
        box((0.0414, 0.112, 0.0448), (-0.009, 0, -0.023)),
        box((0.0414, 0.0538, 0.0428), (-0.009, -0.0253, -0.0667)),
        box((0.0414, 0.072, 0.013), (-0.0093, -0.00557, -0.08874)),
    ),
)


def _finger(finger: str, y: float, z: float, roll: float) -> tuple[ArmLink, ...]:
    """A finger; the description's masses differ from finger to finger as no hand's do, so all have those of its index finger."""
    rows = (
        ("base", (0, y, z), (roll, 0, 0), (0, 0, 1), (-0.47, 0.47), 0.0119, (1.0167e-06, 0, 0, 6.4768e-07, 0, 1.0167e-06), 0.0164),
        ("proximal", (0, 0, 0.0164), (0, 0, 0), (0, 1, 0), (-0.196, 1.61), 0.065,
         (7.9565e-05, 1.7199e-05, 8.7588e-06, 2.4709e-05, 2.4131e-05, 7.9565e-05), 0.054),
        ("medial", (0, 0, 0.054), (0, 0, 0), (0, 1, 0), (-0.174, 1.709), 0.0355,
         (2.6398e-05, 6.6797e-06, 4.7836e-06, 1.3495e-05, 9.372e-06, 2.6398e-05), 0.0384),
        ("distal", (0, 0, 0.0384), (0, 0, 0), (0, 1, 0), (-0.227, 1.618), 0.0368, (1e-05, 0, 0, 2e-05, 0, 2e-05), 0.0267),
    )  # fmt: skip
    return _chain(finger, rows)


def _chain(
    finger: str, rows: tuple[tuple[str, Vector, Vector, Vector, tuple[float, float], float, Vector, float], ...]
) -> tuple[ArmLink, ...]:
    links = []
    for name, xyz, rpy, axis, limits, mass, inertia, length in rows:
        shapes = (box((0.0196, 0.0275, length), (0, 0, length / 2)),)
        if name == "distal":
            shapes = (
                box((0.0196, 0.0269, length - 0.011), (0, 0, (length - 0.011) / 2)),
                capsule((0, 0, 0.01), (0, 0, length), TIP_RADIUS),
            )
        elif name == "carpal":
            shapes = (box((0.0358, 0.034, 0.0455), (-0.0179, 0.009, 0.0145)),)
        links.append(
            ArmLink(
                name=f"{finger}_{name}", joint=f"{finger}_{name}_joint", xyz=xyz, rpy=rpy, axis=axis, range=limits, velocity=SPEED,
                effort=TORQUE, mass=mass, com=np.mean([shape.T_body_shape[:3, 3] for shape in shapes], axis=0), inertia=with_rotor(inertia),
                shapes=shapes,
            )
        )  # fmt: skip
    return tuple(links)


THUMB = _chain("thumb", (
    ("carpal", (-0.0182, 0.019333, -0.045987), (0, -1.65806279, -pi / 2), (-1, 0, 0), (0.263, 1.396), 0.0176,
     (1.8927e-05, 7.1672e-06, 5.3557e-06, 1.4301e-05, 6.8068e-06, 1.8927e-05), 0.0455),
    ("base", (-0.027, 0.005, 0.0399), (0, 0, 0), (0, 0, 1), (-0.105, 1.163), 0.0119,
     (4.2425e-06, 1.0321e-06, 1.6035e-06, 4.5236e-06, 1.4481e-06, 4.2425e-06), 0.0177),
    ("proximal", (0, 0, 0.0177), (0, 0, 0), (0, 1, 0), (-0.189, 1.644), 0.038,
     (4.3044e-05, 9.5707e-06, 5.1205e-06, 1.4445e-05, 1.3428e-05, 4.3044e-05), 0.0514),
    ("distal", (0, 0, 0.0514), (0, 0, 0), (0, 1, 0), (-0.162, 1.719), 0.0556,
     (3.2922e-05, 8.0421e-06, 5.2283e-06, 1.4749e-05, 1.1284e-05, 3.2922e-05), 0.0423),
))  # fmt: skip
FINGERS = (
    THUMB,
    _finger("index", 0.0435, -0.001542, -0.08726646),
    _finger("middle", 0.0, 0.0007, 0.0),
    _finger("ring", -0.0435, -0.001542, 0.08726646),
)

FRAMES: tuple[Frame, ...] = (
    ("palm", HAND_ROOT.name, (0.0117, 0, -0.04), (0, 0, 1), (1, 0, 0)),
    ("wrist", HAND_ROOT.name, (0, 0, -0.095), (0, 0, 1), (1, 0, 0)),
    *(
        (f"{finger}_tip", f"{finger}_distal", (0, 0, end + TIP_RADIUS), (0, 0, 1), (1, 0, 0))
        for finger, end in (("thumb", 0.0423), ("index", 0.0267), ("middle", 0.0267), ("ring", 0.0267))
    ),
)


def tree() -> tuple[RobotTree, dict[str, float]]:
    """The robot's tree, and the effort limit of each moving joint."""
    return robot(
        "panda_allegro",
        BASE,
        ARM,
        pose((0, 0, FLANGE + ADAPTER + HAND_LENGTH)),
        HAND_ROOT,
        chained(HAND_ROOT, FINGERS),
        FRAMES,
    )


def text() -> str:
    """What ``robot.urdf`` must hold."""
    return urdf_text(*tree(), comment=COMMENT)


if __name__ == "__main__":
    URDF.write_text(text())
    print(f"wrote {URDF}")
