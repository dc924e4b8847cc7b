"""``xreset view``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.progress import track

from xreset.cli._common import Host, Meshes, Port, Robot, Source
from xreset.cli._options import Mp4, Png
from xreset.cli._terminal import console, show_notes
from xreset.errors import XResetError
from xreset.files.checks import NonNegativeInt
from xreset.files.storage import write_whole
from xreset.pictures.view import data


def view(
    file: Source,
    *,
    demos: Path | None = None,
    meshes: Meshes = None,
    robot: Robot = None,
    sequence: NonNegativeInt | None = None,
    frame: NonNegativeInt | None = None,
    host: Host = "127.0.0.1",
    port: Port = 8080,
    png: Png | None = None,
    mp4: Mp4 | None = None,
) -> None:
    """Show demonstrations, robot motion, a reset bank or a goal set in a browser, or write pictures of them.

    In an invalid frame, the robot has the color of the reason. The object's goal is green. Human keypoints are
    pink, keypoints in contact are yellow, the robot's fingertips are blue.

    Args:
        file: Demonstrations, or a file of `xreset retarget`, `xreset resets` or `xreset goals`.
        demos: Demonstrations that the file was made from, to show the human hand with the robot.
        sequence: Index of the sequence, from 0. Default: the first; in a bank, all sequences.
        frame: Index of the frame in the sequence (or of the state in the bank). Default: the first one with a hand;
            for --png the middle one.
        png: Picture to write, instead of a page.
        mp4: Film of the sequence to write, instead of a page.
    """
    from xreset.pictures.view import load

    shown = load.load_view(file, demos=demos, robot=robot, meshes=meshes)
    show_notes(shown.notes)
    if png is None and mp4 is None:
        _serve(shown, host, port, sequence, frame)
        return
    rows = shown.choose(sequence=sequence if sequence is not None or not shown.is_motion else 0)
    if png is not None:
        _write_png(png, shown, rows, frame)
    if mp4 is not None:
        _write_mp4(mp4, shown, rows)


def _serve(shown: data.View, host: str, port: int, sequence: int | None, frame: int | None) -> None:
    from xreset.pictures.view import page, server

    opened = page.Page(shown, host=host, port=port, sequence=sequence, frame=frame)
    number = opened.url.rpartition(":")[2]
    print(
        f"{len(shown.sequence_name)} sequences, {len(shown.frame)} {shown.kind} at {opened.url}",
        flush=True,
    )
    tunnel = f"ssh -L {number}:localhost:{number} THIS_MACHINE"
    print(f"From another machine: {tunnel}, then open the same address. Ctrl-C ends.", flush=True)
    server.serve_until_interrupted(opened)


def _write_png(path: Path, shown: data.View, rows: np.ndarray, frame: int | None) -> None:
    from xreset.pictures import render
    from xreset.pictures.view import picture

    chosen = len(rows) // 2 if frame is None else frame
    if not 0 <= chosen < len(rows):
        raise XResetError(f"Frame {chosen} does not exist. Choose one from 0 to {len(rows) - 1}.")
    render.write_png(
        path, picture.Drawer(shown, size=(960, 720), smooth=True).draw(int(rows[chosen]))
    )
    print("\n".join((*shown.text(int(rows[chosen])), f"picture in {path}")))


def _write_mp4(path: Path, shown: data.View, rows: np.ndarray) -> None:
    from xreset.pictures import render
    from xreset.pictures.view import picture

    if not len(rows):
        raise XResetError("This sequence has no state to film. Choose another one with --sequence.")
    draw = picture.Drawer(shown).draw
    frames = [draw(int(row)) for row in track(rows, "drawing", console=console, transient=True)]
    film = render.encode_mp4(np.stack(frames), shown.rate)
    write_whole(path, film)
    print(f"{len(rows)} frames in {path}")


COMMAND = view
