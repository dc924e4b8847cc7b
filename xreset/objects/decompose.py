"""A mesh as few convex pieces that keep to its surface, small enough for every engine.

The mesh is made a solid, cut by planes wherever the convex hull of a part stands too far off the surface, and pieces whose common hull
does not are joined again. Both go by a quick look at few points; of what is joined then, the deviation is known to 0.1 mm, and pieces that
stand off too far are cut again. PhysX takes hulls of at most 64 vertices in its fast path, and contact cost grows with their number.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import ConvexHull, cKDTree

from xreset.errors import ObjectError, needs
from xreset.geometry.shapes import half_spaces, hull, mass_properties, shape_mesh
from xreset.spec import Shape

if TYPE_CHECKING:
    import trimesh
    from manifold3d import Manifold

_CUTS = 7
"""Planes that are tried along each direction, evenly spaced."""
_CROSSES = ((0, 1), (0, 2), (1, 2), (3, 4), (3, 5), (4, 5))
"""Pairs of directions whose middle planes are tried together: halves of a ring are as convex as the ring, quarters are not."""
_DIAGONALS = np.array([(1, 1, 1), (1, 1, -1), (1, -1, 1), (-1, 1, 1)]) / np.sqrt(3)
_SPECK = 1e-11
"""[m^3] Parts smaller than a cube of 0.2 mm are dropped."""
_SMALL_HOLE = 0.03
"""Holes of at most so much of the mesh's area are closed; larger ones are openings."""
_FACES = 3000
"""Meshes that are not closed are thinned out to about so many triangles before they are made solids."""
_QUICK = 0.85
"""Share of the tolerance that a quick look at few points may find."""
_FEW = 0.625
"""Share of the allowed number that pieces are joined to; the others are for those that stand off farthest then."""
_EXACT = 1e-4
"""[m] To which the deviation is known."""
_NEAREST = 8
"""Triangles of a surface that a point's distance to it is taken from."""
_BATCH = 2000
"""Triangles whose distance is taken together."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How a mesh is decomposed; the same on every machine."""

    max_pieces: int = 128
    """If the tolerance asks for more, pieces stand farther off."""
    max_vertices: int = 64
    """Of each piece."""
    hull_depth: float = 0.05
    """A mesh is one convex piece if no point of its hull is farther from its surface than this fraction of its bounding box's diagonal.

    The volume ratio would be no good measure: the recessed lids of a tuna can cost as much volume as a pitcher's handle.
    """
    tolerance: float = 0.002
    """[m] How far pieces may stand off the surface of a mesh that is more than one."""
    thickness: float = 0.001
    """[m] Of the sheet that stands for a mesh that is not closed."""
    effort: int = 12_000_000
    """Triangles that cutting may handle in all, about 50 s of one core; after that, the pieces so far are taken. A count and no clock: the
    pieces of a mesh, and with them its physics, are the same on every machine."""


@dataclass(frozen=True, kw_only=True)
class Pieces:
    """What stands for a mesh in physics."""

    shapes: tuple[Shape, ...]
    deviation: float
    """[m] Largest distance between their surface and the mesh's, to 0.1 mm."""
    volume: float
    """[m^3] Of the solid."""
    com: np.ndarray
    """[3] its centre of mass."""
    inertia: np.ndarray
    """[3, 3] about that, of 1 kg of uniform density [m^2]."""
    cached: bool = False
    finished: bool = True
    """Whether the effort sufficed."""


@dataclass
class _Effort:
    """What is left of :attr:`Settings.effort`."""

    left: int

    def spend(self, *solids: Manifold) -> None:
        """Handle these solids once."""
        self.left -= sum(solid.num_tri() for solid in solids)


Progress = Callable[[int, float], None]
"""Called with the number of parts so far and how far the worst stands off the surface [m]."""


def decompose(
    mesh: trimesh.Trimesh, settings: Settings = Settings(), progress: Progress = lambda parts, worst: None
) -> Pieces:
    """Convex pieces that together have the mesh's shape.

    Args:
        mesh: closed or not (:func:`as_solid`).

    Raises:
        ObjectError: the mesh is concave and manifold3d, which cuts it, is not installed.
    """
    effort = _Effort(settings.effort)
    surface = _Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    around = mesh.convex_hull
    if surface.deviation(around.vertices, around.faces) <= settings.hull_depth * np.linalg.norm(mesh.extents):
        solid, shapes = mesh if mesh.is_volume else around, (limited_hull(mesh.vertices, settings.max_vertices),)
        vertices, faces, piece = np.asarray(solid.vertices), np.asarray(solid.faces), shape_mesh(shapes[0])
        off = surface.deviation(piece.vertices, piece.faces)
    else:
        whole = as_solid(mesh, settings.thickness)
        solid, surface = _Solid(whole.simplify(_QUICK * settings.tolerance / 10)), _Solid(whole)
        shapes, off = _cut_again(solid, surface, _convex(solid, settings, effort, progress), settings, effort, progress)
        vertices, faces = surface.vertices, surface.faces
    com, inertia = mass_properties(vertices, faces, 1.0)
    corners = vertices[faces]
    volume = float(np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6)
    return Pieces(
        shapes=shapes, deviation=max(off, surface.bare(shapes)), volume=volume, com=com, inertia=inertia,
        finished=effort.left > 0,
    )  # fmt: skip


# Solids ----------------------------------------------------------------------------------------------------------------------------------


def as_solid(mesh: trimesh.Trimesh, thickness: float = Settings.thickness) -> Manifold:
    """The mesh as a solid that can be cut.

    If it is not closed, its small holes are capped. If that does not make it a volume, each triangle becomes a plate of that thickness
    [m], its sides along the normals of its corners, and what the plates enclose is filled: a sheet becomes a wall, a scan with cracks a
    solid, half the thickness larger.

    Raises:
        ObjectError: it encloses nothing.
    """
    import trimesh

    m3 = _manifold3d()
    if not mesh.is_volume:
        mesh = _capped(_thinned(mesh))
    if mesh.is_volume:
        arrays = (
            np.ascontiguousarray(mesh.vertices, dtype=np.float64),
            np.ascontiguousarray(mesh.faces, dtype=np.uint64),
        )
        solid = m3.Manifold(m3.Mesh64(*arrays))
        if solid.status() == m3.Error.NoError and solid.volume() > 0:
            return solid
    mesh = mesh.copy()
    trimesh.repair.fix_winding(mesh)
    corners, half = mesh.vertices[mesh.faces], thickness / 2
    sides = [half * normals for normals in (mesh.vertex_normals[mesh.faces], mesh.face_normals[:, None])]
    ends = np.concatenate([corners + sign * side for side in sides for sign in (1, -1)], axis=1)
    union = m3.Manifold.batch_boolean([m3.Manifold.hull_points(points) for points in ends], m3.OpType.Add)
    outer = [part for part in union.decompose() if part.volume() > 0]  # surfaces of cavities have negative volume
    if not outer:
        raise ObjectError(
            "the mesh encloses no solid, however its holes are closed; repair it, for example in MeshLab or Blender."
        )
    return m3.Manifold.batch_boolean(outer, m3.OpType.Add)


def _thinned(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh with at most about ``_FACES`` triangles, by rounding its vertices to a grid."""
    import trimesh

    if len(mesh.faces) <= _FACES:
        return mesh
    cell = np.sqrt(2 * mesh.area / _FACES)
    mesh = trimesh.Trimesh(np.round(mesh.vertices / cell) * cell, mesh.faces)
    mesh.update_faces(mesh.nondegenerate_faces() & mesh.unique_faces())
    return mesh


def _capped(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh with its small holes closed by triangles to their centres."""
    import trimesh

    edges = mesh.edges[trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)]
    vertices, faces = [np.asarray(mesh.vertices)], [np.asarray(mesh.faces)]
    for loop in trimesh.graph.connected_components(edges, min_len=3):
        center = mesh.vertices[loop].mean(axis=0)
        a, b = edges[np.isin(edges[:, 0], loop)].T
        area = np.linalg.norm(np.cross(mesh.vertices[a] - center, mesh.vertices[b] - center), axis=1).sum() / 2
        if area <= _SMALL_HOLE * mesh.area:
            faces.append(np.column_stack((b, a, np.full(len(a), sum(map(len, vertices))))))
            vertices.append(center[None])
    return trimesh.Trimesh(np.concatenate(vertices), np.concatenate(faces), process=False)


class _Surface:
    """Points of a surface, close together."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        self.vertices, self.faces = vertices, faces
        points, of = _samples(vertices, faces, 60_000)
        some = np.zeros(len(vertices), dtype=np.int64)
        some[faces] = np.arange(len(faces))[:, None]  # a triangle of each vertex
        self._points, self._of = np.concatenate((vertices, points)), np.concatenate((some, of))
        self._tree = cKDTree(self._points)

    def farthest(self, vertices: np.ndarray, faces: np.ndarray) -> float:
        """[m] From the farthest of a few points of another surface to the nearest of many of this one."""
        return float(self._tree.query(np.concatenate((vertices, _samples(vertices, faces, 400)[0])))[0].max())

    def deviation(self, vertices: np.ndarray, faces: np.ndarray) -> float:
        """[m] From the farthest point of another surface to this one, to ``_EXACT``.

        The distance to a triangle is convex: over another triangle, it is greatest at a corner. So no point of that one is farther from
        this surface than its corners are from the nearest triangle; it is quartered while that exceeds what its middles have shown.
        """
        farthest, pool, middle = 0.0, vertices[faces], vertices[faces].mean(axis=1)
        bound = self._tree.query(middle)[0] + np.linalg.norm(pool - middle[:, None], axis=2).max(axis=1)
        while bound.size and bound.max() > farthest + _EXACT:
            first, rest = np.split(np.argsort(-bound, kind="stable"), [_BATCH])
            corners = pool[first]
            middle, *ends = self._away(corners)
            farthest = max(farthest, float(middle.min(axis=1).max()))
            least = np.max(ends, axis=0).min(axis=1)
            unsure = least > farthest + _EXACT
            split = corners[unsure]
            between = (split + split[:, [1, 2, 0]]) / 2
            quarters = [between, *(np.stack((split[:, i], between[:, i], between[:, i - 1]), axis=1) for i in range(3))]
            pool = np.concatenate((pool[rest], *quarters))
            bound = np.concatenate((bound[rest], np.tile(least[unsure], 4)))
        return farthest

    def _away(self, corners: np.ndarray) -> np.ndarray:
        """[4, n, k] Distances of triangles' [n, 3, 3] middles and corners to the k triangles here that are next to the middles [m]."""
        from trimesh.triangles import closest_point

        middle = corners.mean(axis=1)
        near = self.vertices[self.faces[self._of[self._tree.query(middle, _NEAREST)[1]]]]
        points = np.stack((middle, *corners.transpose(1, 0, 2)))[:, :, None].repeat(_NEAREST, axis=2)
        near = np.broadcast_to(near, (4, *near.shape)).reshape(-1, 3, 3)
        closest = (
            closest_point(1e3 * near, 1e3 * points.reshape(-1, 3)) / 1e3
        )  # its own tolerance is for triangles of millimetres
        return np.linalg.norm(points - closest.reshape(points.shape), axis=3)

    def bare(self, shapes: Sequence[Shape]) -> float:
        """[m] How far its worst point is outside of all pieces: exact next to a face, too little next to an edge."""
        distance = np.full(len(self._points), np.inf)
        for planes in map(half_spaces, shapes):
            np.minimum(distance, (self._points @ planes[:, :3].T + planes[:, 3]).max(axis=1), out=distance)
        return float(distance.max().clip(0.0))


class _Solid(_Surface):
    """A solid, and how far a convex piece stands off its surface."""

    def __init__(self, solid: Manifold) -> None:
        super().__init__(*_arrays(solid))
        self.solid = solid

    def excess(self, piece: Manifold, measure: Callable[[np.ndarray, np.ndarray], float]) -> float:
        """[m] How far the farthest point of a piece outside the solid is from its surface, by :meth:`farthest` or :meth:`deviation`."""
        outside = piece - self.solid
        return 0.0 if outside.volume() < _SPECK / 100 else measure(*_arrays(outside))


def _convex(solid: _Solid, settings: Settings, effort: _Effort, progress: Progress) -> list[Manifold]:
    """Convex pieces of a solid, few of them."""
    pieces = [part.hull() for part in _cut(solid, settings, effort, progress)]
    tolerance = max(_QUICK * settings.tolerance, *(solid.excess(piece, solid.farthest) for piece in pieces))
    pieces = _joined(solid, pieces, tolerance, effort)
    while len(pieces) > _FEW * settings.max_pieces and effort.left > 0:
        tolerance *= 1.1
        progress(len(pieces), tolerance)
        pieces = _joined(solid, pieces, tolerance, effort)
    return pieces


def _cut(solid: _Solid, settings: Settings, effort: _Effort, progress: Progress) -> list[Manifold]:
    """Parts of a solid whose hulls keep to its surface: the worst one is cut first."""
    queue: list[tuple[float, int, Manifold]] = []
    done: list[Manifold] = []
    count = itertools.count()

    def add(part: Manifold) -> None:
        effort.spend(solid.solid, part)
        excess = solid.excess(part.hull(), solid.farthest)
        if excess <= _QUICK * settings.tolerance:
            done.append(part)
        else:
            heapq.heappush(queue, (-excess, next(count), part))

    for part in solid.solid.decompose():
        add(part)
    while queue and len(queue) + len(done) < 2 * _FEW * settings.max_pieces and effort.left > 0:
        excess, _, worst = heapq.heappop(queue)
        progress(len(queue) + len(done) + 1, -excess)
        parts = _best_cut(worst, effort)
        if len(parts) < 2:
            done.append(worst)
            continue
        for part in parts:
            add(part)
    return done + [part for _, _, part in queue]


def _cut_again(
    solid: _Solid, surface: _Solid, pieces: Sequence[Manifold], settings: Settings, effort: _Effort, progress: Progress
) -> tuple[tuple[Shape, ...], float]:
    """The pieces as shapes, those cut again that stand too far off a surface, the worst first; and how far the worst does then [m].

    Args:
        solid: what they are pieces of: the surface's solid with fewer triangles.
    """
    hull_points = _manifold3d().Manifold.hull_points
    queue: list[tuple[float, int, Manifold, Shape]] = []
    done: list[tuple[float, int, Manifold, Shape]] = []
    count = itertools.count()

    def add(piece: Manifold) -> None:
        effort.spend(surface.solid)
        shape = limited_hull(_arrays(piece)[0], settings.max_vertices)
        heapq.heappush(
            queue, (-surface.excess(hull_points(shape.geometry.vertices), surface.deviation), next(count), piece, shape)
        )

    for piece in pieces:
        add(piece)
    while queue and -queue[0][0] > settings.tolerance and effort.left > 0:
        worst = heapq.heappop(queue)
        there = len(queue) + len(done)
        progress(there + 1, -worst[0])
        parts = _best_cut(worst[2] ^ solid.solid, effort)
        if 1 < len(parts) <= settings.max_pieces - there:
            for part in parts:
                add(part.hull())
        else:
            done.append(worst)
    done = sorted(done + queue, key=lambda one: one[1])
    return tuple(shape for *_, shape in done), max(-excess for excess, *_ in done)


def _best_cut(part: Manifold, effort: _Effort) -> list[Manifold]:
    """The parts by the planes that take away most of the hulls' volume for each further part; one if none cuts it."""
    vertices, faces = _arrays(part)
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    middle = corners.mean(axis=1)
    spread = middle - np.average(middle, axis=0, weights=area)
    directions = np.vstack((np.linalg.eigh((spread * area[:, None]).T @ spread)[1].T, np.eye(3)))
    along = vertices @ directions.T
    low, high = along.min(axis=0), along.max(axis=0)
    offsets = low + (high - low) * np.arange(1, _CUTS + 1)[:, None] / (_CUTS + 1)
    singles = [[(directions[i], float(offset))] for i in range(6) for offset in offsets[:, i]]
    crosses = [[(directions[i], float(offsets[_CUTS // 2, i])) for i in pair] for pair in _CROSSES]
    whole, best, best_gain = part.hull().volume(), [part], -np.inf
    for planes in singles + crosses:
        parts = [part]
        effort.spend(part)
        for normal, offset in planes:
            parts = [half for one in parts for half in one.split_by_plane(tuple(normal), offset)]
        parts = [one for half in parts for one in half.decompose() if one.volume() > _SPECK]
        if len(parts) > 1:
            gain = (whole - sum(one.hull().volume() for one in parts)) / (len(parts) - 1)
            if gain > best_gain:
                best, best_gain = parts, gain
    return best


def _joined(solid: _Solid, hulls: Sequence[Manifold], tolerance: float, effort: _Effort) -> list[Manifold]:
    """Pieces joined wherever the hull of two keeps to the surface; those first that lose least volume by it.

    Args:
        tolerance: what a quick look may find [m].
    """
    batch_hull = _manifold3d().Manifold.batch_hull
    alive: dict[int, Manifold] = {}
    boxes: dict[int, np.ndarray] = {}
    queue: list[tuple[float, int, int, Manifold]] = []

    def add(number: int, piece: Manifold) -> None:
        boxes[number] = np.array(piece.bounding_box()).reshape(2, 3)
        for other, neighbour in alive.items():
            (low, high), (low2, high2) = boxes[number], boxes[other]
            if ((low <= high2 + 2e-4) & (low2 <= high + 2e-4)).all() and effort.left > 0:
                effort.spend(solid.solid)
                both = batch_hull([piece, neighbour])
                if solid.excess(both, solid.farthest) <= tolerance:
                    heapq.heappush(queue, (both.volume() - piece.volume() - neighbour.volume(), other, number, both))
        alive[number] = piece

    for number, piece in enumerate(hulls):
        add(number, piece)
    number = len(hulls)
    while queue:
        _, one, other, both = heapq.heappop(queue)
        if one in alive and other in alive and solid.excess(both, solid.deviation) <= tolerance / _QUICK:
            del alive[one], alive[other]
            add(number, both)
            number += 1
    return list(alive.values())


def _arrays(solid: Manifold) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] and triangles [F, 3]."""
    mesh = solid.to_mesh64()
    return np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts).astype(np.int64)


def _samples(vertices: np.ndarray, faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points [count, 3] uniform over the triangles' area, the same for the same mesh, and the triangle of each [count]."""
    rng = np.random.default_rng(0)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    face = rng.choice(len(faces), count, p=area / area.sum())
    u, v = rng.random((2, count, 1))
    fold = u + v > 1
    u, v = np.where(fold, 1 - u, u), np.where(fold, 1 - v, v)
    return a[face] + u * (b - a)[face] + v * (c - a)[face], face


def _manifold3d() -> Any:
    with needs("manifold3d, which cuts concave meshes,", "objects", ObjectError):
        import manifold3d
    return manifold3d


# Hulls ---------------------------------------------------------------------------------------------------------------------------------


def limited_hull(points: np.ndarray, max_vertices: int) -> Shape:
    """The convex hull of points [V, 3]; if it has more vertices, the hull of those that matter most.

    Vertices are chosen one after the other, each the one farthest outside the hull of those before.
    """
    full = hull(points)
    vertices = full.geometry.vertices
    assert vertices is not None
    if len(vertices) <= max_vertices:
        return full
    along = vertices @ np.vstack((np.eye(3), _DIAGONALS)).T
    chosen = sorted({*along.argmin(axis=0).tolist(), *along.argmax(axis=0).tolist()})
    while len(chosen) < max_vertices:
        inner = ConvexHull(vertices[chosen], qhull_options="QJ")  # joggled: the first few may be coplanar
        outside = (vertices @ inner.equations[:, :3].T + inner.equations[:, 3]).max(axis=1)
        outside[chosen] = -np.inf
        chosen.append(int(outside.argmax()))
    return hull(vertices[chosen])
