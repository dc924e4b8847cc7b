"""``xreset compare``."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from xreset.cli._common import Names, Several
from xreset.cli._terminal import console


def compare(
    runs: Names,
    *,
    x: Literal["minutes", "steps", "iterations"] = "minutes",
    curve: Several = (),
    apart: bool = False,
    out: Path = Path("runs/compare"),
) -> None:
    """Compare trainings: learning curves, first success from home, task progress in every engine, and configurations.

    Runs that differ only in their seed share a curve, with a band from the lowest to the highest run, and a row of the
    table. Notes say what makes the comparison unfair, such as different demonstrations or versions of an engine.

    Args:
        runs: Run folders, folders of results (of a baseline, for example) or names of policies that ship with xreset;
            LABEL=FOLDER gives one a name.
        x: Horizontal axis of the curves: minutes of training as measured, environment steps or iterations.
        curve: Learning curve to draw, as TensorBoard names it (task/grasped_from_home, episode/return, ...); give it
            again for more. Default: task/success and task/success_from_home.
        apart: Show runs that differ only in their seed separately.
        out: Folder for compare.md, compare.png and compare.csv.
    """
    from rich.markdown import Markdown

    from xreset.eval.report import make

    with console.status("reading"):
        page = make.compare(runs, out, x=x, curves=curve, apart=apart)
    console.print(Markdown(page.read_text()))
    console.print(f"page: {page}")


COMMAND = compare
