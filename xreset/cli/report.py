"""``xreset report``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from xreset.cli._terminal import Console, Progress
from xreset.eval import table
from xreset.eval.report import film as films
from xreset.eval.report import make
from xreset.policies import results_folder, shipped
from xreset.text import short_name


def report(
    run: Annotated[Path, tyro.conf.Positional],
    *,
    out: Path | None = None,
    robot: str | None = None,
    objects: Path | None = None,
    film: Path | None = None,
) -> None:
    """Make a self-contained HTML page of a run's evaluations, and one picture.

    Args:
        run: Run folder, a folder of results (of a baseline, for example), or name of a policy that ships with xreset: its runs/NAME.
        out: Folder for index.html and overview.png; default: report/ in the run folder.
        robot: Name or folder of the robot, for the clips; default: as the results name it.
        objects: Folder of real meshes, for the clips; default: as the results name it.
        film: Also write an mp4 with every object side by side, in all engines.
    """
    if not run.exists() and str(run) in shipped():
        run = results_folder(str(run))
    console = Console()
    with Progress(console) as bar:
        made = make.make_report(run, out, robot=robot, objects=objects, progress=bar.count("drawing clips"))
    console.print(table.results_table(made.summaries))
    console.print(made.headline)
    for note in made.notes:
        console.print(f"note: {note}", style="yellow")
    if film is not None:
        with Progress(console) as bar:
            shown = films.make_film(run, film, robot=robot, objects=objects, progress=bar.count("drawing the film"))
        rows, columns = ", ".join(shown.engines), ", ".join(map(short_name, shown.objects))
        console.print(f"film:    {film}\n         from above: {rows}; from the left: {columns}", soft_wrap=True)
    console.print(f"page:    {made.html}\npicture: {made.overview}", soft_wrap=True)


COMMAND = report
