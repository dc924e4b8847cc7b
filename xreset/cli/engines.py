"""``xreset engines``: list, check and compare physics engines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rich.text import Text

from xreset.cli._common import in_all_engines, in_quick_engines
from xreset.cli._terminal import console, show_table
from xreset.cli._verbs import verb
from xreset.eval.engines import verbs
from xreset.files.text import quantity
from xreset.physics.plugins import backend_names, backend_status

if TYPE_CHECKING:
    from xreset.eval.engines.agreement import Parity


def list_() -> None:
    """List physics engines: name, version, device, and why one cannot be used here."""
    table = [("engine", "version", "device", "available")]
    for name in backend_names():
        status = backend_status(name)
        available = "yes" if status.reason is None else f"no: {status.reason}"
        table.append((name, status.version or "-", status.device, available))
    show_table(table)


def _show_checks(runs: Sequence[Mapping[str, Any]], options: Mapping[str, Any]) -> None:
    if options["out"]:
        console.print(f"wrote {options['out']}")
    verdicts = []
    for run in runs:
        verdicts += [check["verdict"] for check in run["checks"]]
    if failed := verdicts.count("failed"):
        console.print(f"{quantity(failed, 'check')} failed", style="bold red")
        raise SystemExit(1)
    console.print("no check failed", style="bold green")


def _show_agreement(found: Parity, options: Mapping[str, Any]) -> None:
    _print(found)
    for tested in (found.reference, found.floor, *found.engines):
        if tested.broken_worlds:
            console.print(
                f"{tested.engine}: {tested.broken_worlds} worlds were not finite or dropped contacts",
                style="bold red",
            )
    if options["out"]:
        console.print(f"wrote {options['out']}")
    if found.missed:
        console.print(f"missed: {'; '.join(found.missed)}", style="bold red")
        raise SystemExit(1)
    console.print("all targets met", style="bold green")


def _print(result: Parity) -> None:
    columns = (result.floor, *result.engines)
    holds = dict(result.reference.carried)
    closings = holds.pop("closing")
    held = sum(map(sum, holds.values()))
    tried = sum(map(len, holds.values()))
    reference = result.reference.engine
    heads = [f"{tested.engine}\n{tested.version}, {tested.device}" for tested in columns]
    table: list[tuple[str | Text, ...]] = [(f"against {reference}", "target", *heads)]
    for i, row in enumerate(result.floor.metrics):
        cells = []
        for tested in columns:
            metric = tested.metrics[i]
            style = "green" if metric.ok else "bold red"
            number = (_number(metric.measured, metric.unit), style)
            cells.append(Text.assemble(number, f" (n = {metric.n})"))
        table.append((row.metric, f"{row.sense} {_number(row.target, row.unit)}", *cells))
    grasps = (
        f"{result.robot}, {quantity(len(result.objects), 'object')}: {quantity(len(closings), 'closing')}, "
        f"{quantity(tried, 'hold')}"
    )
    show_table(table, title=f"{grasps}, of which {reference} carries {sum(closings)} and {held}")


def _number(value: float | None, unit: str) -> str:
    if value is None:
        return "not measured"
    return f"{value:.3g} {unit}" if unit else f"{100 * value:.1f} %"


COMMAND = {
    "": list_,
    "check": verb(verbs.check_engines, _show_checks, prepare=in_all_engines, engine=()),
    "compare": verb(verbs.compare_engines, _show_agreement, prepare=in_quick_engines, engine=()),
}
