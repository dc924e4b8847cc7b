"""Import of real meshes: from a file to an object that every engine can simulate."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from xreset.errors import ObjectError
from xreset.files import file_hash, max_bytes
from xreset.geometry.shapes import hull, mass_properties, shape_mesh
from xreset.objects.decompose import cached_pieces
from xreset.objects.ycb import MASSES
from xreset.spec import ObjectSpec
from xreset.text import shown

if TYPE_CHECKING:
    import trimesh

DEFAULT_DENSITY = 500.0
"""Density of an object of unknown mass [kg/m^3]: a packed household object."""

_LARGEST = 2.0  # [m]: beyond it the file is in other units
_HOLLOW = 120.0  # [kg/m^3]: below it a solid mesh stands for a shell

_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Import:
    """An imported object, and what is to be known about it."""

    obj: ObjectSpec
    notes: tuple[str, ...]
    """What was assumed."""
    seconds: float
    cached: bool
    """Whether the convex pieces came from the cache."""


def mesh_files(folder: str | Path) -> dict[str, Path]:
    """Object name -> mesh file, for every object of a folder.

    Layouts: ``NAME.obj``; ``NAME/textured_simple.obj`` (as in DexYCB's ``models``); ``NAME/textured.obj`` (as in the YCB object set).

    Raises:
        ObjectError: the folder does not exist or has no mesh.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ObjectError(f"there is no folder {folder}; expected a folder of meshes such as NAME.obj or NAME/textured_simple.obj.")
    found = {path.stem: path for path in folder.glob("*.obj")}
    for file in ("textured.obj", "textured_simple.obj"):  # the simpler one wins
        found |= {path.parent.name: path for path in folder.glob(f"*/{file}")}
    if not found:
        raise ObjectError(f"there is no mesh in {folder}; expected NAME.obj, NAME/textured_simple.obj or NAME/textured.obj.")
    return dict(sorted(found.items()))


def import_mesh(path: str | Path, name: str, *, mass: float | None = None) -> ObjectSpec:
    """The object of a mesh file; see :func:`import_with_notes`. What was assumed is logged as a warning."""
    result = import_with_notes(path, name, mass=mass)
    for note in result.notes:
        _log.warning("%s: %s", name, note)
    return result.obj


def import_with_notes(path: str | Path, name: str, *, mass: float | None = None) -> Import:
    """Read a mesh, cut it into convex pieces and work out its mass properties.

    Args:
        path: mesh file, in metres, in the frame of the object's poses.
        name: the object's name; the masses of the YCB object set are known by it.
        mass: mass [kg]; None: the published one, else by ``DEFAULT_DENSITY``.

    Raises:
        ObjectError: the file is missing, damaged, empty or flat, or not in metres.
    """
    start = time.perf_counter()
    path = Path(path)
    mesh = _load(path)
    notes = []
    solid = mesh
    if not mesh.is_volume:
        solid = shape_mesh(hull(mesh.vertices))
        notes.append("the mesh is not closed: volume, centre of mass and inertia are those of its convex hull")
    if mass is None:
        mass = MASSES.get(name)
    if mass is None:
        mass = DEFAULT_DENSITY * float(solid.volume)
        notes.append(f"its mass is not known: {mass:.3f} kg by a density of {DEFAULT_DENSITY:.0f} kg/m^3")
    elif mass / solid.volume < _HOLLOW:
        notes.append(f"the mesh is solid, but {mass:.3f} kg in {solid.volume * 1e3:.2f} l is a hollow object: its real inertia is larger")
    source = file_hash(path)
    pieces, cached = cached_pieces(mesh, source)
    com, inertia = mass_properties(np.asarray(solid.vertices), np.asarray(solid.faces), mass)
    obj = ObjectSpec(
        name=name,
        pieces=pieces,
        mass=float(mass),
        com=com,
        inertia=inertia,
        vertices=np.asarray(mesh.vertices, dtype=float),
        faces=np.asarray(mesh.faces, dtype=np.int64),
        source=source,
    )
    return Import(obj=obj, notes=tuple(notes), seconds=time.perf_counter() - start, cached=cached)


def _load(path: Path) -> trimesh.Trimesh:
    import trimesh

    if not path.is_file():
        raise ObjectError(f"there is no mesh at {path}.")
    if path.stat().st_size > max_bytes():
        raise ObjectError(f"{path} has {path.stat().st_size >> 20} MB, more than XRESET_MAX_FILE_MB allows.")
    try:
        mesh = trimesh.load(path, force="mesh", skip_materials=True, process=False)  # processing would drop damaged vertices silently
        return _checked(mesh, path)
    except ObjectError:
        raise
    except Exception as error:  # trimesh raises whatever its parsers meet
        raise ObjectError(f"{path} cannot be read as a mesh: {shown(str(error))}") from error


def _checked(mesh: object, path: Path) -> trimesh.Trimesh:
    import trimesh

    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces) or not len(mesh.vertices):
        raise ObjectError(f"{path} holds no triangles; it is empty or damaged.")
    if not np.isfinite(mesh.vertices).all():
        raise ObjectError(f"{path} has a vertex that is not finite; it is damaged.")
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        raise ObjectError(f"{path} has a triangle of a vertex that is not there; it is damaged.")
    if mesh.extents is not None and mesh.extents.max() > _LARGEST:  # before merging, which rounds by the size
        raise ObjectError(f"{path} measures {_size(mesh)}; meshes must be in metres. Is it in millimetres?")
    mesh.merge_vertices(merge_tex=True, merge_norm=True)  # texture seams are no holes
    mesh.update_faces(mesh.nondegenerate_faces())
    mesh.remove_unreferenced_vertices()
    if mesh.is_watertight and mesh.is_winding_consistent and mesh.volume < 0:
        mesh.invert()  # inside out
    if not len(mesh.faces) or mesh.extents.min() < 1e-5:
        raise ObjectError(f"{path} is flat: {_size(mesh)}; a solid object is needed.")
    return mesh


def _size(mesh: trimesh.Trimesh) -> str:
    return " x ".join(f"{length:.4g}" for length in (mesh.extents if mesh.extents is not None else (0, 0, 0))) + " m"
