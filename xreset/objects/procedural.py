"""Random everyday shapes, so that a policy learns to grasp shapes and not a few meshes.

Each family is made of convex pieces with random sizes: boxes, cans, cups, eggs, wedges, bottles, hammers and bananas.
Sizes follow what a human hand holds: the narrowest side is at most 9 cm, the longest at most 24 cm. Lengths in meters,
z is up, the origin is the centre of the bounding box.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from xreset.errors import ObjectError, needs
from xreset.files.storage import write_whole
from xreset.geometry.shapes import hull, loft, prism, section, shape_mesh
from xreset.objects.catalogue import canonical_name
from xreset.objects.properties import Properties, refuse_taken
from xreset.objects.standins import stand_in
from xreset.spec import Shape

if TYPE_CHECKING:
    import trimesh

_DENSITY = (150.0, 900.0)
"""Mass per volume [kg/m^3]: from a carton of cereal to a full can."""
_MASS = (0.02, 1.0)
"""Limits of the mass [kg], near the lightest and heaviest objects of the YCB set that a hand lifts."""
_X = np.array([1.0, 0.0, 0.0])
_Y = np.array([0.0, 1.0, 0.0])
_Z = np.array([0.0, 0.0, 1.0])
_CORNERS = 24
"""Points of a cross section."""


def write_shape(folder: Path, number: int, seed: int) -> Path:
    """Write one of the random shapes of a seed, the union of its pieces, and its mass; return the mesh."""
    families = list(_FAMILIES)
    family = families[number % len(families)]
    path = folder / f"{family}_{number:04d}.obj"
    rng = np.random.default_rng([seed, number])
    pieces = _FAMILIES[family](rng)
    mesh = _union(pieces)
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    low, high = np.log(_DENSITY)
    _write(path, mesh, float(np.clip(mesh.volume * np.exp(rng.uniform(low, high)), *_MASS)))
    return path


def write_stand_in(name: str, folder: str | Path) -> Path:
    """Write a built-in object as a mesh, and its mass, into a folder of objects, such as one of random shapes.

    Args:
        name: any of the object's names.
        folder: folder of objects, which is made if there is none.

    Returns:
        the mesh.

    Raises:
        ObjectError: no built-in object has this name, or the folder has one of this name.
    """
    obj = stand_in(canonical_name(name))
    path = Path(folder) / f"{obj.name}.obj"
    refuse_taken(path, _facts(obj.mass))
    _write(path, _union(obj.pieces), obj.mass)
    return path


def _facts(mass: float) -> str:
    return Properties(mass=round(mass, 4)).to_toml()


def _union(pieces: Sequence[Shape]) -> trimesh.Trimesh:
    import trimesh

    with needs("manifold3d", "objects", ObjectError):
        import manifold3d  # noqa: F401
    return trimesh.boolean.union([shape_mesh(piece) for piece in pieces], engine="manifold")


def _write(path: Path, mesh: trimesh.Trimesh, mass: float) -> None:
    from trimesh.exchange.obj import export_obj

    write_whole(path.with_suffix(".toml"), _facts(mass))
    # fewer digits would open seams
    write_whole(path, export_obj(mesh, digits=12))


# Families -------------------------------------------------------------------------------------------------------------


def _rod(
    start: np.ndarray, end: np.ndarray, u: np.ndarray, v: np.ndarray, power: float = 2.0
) -> Shape:
    """Return a straight rod whose cross sections are superellipses with half axes u and v."""
    return loft([section(place, u, v, power=power, count=_CORNERS) for place in (start, end)])


def _ring(z: float, a: float, b: float, power: float = 2.0) -> np.ndarray:
    """Return a horizontal cross section with half axes a and b."""
    return section(z * _Z, a * _X, b * _Y, power=power, count=_CORNERS)


def _box(rng: np.random.Generator) -> list[Shape]:
    """A box with more or less round edges along its longest side, in one of three orientations."""
    narrow = rng.uniform(0.025, 0.085)
    other = rng.uniform(narrow, 0.14)
    length = rng.uniform(0.03, 0.22)
    power = rng.uniform(4.0, 20.0)
    u, v, along = ((_X, _Y, _Z), (_Z, _X, _Y), (_Y, _Z, _X))[rng.integers(3)]
    return [_rod(-0.5 * length * along, 0.5 * length * along, narrow / 2 * u, other / 2 * v, power)]


def _can(rng: np.random.Generator) -> list[Shape]:
    """An elliptic cylinder that stands or lies."""
    a = rng.uniform(0.018, 0.043)
    b = a * rng.uniform(1.0, 1.5)
    length = rng.uniform(0.03, 0.2)
    u, v, along = ((_X, _Y, _Z), (_Y, _Z, _X))[rng.integers(2)]
    return [_rod(-0.5 * length * along, 0.5 * length * along, a * v, b * u)]


def _cup(rng: np.random.Generator) -> list[Shape]:
    """A solid frustum: a cup without its hollow."""
    bottom = rng.uniform(0.02, 0.04)
    top = bottom * rng.uniform(1.05, 1.35)
    height = rng.uniform(0.05, 0.16)
    return [loft([_ring(0.0, bottom, bottom), _ring(height, top, top)])]


def _egg(rng: np.random.Generator) -> list[Shape]:
    """An ellipsoid whose lowest part is cut off, so that it stands."""
    a, b, c = rng.uniform(0.022, 0.045, 3)
    heights = np.linspace(-0.8, 0.98, 9)
    radii = np.sqrt(1.0 - heights * heights)
    return [loft([_ring(z * c, r * a, r * b) for z, r in zip(heights, radii, strict=True)])]


def _wedge(rng: np.random.Generator) -> list[Shape]:
    """A prism over an irregular polygon."""
    corners = rng.integers(3, 8)
    angles = (np.arange(corners) + rng.uniform(-0.2, 0.2, corners)) * 2 * np.pi / corners
    radii = rng.uniform(0.028, 0.05, corners)
    outline = [
        (r * np.cos(angle), 0.8 * r * np.sin(angle)) for r, angle in zip(radii, angles, strict=True)
    ]
    return [prism(outline, 0.0, rng.uniform(0.03, 0.15))]


def _bottle(rng: np.random.Generator) -> list[Shape]:
    """A body, a shoulder and a neck."""
    a = rng.uniform(0.022, 0.04)
    b = a * rng.uniform(1.0, 1.3)
    body = rng.uniform(0.07, 0.14)
    shoulder = rng.uniform(0.015, 0.035)
    neck = rng.uniform(0.01, 0.04)
    share = rng.uniform(0.3, 0.6)
    power = rng.uniform(2.0, 5.0)
    top = body + shoulder
    levels = [
        _ring(0.0, a, b, power),
        _ring(body, a, b, power),
        _ring(top, share * a, share * b),
        _ring(top + neck, share * a, share * b),
    ]
    return [loft(pair) for pair in pairwise(levels)]


def _hammer(rng: np.random.Generator) -> list[Shape]:
    """A lying handle with a block at one end."""
    length = rng.uniform(0.1, 0.2)
    radius = rng.uniform(0.01, 0.02)
    head = rng.uniform((0.02, 0.05, 0.02), (0.04, 0.1, 0.05))
    handle = _rod(0.0 * _X, length * _X, radius * _Y, radius * _Z, 3.0)
    corners = np.array(list(np.ndindex(2, 2, 2))) - 0.5
    middle = np.array([length, 0.0, head[2] / 2 - radius])
    return [handle, hull(corners * head + middle)]


def _banana(rng: np.random.Generator) -> list[Shape]:
    """A lying, bent rod that is thinner at its ends."""
    thickness = rng.uniform(0.014, 0.022)
    bend = rng.uniform(0.06, 0.2)
    angle = rng.uniform(0.08, 0.18) / bend / 2

    def ring(share: float) -> np.ndarray:
        outward = np.array([np.sin(share * angle), np.cos(share * angle), 0.0])
        size = thickness * (1.0 - 0.35 * share * share)
        return section(bend * outward, size * outward, size * _Z, count=12)

    ends = pairwise(np.linspace(-1.0, 1.0, 7))
    # overlapping, so that no seam is open
    return [loft((ring(start - 0.02), ring(end + 0.02))) for start, end in ends]


_FAMILIES = {
    make.__name__.strip("_"): make
    for make in (_box, _can, _cup, _egg, _wedge, _bottle, _hammer, _banana)
}
"""Name -> function that makes a random shape."""
