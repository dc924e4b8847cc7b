"""Whether a backend keeps the contracts of :class:`~xreset.physics.Backend`: a list of checks that any engine must pass.

    from xreset.backends.conformance import run
    results = run(lambda scene, num_worlds, **kw: MyBackend(scene, num_worlds, **kw))

Every check compares with something computed independently of the engine: kinematics of the URDF, equations of motion, m g, or the reference
engine, MuJoCo. It says what it asserts, its tolerance, what it measured, and what usually causes a failure.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import replace

from xreset.backends.conformance import (
    contact_checks,
    friction_checks,
    grasp_checks,
    motion_checks,
    robot_checks,
    state_checks,
    world_checks,
)
from xreset.backends.conformance.harness import Bench, MakeBackend
from xreset.backends.conformance.results import SCHEMA, Check, CheckResult, Measure, Skipped, Verdict, judge
from xreset.backends.conformance.scene import scene
from xreset.errors import BackendUnavailableError, CapabilityError
from xreset.physics import KnownDifference
from xreset.spec import RobotSpec

_MODULES = (state_checks, world_checks, robot_checks, motion_checks, contact_checks, friction_checks, grasp_checks)
CHECKS: tuple[Check, ...] = tuple(
    sorted((c for module in _MODULES for c in vars(module).values() if isinstance(c, Check)), key=lambda c: c.last)
)
"""All checks, in the order in which they run."""

__all__ = ["CHECKS", "SCHEMA", "Check", "CheckResult", "MakeBackend", "Measure", "run"]


def run(
    make: MakeBackend,
    *,
    robot: RobotSpec | None = None,
    only: Iterable[str] | None = None,
    report: Callable[[CheckResult], None] = lambda _: None,
) -> list[CheckResult]:
    """Run the checks.

    Args:
        robot: robot to test with; default the suite's own. Checks that need the suite's own are skipped with another.
        only: names of the checks to run; default all.
        report: called with each result as it comes.

    Raises:
        ValueError: ``only`` names a check that does not exist.
        BackendUnavailableError: the backend cannot be used here.
    """
    wanted = None if only is None else set(only)
    if wanted and (unknown := wanted - {check.name for check in CHECKS}):
        raise ValueError(
            f"there are no checks {sorted(unknown)}; there are {', '.join(check.name for check in CHECKS)}"
        )
    bench = Bench(make, scene(robot))
    results = []
    try:
        for check in CHECKS:
            if wanted is None or check.name in wanted:
                results.append(_run_one(check, bench))
                report(results[-1])
    finally:
        bench.close()
    return results


def _run_one(check: Check, bench: Bench) -> CheckResult:
    start = time.perf_counter()

    def result(verdict: Verdict, problem: str = "", measures: tuple[Measure, ...] = ()) -> CheckResult:
        return CheckResult(
            check=check, verdict=verdict, measures=measures, problem=problem, seconds=time.perf_counter() - start
        )

    if check.own_robot_only and not bench.own_robot:
        return result("skipped", "it needs the suite's own robot")
    try:
        measures = check.run(bench)
    except Skipped as reason:
        return result("skipped", str(reason))
    except CapabilityError as error:
        return result("unsupported" if _lacking(check, bench) else "failed", str(error))
    except BackendUnavailableError:  # nothing can be tested
        raise
    except Exception as error:
        return result("failed", f"{type(error).__name__}: {error}")
    measures = tuple(replace(m, known=_known(check, m, bench)) for m in measures)
    if lacking := _lacking(check, bench):
        problem = f"the backend says that it cannot do {', '.join(sorted(lacking))}, but did not refuse to"
        return result("failed", problem, measures)
    return result(judge(measures), "", measures)


def _lacking(check: Check, bench: Bench) -> set[str]:
    return {*check.capabilities} - {*bench.backend().capabilities}


def _known(check: Check, measure: Measure, bench: Bench) -> KnownDifference | None:
    """What the backend declares about a measure."""
    for known in bench.backend().known_differences:
        if (known.check, known.measure) == (check.name, measure.what) and known.robot in (None, bench.scene.robot.name):
            return known
    return None
