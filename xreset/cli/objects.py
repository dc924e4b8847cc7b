"""``xreset objects``: list, import."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from rich.table import Table

    from xreset.spec import ObjectSpec


def list_(*, objects: Path | None = None) -> None:
    """List the built-in objects, or the objects of a folder of meshes.

    Args:
        objects: Folder of real meshes; default: the built-in stand-ins.
    """
    from xreset.cli._terminal import Console
    from xreset.objects import load_object, object_names

    table = _table()
    for name in object_names(objects):
        table.add_row(*_cells(load_object(name, objects)))
    Console().print(table)


def import_(folder: Annotated[Path, tyro.conf.Positional]) -> None:
    """Cut every mesh of a folder into convex pieces, and keep them for later runs.

    Args:
        folder: Folder with NAME.obj, NAME/textured_simple.obj or NAME/textured.obj; in metres, in the frame of the object poses.
    """
    from xreset.cli._terminal import Console
    from xreset.objects.meshes import import_with_notes, mesh_files

    console = Console()
    table = _table("time")
    notes = []
    files = mesh_files(folder)
    with console.status("") as status:
        for name, path in files.items():
            status.update(f"{name} ({path})")
            result = import_with_notes(path, name)
            table.add_row(*_cells(result.obj), "cached" if result.cached else f"{result.seconds:.1f} s")
            notes += [f"{name}: {note}" for note in result.notes]
    console.print(table)
    for note in notes:
        console.print(note, highlight=False)


def _table(*more: str) -> Table:
    from rich.table import Table

    table = Table()
    for column in ("object", "alias"):
        table.add_column(column, no_wrap=True)
    for column in ("kg", "size, mm", "pieces"):
        table.add_column(column, justify="right", no_wrap=True)
    table.add_column("source", overflow="fold")
    for column in more:
        table.add_column(column, justify="right")
    return table


def _cells(obj: ObjectSpec) -> tuple[str, ...]:
    from xreset.objects import bounding_box
    from xreset.objects.catalogue import ALIASES

    low, high = bounding_box(obj)
    kinds = {piece.geometry.kind for piece in obj.pieces}
    return (
        obj.name,
        next((alias for alias, name in ALIASES.items() if name == obj.name), ""),
        f"{obj.mass:.3f}",
        "x".join(f"{1000 * length:.0f}" for length in high - low),
        f"{len(obj.pieces)} {' + '.join(sorted(kinds))}",
        obj.source if obj.source == "stand-in" else f"mesh {obj.source[:8]}",
    )


COMMAND = {"list": list_, "import": import_}
