"""A mesh as few convex pieces, small enough for every engine, kept in a cache because it takes seconds.

PhysX takes hulls of at most 64 vertices in its fast path, and contact cost grows with the number of pieces.
"""

from __future__ import annotations

import hashlib
import json
import os
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from xreset.errors import FileFormatError, ObjectError, XResetError
from xreset.files import POSITION, Field, read_npz, write_npz
from xreset.geometry.shapes import hull
from xreset.spec import Shape

if TYPE_CHECKING:
    import trimesh

SCHEMA_NAME = "xreset-pieces/1"
SCHEMA = {"vertices": Field(("V", 3), "f", within=POSITION), "offsets": Field(("K+1",), "i")}


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How a mesh is decomposed. Every field is part of the cache's key."""

    max_pieces: int = 16
    max_vertices: int = 64
    """Of each piece."""
    hull_depth: float = 0.05
    """A mesh is one convex piece if no point of its hull is farther from its surface than this fraction of its bounding box's diagonal.

    The volume ratio would be no good measure: the recessed lids of a tuna can cost as much volume as a pitcher's handle.
    """
    threshold: float = 0.08
    """CoACD's concavity threshold, relative to a mesh scaled to [-1, 1]."""
    seed: int = 0


def decompose(mesh: trimesh.Trimesh, settings: Settings = Settings()) -> tuple[Shape, ...]:
    """Convex pieces that together have the mesh's shape.

    Raises:
        ObjectError: the mesh is concave and CoACD, which decomposes it, is not installed.
    """
    if _depth(mesh) <= settings.hull_depth:
        return (limited_hull(mesh.vertices, settings.max_vertices),)
    try:
        import coacd
    except ImportError as error:
        raise ObjectError(
            f"a concave mesh needs CoACD to be cut into convex pieces ({error}). Install it: pip install 'xreset[objects]'"
        ) from error
    coacd.set_log_level("error")
    parts = coacd.run_coacd(
        coacd.Mesh(np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces, dtype=np.int32)),
        threshold=settings.threshold,
        max_convex_hull=settings.max_pieces,
        preprocess_mode="off" if mesh.is_watertight else "on",
        preprocess_resolution=30,
        mcts_nodes=10,
        mcts_iterations=60,
        decimate=True,
        max_ch_vertex=settings.max_vertices,
        seed=settings.seed,
    )
    return tuple(limited_hull(vertices, settings.max_vertices) for vertices, _ in parts)


def cached_pieces(mesh: trimesh.Trimesh, source: str, settings: Settings = Settings()) -> tuple[tuple[Shape, ...], bool]:
    """The pieces of a mesh, from the cache if they are there, and whether they were.

    Args:
        mesh: the mesh.
        source: SHA-256 of what it was read from.
        settings: how to decompose it.
    """
    key = hashlib.sha256(json.dumps([SCHEMA_NAME, source, asdict(settings)], sort_keys=True).encode()).hexdigest()
    path = cache_folder() / "objects" / f"{key}.npz"
    if path.is_file():
        try:
            arrays = read_npz(path, SCHEMA_NAME, SCHEMA, what="cached convex pieces")
            return tuple(hull(part) for part in np.split(arrays["vertices"], arrays["offsets"][1:-1])), True
        except (FileFormatError, ObjectError):
            path.unlink(missing_ok=True)  # damaged: make it again
    pieces = decompose(mesh, settings)
    parts = [piece.geometry.vertices for piece in pieces if piece.geometry.vertices is not None]
    offsets = np.cumsum([0, *map(len, parts)])
    config, inputs = asdict(settings), {"mesh": source}
    with suppress(XResetError):  # a cache that cannot be written costs time, nothing else
        write_npz(path, SCHEMA_NAME, {"vertices": np.concatenate(parts), "offsets": offsets}, config=config, inputs=inputs)
    return pieces, False


def cache_folder() -> Path:
    """``XRESET_CACHE``, or ``xreset`` in the user's cache folder."""
    if os.environ.get("XRESET_CACHE"):
        return Path(os.environ["XRESET_CACHE"])
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "xreset"


def limited_hull(points: np.ndarray, max_vertices: int) -> Shape:
    """The convex hull of points [V, 3]; if it has more vertices, the hull of those that matter most.

    Vertices are chosen one after the other, each the one farthest outside the hull of those before.
    """
    from scipy.spatial import ConvexHull

    full = hull(points)
    vertices = full.geometry.vertices
    assert vertices is not None
    if len(vertices) <= max_vertices:
        return full
    chosen = sorted({int(i) for axis in range(3) for i in (vertices[:, axis].argmin(), vertices[:, axis].argmax())})
    while len(chosen) < 4:
        chosen.append(_farthest_from_span(vertices, chosen))
    while len(chosen) < max_vertices:
        inner = ConvexHull(vertices[chosen], qhull_options="QJ")  # joggled: the first few may be coplanar
        outside = (vertices @ inner.equations[:, :3].T + inner.equations[:, 3]).max(axis=1)
        outside[chosen] = -np.inf
        chosen.append(int(outside.argmax()))
    return hull(vertices[chosen])


def _farthest_from_span(vertices: np.ndarray, chosen: list[int]) -> int:
    rest = vertices - vertices[chosen[0]]
    basis = np.linalg.qr((vertices[chosen[1:]] - vertices[chosen[0]]).T)[0]
    return int(np.linalg.norm(rest - rest @ basis @ basis.T, axis=1).argmax())


def _depth(mesh: trimesh.Trimesh) -> float:
    """Largest distance of the convex hull's surface from the mesh's, as a fraction of the bounding box's diagonal (sampled)."""
    import trimesh
    from scipy.spatial import cKDTree

    hull_points = trimesh.sample.sample_surface(mesh.convex_hull, 2000, seed=0)[0]
    own_points = trimesh.sample.sample_surface(mesh, 40000, seed=0)[0]
    return float(cKDTree(own_points).query(hull_points)[0].max() / np.linalg.norm(mesh.extents))
