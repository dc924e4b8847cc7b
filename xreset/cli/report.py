"""``xreset report``."""

from __future__ import annotations

from pathlib import Path

from xreset.cli._common import Robot, Source
from xreset.cli._terminal import console, show_notes
from xreset.eval import table
from xreset.files.text import short_name
from xreset.policy.shipped import run_folder


def report(
    run: Source,
    *,
    out: Path | None = None,
    robot: Robot = None,
    meshes: Path | None = None,
    film: Path | None = None,
) -> None:
    """Make a self-contained HTML page of a run's evaluations.

    Args:
        run: Run folder, folder of results (for example of a baseline), or name of a policy that ships with xreset (then
            runs/NAME).
        out: Folder for index.html; default: report/ in the run folder.
        meshes: Folder of real meshes, for the clips; default: as the results name it.
        film: MP4 to write as well: every object in every engine, next to each other.
    """
    from xreset.eval.report import clips, make

    with console.status("drawing clips"):
        html, data = make.make_report(run_folder(run), out, robot=robot, meshes=meshes)
    console.print(table.results_table(list(data.training.results.values())))
    console.print(make.headline(data))
    show_notes(data.notes)
    if film is not None:
        with console.status("drawing the film"):
            shown = clips.make_film(data, film)
        rows = ", ".join(data.training.results)
        columns = ", ".join(map(short_name, shown))
        console.print(f"film: {film}\n      from the top: {rows}; from the left: {columns}")
    console.print(f"page: {html}")


COMMAND = report
