"""Stand-ins for the nine YCB objects of the paper: a few convex pieces each, described in ``standins.toml``."""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from xreset.errors import ObjectError
from xreset.files.storage import read_toml
from xreset.geometry.shapes import (
    box,
    cylinder,
    hull,
    loft,
    mass_properties,
    prism,
    section,
    surface_of,
)
from xreset.objects.ycb import MASSES
from xreset.spec import ObjectSpec, Shape

_MM = 1e-3
_UP = np.array([0.0, 0.0, 1.0])
_SHAPES = read_toml(Path(__file__).with_name("standins.toml"), error=ObjectError)

STAND_INS = tuple(_SHAPES)
"""Official names of the objects that have a stand-in."""


@cache
def stand_in(name: str) -> ObjectSpec:
    """Make the stand-in of an official name (``KeyError`` if there is none).

    Mass is the published one; center of mass and inertia are those of the pieces at uniform density.
    """
    pieces = []
    for kind, description in _SHAPES[name].items():
        pieces += _MAKERS[kind](description)
    vertices, faces = surface_of(pieces)
    mass = MASSES[name]
    com, inertia = mass_properties(vertices, faces, mass)
    return ObjectSpec(
        name=name,
        pieces=tuple(pieces),
        mass=mass,
        com=com,
        inertia=inertia,
        vertices=vertices,
        faces=faces,
    )


def _box(made: dict[str, Any]) -> list[Shape]:
    return [box(_metres(made["center"]), tuple(_metres(made["size"])))]


def _cylinder(made: dict[str, Any]) -> list[Shape]:
    return [cylinder(_metres(made["center"]), made["radius"] * _MM, made["height"] * _MM)]


def _lofts(made: dict[str, Any]) -> list[Shape]:
    """Hulls of horizontal superellipses around a vertical axis."""
    u, v = _axes(made["turn"])
    center = _metres([*made["center"], 0.0]) + made["forward"] * _MM * v
    shapes = []
    for outline in made["pieces"]:
        rings = []
        for z, a, b, power in outline:
            ring = section(
                center + z * _MM * _UP, a * _MM * u, b * _MM * v, power=power, count=made["corners"]
            )
            rings.append(ring)
        shapes.append(loft(rings))
    return shapes


def _hulls(made: dict[str, Any]) -> list[Shape]:
    """Hulls of points next to a vertical axis."""
    u, v = _axes(made["turn"])
    center = _metres([*made["center"], 0.0])
    shapes = []
    for points in made["pieces"]:
        corners = [
            center + out * _MM * u + z * _MM * _UP + side * _MM * v for out, z, side in points
        ]
        shapes.append(hull(np.array(corners)))
    return shapes


def _ribs(made: dict[str, Any]) -> list[Shape]:
    """Hulls of neighbouring ellipses across a curved line."""
    rings = []
    for x, y, z, width, height, degrees in made["ribs"]:
        _, across = _axes(degrees)
        rings.append(
            section(
                _metres([x, y, z]), width * _MM * across, height * _MM * _UP, count=made["corners"]
            )
        )
    return [loft(pair) for pair in pairwise(rings)]


def _bars(made: dict[str, Any]) -> list[Shape]:
    """Hulls of upright superellipses across the x or the y axis."""
    shapes = []
    for sections in made["pieces"]:
        rings = []
        for axis, place, low, high, depth, power in sections:
            center = np.zeros(3)
            center[axis] = place * _MM
            center[1 - axis] = (low + high) / 2 * _MM
            half = (high - low) / 2 * _MM * np.eye(3)[1 - axis]
            rings.append(
                section(center, half, depth * _MM * _UP, power=power, count=made["corners"])
            )
        shapes.append(loft(rings))
    return shapes


def _prisms(made: list[dict[str, Any]]) -> list[Shape]:
    """Polygons between two heights."""
    return [
        prism(_metres(part["outline"]), part["bottom"] * _MM, part["top"] * _MM) for part in made
    ]


def _metres(lengths: Any) -> np.ndarray:
    return np.array(lengths) * _MM


def _axes(degrees: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the x and y axes turned about z."""
    cos = np.cos(np.radians(degrees))
    sin = np.sin(np.radians(degrees))
    return np.array([cos, sin, 0.0]), np.array([-sin, cos, 0.0])


_MAKERS: dict[str, Any] = {
    "box": _box,
    "cylinder": _cylinder,
    "lofts": _lofts,
    "hulls": _hulls,
    "ribs": _ribs,
    "bars": _bars,
    "prisms": _prisms,
}
