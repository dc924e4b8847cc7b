"""Which objects there are, by any of their names."""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

from xreset.errors import ObjectError
from xreset.objects.meshes import import_mesh, mesh_files
from xreset.objects.standins import STAND_INS, stand_in
from xreset.spec import ObjectSpec

ALIASES = {
    "cheez-its": "003_cracker_box",
    "soup": "005_tomato_soup_can",
    "mustard": "006_mustard_bottle",
    "tuna": "007_tuna_fish_can",
    "spam": "010_potted_meat_can",
    "banana": "011_banana",
    "pitcher": "019_pitcher_base",
    "powerdrill": "035_power_drill",
    "scissors": "037_scissors",
}
"""The paper's names."""


def object_names(folder: Path | None = None) -> tuple[str, ...]:
    """Official names of the built-in objects, or of the meshes in a folder."""
    if folder is None:
        return STAND_INS
    return tuple(mesh_files(folder))


def canonical_name(name: str, known: Iterable[str] = STAND_INS) -> str:
    """The official name of an object: from itself, its name without the number, or the paper's name for it.

    Raises:
        ObjectError: none of the known objects is meant.
    """
    known = tuple(known)
    wanted = name.strip().lower().replace(" ", "_")
    if name in known:
        return name
    if ALIASES.get(wanted) in known:
        return ALIASES[wanted]
    matches = [full for full in known if full.lower() == wanted or full.lower().split("_", 1)[-1] == wanted]
    if len(matches) == 1:
        return matches[0]
    short = {full: alias for alias, full in ALIASES.items()}
    listing = ", ".join(f"{full} ({short[full]})" if full in short else full for full in known) or "none"
    raise ObjectError(f"there is no object {name!r}; there are {listing}.")


def load_object(name: str, folder: Path | None = None) -> ObjectSpec:
    """An object by any of its names.

    Args:
        name: official name, name without number, or the paper's name.
        folder: folder of real meshes (``NAME.obj``, ``NAME/textured_simple.obj`` or ``NAME/textured.obj``); None for the stand-in.

    Raises:
        ObjectError: unknown object, or no usable mesh of it in the folder.
    """
    if folder is None:
        return _stand_in(canonical_name(name))
    files = mesh_files(folder)
    try:
        full = canonical_name(name, files)
    except ObjectError as error:
        raise ObjectError(
            f"{error} (looked for meshes in {folder}; without that folder the built-in stand-ins are used)"
        ) from None
    return import_mesh(files[full], full)


def load_objects(names: Iterable[str], folder: Path | None = None) -> tuple[ObjectSpec, ...]:
    """Several objects, in that order; see :func:`load_object`."""
    return tuple(load_object(name, folder) for name in names)


_stand_in = lru_cache(maxsize=None)(stand_in)
