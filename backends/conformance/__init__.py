"""Whether a backend keeps the contracts of :class:`~xreset.backends.base.Backend`: a list of checks that any engine must pass.

    from xreset.backends.conformance import run
    results = run(lambda scene, num_worlds, **kw: MyBackend(scene, num_worlds, **kw))

Every check compares with something computed independently of any engine (kinematics of the URDF, equations of motion, m g), and says
what it asserts, its tolerance, what it measured, and the likely cause of a failure.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable

from xreset.backends.conformance import contact_checks, motion_checks, state_checks
from xreset.backends.conformance.harness import Bench, Check, CheckResult, MakeBackend, Measure
from xreset.backends.conformance.scene import scene
from xreset.errors import BackendUnavailableError, CapabilityError
from xreset.spec import RobotSpec

CHECKS: tuple[Check, ...] = (*state_checks.CHECKS, *motion_checks.CHECKS, *contact_checks.CHECKS, *state_checks.LAST)
"""All checks, in the order in which they run."""

__all__ = ["CHECKS", "Check", "CheckResult", "MakeBackend", "Measure", "run"]


def run(
    make: MakeBackend,
    *,
    robot: RobotSpec | None = None,
    only: Iterable[str] | None = None,
    report: Callable[[CheckResult], None] = lambda _: None,
) -> list[CheckResult]:
    """Run the checks.

    Args:
        make: builds the backend under test.
        robot: robot to test with; default the suite's own. Some checks need the suite's own and are left out with another.
        only: names of the checks to run; default all.
        report: called with each result as it comes.

    Raises:
        ValueError: ``only`` names a check that does not exist.
        BackendUnavailableError: the backend cannot be used here.
    """
    wanted = None if only is None else set(only)
    if wanted and (unknown := wanted - {check.name for check in CHECKS}):
        raise ValueError(f"there are no checks {sorted(unknown)}; there are {', '.join(check.name for check in CHECKS)}")
    bench = Bench(make, scene(robot))
    results = []
    try:
        for check in CHECKS:
            if (wanted is not None and check.name not in wanted) or (check.own_robot_only and not bench.own_robot):
                continue
            results.append(_run_one(check, bench))
            report(results[-1])
    finally:
        bench.close()
    return results


def _run_one(check: Check, bench: Bench) -> CheckResult:
    start = time.perf_counter()

    def result(status, measures=(), problem="") -> CheckResult:
        hint = check.hint if status == "failed" else ""
        seconds = time.perf_counter() - start
        return CheckResult(
            name=check.name, claim=check.claim, status=status, measures=tuple(measures), problem=problem, hint=hint, seconds=seconds
        )

    try:
        measures = check.run(bench)
        lacking = set(check.capabilities) - bench.backend().capabilities
    except CapabilityError as error:
        lacking = set(check.capabilities) - bench.backend().capabilities
        return result("unsupported" if lacking else "failed", problem=str(error))
    except BackendUnavailableError:  # nothing can be tested
        raise
    except Exception as error:
        return result("failed", problem=f"{type(error).__name__}: {error}")
    if lacking:
        return result("failed", measures, f"the backend says that it cannot set {', '.join(sorted(lacking))}, but did not refuse to")
    return result("passed" if all(m.ok for m in measures) else "failed", measures)
