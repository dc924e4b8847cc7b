"""``xreset engines``: list, check, compare, trace and attribute differences between physics engines."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any

from rich.text import Text
from tyro.conf import arg

from xreset.cli._common import (
    AllEngines,
    Device,
    Several,
    in_all_engines,
    in_quick_engines,
    usable_engines,
)
from xreset.cli._options import Output
from xreset.cli._terminal import console, show_table
from xreset.cli._verbs import verb
from xreset.eval import verbs
from xreset.files.storage import measured, write_json, write_whole
from xreset.physics.plugins import backend_class, backend_names, backend_status, make_backend
from xreset.spec import SceneSpec

if TYPE_CHECKING:
    from xreset.backends import conformance
    from xreset.eval.engines.agreement import Parity
    from xreset.eval.engines.attribution import Attribution
    from xreset.eval.engines.replay import TraceResult


def list_() -> None:
    """List physics engines: name, version, device, and why one cannot be used here."""
    table = [("engine", "version", "device", "available")]
    for name in backend_names():
        status = backend_status(name)
        available = "yes" if status.reason is None else f"no: {status.reason}"
        table.append((name, status.version or "-", status.device, available))
    show_table(table)


def check(
    *,
    engine: AllEngines = (),
    robot: str | None = None,
    device: Device = "cpu",
    only: Annotated[Several, arg(name="check")] = (),
    json: Output | None = None,
    page: Output | None = None,
    verbose: bool = False,
) -> None:
    """Test whether physics engines keep their contract. Exits with 1 if one does not.

    Args:
        robot: Name or folder of the robot to test with. Default: a gripper, with which every check can run.
        only: Check to run; give it again for more. Default: all.
        json: File to write the results to.
        page: Markdown page to write, with a table of the results.
        verbose: Show every measured number, not only the one nearest to its tolerance.
    """
    from xreset.backends import conformance
    from xreset.eval.engines import page as pages
    from xreset.geometry import description

    spec = description.load_robot(robot) if robot else conformance.scene().robot
    runs = []
    failed = 0
    for name in dict.fromkeys(engine) or usable_engines():
        status = backend_status(name)
        used = device if device.split(":")[0] in status.device else "cpu"
        make = _maker(name, used)  # refuses an unknown engine, so it comes before the headline
        what = f" {status.version}, {spec.name}, {used}: verdict, check, and what came nearest to its tolerance"
        console.print(Text.assemble((name, "bold"), what))
        results = conformance.run(
            make, robot=spec, only=only or None, report=lambda result: _print_check(result, verbose)
        )
        runs.append(
            {
                "engine": name,
                "engine_version": status.version,
                "robot": spec.name,
                "device": used,
                "capabilities": sorted(backend_class(name).capabilities),
                "seconds": round(sum(result.seconds for result in results), 3),
                "checks": [result.as_dict() for result in results],
            }
        )
        failed += sum(result.verdict == "failed" for result in results)
    found = measured({"schema": conformance.SCHEMA, "runs": runs})
    if json is not None:
        write_json(json, found)
        console.print(f"wrote {json}")
    if page is not None:
        write_whole(page, pages.page([found]))
        console.print(f"wrote {page}")
    if failed:
        console.print(f"{failed} checks failed", style="bold red")
        raise SystemExit(1)
    console.print("no check failed", style="bold green")


def _maker(name: str, device: str) -> conformance.MakeBackend:
    """Return the function that makes worlds on a device.

    The worlds that it makes first, which all checks share, run in processes of their own. Most others run in this one:
    a new process takes longer to start than their check takes.
    """
    from xreset.backends import pool

    pooled = issubclass(backend_class(name), pool.PoolBackend)
    shared = True

    def make(scene: SceneSpec, num_worlds: int, **chosen: Any) -> Any:
        nonlocal shared
        here = pooled and not shared and num_worlds <= 24
        shared = False
        options = {"workers": 0} if here else {}
        return make_backend(name, scene, num_worlds, device=device, **chosen, **options)

    return make


_STYLE = {
    "passed": "green",
    "known difference": "cyan",
    "failed": "bold red",
    "unsupported": "yellow",
    "skipped": "dim",
}


def _print_check(result: conformance.CheckResult, verbose: bool) -> None:
    detail = _text(result.worst) if result.measures else result.problem
    verdict = (f"{result.verdict:<16}", _STYLE[result.verdict])
    console.print(
        Text.assemble("  ", verdict, f" {result.name:<22} {result.seconds:5.1f} s  {detail}")
    )
    for measure in result.measures:
        if verbose or measure.verdict != "passed":
            console.print(f"{'':19}{measure.verdict}: {_text(measure)}")
            if measure.verdict == "known difference" and measure.known is not None:
                console.print(
                    f"{'':19}accepted up to {measure.known.bound:.3g}: {measure.known.reason}"
                )
    if result.verdict == "failed":
        console.print(f"{'':19}asserted: {result.check.statement}")
        if result.problem:
            console.print(f"{'':19}raised: {result.problem}")
        console.print(f"{'':19}likely: {result.check.cause}")


def _text(measure: conformance.Measure | None) -> str:
    if measure is None:
        return ""
    digits = 2 if measure.verdict == "passed" else 3
    measured, tolerance = (f"{x:.{digits}g}" for x in (measure.measured, measure.tolerance))
    if measured == tolerance:  # show on which side it is
        measured = f"{measure.measured:.6g}"
    text = f"{measure.what}: {measured}, tolerance {tolerance} {measure.unit}".rstrip()
    if measure.where and measure.verdict != "passed":
        text += f" ({measure.where})"
    return text


def _show_agreement(found: Parity, options: Mapping[str, Any]) -> None:
    _print(found)
    for tested in (found.reference, found.floor, *found.engines):
        if tested.broken_worlds:
            console.print(
                f"{tested.engine}: {tested.broken_worlds} worlds were not finite or dropped contacts",
                style="bold red",
            )
    if options["json"]:
        console.print(f"wrote {options['json']}")
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
        f"{result.robot}, {len(result.objects)} objects: {len(closings)} closings, {tried} holds"
    )
    show_table(table, title=f"{grasps}, of which {reference} carries {sum(closings)} and {held}")


def _number(value: float | None, unit: str) -> str:
    if value is None:
        return "not measured"
    return f"{value:.3g} {unit}" if unit else f"{100 * value:.1f} %"


def _show_trace(found: TraceResult, options: Mapping[str, Any]) -> None:
    from xreset.eval.engines import replay

    console.print(replay.rich_table(found))
    for sentence in replay.sentences(found):
        console.print(sentence)
    console.print(f"results in {options['out']}")


def _show_attribution(found: Attribution, options: Mapping[str, Any]) -> None:
    from xreset.eval.engines import attribution

    first = found.a
    counts = (
        f"episodes: {len(first.nominal)}, demonstrations: {first.nominal['sequence'].nunique()}, "
        f"seed: {first.seed}"
    )
    title = f"{first.policy} on {first.robot}: what costs the skill between {first.engine} and {found.b.engine}"
    console.print(attribution.rich_table(found, f"{title}\n{counts}"))
    for line in attribution.not_tried(found):
        console.print(line, style="dim")
    console.print(attribution.verdict(found))
    console.print(f"results in {found.folder}")


COMMAND = {
    "": list_,
    "check": check,
    "compare": verb(verbs.compare_engines, _show_agreement, prepare=in_quick_engines, engines=()),
    "trace": verb(verbs.trace_engines, _show_trace, prepare=in_all_engines, engines=()),
    "attribute": verb(verbs.attribute, _show_attribution),
}
