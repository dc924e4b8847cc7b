"""``xreset objects``: list, import, make."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.text import Text

from xreset.cli._common import Source
from xreset.cli._options import Output, Png
from xreset.cli._terminal import console, show_table
from xreset.cli._verbs import verb
from xreset.errors import ObjectError
from xreset.objects import verbs
from xreset.objects.properties import Properties
from xreset.spec import ObjectSpec


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


def import_(
    path: Source,
    *,
    out: Output | None = None,
    name: str | None = None,
    scale: float = 1.0,
    mass: float | None = None,
    density: float | None = None,
    friction: float | None = None,
    tolerance: float | None = None,
    png: Png | None = None,
) -> None:
    """Cut a mesh, or every mesh of a folder, into convex pieces, and keep them for later runs.

    A mesh file goes into a folder of objects (--out), which other commands take as --meshes. NAME.toml in this folder
    holds mass and friction. The name of a built-in object puts it into such a folder as well.

    Args:
        path: A mesh file; or a folder with NAME.obj, NAME/textured_simple.obj or NAME/textured.obj, in metres, in the
            frame of the object poses; or the name of a built-in object.
        out: Folder of objects, for a mesh file or a built-in object.
        name: Name of the object in this folder; default: the name of the file.
        scale: Length of a unit of the file in metres: 0.001 for millimetres.
        mass: Mass in kg.
        density: Density in kg/m^3, instead of the mass.
        friction: Friction coefficient: the middle of the range that training and evaluation draw from.
        tolerance: Largest deviation of the pieces from the surface, in metres; default: 0.002.
        png: Picture to write: the meshes next to their pieces, with the deviation in millimetres.
    """
    from xreset.objects import catalogue, meshes, procedural
    from xreset.pictures import pieces, render

    try:
        properties = Properties(mass=mass, density=density, friction=friction, tolerance=tolerance)
    except ValueError as error:
        raise ObjectError(f"{error}.") from error
    described = (name, scale, properties) != (None, 1.0, Properties())
    built_in = catalogue.official_name(str(path))
    if path.is_dir():
        if out is not None or described:
            raise ObjectError(
                f"{path} is a folder. --out, --name, --scale, --mass, --density, --friction and --tolerance are for one"
                " mesh file. For a folder, write these properties into NAME.toml next to each mesh."
            )
        files = catalogue.mesh_files(path)
    elif not path.exists() and built_in not in catalogue.object_names():
        raise ObjectError(
            f"There is no {path}. Expected a mesh file, a folder of objects, or a built-in object (xreset objects)."
        )
    elif out is None:
        raise ObjectError(f"{path} needs a folder of objects to go into. Add --out.")
    elif not path.exists():
        if described:
            raise ObjectError(
                f"{path} is a built-in object. --name, --scale, --mass, --density, --friction and --tolerance are for "
                "mesh files; edit NAME.toml in the folder instead."
            )
        written = procedural.write_stand_in(built_in, out)
        out = None  # it is there
        files = {built_in: written}
    else:
        files = {name or path.stem: path}
    table = [(*_HEAD, "mass from", "deviation, mm")]
    found = []
    with console.status("") as status:
        for object_name, file in files.items():
            status.update(Text(f"{object_name} ({file})"))
            if out is None:
                result = meshes.import_with_notes(file, object_name)
            else:
                result = meshes.add_mesh(file, out, object_name, scale=scale, properties=properties)
            table.append((*_cells(result.obj), result.mass_source, f"{1e3 * result.deviation:.1f}"))
            found.append(result)
    show_table(table)
    for result in found:
        for note in (*result.notes, result.hollows()):
            if note:
                console.print(f"{result.obj.name}: {note}")
    if png is not None:
        captions = []
        for result in found:
            deviation = f"at most {1e3 * result.deviation:.1f} mm off the surface"
            captions.append(f"{result.obj.name}: {len(result.obj.pieces)} pieces, {deviation}")
        render.write_png(png, pieces.draw_pieces([result.obj for result in found], captions))
        console.print(f"{png}: meshes and their pieces")


_HEAD: tuple[str, ...] = ("object", "alias", "kg", "size, mm", "pieces")


def _cells(obj: ObjectSpec) -> tuple[str, ...]:
    from xreset.objects import sampling, ycb

    low, high = sampling.bounding_box(obj)
    kinds = {piece.geometry.kind for piece in obj.pieces}
    return (
        obj.name,
        ycb.ALIAS_OF.get(obj.name, ""),
        f"{obj.mass:.3g}",
        "x".join(f"{1000 * length:.0f}" for length in high - low),
        f"{len(obj.pieces)} {' + '.join(sorted(kinds))}",
    )


def _show_made(written: Sequence[Path], options: Mapping[str, Any]) -> None:
    console.print(f"{options['out']}: {len(written)} shapes")


COMMAND = {"": list_, "import": import_, "make": verb(verbs.make_shapes, _show_made)}
