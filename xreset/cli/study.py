"""``xreset study``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from xreset.cli._common import Name, Several
from xreset.cli._options import Output
from xreset.cli._terminal import console, show_notes
from xreset.errors import RunError
from xreset.eval.study import file as files

if TYPE_CHECKING:
    from xreset.eval.study import plan


def study(
    file: Name,
    *,
    data: Path = Path("data"),
    out: Output = Path("runs/studies"),
    run: Several = (),
    only: Literal["all", "data", "train", "eval", "tables"] = "all",
    dry_run: bool = False,
) -> None:
    """Run the missing steps of a study: reset banks, trainings, evaluations, and tables next to the paper's.

    Steps run one after another. After a stop, the same command continues; finished steps are not repeated. Studies with
    the same --out share their runs.

    Args:
        file: Study file, or name of a study that ships with xreset.
        data: Folder with the study's demonstrations and meshes.
        out: Folder for all output.
        run: Only these runs of the study; give it again for more. Default: all.
        only: Kind of steps to run: reset banks, trainings, evaluations or tables.
        dry_run: Print the plan and its commands, and run nothing.
    """
    from xreset.eval.study import launch, plan, report

    path = files.study_path(file)

    def planned() -> plan.Plan:
        return plan.make_plan(files.read_study(path), path.stem, given=data, out=out, only=run)

    todo = planned()
    wanted = [step for step in todo.steps.values() if only in ("all", step.kind)]
    if dry_run:
        for step in wanted:
            left, commands = step.todo()
            after = [need for need in step.needs if todo.steps[need].left()]
            waits = f" (after {', '.join(after)})" if after else ""
            console.print(f"{step.name}: {left or 'done'}{waits}")
            for command in commands:
                console.print(f"    {launch.shown_command(command)}")
        return
    problems = []
    if only != "tables":
        for subset in todo.subsets():
            subset.make()
        undone = [step for step in wanted if step.left()]
        problems = launch.launch(todo, undone, console.print)
    if only in ("all", "tables"):
        written = report.write_page(planned(), out / "reports" / todo.name)
        show_notes(written.notes)
        console.print(f"page: {written.page}")
    if problems:
        raise RunError(
            "\n".join([f"{len(problems)} steps failed. Finished steps are kept.", *problems])
        )


COMMAND = study
