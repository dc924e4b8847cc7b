"""Check whether engines keep their contract, and say what is found as soon as it is known."""

from __future__ import annotations

from collections.abc import Callable, Collection
from functools import partial
from typing import Any

from rich.text import Text

from xreset.backends import conformance, pool
from xreset.physics.plugins import backend_class, device_for, make_backend
from xreset.spec import RobotSpec, SceneSpec

Say = Callable[[str | Text], None]


def check(
    name: str, robot: RobotSpec, device: str, only: Collection[str], say: Say
) -> dict[str, Any]:
    """Check an engine, and return its entry in the file of :mod:`xreset.backends.conformance.results`.

    Args:
        name: name of the engine.
        robot: robot to test with.
        device: where the engine runs if it can; else it runs on the CPU.
        only: names of the checks to run; empty: all.
        say: called with lines for people: every measured number of checks that are named, else the one nearest to its
            tolerance.
    """
    engine = backend_class(name)
    version = engine.engine_version()
    used = device_for(name, device)
    what = (
        f" {version}, {robot.name}, {used}: verdict, check, and what came nearest to its tolerance"
    )
    say(Text.assemble((name, "bold"), what))
    report = partial(_say_result, every=bool(only), say=say)
    results = conformance.run(_maker(name, used), robot=robot, only=only or None, report=report)
    return {
        "engine": name,
        "engine_version": version,
        "robot": robot.name,
        "device": used,
        "capabilities": sorted(engine.capabilities),
        "seconds": round(sum(result.seconds for result in results), 3),
        "checks": [result.as_dict() for result in results],
    }


def _maker(name: str, device: str) -> conformance.MakeBackend:
    """Return the function that makes worlds on a device.

    The worlds that it makes first, which all checks share, run in processes of their own. Most others run in this one:
    a new process takes longer to start than their check takes.
    """
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


def _say_result(result: conformance.CheckResult, every: bool, say: Say) -> None:
    detail = shown(result.worst) if result.measures else result.problem
    verdict = (f"{result.verdict:<16}", _STYLE[result.verdict])
    say(Text.assemble("  ", verdict, f" {result.name:<22} {result.seconds:5.1f} s  {detail}"))
    for measure in result.measures:
        if every or measure.verdict != "passed":
            say(f"{'':19}{measure.verdict}: {shown(measure)}")
            if measure.verdict == "known difference" and measure.known is not None:
                say(f"{'':19}accepted up to {measure.known.bound:.3g}: {measure.known.reason}")
    if result.verdict == "failed":
        say(f"{'':19}asserted: {result.check.statement}")
        if result.problem:
            say(f"{'':19}raised: {result.problem}")
        say(f"{'':19}likely: {result.check.cause}")


def shown(measure: conformance.Measure | None) -> str:
    """Return what was measured, with its tolerance, as a line says it."""
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
