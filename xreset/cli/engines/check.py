"""``xreset engines check``: test physics engines."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.text import Text

from xreset.cli._common import AllEngines, Device, this_command, usable_engines
from xreset.cli._terminal import console
from xreset.errors import XResetError
from xreset.files import code_version, write_json
from xreset.plugins import backend_class, backend_status, make_backend
from xreset.spec import SceneSpec

if TYPE_CHECKING:
    from xreset.backends import conformance


def check(
    *,
    backend: AllEngines = (),
    robot: str | None = None,
    device: Device = "cpu",
    only: Annotated[tuple[str, ...], tyro.conf.arg(name="check"), tyro.conf.UseAppendAction] = (),
    json: Path | None = None,
    verbose: bool = False,
) -> None:
    """Test whether physics engines keep their contract. Exits with 1 if one does not.

    Args:
        robot: Name or folder of the robot to test with. Default: a gripper, with which every check can run.
        only: Check to run; give it again for more. Default: all.
        json: File to write the results to.
        verbose: Show every measured number, not only the one nearest to its tolerance.
    """
    from xreset import description
    from xreset.backends import conformance

    known = [c.name for c in conformance.CHECKS]
    if unknown := sorted(set(only) - set(known)):
        raise XResetError(f"Unknown check {', '.join(unknown)}. Choose from: {', '.join(known)}.")
    spec = description.load_robot(robot) if robot else conformance.scene().robot
    runs = []
    for name in dict.fromkeys(backend) or usable_engines():
        status = backend_status(name)
        used = device if device.split(":")[0] in status.device else "cpu"
        what = f" {status.version}, {spec.name}, {used}: verdict, check, and what came nearest to its tolerance"
        console.print(Text.assemble((name, "bold"), what))
        results = conformance.run(
            _maker(name, used), robot=spec, only=only or None, report=lambda r: _print(r, verbose)
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
    if json is not None:
        content = {
            "schema": conformance.SCHEMA,
            "xreset_version": code_version(),
            "command": this_command(),
        }
        write_json(json, content | {"runs": runs})
        console.print(f"wrote {json}")
    failed = 0
    for record in runs:
        failed += sum(result["verdict"] == "failed" for result in record["checks"])
    if failed:
        console.print(f"{failed} checks failed", style="bold red")
        raise SystemExit(1)
    console.print("no check failed", style="bold green")


def _maker(name: str, device: str) -> conformance.MakeBackend:
    """Return what builds worlds on a device. A few worlds run in this process, which is faster than to start others."""
    from xreset.backends import conformance, pool

    pooled = issubclass(backend_class(name), pool.PoolBackend)

    def make(scene: SceneSpec, num_worlds: int, **chosen: Any) -> Any:
        here = pooled and num_worlds != conformance.Bench.NUM_WORLDS and num_worlds <= 24
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


def _print(result: conformance.CheckResult, verbose: bool) -> None:
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
    return f"{measure.what}: {measure.measured:.2g}, tolerance {measure.tolerance:.2g} {measure.unit}".rstrip()


COMMAND = check
