"""Import of real meshes: from a file to an object that every engine can simulate."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from xreset.errors import ObjectError
from xreset.files import atomic_write, file_hash, max_bytes
from xreset.geometry.shapes import shell_properties
from xreset.objects.cache import cached_pieces
from xreset.objects.decompose import Progress, Settings
from xreset.objects.properties import Properties, properties_of
from xreset.objects.ycb import MASSES
from xreset.spec import ObjectSpec
from xreset.text import shown

if TYPE_CHECKING:
    import trimesh

DEFAULT_DENSITY = 500.0
"""Density of an object of unknown mass [kg/m^3]: a packed household object."""

_LARGEST = 2.0  # [m]: beyond it the file is in other units
_HOLLOW = 120.0  # [kg/m^3]: below it a solid mesh stands for a shell
_FEW_MM = 0.002  # [m]: pieces that stand farther off the surface are worth a note

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
    deviation: float
    """[m] Largest distance between the pieces' surface and the mesh's (sampled)."""


def mesh_files(folder: str | Path) -> dict[str, Path]:
    """Object name -> mesh file, for every object of a folder.

    Layouts: ``NAME.obj``; ``NAME/textured_simple.obj`` (as in DexYCB's ``models``); ``NAME/textured.obj`` (as in the YCB object set).

    Raises:
        ObjectError: the folder does not exist or has no mesh.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ObjectError(
            f"there is no folder {folder}; expected a folder of meshes such as NAME.obj or NAME/textured_simple.obj."
        )
    found = {path.stem: path for path in folder.glob("*.obj")}
    for file in ("textured.obj", "textured_simple.obj"):  # the simpler one wins
        found |= {path.parent.name: path for path in folder.glob(f"*/{file}")}
    if not found:
        raise ObjectError(
            f"there is no mesh in {folder}; expected NAME.obj, NAME/textured_simple.obj or NAME/textured.obj."
        )
    return dict(sorted(found.items()))


def import_mesh(path: str | Path, name: str) -> ObjectSpec:
    """The object of a mesh file; see :func:`import_with_notes`. What was assumed is logged as a warning."""
    result = import_with_notes(path, name)
    for note in result.notes:
        _log.warning("%s: %s", name, note)
    return result.obj


def import_with_notes(
    path: str | Path, name: str, *, mass: float | None = None, progress: Progress = lambda parts, worst: None
) -> Import:
    """Read a mesh, cut it into convex pieces and work out its mass properties.

    A closed mesh whose mass is that of no solid (below 120 kg/m^3) is a shell: its mass lies evenly on its surface.

    Args:
        path: mesh file, in metres, in the frame of the object's poses; beside it,
            NAME.toml may say what it is made of (:mod:`xreset.objects.properties`).
        name: the object's name; the masses of the YCB object set are known by it.
        mass: mass [kg]; None: what stands beside the mesh, else the published one, else by density.
        progress: see :func:`xreset.objects.decompose.decompose`.

    Raises:
        ObjectError: the file is missing, damaged, empty or flat, or not in metres.
    """
    start = time.perf_counter()
    path = Path(path)
    mesh, own = read_mesh(path), properties_of(path)
    source = file_hash(path)
    pieces = cached_pieces(mesh, source, progress)
    notes = []
    if not mesh.is_volume:
        if len(pieces.shapes) == 1:
            notes.append("the mesh is not closed: volume, centre of mass and inertia are those of its convex hull")
        elif pieces.volume < 1.5 * mesh.area * Settings().thickness:
            notes.append(f"the mesh is not closed: it is taken as a wall {1e3 * Settings().thickness:g} mm thick")
        else:
            notes.append("the mesh is not closed: its holes were filled")
    mass = mass or own.mass or (None if own.density else MASSES.get(name))
    com, inertia = pieces.com, pieces.inertia * (mass or 0.0)
    if mass is None:
        mass = (own.density or DEFAULT_DENSITY) * pieces.volume
        inertia = pieces.inertia * mass
        if own.density is None:
            notes.append(f"its mass is not known: {mass:.3f} kg by a density of {DEFAULT_DENSITY:.0f} kg/m^3")
    elif mesh.is_volume and mass / pieces.volume < _HOLLOW:
        com, inertia = shell_properties(np.asarray(mesh.vertices), np.asarray(mesh.faces), mass)
        litres = pieces.volume * 1e3
        notes.append(
            f"the mesh is solid, but {mass:.3f} kg in {litres:.2f} l is a hollow object: its mass is put on its surface"
        )
    if not pieces.finished:
        notes.append(
            "cutting it was stopped early, for it takes too long: a mesh with fewer triangles would fit better"
        )
    if len(pieces.shapes) > 1 and pieces.deviation > _FEW_MM:
        notes.append(f"its pieces stand up to {1e3 * pieces.deviation:.1f} mm off its surface")
    obj = ObjectSpec(
        name=name,
        pieces=pieces.shapes,
        mass=float(mass),
        com=com,
        inertia=inertia,
        vertices=np.asarray(mesh.vertices, dtype=float),
        faces=np.asarray(mesh.faces, dtype=np.int64),
        source=source,
        friction=own.friction,
    )
    return Import(
        obj=obj,
        notes=tuple(notes),
        seconds=time.perf_counter() - start,
        cached=pieces.cached,
        deviation=pieces.deviation,
    )


def add_mesh(
    path: Path,
    folder: Path,
    name: str,
    *,
    scale: float = 1.0,
    properties: Properties | None = None,
    progress: Progress = lambda parts, worst: None,
) -> Import:
    """Put a mesh of any format and scale, and what it is made of, as ``NAME.obj`` and ``NAME.toml`` into a folder, and import it there.

    Raises:
        ObjectError: it cannot be used, is not in metres once scaled, or the folder has one of that name; nothing is then left there.
        XResetError: it cannot be written.
    """
    if not is_name(name):
        raise ObjectError(f"{shown(name)} is no name for an object; expected letters, digits, - and _.")
    target = folder / f"{name}.obj"
    facts = target.with_suffix(".toml")
    if target.exists() or facts.exists():
        raise ObjectError(
            f"{target} or its .toml is there already. Nothing was changed; choose another --name or --out."
        )
    mesh = read_mesh(path, scale=scale)
    text = mesh.export(file_type="obj", include_normals=False, include_color=False, include_texture=False, header="")
    try:
        with atomic_write(target) as file:
            file.write(text.encode())
        if properties is not None:
            properties.write(facts)
        return import_with_notes(target, name, progress=progress)
    except BaseException:
        target.unlink(missing_ok=True)
        facts.unlink(missing_ok=True)
        raise


def is_name(text: str) -> bool:
    """Whether a text can be an object's name and a file's."""
    return bool(text) and text.isascii() and text.replace("_", "").replace("-", "").isalnum()


def read_mesh(path: Path, *, scale: float = 1.0) -> trimesh.Trimesh:
    """The triangles of a file, in metres, closed where they touch.

    Args:
        path: file of any format that trimesh reads.
        scale: metres in a unit of the file.

    Raises:
        ObjectError: it is missing, damaged, empty or flat, or not in metres once scaled.
    """
    import trimesh

    if not path.is_file():
        raise ObjectError(f"there is no mesh at {path}.")
    if path.stat().st_size > max_bytes():
        raise ObjectError(f"{path} has {path.stat().st_size >> 20} MB, more than XRESET_MAX_FILE_MB allows.")
    try:
        mesh = trimesh.load(
            path, force="mesh", skip_materials=True, process=False
        )  # processing would drop damaged vertices silently
        if isinstance(mesh, trimesh.Trimesh) and scale != 1.0:
            mesh.apply_scale(scale)
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
        raise ObjectError(
            f"{path} measures {_size(mesh)}; meshes must be in metres. Is it in millimetres (--scale 0.001)?"
        )
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
