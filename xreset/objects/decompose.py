"""Cut a mesh into few convex pieces that keep to its surface, small enough for every engine.

The mesh is made a solid. Planes cut it wherever the convex hull of a part deviates too much from the surface, and
pieces whose common hull does not are joined again. Both steps measure the deviation quickly, at few points. The
deviation of the joined pieces is then measured to 0.1 mm, and pieces that deviate too much are cut again. PhysX takes
hulls of at most 64 vertices in its fast path, and contact cost grows with their number.
"""

from __future__ import annotations

import heapq
import itertools
import logging
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import ConvexHull, cKDTree

from xreset.errors import ObjectError, needs
from xreset.files.checks import frozen
from xreset.geometry.shapes import (
    MANY_POINTS,
    half_spaces,
    hull,
    mass_properties,
    mesh_arrays,
    outermost,
    plane_heights,
    shape_mesh,
    triangle_normals,
)
from xreset.objects.sampling import sample_surface
from xreset.spec import Shape

if TYPE_CHECKING:
    import trimesh
    from manifold3d import Manifold

_log = logging.getLogger(__name__)

_CUTS = 7
"""Planes that are tried along each direction, evenly spaced."""
_CROSSES = ((0, 1), (0, 2), (1, 2), (3, 4), (3, 5), (4, 5))
"""Pairs of directions whose middle planes are tried together: halves of a ring are as convex as the ring, quarters are
not."""
_DIAGONALS = np.array([(1, 1, 1), (1, 1, -1), (1, -1, 1), (-1, 1, 1)]) / np.sqrt(3)
WALL = 0.001
"""Thickness of the wall that stands for a sheet [m]."""
_MAX_VERTICES = 64
"""Most vertices of a piece."""
_SPECK = 1e-11
"""Smaller parts are dropped: a cube of 0.2 mm [m^3]."""
_OVERLAP = 1e-6
"""Share of the volume up to which parts of a solid do not overlap."""
_SMALL_HOLE = 0.03
"""Largest share of the mesh's area that a hole may have to be closed; larger ones are openings."""
_FACES = 3000
"""Meshes that are not closed are reduced to about this many triangles before they are made solids."""
_QUICK = 0.85
"""Share of the tolerance that the quick measure may find."""
_LONG = 0.95
"""Share of the effort that is left when the user learns that cutting takes long."""
_FEW = 0.625
"""Share of the allowed number that pieces are joined to; the others are for the pieces that deviate most then."""
_EXACT = 1e-4
"""Accuracy of the deviation [m]."""
_OUTSIDE = 5e-4
"""How far points of a mesh with very many may be outside its hull [m]."""
_NEAREST = 8
"""Triangles of a surface that the distance of a point is computed from."""
_BATCH = 2000
"""Triangles whose distances are computed together."""
_LEAST_EFFORT = 2000
"""Triangles that the measure of a pair of pieces counts for at least: its points take time in any case."""
_TOUCH = 2e-4
"""Pieces whose bounding boxes are closer than this may be joined [m]."""


@frozen
class Settings:
    """Settings of a decomposition; the same on every machine."""

    max_pieces: int = 128
    """If the tolerance asks for more, pieces deviate more."""
    hull_depth: float = 0.05
    """A mesh is one convex piece if no point of its hull is farther from its surface than this fraction of its bounding
    box's diagonal; 0: than the tolerance.

    The volume ratio would be no good measure: the recessed lids of a tuna can cost as much volume as a pitcher's
    handle.
    """
    tolerance: float = 0.002
    """Largest deviation of the pieces from the surface of a mesh that is more than one piece [m]."""
    effort: int = 12_000_000
    """Triangles that cutting may handle in all, about 50 s of one core; the pieces so far are taken then. It is a count
    and not a time, so that the pieces of a mesh, and with them its physics, are the same on every machine."""


@frozen
class Pieces:
    """Convex pieces that stand for a mesh in physics."""

    shapes: tuple[Shape, ...]
    deviation: float
    """Largest distance between their surface and the mesh's, to 0.1 mm [m]."""
    volume: float
    """Volume of the solid [m^3]."""
    com: np.ndarray
    """[3] center of mass of the solid."""
    inertia: np.ndarray
    """[3, 3] about it, of 1 kg of uniform density [m^2]."""
    finished: bool = True
    """Whether cutting ended before :attr:`Settings.effort` was spent."""


def decompose(mesh: trimesh.Trimesh, settings: Settings = Settings()) -> Pieces:
    """Return convex pieces that together have the mesh's shape.

    Args:
        mesh: closed or not (:func:`as_solid`); its metadata may have the object's ``name``, for a message.

    Raises:
        ObjectError: the mesh is concave and manifold3d, which cuts it, is not installed; or the mesh encloses nothing,
            or specks only.
        QhullError: the mesh spans no volume.
    """
    surface = _Surface(*mesh_arrays(mesh))
    points = mesh.vertices
    if len(points) > MANY_POINTS:
        points = outermost(np.asarray(points), _OUTSIDE)
        around = shape_mesh(hull(points))
    else:
        around = mesh.convex_hull
    finished = True
    depth = float(settings.hull_depth * np.linalg.norm(mesh.extents)) or settings.tolerance
    if surface.deviation(around.vertices, around.faces, limit=depth) <= depth:
        shapes = [limited_hull(points)]
        piece = shape_mesh(shapes[0])
        deviation = surface.deviation(piece.vertices, piece.faces)
        if mesh.is_volume and mesh.body_count > 1:
            volume, com, inertia = _mass_of(as_solid(mesh))
        else:
            solid = mesh if mesh.is_volume else around
            volume = solid.volume
            com, inertia = mass_properties(*mesh_arrays(solid), 1.0)
    else:
        whole = as_solid(mesh)
        cutter = _Cutter(whole, settings, mesh.metadata.get("name", "the mesh"))
        shapes, deviation = cutter.shapes()
        finished = cutter.effort > 0
        surface = cutter.surface
        volume, com, inertia = _mass_of(whole)
    return Pieces(
        shapes=tuple(shapes),
        deviation=max(deviation, surface.uncovered(shapes)),
        volume=float(volume),
        com=com,
        inertia=inertia,
        finished=finished,
    )


def openings(mesh: trimesh.Trimesh) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the vertices [n] and the edges [n, 2] around each hole of a mesh."""
    import trimesh

    edges = mesh.edges[trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)]
    loops = trimesh.graph.connected_components(edges, min_len=3)
    return [(np.asarray(loop), edges[np.isin(edges[:, 0], loop)]) for loop in loops]


# Solids ---------------------------------------------------------------------------------------------------------------


def as_solid(mesh: trimesh.Trimesh) -> Manifold:
    """Return the mesh as a solid that can be cut.

    Small holes of an open mesh are capped. If that does not make it a volume, each triangle becomes a plate as thick as
    ``WALL``, its sides along the normals of its corners, and the space that the plates enclose is filled: a sheet
    becomes a wall, a scan with cracks a solid, half the thickness larger.

    Raises:
        ObjectError: the mesh encloses nothing.
    """
    import trimesh

    m3 = _manifold3d()
    if not mesh.is_volume:
        mesh = _capped(_thinned(mesh))
    if mesh.is_volume:
        vertices = np.ascontiguousarray(mesh.vertices, dtype=np.float64)
        faces = np.ascontiguousarray(mesh.faces, dtype=np.uint64)
        solid = m3.Manifold(m3.Mesh64(vertices, faces))
        if solid.status() == m3.Error.NoError and solid.volume() > 0:
            return solid
    mesh = mesh.copy()
    trimesh.repair.fix_winding(mesh)
    corners = mesh.vertices[mesh.faces]
    corner_sides = WALL / 2 * mesh.vertex_normals[mesh.faces]
    face_sides = WALL / 2 * mesh.face_normals[:, None]
    plates = np.concatenate(
        (
            corners + corner_sides,
            corners - corner_sides,
            corners + face_sides,
            corners - face_sides,
        ),
        axis=1,
    )
    union = m3.Manifold.batch_boolean(
        [m3.Manifold.hull_points(points) for points in plates], m3.OpType.Add
    )
    # surfaces of cavities have negative volume
    outer = [part for part in union.decompose() if part.volume() > 0]
    if not outer:
        raise ObjectError(
            "The mesh encloses no solid, even with its holes closed. Repair it, for example in MeshLab."
        )
    return m3.Manifold.batch_boolean(outer, m3.OpType.Add)


def mass_of_shapes(shapes: Sequence[Shape]) -> tuple[float, np.ndarray, np.ndarray]:
    """Return volume, center of mass and inertia of convex shapes of one body; see :func:`_mass_of`. Only several shapes
    need manifold3d."""
    if len(shapes) == 1:
        mesh = shape_mesh(shapes[0])
        return float(mesh.volume), *mass_properties(*mesh_arrays(mesh), 1.0)
    solid = _manifold3d().Manifold
    hulls = [solid.hull_points(shape_mesh(shape).vertices) for shape in shapes]
    return _mass_of(solid.compose(hulls))


def _mass_of(solid: Manifold) -> tuple[float, np.ndarray, np.ndarray]:
    """Return volume [m^3], center of mass [3] and the inertia [3, 3] of 1 kg about it. Where parts overlap, the volume
    counts once."""
    merged = _merged(solid)
    return merged.volume(), *mass_properties(*_arrays(merged), 1.0)


def _merged(solid: Manifold) -> Manifold:
    """Make overlapping parts of a solid one: where two overlap, the volume would count twice. A solid without such
    parts is returned as it is."""
    m3 = _manifold3d()
    parts = solid.decompose()
    bodies = [part for part in parts if part.volume() > 0]
    cavities = [part for part in parts if part.volume() <= 0]  # their surfaces face inwards
    merged = m3.Manifold.batch_boolean(bodies, m3.OpType.Add)
    if merged.volume() > (1 - _OVERLAP) * sum(body.volume() for body in bodies):
        return solid
    if not cavities:
        return merged
    for cavity in cavities:
        vertices, faces = _arrays(cavity)
        turned = np.array(faces[:, ::-1], dtype=np.uint64, order="C")
        inner = m3.Manifold(m3.Mesh64(np.array(vertices, order="C"), turned))
        hosts = [i for i, body in enumerate(bodies) if (inner - body).volume() < _SPECK]
        if hosts:
            bodies[min(hosts, key=lambda i: bodies[i].volume())] -= inner
    return m3.Manifold.batch_boolean(bodies, m3.OpType.Add)


def _thinned(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Reduce a mesh to at most about ``_FACES`` triangles by rounding its vertices to a grid."""
    import trimesh

    if len(mesh.faces) <= _FACES:
        return mesh
    cell = np.sqrt(2 * mesh.area / _FACES)
    mesh = trimesh.Trimesh(np.round(mesh.vertices / cell) * cell, mesh.faces)
    mesh.update_faces(mesh.nondegenerate_faces() & mesh.unique_faces())
    return mesh


def _capped(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Close the small holes of a mesh by triangles to their centers."""
    import trimesh

    centers = []
    faces = [np.asarray(mesh.faces)]
    for loop, edges in openings(mesh):
        center = mesh.vertices[loop].mean(axis=0)
        a, b = edges.T
        normals = np.cross(mesh.vertices[a] - center, mesh.vertices[b] - center)
        if np.linalg.norm(normals, axis=1).sum() / 2 <= _SMALL_HOLE * mesh.area:
            tip = len(mesh.vertices) + len(centers)
            faces.append(np.column_stack((b, a, np.full(len(a), tip))))
            centers.append(center)
    vertices = np.concatenate((mesh.vertices, np.reshape(centers, (-1, 3))))
    return trimesh.Trimesh(vertices, np.concatenate(faces), process=False)


class _Surface:
    """A surface, with many points on it."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        self.vertices = vertices
        self.faces = faces
        points, face, _ = sample_surface(vertices, faces, 60_000)
        face_of_vertex = np.zeros(len(vertices), dtype=np.int64)
        face_of_vertex[faces] = np.arange(len(faces))[:, None]  # any one of its triangles
        self._points = np.concatenate((vertices, points))
        self._face = np.concatenate((face_of_vertex, face))
        self._tree = cKDTree(self._points)

    def quick_deviation(self, vertices: np.ndarray, faces: np.ndarray) -> float:
        """Return the largest distance from a few points of another surface to the nearest of many of this one [m]."""
        points, _, _ = sample_surface(vertices, faces, 400)
        return float(self._tree.query(np.concatenate((vertices, points)))[0].max())

    def deviation(
        self, vertices: np.ndarray, faces: np.ndarray, *, limit: float | None = None
    ) -> float:
        """Return the largest distance of a point of another surface to this one, to ``_EXACT`` [m].

        The distance to a triangle is convex: over another triangle, it is greatest at a corner. So no point of that
        triangle is farther from this surface than its corners are from the nearest triangle; it is quartered while that
        exceeds what its middles have shown.

        Args:
            vertices: [V, 3]
            faces: [F, 3]
            limit: the search ends as soon as the deviation is known to exceed this or not to exceed it [m]. The
                returned number is then on the same side of the limit as the deviation.
        """
        farthest = 0.0
        pool = vertices[faces]
        middle = pool.mean(axis=1)
        radius = np.linalg.norm(pool - middle[:, None], axis=2).max(axis=1)
        bound = np.asarray(self._tree.query(middle)[0]) + radius
        while bound.size and bound.max() > farthest + _EXACT:
            if limit is not None and (farthest > limit or bound.max() <= limit):
                break
            first, rest = np.split(np.argsort(-bound, kind="stable"), [_BATCH])
            corners = pool[first]
            middle, *ends = self._distances(corners)
            farthest = max(farthest, float(middle.min(axis=1).max()))
            least = np.max(ends, axis=0).min(axis=1)
            unsure = least > farthest + _EXACT
            a, b, c = corners[unsure].swapaxes(0, 1)
            ab = (a + b) / 2
            bc = (b + c) / 2
            ca = (c + a) / 2
            quarters = [
                np.stack(quarter, axis=1)
                for quarter in ((ab, bc, ca), (a, ab, ca), (b, bc, ab), (c, ca, bc))
            ]
            pool = np.concatenate((pool[rest], *quarters))
            bound = np.concatenate((bound[rest], np.tile(least[unsure], 4)))
        return farthest

    def _distances(self, corners: np.ndarray) -> np.ndarray:
        """[4, n, k] distances of triangles' [n, 3, 3] middles and corners to the k triangles here that are nearest to
        the middles [m]."""
        from trimesh.triangles import closest_point

        middle = corners.mean(axis=1)
        near = self.vertices[self.faces[self._face[self._tree.query(middle, _NEAREST)[1]]]]
        points = np.stack((middle, *corners.transpose(1, 0, 2)))[:, :, None].repeat(
            _NEAREST, axis=2
        )
        near = np.broadcast_to(near, (4, *near.shape)).reshape(-1, 3, 3)
        # in millimetres, for which closest_point has its tolerance
        closest = closest_point(1e3 * near, 1e3 * points.reshape(-1, 3)) / 1e3
        return np.linalg.norm(points - closest.reshape(points.shape), axis=3)

    def uncovered(self, shapes: Sequence[Shape]) -> float:
        """Return the largest distance of a point of this surface from all pieces [m]: exact near a face of a piece, too
        small near an edge."""
        planes = [half_spaces(shape) for shape in shapes]
        distances = [plane_heights(self._points, own).max(axis=1) for own in planes]
        return float(np.min(distances, axis=0).max().clip(0.0))


class _Solid(_Surface):
    """A solid and its surface."""

    def __init__(self, solid: Manifold) -> None:
        super().__init__(*_arrays(solid))
        self.solid = solid

    def excess(self, piece: Manifold, *, quick: bool, limit: float | None = None) -> float:
        """Return how far a piece reaches out of the solid [m]; see :meth:`deviation` for the limit."""
        outside = piece - self.solid
        if outside.volume() < _SPECK / 100:
            return 0.0
        if quick:
            return self.quick_deviation(*_arrays(outside))
        return self.deviation(*_arrays(outside), limit=limit)


# Cutting and joining --------------------------------------------------------------------------------------------------


class _Cutter:
    """One decomposition of a solid. Pieces are cut from a copy with fewer triangles; in the end they are measured
    against the whole solid."""

    def __init__(self, whole: Manifold, settings: Settings, name: str) -> None:
        """Prepare a solid; ``ObjectError`` if it consists of specks."""
        self.surface = _Solid(whole)
        self.effort = settings.effort
        """Triangles that may still be handled."""
        simple = whole.simplify(_QUICK * settings.tolerance / 10)
        self._parts = [part for part in simple.decompose() if part.volume() > _SPECK]
        if not self._parts:
            raise ObjectError(
                "Every part of the mesh is smaller than a cube of 0.2 mm. Scale it up."
            )
        self._solid = _Solid(simple)
        self._settings = settings
        self._name = name

    def shapes(self) -> tuple[list[Shape], float]:
        """Return the pieces and their largest deviation [m]."""
        most = self._settings.max_pieces
        tolerance = _QUICK * self._settings.tolerance
        cut = self._cut_worst(
            self._parts, self._quick_excess, self._best_cut, tolerance, int(2 * _FEW * most)
        )
        pieces = convex_hulls(part for *_, part in cut)
        tolerance = max(tolerance, *(-excess for excess, *_ in cut))
        pieces = self._joined(pieces, tolerance)
        while len(pieces) > _FEW * most and self.effort > 0:
            tolerance *= 1.1
            pieces = self._joined(pieces, tolerance)
        cut = self._cut_worst(pieces, self._excess, self._cut_piece, self._settings.tolerance, most)
        cut.sort(key=lambda entry: entry[1])
        return [_shape(piece) for *_, piece in cut], max(-excess for excess, *_ in cut)

    def _spend(self, *solids: Manifold) -> None:
        before = self.effort
        self.effort -= sum(solid.num_tri() for solid in solids)
        if self.effort < _LONG * self._settings.effort <= before:
            _log.warning("%s is cut into convex pieces, which takes up to a minute", self._name)

    def _cut_worst(
        self,
        parts: Sequence[Manifold],
        excess: Callable[[Manifold], float],
        cut: Callable[[Manifold], list[Manifold]],
        tolerance: float,
        most: int,
    ) -> list[tuple[float, int, Manifold]]:
        """Cut the part with the largest excess until none exceeds the tolerance, or there would be too many.

        Returns:
            The negative excess that is left [m], a running number, and the part, of all parts.
        """
        count = itertools.count()
        queue: list[tuple[float, int, Manifold]] = []
        whole: list[tuple[float, int, Manifold]] = []

        def add(part: Manifold) -> None:
            entry = (-excess(part), next(count), part)
            if -entry[0] > tolerance:
                heapq.heappush(queue, entry)
            else:
                whole.append(entry)

        for part in parts:
            add(part)
        while queue and len(queue) + len(whole) < most and self.effort > 0:
            worst = heapq.heappop(queue)
            smaller = cut(worst[2])
            if 1 < len(smaller) <= most - len(queue) - len(whole):
                for part in smaller:
                    add(part)
            else:
                whole.append(worst)
        return whole + queue

    def _quick_excess(self, part: Manifold) -> float:
        self._spend(self._solid.solid, part)
        return self._solid.excess(part.hull(), quick=True)

    def _excess(self, piece: Manifold) -> float:
        self._spend(self.surface.solid)
        limited = _manifold3d().Manifold.hull_points(_shape(piece).geometry.vertices)
        return self.surface.excess(limited, quick=False)

    def _cut_piece(self, piece: Manifold) -> list[Manifold]:
        return convex_hulls(self._best_cut(piece ^ self._solid.solid))

    def _best_cut(self, part: Manifold) -> list[Manifold]:
        """Cut a part by the planes that remove most of the hulls' volume for each further part.

        Returns:
            The smaller parts; the part alone if no plane cuts it.
        """
        best = [part]
        best_gain = -np.inf
        whole = part.hull().volume()
        for planes in _planes(*_arrays(part)):
            parts = [part]
            self._spend(part)
            for normal, offset in planes:
                halves = [one.split_by_plane(tuple(normal), float(offset)) for one in parts]
                parts = list(itertools.chain.from_iterable(halves))
            connected = itertools.chain.from_iterable(half.decompose() for half in parts)
            parts = [one for one in connected if one.volume() > _SPECK]
            if len(parts) > 1:
                gain = (whole - sum(one.hull().volume() for one in parts)) / (len(parts) - 1)
                if gain > best_gain:
                    best = parts
                    best_gain = gain
        return best

    def _joined(self, hulls: Sequence[Manifold], tolerance: float) -> list[Manifold]:
        """Join two pieces wherever their common hull keeps to the surface. Pairs whose hull adds the least volume come
        first.

        Args:
            hulls: convex pieces.
            tolerance: largest deviation by the quick measure [m].
        """
        batch_hull = _manifold3d().Manifold.batch_hull
        alive: dict[int, Manifold] = {}
        boxes: dict[int, np.ndarray] = {}
        queue: list[tuple[float, int, int, Manifold]] = []

        def add(number: int, piece: Manifold) -> None:
            low, high = np.array(piece.bounding_box()).reshape(2, 3)
            for other, neighbour in alive.items():
                other_low, other_high = boxes[other]
                near = ((low <= other_high + _TOUCH) & (other_low <= high + _TOUCH)).all()
                if near and self.effort > 0:
                    self.effort -= max(self._solid.solid.num_tri(), _LEAST_EFFORT)
                    both = batch_hull([piece, neighbour])
                    if self._solid.excess(both, quick=True) <= tolerance:
                        added = both.volume() - piece.volume() - neighbour.volume()
                        heapq.heappush(queue, (added, other, number, both))
            boxes[number] = np.stack((low, high))
            alive[number] = piece

        for number, piece in enumerate(hulls):
            add(number, piece)
        number = len(hulls)
        limit = tolerance / _QUICK
        while queue:
            _, one, other, both = heapq.heappop(queue)
            if (
                one in alive
                and other in alive
                and self._solid.excess(both, quick=False, limit=limit) <= limit
            ):
                del alive[one], alive[other]
                add(number, both)
                number += 1
        return list(alive.values())


def _planes(vertices: np.ndarray, faces: np.ndarray) -> list[list[tuple[np.ndarray, float]]]:
    """Return the sets of planes (normal, offset) that are tried on a part: across its principal axes and x, y, z, then
    some in pairs."""
    corners = vertices[faces]
    area = np.linalg.norm(triangle_normals(corners), axis=1)
    if not area.sum():
        return []
    middle = corners.mean(axis=1)
    spread = middle - np.average(middle, axis=0, weights=area)
    directions = np.vstack((np.linalg.eigh((spread * area[:, None]).T @ spread)[1].T, np.eye(3)))
    along = vertices @ directions.T
    low = along.min(axis=0)
    high = along.max(axis=0)
    offsets = low + (high - low) * np.arange(1, _CUTS + 1)[:, None] / (_CUTS + 1)
    sets = []
    for direction, places in zip(directions, offsets.T, strict=True):
        sets += [[(direction, place)] for place in places]
    for pair in _CROSSES:
        sets.append([(directions[i], offsets[_CUTS // 2, i]) for i in pair])
    return sets


def convex_hulls(parts: Iterable[Manifold]) -> list[Manifold]:
    """Return the convex hulls of parts. The hull of a sliver can be flat; such hulls are left out."""
    hulls = [part.hull() for part in parts]
    return [one for one in hulls if one.volume() > _SPECK]


def _arrays(solid: Manifold) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices [V, 3] and triangles [F, 3]."""
    mesh = solid.to_mesh64()
    return np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts).astype(np.int64)


def _manifold3d() -> Any:
    with needs("manifold3d, which cuts and joins meshes,", "objects", ObjectError):
        import manifold3d
    return manifold3d


# Hulls ----------------------------------------------------------------------------------------------------------------


def _shape(piece: Manifold) -> Shape:
    return limited_hull(_arrays(piece)[0])


def limited_hull(points: np.ndarray) -> Shape:
    """Return the convex hull of points [V, 3]; if it has more than 64 vertices, the hull of those that matter most.

    Vertices are chosen one after another, each the one farthest outside the hull of those before.
    """
    full = hull(points)
    vertices = np.asarray(full.geometry.vertices)
    if len(vertices) <= _MAX_VERTICES:
        return full
    along = vertices @ np.vstack((np.eye(3), _DIAGONALS)).T
    chosen = np.unique((along.argmin(axis=0), along.argmax(axis=0))).tolist()
    while len(chosen) < _MAX_VERTICES:
        # joggled: the first few may be coplanar
        planes = ConvexHull(vertices[chosen], qhull_options="QJ").equations
        outside = plane_heights(vertices, planes).max(axis=1)
        outside[chosen] = -np.inf
        chosen.append(outside.argmax())
    return hull(vertices[chosen])
