"""``xreset engines``: list, check, compare, trace and attribute differences between physics engines."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from rich.text import Text
from tyro.conf import arg

from xreset.cli._common import (
    AllEngines,
    Device,
    Flat,
    Meshes,
    Robot,
    Several,
    Source,
    measured,
    quick_engines,
    usable_engines,
    write_measured,
)
from xreset.cli._options import Output
from xreset.cli._terminal import Progress, console, show_table
from xreset.cli._verbs import verb
from xreset.eval import verbs
from xreset.eval.setting import Place
from xreset.files.checks import NonNegativeInt, PositiveInt
from xreset.files.storage import file_hash, write_json, write_whole
from xreset.physics.plugins import backend_class, backend_names, backend_status, make_backend
from xreset.spec import SceneSpec

if TYPE_CHECKING:
    from xreset.backends import conformance
    from xreset.eval.engines import agreement
    from xreset.eval.engines.attribution import Attribution


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
    write_measured(json, found)
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


def compare(
    motion: Source,
    *,
    robot: Robot = None,
    meshes: Meshes = None,
    only: Several = (),
    engine: AllEngines = (),
    grasps: PositiveInt = 48,
    device: Device = "cpu",
    json: Output | None = None,
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
    from xreset.eval.engines import agreement
    from xreset.resets.inputs import load_inputs

    engines = [each for each in quick_engines(engine, device) if each.name != agreement.REFERENCE]
    with Progress() as bar:
        move = bar.stages()
        loaded = load_inputs(
            motion, robot=robot, meshes=meshes, only=only, accept=("demos", "motion")
        )
        grasped = loaded.motion(partial(move, "retargeting"))
        # hashed now, because after minutes of work the file may have changed
        inputs = {"motion": file_hash(motion)}
        result = agreement.compare(
            loaded.robot, loaded.objects, grasped, engines, grasps=grasps, progress=move
        )
    _print(result)
    for tested in (result.reference, result.floor, *result.engines):
        if tested.broken_worlds:
            console.print(
                f"{tested.engine}: {tested.broken_worlds} worlds were not finite or dropped contacts",
                style="bold red",
            )
    write_measured(json, asdict(result) | {"ok": not result.missed, "inputs": inputs})
    if result.missed:
        console.print(f"missed: {'; '.join(result.missed)}", style="bold red")
        raise SystemExit(1)
    console.print("all targets met", style="bold green")


def _print(result: agreement.Parity) -> None:
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


def trace(
    source: Source,
    *,
    engine: Several = (),
    reference: str = "mujoco",
    object: str | None = None,
    episode: NonNegativeInt = 0,
    place: Flat[Place] = Place(),
    out: Output = Path("runs/trace"),
) -> None:
    """Replay the same actions from the same state in several engines, and show when and by how much they diverge.

    Args:
        source: Source of the actions. Demonstrations or robot motion: an open-loop grasp and lift. The trace of an
            evaluation (eval/ENGINE.trace.npz): an episode of the policy.
        engine: Engine to compare with the reference; give it again for more. Default: all that can be used here.
        reference: Engine that the others are compared with.
        object: Object, if the source has several; default: the first.
        episode: Which of the object's grasps or recorded episodes.
        place: Robot, meshes, seed, device.
        out: Folder for trace.json.
    """
    from xreset.eval import rollout
    from xreset.eval.engines import actions, replay

    base = rollout.engine(reference, device=place.device)
    names = [name for name in dict.fromkeys(engine) or usable_engines() if name != reference]
    engines = [rollout.engine(name, device=place.device) for name in names]
    with Progress() as bar:
        move = bar.stages()
        move("actions")
        played = actions.from_file(source, place, object, episode)
        result = replay.trace(played, base, engines, seed=place.seed, progress=move)
        write_json(out / "trace.json", measured(result.as_dict()))
    console.print(replay.rich_table(result))
    for sentence in replay.sentences(result):
        console.print(sentence)
    console.print(f"results in {out}")


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
    "compare": compare,
    "trace": trace,
    "attribute": verb(verbs.attribute, _show_attribution),
}
