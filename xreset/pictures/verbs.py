"""Functions that are commands as well: their signatures are the options, and their docstrings the help.

They import most of what they need when they are called, because the help of a command is shown at once.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from xreset.errors import ObjectError, XResetError
from xreset.files.checks import NonNegativeInt, Output, Png, PngOrMp4, Port, obeys_rules
from xreset.files.progress import NamedProgress, unseen
from xreset.files.storage import write_whole
from xreset.files.text import quantity
from xreset.objects.properties import Properties

if TYPE_CHECKING:
    from xreset.objects.meshes import Import
    from xreset.pictures.view.data import View
else:  # what a command prints
    Import = View = Any

_warn = logging.getLogger(__name__).warning


@obeys_rules
def view(
    file: str | Path,
    *,
    demos: str | Path | None = None,
    meshes: str | Path | None = None,
    robot: str | Path | None = None,
    sequence: NonNegativeInt | None = None,
    frame: NonNegativeInt | None = None,
    host: str = "127.0.0.1",
    port: Port = 8080,
    out: PngOrMp4 | None = None,
    say: Callable[[str], None] = print,
    note: Callable[[str], None] = _warn,
    progress: NamedProgress = unseen,
) -> None:
    """Show demonstrations, robot motion, a reset bank or a goal set in a browser, or write pictures of them.

    In an invalid frame, the robot has the color of the reason. The object's goal is green. Human keypoints are
    pink, keypoints in contact are yellow, the robot's fingertips are blue.

    Args:
        file: demonstrations, or a file of xreset retarget, xreset resets or xreset goals.
        demos: demonstrations that the file was made from, to show the human hand with the robot.
        meshes: folder of real meshes; default: as the file names it, else the stand-ins.
        robot: name or folder of the robot; default: the file's.
        sequence: index of the sequence, from 0. Default: the first; in a bank, all sequences.
        frame: index of the frame in the sequence (or of the state in the bank). Default: the first one with a hand;
            for a picture the middle one.
        host: address to serve at; 0.0.0.0 allows other machines.
        port: port to serve at; if it is taken, the next free one.
        out: file to write in place of a page: a picture (.png), or a film of the sequence (.mp4).
        say: called with the address of the page, or with what the picture shows.
        note: called with each doubt about the demonstrations.
        progress: called with ("drawing", frames of the film drawn, frames in all).

    Raises:
        XResetError: a file, the robot or an object cannot be used, the files do not belong together, or the server does
            not start.
    """
    from xreset.pictures.view.load import load_view

    shown = load_view(file, demos=demos, robot=robot, meshes=meshes)
    for text in shown.notes:
        note(text)
    if out is None:
        _serve(shown, host, port, sequence, frame, say)
        return
    path = Path(out)
    if frame is not None and path.suffix.lower() == ".mp4":
        raise XResetError(
            "A film has all frames of a sequence. Leave out the frame, or end the name in .png."
        )
    rows = shown.some_rows(sequence, frame)
    if path.suffix.lower() == ".png":
        _write_png(path, shown, rows, frame, say)
    else:
        _write_mp4(path, shown, rows, say, progress)


def _serve(
    shown: View,
    host: str,
    port: int,
    sequence: int | None,
    frame: int | None,
    say: Callable[[str], None],
) -> None:
    from xreset.pictures.view import page, server

    opened = page.Page(shown, host=host, port=port, sequence=sequence, frame=frame)
    number = opened.url.rpartition(":")[2]
    sequences = quantity(len(shown.sequence_name), "sequence")
    row = "frame" if shown.is_motion else shown.kind.removesuffix("s")
    say(f"{sequences}, {quantity(len(shown.frame), row)} at {opened.url}")
    tunnel = f"ssh -L {number}:localhost:{number} THIS_MACHINE"
    say(f"From another machine: {tunnel}, then open the same address. Ctrl-C ends.")
    server.serve_until_interrupted(opened)


def _write_png(
    path: Path, shown: View, rows: np.ndarray, frame: int | None, say: Callable[[str], None]
) -> None:
    from xreset.pictures.render import write_png
    from xreset.pictures.view.picture import Drawer

    row = int(rows[len(rows) // 2 if frame is None else frame])
    write_png(path, Drawer(shown, size=(960, 720), smooth=True).draw(row))
    say("\n".join((*shown.text(row), f"picture in {path}")))


def _write_mp4(
    path: Path,
    shown: View,
    rows: np.ndarray,
    say: Callable[[str], None],
    progress: NamedProgress,
) -> None:
    from xreset.pictures.render import encode_mp4
    from xreset.pictures.view.picture import Drawer

    say(f"drawing {quantity(len(rows), 'frame')}")
    draw = Drawer(shown).draw

    def frames() -> Iterator[np.ndarray]:
        for i, row in enumerate(rows):
            progress("drawing", i, len(rows))
            yield draw(int(row))

    write_whole(path, encode_mp4(frames(), shown.rate))
    say(f"{quantity(len(rows), 'frame')} in {path}")


@obeys_rules
def import_objects(
    path: str | Path,
    *,
    out: Output | None = None,
    name: str | None = None,
    scale: float = 1.0,
    mass: float | None = None,
    friction: float | None = None,
    picture: Png | None = None,
    progress: NamedProgress = unseen,
) -> list[Import]:
    """Cut a mesh, or every mesh of a folder, into convex pieces, and keep them for later runs.

    A mesh file NAME.stl goes into a folder of objects (--out), which other commands take as --meshes. NAME.toml in this
    folder holds mass or density, friction, and the tolerance of the pieces; after a change, import the folder again.
    The name of a built-in object puts it into such a folder as well.

    Args:
        path: a mesh file; or a folder with NAME.obj, NAME/textured_simple.obj or NAME/textured.obj, in metres, in the
            frame of the object poses; or the name of a built-in object.
        out: folder of objects, for a mesh file or a built-in object.
        name: name of the object in this folder; default: the name of the file.
        scale: length of a unit of the file in metres: 0.001 for millimetres.
        mass: mass in kg.
        friction: friction coefficient: the middle of the range that training and evaluation draw from.
        picture: PNG to write: the meshes next to their pieces, with the deviation in millimetres.
        progress: called with (the mesh that is cut, meshes done, meshes in all).

    Raises:
        ObjectError: a mesh cannot be used, or options do not fit together.
    """
    from xreset.objects import catalogue, meshes, procedural
    from xreset.pictures import pieces, render

    path = Path(path)
    try:
        properties = Properties(mass=mass, friction=friction)
    except ValueError as error:
        raise ObjectError(f"{error}.") from error
    described = (name, scale, properties) != (None, 1.0, Properties())
    built_in = catalogue.official_name(str(path))
    if path.is_dir():
        if out is not None or described:
            raise ObjectError(
                f"{path} is a folder. --out, --name, --scale, --mass and --friction are for one mesh file. For a "
                "folder, write mass and friction into NAME.toml next to each mesh."
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
                f"{path} is a built-in object. --name, --scale, --mass and --friction are for mesh files; edit "
                "NAME.toml in the folder instead."
            )
        written = procedural.write_stand_in(built_in, out)
        out = None  # it is there
        files = {built_in: written}
    else:
        files = {name or path.stem: path}
    found = []
    for object_name, file in files.items():
        progress(f"{object_name} ({file})", len(found), len(files))
        if out is None:
            result = meshes.import_with_notes(file, object_name)
        else:
            result = meshes.add_mesh(
                file, Path(out), object_name, scale=scale, properties=properties
            )
        found.append(result)
    if picture is not None:
        captions = []
        for result in found:
            deviation = f"at most {1e3 * result.deviation:.1f} mm off the surface"
            count = quantity(len(result.obj.pieces), "piece")
            captions.append(f"{result.obj.name}: {count}, {deviation}")
        objects = [result.obj for result in found]
        render.write_png(Path(picture), pieces.draw_pieces(objects, captions))
    return found
