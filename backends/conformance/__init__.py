"""Whether a backend keeps the contract of :class:`~xreset.physics.Backend`: checks that any engine must pass.

    from xreset.backends.conformance import run
    results = run(lambda scene, num_worlds, **kw: MyBackend(scene, num_worlds, **kw))

Every check compares with something computed independently of the engine: kinematics of the URDF, equations of motion,
m g, or the reference engine MuJoCo. ``checks.toml`` states what each check asserts, its tolerances and what usually
causes a failure; the function of the same name makes the measurements.
"""

from __future__ import annotations

import time
import tomllib
from collections.abc import Callable, Iterable
from pathlib import Path

from xreset.backends.conformance import (
    contact_checks,
    grasp_checks,
    motion_checks,
    robot_checks,
    state_checks,
    world_checks,
)
from xreset.backends.conformance.harness import Bench, MakeBackend
from xreset.backends.conformance.results import (
    SCHEMA,
    Check,
    CheckResult,
    Measure,
    Skipped,
    Verdict,
    judge,
    largest,
)
from xreset.backends.conformance.scene import scene
from xreset.errors import BackendUnavailableError, CapabilityError
from xreset.physics import Backend
from xreset.spec import RobotSpec

__all__ = [
    "CHECKS",
    "SCHEMA",
    "Bench",
    "Check",
    "CheckResult",
    "MakeBackend",
    "Measure",
    "run",
    "scene",
]

_MODULES = (state_checks, world_checks, robot_checks, motion_checks, contact_checks, grasp_checks)
_TABLE = tomllib.loads(Path(__file__).with_name("checks.toml").read_text())


def _read_checks() -> tuple[Check, ...]:
    functions = {}
    for module in _MODULES:
        functions |= vars(module)
    return tuple(
        Check(name=name, run=functions[name], **row) for name, row in _TABLE["checks"].items()
    )


CHECKS = _read_checks()
"""All checks, in the order in which they run."""


def run(
    make: MakeBackend,
    *,
    robot: RobotSpec | None = None,
    only: Iterable[str] | None = None,
    report: Callable[[CheckResult], None] = lambda _: None,
) -> list[CheckResult]:
    """Run the checks.

    Args:
        make: builds the backend under test: ``make(scene, num_worlds, object_index=...)``.
        robot: robot to test with; default: the suite's own. Checks that need the suite's own robot skip any other.
        only: names of the checks to run; default: all.
        report: called with each result as soon as it is known.

    Raises:
        ValueError: ``only`` names a check that does not exist.
        BackendUnavailableError: the backend cannot be used here.
    """
    known = [check.name for check in CHECKS]
    wanted = set(known if only is None else only)
    if unknown := sorted(wanted.difference(known)):
        raise ValueError(f"Unknown checks: {', '.join(unknown)}. Choose from: {', '.join(known)}.")
    bench = Bench(make, scene(robot))
    results = []
    try:
        for check in CHECKS:
            if check.name in wanted:
                start = time.perf_counter()
                verdict, problem, measures = _run_one(check, bench)
                seconds = time.perf_counter() - start
                result = CheckResult(
                    check=check,
                    verdict=verdict,
                    measures=measures,
                    problem=problem,
                    seconds=seconds,
                )
                results.append(result)
                report(result)
    finally:
        bench.close()
    return results


def _run_one(check: Check, bench: Bench) -> tuple[Verdict, str, tuple[Measure, ...]]:
    """Return verdict, problem and measures."""
    if check.own_robot_only and not bench.own_robot:
        return "skipped", "it needs the suite's own robot", ()
    try:
        errors = check.run(bench)
    except Skipped as reason:
        return "skipped", str(reason), ()
    except CapabilityError as error:
        lacking = set(check.capabilities) - bench.backend.capabilities
        return "unsupported" if lacking else "failed", str(error), ()
    except BackendUnavailableError:  # nothing can be tested
        raise
    except Exception as error:
        return "failed", f"{type(error).__name__}: {error}", ()
    measures = []
    for what, found in errors.items():
        measured, where = largest(found)
        tolerance, unit = check.limit(what, bench.backend.device.type, _TABLE["states"])
        known = _known_difference(bench.backend, check.name, what, bench.scene.robot.name)
        measures.append(Measure(what, measured, tolerance, unit, where, known))
    lacking = set(check.capabilities) - bench.backend.capabilities
    if lacking:
        problem = f"the backend says that it cannot do {', '.join(sorted(lacking))}, but did not refuse to"
        return "failed", problem, tuple(measures)
    return judge(measures), "", tuple(measures)


def _known_difference(backend: Backend, check: str, measure: str, robot: str):
    """Return the known difference that the backend declares for a measure; None if there is none."""
    for known in backend.known_differences:
        if (known.check, known.measure) == (check, measure) and known.robot in (None, robot):
            return known
    return None
