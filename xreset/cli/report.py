"""``xreset report``."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from xreset.cli._common import Names, Robot, Several
from xreset.cli._options import Mp4, Output
from xreset.cli._terminal import console, show_notes
from xreset.files.text import short_name


def report(
    runs: Names,
    *,
    out: Output | None = None,
    robot: Robot = None,
    meshes: Path | None = None,
    x: Literal["minutes", "steps", "iterations"] | None = None,
    curve: Several = (),
    apart: bool = False,
    film: Mp4 | None = None,
) -> None:
    """Make a self-contained HTML page of a run's evaluations, or of several runs side by side.

    Runs that differ only in their seed share a row of the table and a curve, with a band from the lowest to the highest
    run. Notes say what makes runs incomparable, such as different demonstrations or versions of an engine.

    Args:
        runs: Run folders, folders of results (of a baseline, for example) or names of policies that ship with xreset
            (then runs/NAME); LABEL=FOLDER gives one a name.
        out: Folder for index.html and results.csv; default: report/ in the folder of a single run, runs/report for
            several.
        meshes: Folder of real meshes, for the films; default: as the results name it.
        x: Horizontal axis of the learning curves; default: minutes as measured, or iterations if they are not known.
        curve: Learning curve to draw, as TensorBoard names it (task/grasped_from_home, episode/length, ...); give it
            again for more. Default: success, success from home, grasps and return.
        apart: Show runs that differ only in their seed separately.
        film: MP4 to write as well: every object in every run and engine, next to each other.
    """
    from xreset.eval import table
    from xreset.eval.report import clips, make

    with console.status("drawing films"):
        page, found = make.make_report(
            runs, out, robot=robot, meshes=meshes, x=x, curves=curve, apart=apart
        )
    for training in found.evaluated:
        console.print(table.results_table(list(training.results.values())))
    console.print(make.headline(found.evaluated))
    show_notes(found.notes)
    if film is not None:
        with console.status("drawing the film"):
            shown = clips.make_film(found.evaluated, film, robot=robot, meshes=meshes)
        places = []
        for training in found.evaluated:
            places += [f"{training.label} in {engine}" for engine in training.results]
        columns = ", ".join(map(short_name, shown))
        console.print(
            f"film: {film}\n      from the top: {', '.join(places)}; from the left: {columns}"
        )
    console.print(f"page: {page}")


COMMAND = report
