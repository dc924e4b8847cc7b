"""``xreset objects``: list, import, make."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from xreset.cli._terminal import console, show_table
from xreset.cli._verbs import verb
from xreset.files.text import quantity
from xreset.objects import verbs
from xreset.pictures import verbs as pictures
from xreset.spec import ObjectSpec

if TYPE_CHECKING:
    from xreset.objects.meshes import Import


def list_(*, meshes: Path | None = None) -> None:
    """List the built-in objects, or the objects of a folder of meshes (--meshes FOLDER).

    Args:
        meshes: Folder of real meshes; default: the built-in stand-ins.
    """
    from xreset.objects import catalogue

    table = [_HEAD]
    for name in catalogue.object_names(meshes):
        table.append(_cells(catalogue.load_object(name, meshes)))
    show_table(table)


def _show_imported(found: Sequence[Import], options: Mapping[str, Any]) -> None:
    table = [(*_HEAD, "mass from", "deviation, mm")]
    for result in found:
        table.append((*_cells(result.obj), result.mass_source, f"{1e3 * result.deviation:.1f}"))
    show_table(table)
    for result in found:
        for note in (*result.notes, result.hollows()):
            if note:
                console.print(f"{result.obj.name}: {note}")
    if options["picture"]:
        console.print(f"{options['picture']}: meshes and their pieces")


_HEAD: tuple[str, ...] = ("object", "alias", "kg", "size, mm", "pieces")


def _cells(obj: ObjectSpec) -> tuple[str, ...]:
    from xreset.objects import sampling, ycb

    low, high = sampling.bounding_box(obj)
    kinds = {piece.geometry.kind for piece in obj.pieces}
    return (
        obj.name,
        ycb.ALIAS_OF.get(obj.name, ""),
        f"{obj.mass:.3g}",
        "x".join(f"{1000 * size:.{1 if size < 0.01 else 0}f}" for size in high - low),
        f"{len(obj.pieces)} {' + '.join(sorted(kinds))}",
    )


def _show_made(written: Sequence[Path], options: Mapping[str, Any]) -> None:
    console.print(f"{options['out']}: {quantity(len(written), 'shape')}")


COMMAND = {
    "": list_,
    "import": verb(pictures.import_objects, _show_imported),
    "make": verb(verbs.make_shapes, _show_made),
}
