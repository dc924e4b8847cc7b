"""Import of real meshes: from a file to an object that every engine can simulate."""

from __future__ import annotations

import logging
import re
import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import QhullError

from xreset.errors import ObjectError
from xreset.files.checks import frozen
from xreset.files.storage import file_hash, write_whole
from xreset.files.text import shown
from xreset.geometry.shapes import load_mesh, mesh_arrays, shell_properties, winding_number
from xreset.objects.cache import cached_pieces
from xreset.objects.decompose import WALL, Pieces, Settings, openings
from xreset.objects.properties import (
    DENSITIES,
    MASSES,
    Properties,
    properties_file,
    properties_of,
    refuse_taken,
)
from xreset.objects.ycb import MASSES as PUBLISHED_MASSES
from xreset.spec import ObjectSpec

if TYPE_CHECKING:
    import trimesh

DEFAULT_DENSITY = 500.0
"""Density of an object of unknown mass [kg/m^3]: a packed household object."""

_SIZES = (0.005, 2.0)
"""Lengths of meshes in metres [m]; a smaller or larger one is in other units."""
_FLAT = 1e-5
"""A thinner mesh is flat [m]."""
_HOLLOW = 120.0
"""A closed mesh of a lower density is a shell [kg/m^3]."""
_SPECK_AREA = 0.01
"""Largest share of a mesh's area that a part has which is a speck."""
_BUBBLE = 1e-3
"""Share of a mesh's volume up to which a part that faces inwards is a bubble, as scans have them."""
_SPECK_GAP = 0.2
"""How far such a part is from the largest one, as a share of its length."""
_FEW_MM = 0.002
"""Deviation of pieces from the surface that is worth a note [m]."""

_TURNED = "triangles face inwards, and were turned. Those of a mirrored mesh do, too: compare it with the object"

_log = logging.getLogger(__name__)


@frozen
class Import:
    """An imported object, and how it was made."""

    obj: ObjectSpec
    notes: tuple[str, ...]
    """Assumptions."""
    deviation: float
    """Largest distance between the pieces' surface and the mesh's [m]."""
    mass_source: str
    """Where the mass comes from, in words."""
    tolerance: float | None
    """Stated tolerance of the pieces [m]."""

    def hollows(self) -> str:
        """Return a sentence about what the pieces fill or leave out; empty if they keep to the surface."""
        if self.deviation <= _FEW_MM or self.tolerance is not None:
            return ""
        count = len(self.obj.pieces)
        pieces = f"its {count} pieces fill" if count > 1 else "its convex hull fills"
        return (
            f"{pieces} hollows up to {1e3 * self.deviation:.1f} mm deep. `tolerance = 0.002` in {self.obj.name}.toml"
            " keeps them open"
        )


def import_mesh(path: str | Path, name: str) -> ObjectSpec:
    """Return the object of a mesh file; see :func:`import_with_notes`. Assumptions are logged as warnings."""
    result = import_with_notes(path, name)
    for note in result.notes:
        _warn_once(name, note)
    return result.obj


@cache
def _warn_once(name: str, note: str) -> None:
    """Log an assumption about an object once in a process, however often its mesh is loaded."""
    _log.warning("%s: %s", name, note)


def import_with_notes(path: str | Path, name: str) -> Import:
    """Read a mesh, cut it into convex pieces and compute its mass properties.

    A closed mesh whose mass is that of no solid (below 120 kg/m^3) is a shell: its mass is spread evenly over its
    surface.

    Args:
        path: mesh file, in metres, in the frame of the object's poses; NAME.toml may state its properties
            (:mod:`xreset.objects.properties`).
        name: the object's name. The masses of the YCB object set are known by name, other masses follow from a
            density.

    Raises:
        ObjectError: the file is missing, damaged, empty or flat, or not in metres.
    """
    path = Path(path)
    notes: list[str] = []
    mesh = read_mesh(path, notes)
    mesh = _without_specks(mesh, notes)
    own = properties_of(path)
    known = _known_mass(name, own)
    source = mesh_source(path, own)
    cut = " ".join((source.split()[0], *notes))  # earlier versions cut specks, too
    try:
        if known is not None:
            _check_density(mesh, known[0])  # at once: cutting takes up to a minute
        settings = Settings()
        if own.tolerance is not None:
            settings = Settings(hull_depth=0.0, tolerance=own.tolerance)
        mesh.metadata["name"] = name
        pieces = cached_pieces(mesh, cut, settings)
        if known is None:
            _check_density(mesh, _density(own) * pieces.volume)
    except ObjectError as error:
        raise ObjectError(f"{path}: {error}") from error
    except QhullError as error:
        raise ObjectError(
            f"{path} spans no volume: it is flat, or damaged. A solid object is needed."
        ) from error
    if not mesh.is_volume:
        notes.append(_how_closed(mesh, pieces))
    mass, mass_source = known or _guessed_mass(path, own, pieces.volume, notes)
    com = pieces.com
    inertia = pieces.inertia * mass
    if own.density is None and mesh.is_volume and mass / pieces.volume < _HOLLOW:
        com, inertia = shell_properties(*mesh_arrays(mesh), mass)
        litres = pieces.volume * 1e3
        notes.append(
            f"{mass:.3f} kg in {litres:.2f} l is a hollow object: its mass is put on its surface"
        )
    if not pieces.finished:
        notes.append(
            "cutting took too long and was stopped: a mesh with fewer triangles would fit better"
        )
    vertices, faces = mesh_arrays(mesh)
    obj = ObjectSpec(
        name=name,
        pieces=pieces.shapes,
        mass=float(mass),
        com=com,
        inertia=inertia,
        vertices=vertices,
        faces=faces,
        source=source,
        friction=own.friction,
    )
    return Import(
        obj=obj,
        notes=tuple(notes),
        deviation=pieces.deviation,
        mass_source=mass_source,
        tolerance=own.tolerance,
    )


def mesh_source(path: Path, own: Properties) -> str:
    """Return the :attr:`~xreset.spec.ObjectSpec.source` of the object of a mesh file with stated properties."""
    return f"{file_hash(path)} {own.tolerance or 'hull'}"


def _known_mass(name: str, own: Properties) -> tuple[float, str] | None:
    """Return an object's stated or published mass [kg] and its source in words; None if its density decides."""
    if own.mass is not None:
        return own.mass, "stated"
    if own.density is None and name in PUBLISHED_MASSES:
        return PUBLISHED_MASSES[name], "published (YCB)"
    return None


def _density(own: Properties) -> float:
    """Return the stated or guessed density [kg/m^3]."""
    return DEFAULT_DENSITY if own.density is None else own.density


def _guessed_mass(
    path: Path, own: Properties, volume: float, notes: list[str]
) -> tuple[float, str]:
    """Return the mass [kg] of a solid of a volume [m^3] and its source in words; a guessed density is noted."""
    density = _density(own)
    if own.density is None:
        notes.append(
            f"its mass is unknown: {density * volume:.3g} kg is assumed, by a density of"
            f" {density:.0f} kg/m^3. State it next to the mesh, in {properties_file(path).name}: mass = 0.12"
        )
    return density * volume, f"{density:g} kg/m^3"


def _check_density(mesh: trimesh.Trimesh, mass: float) -> None:
    """Refuse, with ``ObjectError``, a mesh of another unit or a mass that no object of its size has."""
    # an open mesh is at most as large as its convex hull
    density = mass / (mesh if mesh.is_volume else mesh.convex_hull).volume
    if MASSES[0] <= mass <= MASSES[1] and DENSITIES[0] <= density <= DENSITIES[1]:
        return
    raise ObjectError(
        f"it measures {_size(mesh)}, so {mass:.3g} kg are {density:.3g} kg/m^3; expected {MASSES[0]:g} to"
        f" {MASSES[1]:g} kg, and {DENSITIES[0]:g} to {DENSITIES[1]:g} kg/m^3. Is the mesh in metres? If not: xreset"
        " objects import MESH --scale."
    )


def _how_closed(mesh: trimesh.Trimesh, pieces: Pieces) -> str:
    """Return a sentence about what was taken as the solid of a mesh that is not closed."""
    widths = [1e3 * np.ptp(mesh.vertices[loop], axis=0).max() for loop, _ in openings(mesh)]
    holes = ""
    if widths:
        holes = f" ({len(widths)} hole{'s' * (len(widths) > 1)}, the widest {max(widths):.0f} mm)"
    solid = "its holes were filled"
    if len(pieces.shapes) == 1:
        solid = "volume, center of mass and inertia are those of its convex hull"
    elif pieces.volume < 1.5 * mesh.area * WALL:
        solid = f"it is taken as a wall {1e3 * WALL:g} mm thick"
    return f"the mesh is not closed{holes}: {solid}"


def add_mesh(
    path: Path,
    folder: Path,
    name: str,
    *,
    scale: float = 1.0,
    properties: Properties | None = None,
) -> Import:
    """Import a mesh of any format and scale, and put it with its properties as ``NAME.obj`` and ``NAME.toml`` into a
    folder.

    The pieces keep to the surface within the tolerance of the properties, 2 mm if they state none. The files are
    written when the mesh has been cut: a command that was killed can be repeated.

    Raises:
        ObjectError: the mesh cannot be used, is not in metres once scaled, or the folder has one of that name; nothing
            is then written.
        XResetError: the files cannot be written.
    """
    if not re.fullmatch("[A-Za-z0-9_-]{1,200}", name):
        raise ObjectError(
            f"{shown(name)} cannot be an object's name. Use letters, digits, - and _."
        )
    target = folder / f"{name}.obj"
    properties = properties or Properties()
    known = replace(properties, tolerance=properties.tolerance or Settings.tolerance).to_toml()
    refuse_taken(target, known)
    from trimesh.exchange.obj import export_obj

    notes: list[str] = []
    mesh = read_mesh(path, notes, scale=scale)
    text = export_obj(
        mesh, include_normals=False, include_color=False, include_texture=False, header=""
    )
    with tempfile.TemporaryDirectory() as temporary:
        draft = Path(temporary) / target.name
        draft.write_text(text)
        draft.with_suffix(".toml").write_text(known)
        try:
            result = import_with_notes(draft, name)
        except ObjectError as error:  # the user knows only the mesh's own name
            raise ObjectError(str(error).replace(str(draft), str(path))) from error
    write_whole(target.with_suffix(".toml"), known)
    write_whole(target, text)
    return replace(result, notes=(*notes, *result.notes))


def read_mesh(path: Path, notes: list[str] | None = None, *, scale: float = 1.0) -> trimesh.Trimesh:
    """Read the triangles of a file, in metres, joined where they touch.

    Args:
        path: file of any format that trimesh reads, but not an archive.
        notes: gets a line if triangles were turned; None: nobody reads it.
        scale: metres in a unit of the file.

    Raises:
        ObjectError: the file is missing, damaged, too large, empty or flat, or not in metres once scaled.
    """
    if not scale > 0:
        raise ObjectError(f"scale is {scale:g}, expected a number above 0.")
    mesh = load_mesh(path)
    try:
        if scale != 1.0:
            mesh.apply_scale(scale)
        return _checked(mesh, path, [] if notes is None else notes)
    except ObjectError:
        raise
    except Exception as error:  # trimesh raises any kind of error
        raise ObjectError(f"{path} cannot be read as a mesh: {shown(str(error))}") from error


def _checked(mesh: trimesh.Trimesh, path: Path, notes: list[str]) -> trimesh.Trimesh:
    """Return the mesh, joined where triangles of a part touch; see :func:`read_mesh` for errors."""
    if not np.isfinite(mesh.vertices).all():
        raise ObjectError(f"{path} has a vertex that is not finite; it is damaged.")
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        raise ObjectError(f"{path} has a triangle of an unknown vertex; it is damaged.")
    # before merging, which rounds by the size
    if mesh.extents is not None and not _SIZES[0] <= mesh.extents.max() <= _SIZES[1]:
        raise ObjectError(
            f"{path} measures {_size(mesh)}, expected {_SIZES[0]:g} to {_SIZES[1]:g} m. Import the file with its unit:"
            " xreset objects import MESH --scale 0.001 for millimetres."
        )
    mesh.merge_vertices(merge_tex=True, merge_norm=True)  # texture seams are no holes
    mesh.update_faces(mesh.nondegenerate_faces())
    mesh.remove_unreferenced_vertices()
    if not len(mesh.faces) or mesh.extents.min() < _FLAT:
        raise ObjectError(f"{path} is flat: {_size(mesh)}; a solid object is needed.")
    mesh = _parted(mesh)
    if mesh.is_watertight and mesh.is_winding_consistent:
        if _turn_outward(mesh):
            notes.append(_TURNED)
        least, middle, largest = np.linalg.eigvalsh(mesh.moment_inertia)
        if min(least, least + middle - 0.999 * largest) <= 0:
            raise ObjectError(
                f"{path} crosses itself: its moments of inertia are those of no solid. Repair it, for example in"
                " MeshLab."
            )
    return mesh


def _turn_outward(mesh: trimesh.Trimesh) -> bool:
    """Turn the parts of a closed mesh that face inwards, but for cavities, which are inside of other parts; return
    whether there were any."""
    before = mesh.faces
    if mesh.volume < 0:
        mesh.invert()
    part = _parts(mesh)
    volumes = np.bincount(part, np.linalg.det(mesh.triangles))
    solid = mesh.faces[volumes[part] >= 0]
    for number in np.flatnonzero(volumes < -_BUBBLE * volumes.sum()):
        own = part == number
        corners = mesh.vertices[mesh.faces[own].ravel()]
        ends = corners[np.append(corners.argmin(axis=0), corners.argmax(axis=0))]
        if winding_number(ends, mesh.vertices, solid).min() < 0.1:
            mesh.faces = np.where(own[:, None], mesh.faces[:, ::-1], mesh.faces)
    return bool((mesh.faces != before).any())


def _parts(mesh: trimesh.Trimesh) -> np.ndarray:
    """[F] number of the part of each triangle; an edge of two triangles joins them."""
    import trimesh

    return trimesh.graph.connected_component_labels(mesh.face_adjacency, len(mesh.faces))


def _without_specks(mesh: trimesh.Trimesh, notes: list[str]) -> trimesh.Trimesh:
    """Return a mesh without small parts that are far from its largest part, as scans have them; they are noted."""
    import trimesh

    labels = trimesh.graph.connected_component_labels(mesh.edges_unique, len(mesh.vertices))
    if labels.max() == 0:
        return mesh
    part = labels[mesh.faces[:, 0]]
    area = np.bincount(part, mesh.area_faces, minlength=labels.max() + 1)
    low = np.full((len(area), 3), np.inf)
    high = np.full((len(area), 3), -np.inf)
    np.minimum.at(low, labels, mesh.vertices)
    np.maximum.at(high, labels, mesh.vertices)
    main = area.argmax()
    gap = np.maximum(low - high[main], low[main] - high).max(axis=1)
    is_speck = (area < _SPECK_AREA * area.sum()) & (
        gap > _SPECK_GAP * (high[main] - low[main]).max()
    )
    if not is_speck.any():
        return mesh
    notes.append(
        f"{is_speck.sum()} specks, up to {1e3 * gap[is_speck].max():.0f} mm away from the rest, are left out"
    )
    kept = mesh.copy()
    kept.update_faces(~is_speck[part])
    kept.remove_unreferenced_vertices()
    return kept


def _parted(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return a mesh whose solid parts share no vertices, if that closes it: an edge in which two parts touch has four
    triangles, and would count as open."""
    import trimesh

    if mesh.is_watertight:
        return mesh
    part = _parts(mesh)
    corners = np.column_stack((part.repeat(3), mesh.faces.ravel()))
    own, faces = np.unique(corners, axis=0, return_inverse=True)
    parted = trimesh.Trimesh(mesh.vertices[own[:, 1]], faces.reshape(-1, 3), process=False)
    volumes = np.bincount(part, np.linalg.det(parted.triangles))
    return parted if volumes.min() > 0 and parted.is_volume else mesh


def _size(mesh: trimesh.Trimesh) -> str:
    lengths = mesh.extents if mesh.extents is not None else (0, 0, 0)
    return " x ".join(f"{length:.4g}" for length in lengths) + " m"
