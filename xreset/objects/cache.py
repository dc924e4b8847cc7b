"""Convex pieces of meshes, kept in a cache because cutting them takes seconds."""

from __future__ import annotations

import hashlib
import json
import os
from contextlib import suppress
from dataclasses import asdict
from importlib.metadata import distributions
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from xreset.errors import FileFormatError, ObjectError, XResetError
from xreset.files.records import POSITION, Field, read_npz, write_npz
from xreset.geometry.shapes import hull
from xreset.objects.decompose import Pieces, Settings, decompose

if TYPE_CHECKING:
    import trimesh

SCHEMA_NAME = "xreset-pieces/3"
_NUMBERS = {
    "deviation": Field((), "f", within=POSITION),
    "volume": Field((), "f"),
    "com": Field((3,), "f", within=POSITION),
    "inertia": Field((3, 3), "f"),
    "finished": Field((), "b"),
}
SCHEMA = {
    "vertices": Field(("V", 3), "f", within=POSITION),
    "offsets": Field(("K+1",), "i"),
    **_NUMBERS,
}
_ALGORITHM = 4
"""Raise it when :mod:`xreset.objects.decompose` gives other pieces or mass properties than before."""


def cached_pieces(mesh: trimesh.Trimesh, source: str, settings: Settings) -> Pieces:
    """Return the pieces of a mesh, from the cache if they are there.

    Args:
        source: SHA-256 of the mesh's file.
    """
    cutter = [found.version for found in distributions(name="manifold3d")]
    identity = json.dumps([SCHEMA_NAME, source, asdict(settings), _ALGORITHM, cutter])
    folder = cache_folder()
    if folder is None:
        return decompose(mesh, settings)
    path = folder / "objects" / f"{hashlib.sha256(identity.encode()).hexdigest()}.npz"
    with suppress(OSError):  # a cache that cannot be read or written costs time, nothing else
        if path.is_file():
            try:
                return _read_pieces(path)
            except (FileFormatError, ObjectError):
                path.unlink(missing_ok=True)  # damaged: make it again
    pieces = decompose(mesh, settings)
    parts = [np.asarray(piece.geometry.vertices) for piece in pieces.shapes]
    arrays = {"vertices": np.concatenate(parts), "offsets": np.cumsum([0, *map(len, parts)])}
    arrays |= {name: np.asarray(getattr(pieces, name)) for name in _NUMBERS}
    with suppress(XResetError, OSError):
        write_npz(path, SCHEMA_NAME, arrays, inputs={"mesh": source})
    return pieces


def _read_pieces(path: Path) -> Pieces:
    arrays = read_npz(path, SCHEMA_NAME, SCHEMA, what="cached convex pieces")
    shapes = tuple(hull(part) for part in np.split(arrays["vertices"], arrays["offsets"][1:-1]))
    numbers: dict[str, Any] = {name: arrays[name][()] for name in _NUMBERS}
    return Pieces(shapes=shapes, **numbers)


def cache_folder() -> Path | None:
    """``XRESET_CACHE``, or ``xreset`` in the user's cache folder; None: the user has no home."""
    if os.environ.get("XRESET_CACHE"):
        return Path(os.environ["XRESET_CACHE"])
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "xreset"
    except RuntimeError:
        return None
