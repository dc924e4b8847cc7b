"""Parametric stand-ins for the nine YCB objects of the paper.

Each is a few convex pieces in the frame of the DexYCB object poses. Sizes and offsets come from the YCB object set (Calli et al. 2015,
"Benchmarking in Manipulation Research"), measured on the published models; the models are scans, so a can is not quite round and its centre
is some millimetres off the frame's origin. Masses are the set's published ones. Numbers below are in millimetres.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from xreset.geometry.shapes import box, cylinder, hull, loft, mass_properties, prism, section, surface_of
from xreset.objects.ycb import MASSES
from xreset.spec import ObjectSpec, Shape

MM = 1e-3
UP = np.array([0.0, 0.0, 1.0])


def stand_in(name: str) -> ObjectSpec:
    """The stand-in of that official name (``KeyError`` if there is none).

    Mass is the published one; centre of mass and inertia are those of the pieces at uniform density. The pitcher is solid, as its scan is:
    its real shell has a larger inertia.
    """
    pieces = _MAKERS[name]()
    vertices, faces = surface_of(pieces)
    com, inertia = mass_properties(vertices, faces, MASSES[name])
    return ObjectSpec(
        name=name, pieces=pieces, mass=MASSES[name], com=com, inertia=inertia, vertices=vertices, faces=faces
    )


def _meat_can() -> tuple[Shape, ...]:
    u, v = _turned(3.5)
    body = [
        section((-2.4 * MM, -0.5 * MM, z * MM), 49.5 * MM * u, 26.0 * MM * v, power=4.0, count=32)
        for z in (-49.5, 33.5)
    ]
    return (loft(body),)


def _mustard_bottle() -> tuple[Shape, ...]:
    u, v = _turned(-22.5)
    center = -2.2 * MM * v
    # height, half width, half depth, power: the waist, the shoulder, the cap and the nozzle
    outline = (
        ((-84, 47.0, 27.5, 2.8), (-60, 48.0, 28.3, 2.8), (-20, 41.0, 25.3, 2.6)),
        ((-20, 41.0, 25.3, 2.6), (12, 47.5, 25.3, 2.6), (40, 47.5, 25.5, 2.6)),
        ((40, 47.5, 25.5, 2.6), (60, 37.0, 27.5, 2.2), (72, 22.0, 21.0, 2.0)),
        ((72, 20.0, 20.5, 2.0), (93, 19.7, 20.0, 2.0)),
        ((93, 11.0, 11.0, 2.0), (107, 8.5, 8.5, 2.0)),
    )
    return tuple(
        loft(section(center + z * MM * UP, a * MM * u, b * MM * v, power=power, count=20) for z, a, b, power in part)
        for part in outline
    )


def _banana() -> tuple[Shape, ...]:
    # centre line x, y, height of the centre; half widths in the plane and along z; direction of the centre line in degrees
    ribs = (
        (-12.0, -101.0, -4.0, 4.5, 4.5, 98),
        (-12.6, -88.0, -2.5, 11.8, 11.2, 97),
        (-16.4, -60.0, -0.7, 16.9, 16.0, 95),
        (-16.5, -26.0, 1.0, 18.5, 17.5, 84),
        (-5.4, 17.6, 1.8, 18.6, 18.0, 67),
        (11.0, 44.5, 1.2, 18.2, 17.5, 51),
        (28.3, 60.1, -1.1, 15.6, 15.6, 34),
        (46.5, 67.6, -5.2, 8.4, 9.2, 18),
        (72.5, 71.2, -10.6, 5.2, 5.8, 4),
    )
    rings = []
    for x, y, z, width, height, degrees in ribs:
        across = np.array([-np.sin(np.radians(degrees)), np.cos(np.radians(degrees)), 0.0])
        rings.append(section((x * MM, y * MM, z * MM), width * MM * across, (0, 0, height * MM), count=14))
    return tuple(loft(pair) for pair in pairwise(rings))


def _pitcher() -> tuple[Shape, ...]:
    center = np.array([-13.4, -13.7, 0.0]) * MM
    out, side = _turned(45.0)  # the handle points to +x +y, the spout away from it

    def ring(z: float, radius: float) -> np.ndarray:
        return section(center + z * MM * UP, radius * MM * out, radius * MM * side, count=20)

    def across(
        outline: tuple[tuple[float, float], ...], half: float
    ) -> Shape:  # outline: distance from the axis, height
        return hull(
            np.array([center + r * MM * out + z * MM * UP + s * half * MM * side for r, z in outline for s in (-1, 1)])
        )

    body = loft([ring(-146.0, 46.0), ring(-138.0, 52.5), ring(87.0, 65.0)])
    lid = loft([ring(87.0, 56.0), ring(94.5, 30.0)])
    spout = hull(
        np.array(
            [
                center - r * MM * out + z * MM * UP + s * MM * side
                for r, z, s in ((60, 84, 16), (60, 84, -16), (80, 70, 12), (80, 70, -12), (58, 45, 0))
            ]
        )
    )
    handle = (
        across(((60, 82), (62, 63), (88, 62), (92, 55), (104, 55), (96, 72), (80, 80)), 8.0),
        across(((91, 57), (104, 57), (106, 35), (102, -5), (88, -5), (86, 20)), 8.0),
        across(((88, -3), (102, -3), (98, -35), (91, -46), (78, -55), (72, -46), (84, -30)), 8.0),
        across(((56, -47), (56, -72), (80, -56), (75, -45)), 8.0),
    )
    return (body, lid, spout, *handle)


def _power_drill() -> tuple[Shape, ...]:
    def along_x(x: float, low: float, high: float, depth: float, power: float = 2.5) -> np.ndarray:
        return section(
            (x * MM, (low + high) / 2 * MM, 0.0),
            (0, (high - low) / 2 * MM, 0),
            (0, 0, depth * MM),
            power=power,
            count=16,
        )

    def along_y(y: float, left: float, right: float, depth: float, power: float = 3.0) -> np.ndarray:
        return section(
            ((left + right) / 2 * MM, y * MM, 0.0),
            ((right - left) / 2 * MM, 0, 0),
            (0, 0, depth * MM),
            power=power,
            count=16,
        )

    chuck = loft([along_x(-101, 38, 56, 9), along_x(-88, 28, 65, 19.5, 2.0), along_x(-45, 25, 68, 22.0, 2.0)])
    head = loft(
        [along_x(-45, 23, 71, 24.0), along_x(50, 24, 69, 24.0), along_x(78, 28, 65, 21.0), along_x(82.5, 36, 57, 13.0)]
    )
    neck = loft([along_y(26, -32, 72, 20.0), along_y(10, -26, 60, 15.0)])
    trigger = loft([along_y(10, -26, 46, 15.5), along_y(-17, -14, 46, 14.0)])
    grip = loft([along_y(-14, 3, 46, 16.5), along_y(-45, 8, 53, 16.5)])
    shaft = loft([along_y(-45, 8, 53, 16.5), along_y(-80, 13, 53, 14.5)])
    base = loft(
        [
            along_y(-79, -8, 52, 20.0),
            along_y(-86, -38, 53, 22.0),
            along_y(-100, -44, 59, 26.5),
            along_y(-113, -44, 57, 27.5),
        ]
    )
    return (chuck, head, neck, trigger, grip, shaft, base)


def _scissors() -> tuple[Shape, ...]:
    low, high = -7.2 * MM, 7.4 * MM

    def part(*outline: tuple[float, float]) -> Shape:
        return prism([(x * MM, y * MM) for x, y in outline], low, high)

    blades = prism(
        [(x * MM, y * MM) for x, y in ((8, 44), (21, 44), (39, 108), (40, 127), (36, 128), (28, 115))],
        -2.0 * MM,
        2.8 * MM,
    )
    hub = part((5, 44), (12, 47), (20, 45), (22, 38), (20, 0), (18, -8), (0, -8), (-5, 0), (-4, 20), (2, 33))
    left = (
        part((-4, 20), (-20, 9), (-38, 0), (-50, -12), (-47, -15), (-20, -9), (-6, -8), (-4, 0)),
        part((-50, -12), (-55, -28), (-53, -40), (-46, -48), (-42, -43), (-47, -34), (-47, -15)),
        part((-46, -48), (-37, -53), (-22, -48), (-11, -33), (-9, -10), (-19, -9), (-21, -28), (-34, -42), (-42, -43)),
    )
    right = (
        part((-3, -8), (9, -8), (7, -24), (0, -58), (-7, -58), (-11, -44), (-10, -30)),
        part((-7, -58), (-2, -67), (8, -72), (18, -70), (26, -60), (21, -61), (15, -65), (5, -65), (0, -60)),
        part((18, -8), (22, -4), (28, -17), (32, -35), (30, -50), (26, -60), (22, -59), (20, -22)),
    )
    return (blades, hub, *left, *right)


def _turned(degrees: float) -> tuple[np.ndarray, np.ndarray]:
    """The x and y axes turned about z."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([c, s, 0.0]), np.array([-s, c, 0.0])


_MAKERS: dict[str, Callable[[], tuple[Shape, ...]]] = {
    "003_cracker_box": lambda: (box((-1.2 * MM, -1.6 * MM, -4.7 * MM), (69.5 * MM, 161.0 * MM, 213.5 * MM)),),
    "005_tomato_soup_can": lambda: (cylinder((-0.3 * MM, 2.0 * MM, -8.6 * MM), 33.2 * MM, 101.6 * MM),),
    "006_mustard_bottle": _mustard_bottle,
    "007_tuna_fish_can": lambda: (cylinder((0.1 * MM, -0.2 * MM, -4.4 * MM), 42.2 * MM, 33.7 * MM),),
    "010_potted_meat_can": _meat_can,
    "011_banana": _banana,
    "019_pitcher_base": _pitcher,
    "035_power_drill": _power_drill,
    "037_scissors": _scissors,
}

STAND_INS = tuple(_MAKERS)
"""Official names of the objects that have a stand-in."""
