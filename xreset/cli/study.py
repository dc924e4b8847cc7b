"""``xreset study``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

from xreset.cli._terminal import Console
from xreset.errors import RunError
from xreset.eval.study import file as files
from xreset.eval.study import launch, plan, report


def study(
    file: Annotated[str, tyro.conf.Positional],
    *,
    data: Path = Path("data"),
    out: Path = Path("runs/studies"),
    run: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = (),
    only: Literal["all", "data", "train", "eval", "tables"] = "all",
    cluster: Literal["local", "slurm"] = "local",
    per_gpu: int = 1,
    slurm: tuple[str, ...] = (),
    dry_run: bool = False,
) -> None:
    """Do what is missing of a study: reset banks, trainings, evaluations, tables beside the paper's.

    After a kill the same command goes on; what is done is not done again. Folders of the same --out are shared between studies.

    Args:
        file: Study file, or name of a study that ships with xreset.
        data: Folder that the study's demonstrations and meshes are relative to.
        out: Folder for everything that is made.
        run: Only these runs of the study; give it again for more. Default: all.
        only: What to do: reset banks, trainings, evaluations or tables.
        cluster: Where trainings run: as processes on this machine, on its GPUs, or as jobs of Slurm.
        per_gpu: Trainings at a time on each GPU of this machine.
        slurm: Options of sbatch as submitit names them, such as partition=gpu time=600 (minutes) cpus_per_task=16.
        dry_run: Print the plan and its commands; do nothing.
    """
    if slurm and cluster != "slurm":
        raise RunError("--slurm goes with --cluster slurm.")
    if wrong := [text for text in slurm if "=" not in text]:
        raise RunError(f"--slurm {wrong[0]} is not KEY=VALUE.")
    options = {
        key: int(value) if value.isdecimal() else value for key, _, value in (text.partition("=") for text in slurm)
    }
    path, console = files.study_path(file), Console()

    def planned() -> plan.Plan:
        return plan.make_plan(files.read_study(path), path.stem, given=data, out=out, only=run)

    todo = planned()
    wanted = [step for step in todo.steps.values() if only in ("all", step.kind)]
    if dry_run:
        for name, state, on, after in report.plan_rows(todo, [step.name for step in wanted]).body:
            console.print(
                f"{name}: {state} ({on}{', after ' + after if after else ''})", highlight=False, soft_wrap=True
            )
            for command in [] if todo.steps[name].done() else todo.steps[name].commands():
                console.print(f"    {launch.shown_command(command)}", highlight=False, soft_wrap=True)
        return
    problems = []
    if only != "tables":
        for subset in todo.subsets:
            subset.make()
        problems = launch.launch(
            todo, [step for step in wanted if not step.done()], cluster=cluster, per_gpu=per_gpu, options=options,
            say=lambda line: console.print(line, highlight=False, soft_wrap=True),
        )  # fmt: skip
    if only in ("all", "tables"):
        page = report.write_page(planned(), out / "reports" / todo.name)
        for note in page.notes:
            console.print(f"note: {note}", style="yellow")
        console.print(f"page: {page.path}", soft_wrap=True)
    if problems:
        raise RunError("\n".join([f"{len(problems)} steps are not done; what is done is kept.", *problems]))


COMMAND = study
