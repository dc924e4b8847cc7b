"""Convex pieces of meshes, kept in a cache because cutting them takes seconds."""

from __future__ import annotations

import hashlib
import json
import os
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from xreset.errors import FileFormatError, ObjectError, XResetError
from xreset.geometry.shapes import hull
from xreset.objects.decompose import Pieces, Progress, Settings, decompose
from xreset.records import POSITION, Field, read_npz, write_npz

if TYPE_CHECKING:
    import trimesh

SCHEMA_NAME = "xreset-pieces/3"
SCHEMA = {
    "vertices": Field(("V", 3), "f", within=POSITION),
    "offsets": Field(("K+1",), "i"),
    "deviation": Field((), "f", within=POSITION),
    "volume": Field((), "f"),
    "com": Field((3,), "f", within=POSITION),
    "inertia": Field((3, 3), "f"),
}


def cached_pieces(mesh: trimesh.Trimesh, source: str, progress: Progress) -> Pieces:
    """The pieces of a mesh, from the cache if they are there. Those of a decomposition that was cut short are not kept.

    Args:
        source: SHA-256 of what it was read from.
    """
    settings = Settings()
    config = asdict(settings)
    key = hashlib.sha256(json.dumps([SCHEMA_NAME, source, config], sort_keys=True).encode()).hexdigest()
    path = cache_folder() / "objects" / f"{key}.npz"
    if path.is_file():
        try:
            arrays = read_npz(path, SCHEMA_NAME, SCHEMA, what="cached convex pieces")
            shapes = tuple(hull(part) for part in np.split(arrays["vertices"], arrays["offsets"][1:-1]))
            deviation, volume = float(arrays["deviation"]), float(arrays["volume"])
            return Pieces(
                shapes=shapes,
                deviation=deviation,
                volume=volume,
                com=arrays["com"],
                inertia=arrays["inertia"],
                cached=True,
            )
        except (FileFormatError, ObjectError):
            path.unlink(missing_ok=True)  # damaged: make it again
    pieces = decompose(mesh, settings, progress)
    parts = [piece.geometry.vertices for piece in pieces.shapes if piece.geometry.vertices is not None]
    offsets = np.cumsum([0, *map(len, parts)])
    numbers = {name: np.asarray(getattr(pieces, name)) for name in ("deviation", "volume", "com", "inertia")}
    arrays = {"vertices": np.concatenate(parts), "offsets": offsets, **numbers}
    with suppress(XResetError):  # a cache that cannot be written costs time, nothing else
        if pieces.finished:
            write_npz(path, SCHEMA_NAME, arrays, config=config, inputs={"mesh": source})
    return pieces


def cache_folder() -> Path:
    """``XRESET_CACHE``, or ``xreset`` in the user's cache folder."""
    if os.environ.get("XRESET_CACHE"):
        return Path(os.environ["XRESET_CACHE"])
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "xreset"
