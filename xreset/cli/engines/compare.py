"""``xreset engines compare``: compare grasps in several engines."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from rich.text import Text

from xreset.cli._common import (
    AllEngines,
    Device,
    Objects,
    Robot,
    Several,
    Source,
    this_command,
    usable_engines,
)
from xreset.cli._terminal import Progress, console, show_table
from xreset.files import code_version, file_hash, write_json

if TYPE_CHECKING:
    from xreset.eval.engines import agreement


def compare(
    motion: Source,
    *,
    robot: Robot = None,
    objects: Objects = None,
    only: Several = (),
    backend: AllEngines = (),
    grasps: int = 48,
    device: Device = "cpu",
    json: Path | None = None,
) -> None:
    """Measure how far physics engines agree with MuJoCo on grasps. Exits with 1 if one misses a target.

    Press: a hand closes on an object that cannot move. Closing: a hand closes on an object on the table, lifts and
    shakes it. Hold: lift and shake from a common state. The column of MuJoCo at half the timestep shows how far two
    solutions of the same equations differ. MuJoCo-Warp is left out on a CPU, where it is slow, unless it is named.

    Args:
        motion: File with the grasps: of `xreset retarget`, or of `xreset demos`, which is retargeted first.
        only: Object to use; give it again for more. Default: all objects of the file.
        grasps: Number of closings, and of holds.
        json: File to write the results to.
    """
    from xreset.eval import trial
    from xreset.eval.engines import agreement
    from xreset.inputs import load_inputs

    names = [
        name for name in dict.fromkeys(backend) or usable_engines() if name != agreement.REFERENCE
    ]
    engines = [trial.engine(name, device=device) for name in names]
    if not backend:
        engines = [each for each in engines if not each.slow]
    with Progress() as bar:
        task = bar.add_task("retargeting")
        loaded = load_inputs(
            motion, robot=robot, objects=objects, only=only, accept=("demos", "motion")
        )
        grasped = loaded.motion(lambda done, total: bar.update(task, completed=done, total=total))
        # now: after minutes of work the file may be another, or gone
        inputs = {"motion": file_hash(motion)}
        result = agreement.compare(
            loaded.robot,
            loaded.objects,
            grasped,
            engines,
            grasps=grasps,
            progress=lambda doing, done, total: bar.update(
                task, description=doing, completed=done, total=total
            ),
        )
    _print(result)
    for tested in (result.reference, result.floor, *result.engines):
        if tested.broken:
            console.print(
                f"{tested.engine.name}: {tested.broken} worlds were not finite or dropped contacts",
                style="bold red",
            )
    if json is not None:
        write_json(
            json,
            result.as_dict()
            | {"xreset_version": code_version(), "command": this_command(), "inputs": inputs},
        )
        console.print(f"wrote {json}")
    if result.missed:
        console.print(f"missed: {'; '.join(result.missed)}", style="bold red")
        raise SystemExit(1)
    console.print("all targets met", style="bold green")


def _print(result: agreement.Parity) -> None:
    columns: tuple[agreement.EngineParity, ...] = (result.floor, *result.engines)
    holds = [flags for name, flags in result.reference.carried.items() if name != "closing"]
    held = sum(map(sum, holds))
    tried = sum(map(len, holds))
    reference = result.reference.engine.name
    heads = [
        f"{tested.engine.name}\n{tested.engine.version}, {tested.engine.device}"
        for tested in columns
    ]
    table: list[tuple[str | Text, ...]] = [(f"against {reference}", "target", *heads)]
    for i, row in enumerate(result.floor.metrics):
        cells = [_cell(tested.metrics[i]) for tested in columns]
        table.append((row.metric, f"{row.sense} {_number(row.target, row.unit)}", *cells))
    grasps = f"{result.robot.name}, {len(result.objects)} objects: {len(result.closing)} closings, {tried} holds"
    show_table(
        table,
        title=f"{grasps}, of which {reference} carries {sum(result.reference.carried['closing'])} and {held}",
    )


def _cell(metric: agreement.Metric) -> Text:
    style = "green" if metric.ok else "bold red"
    return Text.assemble((_number(metric.measured, metric.unit), style), f" (n = {metric.n})")


def _number(value: float | None, unit: str) -> str:
    if value is None:
        return "not measured"
    return f"{value:.3g} {unit}" if unit else f"{100 * value:.1f} %"


COMMAND = compare
