"""Load the known objects by any of their names."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from xreset.errors import ObjectError
from xreset.files.checks import first_repeated
from xreset.files.storage import matches
from xreset.files.text import short_name, shown
from xreset.objects.meshes import import_mesh, mesh_source
from xreset.objects.properties import properties_of
from xreset.objects.standins import STAND_INS, stand_in
from xreset.objects.ycb import ALIAS_OF
from xreset.spec import ObjectSpec

ALIASES = {alias: name for name, alias in ALIAS_OF.items()}
"""The paper's names -> official names."""
_OTHERS = (".stl", ".ply", ".glb", ".gltf", ".dae", ".off")
"""Formats of meshes that an import makes an .obj of."""


def object_names(meshes: str | Path | None = None) -> tuple[str, ...]:
    """Official names of the built-in objects, or of the meshes in a folder."""
    if meshes is None:
        return STAND_INS
    return tuple(mesh_files(meshes))


def mesh_files(folder: str | Path) -> dict[str, Path]:
    """Return object name -> mesh file, for every object of a folder.

    Layouts: ``NAME.obj``; ``NAME/textured_simple.obj`` (as in DexYCB's ``models``); ``NAME/textured.obj`` (as in the
        YCB object set).

    Raises:
        ObjectError: the folder does not exist, has no mesh, or has an object in two layouts.
    """
    folder = Path(folder)
    expected = "Expected NAME.obj, NAME/textured_simple.obj or NAME/textured.obj."
    if os.path.isfile(folder):
        raise ObjectError(f"{folder} is a file, not a folder of meshes. {expected}")
    if not os.path.isdir(folder):
        raise ObjectError(f"There is no folder {shown(str(folder))}. {expected}")
    found = {path.stem: path for path in matches(folder, "[!.]*.[oO][bB][jJ]")}
    nested = {}
    for file in ("textured.obj", "textured_simple.obj"):  # the simpler one wins
        nested |= {path.parent.name: path for path in matches(folder, f"*/{file}")}
    for name in found.keys() & nested.keys():
        raise ObjectError(
            f"{found[name]} and {nested[name]} have the same name. Remove one of them."
        )
    found |= nested
    if not found:
        advice = f"Import other formats: xreset objects import MESH --out {folder}"
        raise ObjectError(f"There is no mesh in {folder}. {expected} {advice}")
    return dict(sorted(found.items()))


def canonical_name(name: str, known: Iterable[str] = STAND_INS) -> str:
    """Return the name of a known object: from itself, its name with or without a number, or the paper's name for it.

    Raises:
        ObjectError: no known object has this name.
    """
    return canonical_names([name], known)[0]


def canonical_names(
    names: Iterable[str], known: Iterable[str] = STAND_INS, folder: str | Path | None = None
) -> tuple[str, ...]:
    """Return the names of known objects, or of the one of a single name; see :func:`canonical_name`.

    Args:
        names: the names.
        known: the known objects.
        folder: where the meshes of the known objects are.

    Raises:
        ObjectError: names every unknown object, and its files of another format in the folder.
    """
    names = (names,) if isinstance(names, str) else names
    known = tuple(known)
    found = []
    unknown = []
    for name in names:
        if not isinstance(name, str):
            raise ObjectError(f"Found {shown(name)}, expected the name of an object.")
        key = _key(name)
        short = short_name(key, "_")
        matches = [name]
        if name not in known:
            matches = [other for other in known if key in _keys(other) or _key(other) == short]
        if len(matches) == 1:
            found.append(matches[0])
        else:
            unknown.append(repr(name))
    if unknown:
        listing = [
            f"{other} ({ALIAS_OF[other]})" if other in ALIAS_OF else other for other in known
        ]
        what = f"Unknown object{'s' * (len(unknown) > 1)} {', '.join(dict.fromkeys(unknown))}"
        advice = ""
        if known is STAND_INS:
            advice = " Other objects need the folder of their meshes (meshes=... or --meshes)."
        if folder is not None:
            advice = f" These are the meshes in {folder}: give another folder, or none for the built-in objects."
            others = [path for path in Path(folder).iterdir() if path.suffix.lower() in _OTHERS]
            if others:
                advice += (
                    f" It has {min(others).name} as well, but only .obj files are read: "
                    f"xreset objects import {min(others)} --out {folder}"
                )
        raise ObjectError(f"{what}. Choose from: {', '.join(listing) or 'none'}.{advice}")
    return tuple(found)


def official_name(name: str) -> str:
    """Return the official name of a built-in object; another name stays as it is, because it may belong to a mesh."""
    try:
        return canonical_name(name)
    except ObjectError:
        return name


def _key(name: str) -> str:
    key = name.strip().lower().replace(" ", "_")
    return ALIASES.get(key, key)


def _keys(name: str) -> tuple[str, str]:
    """Return the names of an object with and without its number."""
    key = _key(name)
    return key, short_name(key, "_")


def load_object(name: str, meshes: str | Path | None = None) -> ObjectSpec:
    """Load an object by any of its names.

    Args:
        name: official name, name without number, or the paper's name.
        meshes: folder of real meshes (``NAME.obj``, ``NAME/textured_simple.obj`` or ``NAME/textured.obj``); None for
            the stand-in. An object that is asked for by its official name has it, whatever its mesh is called.

    Raises:
        ObjectError: unknown object, or no usable mesh of it in the folder.
    """
    if meshes is None:
        return stand_in(canonical_name(name))
    path, own = _mesh_of(name, meshes)
    return import_mesh(path, own)


def object_source(name: str, meshes: str | Path | None = None) -> str:
    """Return where the geometry of an object comes from, as :func:`load_object` states it, without cutting its
    mesh."""
    if meshes is None:
        return stand_in(canonical_name(name)).source
    path, _ = _mesh_of(name, meshes)
    return mesh_source(path, properties_of(path))


def _mesh_of(name: str, meshes: str | Path) -> tuple[Path, str]:
    """Return the mesh file of an object in a folder, and the name of the object that it makes."""
    files = mesh_files(meshes)
    (full,) = canonical_names([name], files, meshes)
    return files[full], name if name in STAND_INS else full


def load_objects(
    names: Iterable[str] | None, meshes: str | Path | None = None
) -> tuple[ObjectSpec, ...]:
    """Load objects in the order of their names, as :func:`load_object` does. A single name gives one object, None gives
    all of :func:`object_names`."""
    if names is None:
        names = object_names(meshes)
    names = (names,) if isinstance(names, str) else tuple(names)
    if not names:
        raise ObjectError("No object is named. Name one or several, or give None for all.")
    loaded = tuple(load_object(name, meshes) for name in names)
    if (i := first_repeated([obj.name for obj in loaded])) is not None:
        raise ObjectError(f"The object {loaded[i].name} is given twice. Name each object once.")
    return loaded
