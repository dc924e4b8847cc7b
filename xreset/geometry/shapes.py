"""Convex shapes: how to make them, their meshes, and the mass properties of triangle meshes.

Lengths in metres, coordinates in the object's mesh frame.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull, QhullError

from xreset.errors import ObjectError
from xreset.spec import Geometry, Shape

if TYPE_CHECKING:
    import trimesh
_FEW = 300
"""Points that every engine bears in a hull."""
CYLINDER_SECTIONS = 48
"""Sides of the prism that stands for a cylinder in a surface mesh."""


def box(center: ArrayLike, size: Sequence[float]) -> Shape:
    """An axis-aligned box of edge lengths ``size``."""
    return Shape(
        geometry=Geometry(kind="box", size=tuple(float(s) / 2 for s in size)), T_body_shape=_translation(center)
    )


def cylinder(center: ArrayLike, radius: float, height: float) -> Shape:
    """A cylinder along z."""
    return Shape(
        geometry=Geometry(kind="cylinder", size=(float(radius), float(height) / 2)), T_body_shape=_translation(center)
    )


def hull(points: np.ndarray, tolerance: float = 0.0) -> Shape:
    """The convex hull of points [V, 3].

    Args:
        points: [V, 3]
        tolerance: if there are more than 300 points: the hull of a few of them, no face of which another lies beyond by more than
            this [m]; 0: of all.

    Raises:
        ObjectError: the points span no volume.
    """
    points = np.asarray(points, dtype=float)
    try:
        points = _outermost(points, tolerance) if tolerance > 0 and len(points) > _FEW else points
        convex = ConvexHull(points)
    except (QhullError, ValueError) as error:
        raise ObjectError(
            f"{len(points)} points span no volume, so they have no convex hull: {str(error).splitlines()[0]}"
        ) from error
    index = np.full(len(points), -1)
    index[convex.vertices] = np.arange(len(convex.vertices))
    corners = points[convex.simplices]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = (normals * convex.equations[:, :3]).sum(axis=1) < 0  # qhull's triangles have no consistent winding
    faces = convex.simplices.copy()
    faces[inward] = faces[inward][:, ::-1]
    return Shape(geometry=Geometry(kind="hull", vertices=points[convex.vertices], faces=index[faces].astype(np.int64)))


def _outermost(points: np.ndarray, tolerance: float) -> np.ndarray:
    """Points [n, 3] whose hull lacks less than the tolerance: those farthest beyond the hull of the points so far, face by face."""
    points = points[ConvexHull(points).vertices]
    directions = np.array([d for d in np.ndindex(3, 3, 3) if d != (1, 1, 1)]) - 1.0
    chosen = np.unique((points @ directions.T).argmax(axis=0))
    while True:
        planes = ConvexHull(points[chosen]).equations
        beyond = points @ planes[:, :3].T + planes[:, 3]
        farthest = beyond.argmax(axis=0)
        worst = beyond[farthest, np.arange(len(planes))]
        missing = np.unique(farthest[worst > max(tolerance, worst.max() / 2)])
        if not len(missing):
            return points[chosen]
        chosen = np.union1d(chosen, missing)


def loft(sections: Iterable[np.ndarray]) -> Shape:
    """The convex hull of cross sections, each [n, 3]."""
    return hull(np.concatenate(list(sections)))


def section(
    center: ArrayLike, half_u: ArrayLike, half_v: ArrayLike, *, power: float = 2.0, count: int = 16
) -> np.ndarray:
    """[count, 3] points of a superellipse |u|^power + |v|^power = 1 with half axes ``half_u`` and ``half_v`` (vectors).

    A power of 2 is an ellipse; larger ones approach a rectangle.
    """
    angle = (np.arange(count) + 0.5) * 2 * np.pi / count
    c, s = np.cos(angle), np.sin(angle)
    radius = (np.abs(c) ** power + np.abs(s) ** power) ** (-1 / power)
    center, half_u, half_v = (np.asarray(vector, dtype=float) for vector in (center, half_u, half_v))
    return center + np.outer(radius * c, half_u) + np.outer(radius * s, half_v)


def prism(outline: Sequence[tuple[float, float]], bottom: float, top: float) -> Shape:
    """The convex hull of a polygon in x and y between two heights."""
    xy = np.asarray(outline, dtype=float)
    return loft([np.column_stack([xy, np.full(len(xy), z)]) for z in (bottom, top)])


def shape_mesh(shape: Shape, *, coarse: bool = False) -> trimesh.Trimesh:
    """The closed triangle mesh of a convex shape, in its body's frame.

    Args:
        shape: the shape.
        coarse: round shapes with few triangles: enough for a picture, not for a distance.
    """
    import trimesh

    geometry = shape.geometry
    if geometry.kind == "box":
        mesh = trimesh.creation.box(2 * np.array(geometry.size))
    elif geometry.kind == "sphere":
        mesh = trimesh.creation.icosphere(2 if coarse else 3, geometry.size[0])
    elif geometry.kind == "cylinder":
        mesh = trimesh.creation.cylinder(
            geometry.size[0], 2 * geometry.size[1], sections=24 if coarse else CYLINDER_SECTIONS
        )
    elif geometry.kind == "capsule":
        mesh = trimesh.creation.capsule(
            radius=geometry.size[0], height=2 * geometry.size[1], count=(10, 14) if coarse else (32, 32)
        )
        mesh.apply_translation(
            [0, 0, -mesh.bounds.mean(axis=0)[2]]
        )  # trimesh has had its origin at one end or in the middle
    else:
        mesh = trimesh.Trimesh(geometry.vertices, geometry.faces, process=False)
    mesh.apply_transform(shape.T_body_shape)
    return mesh


def surface_of(pieces: Sequence[Shape]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] and triangles [F, 3] of all pieces together; where pieces overlap, triangles lie inside the solid."""
    import trimesh

    mesh = trimesh.util.concatenate([shape_mesh(piece) for piece in pieces])
    return np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces, dtype=np.int64)


def mass_properties(vertices: np.ndarray, faces: np.ndarray, mass: float) -> tuple[np.ndarray, np.ndarray]:
    """Centre of mass [3] and inertia [3, 3] about it of a closed mesh with uniform density and that mass.

    For a mesh of several closed parts each part counts in full, so a volume where two parts overlap counts twice.
    """
    import trimesh

    solid = trimesh.Trimesh(vertices, faces, process=False).mass_properties
    return np.asarray(solid.center_mass), np.asarray(solid.inertia) * (mass / solid.mass)


def shell_properties(vertices: np.ndarray, faces: np.ndarray, mass: float) -> tuple[np.ndarray, np.ndarray]:
    """Centre of mass [3] and inertia [3, 3] about it of a thin wall along the triangles, of the same thickness everywhere."""
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    weight = mass * area / area.sum()
    com = np.einsum("f,fi->i", weight, corners.mean(axis=1)) / mass
    local = corners - com
    total = local.sum(axis=1)
    second = np.einsum("f,fki,fkj->ij", weight, local, local) + np.einsum("f,fi,fj->ij", weight, total, total)
    second /= 12  # of x x^T over a triangle: (the corners' + that of their sum) / 12
    return com, np.trace(second) * np.eye(3) - second


def _translation(center: ArrayLike) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = center
    return T


def half_spaces(shape: Shape) -> np.ndarray:
    """[P, 4] the planes of a convex shape, (outward unit normal, offset): a point x is inside where normal . x + offset <= 0 for all."""
    vertices = np.asarray(shape_mesh(shape).vertices, dtype=float)
    return np.unique(ConvexHull(vertices).equations.round(9), axis=0)  # coplanar triangles share a plane
