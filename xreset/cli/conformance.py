"""``xreset conformance``: whether physics engines keep the contracts of the interface."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from rich.console import Console

    from xreset.backends.conformance import CheckResult, MakeBackend, Measure


def conformance(
    *,
    backend: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = (),
    robot: str | None = None,
    device: str = "cpu",
    check: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = (),
    json: Path | None = None,
    verbose: bool = False,
) -> None:
    """Test that physics engines keep the contracts of the interface. Exits with 1 if one does not.

    Args:
        backend: Engine to test, a plugin's too; give it again for several. Default: all that can be used here.
        robot: Robot to test with, a name or a folder. Default: a small one of the suite's own, with which every check can run.
        device: Where engines run that can run on GPUs: cpu or cuda.
        check: Check to run; give it again for several. Default: all.
        json: File to write the results to.
        verbose: Show every number that was measured, not only the one nearest to its tolerance.
    """
    from rich.console import Console

    from xreset import robots
    from xreset.backends import backend_status
    from xreset.backends.conformance import CHECKS, run
    from xreset.errors import XResetError
    from xreset.files import write_json

    known = [c.name for c in CHECKS]
    if unknown := sorted(set(check) - set(known)):
        raise XResetError(f"there is no check {', '.join(unknown)}; there are {', '.join(known)}.")
    console = Console(highlight=False, soft_wrap=True)
    spec = None if robot is None else robots.load(robot)
    records = []
    for name in dict.fromkeys(backend) or _usable(console):
        status = backend_status(name)
        used = device if device.split(":")[0] in status.device else "cpu"
        console.print(f"[bold]{name}[/] on {used}: status, check, and what came nearest to its tolerance")
        results = run(_maker(name, used), robot=spec, only=check or None, report=lambda r: _print(console, r, verbose))
        records.append(
            {
                "backend": name,
                "backend_version": status.version,
                "device": used,
                "checks": [result.as_dict() for result in results],
            }
        )
    if json is not None:
        write_json(json, {"schema": "xreset-conformance/1", "robot": robot, "backends": records})
        console.print(f"wrote {json}", markup=False)
    failed = sum(result["status"] == "failed" for record in records for result in record["checks"])
    console.print(f"{failed} checks failed" if failed else "all checks passed", style="bold red" if failed else "bold green")
    if failed:
        raise SystemExit(1)


def _usable(console: Console) -> list[str]:
    """Names of the backends that can be used here; says why others cannot."""
    from xreset.backends import backend_names, backend_status

    names = []
    for name in backend_names():
        status = backend_status(name)
        if status.reason is None:
            names.append(name)
        else:
            console.print(f"left out {name}: {status.reason}", markup=False)
    return names


def _maker(name: str, device: str) -> MakeBackend:
    from xreset.backends import make_backend

    return lambda scene, num_worlds, *, object_index=None: make_backend(name, scene, num_worlds, object_index=object_index, device=device)


_STYLE = {"passed": "green", "failed": "bold red", "unsupported": "yellow"}


def _print(console: Console, result: CheckResult, verbose: bool) -> None:
    console.print(
        f"  [{_STYLE[result.status]}]{result.status:<11}[/] {result.name:<20} {result.seconds:5.1f} s  {_text(result.worst)}".rstrip()
    )
    if verbose or result.status == "failed":
        for measure in result.measures:
            if verbose or not measure.ok:
                console.print(f"{'':14}{'ok ' if measure.ok else 'BAD'} {_text(measure)}", markup=False)
    if result.status == "failed":
        console.print(f"{'':14}asserted: {result.claim}", markup=False)
        if result.problem:
            console.print(f"{'':14}raised: {result.problem}", markup=False)
        console.print(f"{'':14}likely: {result.hint}", markup=False)


def _text(measure: Measure | None) -> str:
    if measure is None:
        return ""
    return f"{measure.what}: {measure.error:.2g}, tolerance {measure.tolerance:.2g} {measure.unit}".rstrip()


COMMAND = conformance
