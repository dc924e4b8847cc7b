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
from collections import ChainMap
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from torch import Tensor

from xreset.backends.conformance import (
    contact_checks,
    grasp_checks,
    motion_checks,
    press_checks,
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
from xreset.errors import BackendUnavailableError, CapabilityError, XResetError
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

_MODULES = (
    state_checks,
    world_checks,
    robot_checks,
    motion_checks,
    contact_checks,
    press_checks,
    grasp_checks,
)
_TABLE = tomllib.loads(Path(__file__).with_name("checks.toml").read_text())
_FUNCTIONS: Mapping[str, Any] = ChainMap(*map(vars, _MODULES))
CHECKS = tuple(
    Check(name=name, run=_FUNCTIONS[name], **row) for name, row in _TABLE["checks"].items()
)
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
        XResetError: ``only`` names a check that does not exist.
        BackendUnavailableError: the backend cannot be used here.
    """
    known = [check.name for check in CHECKS]
    wanted = set(known if only is None else only)
    if unknown := sorted(wanted.difference(known)):
        raise XResetError(f"Unknown check: {', '.join(unknown)}. Choose from: {', '.join(known)}.")
    bench = Bench(make, scene(robot))
    results = []
    try:
        declared = {difference.check for difference in bench.backend.known_differences}
        if unknown := sorted(declared.difference(known)):
            raise XResetError(
                f"{type(bench.backend).__name__}.known_differences names unknown checks: {', '.join(unknown)}. "
                f"Choose from: {', '.join(known)}."
            )
        for check in CHECKS:
            if check.name in wanted:
                start = time.perf_counter()
                result = _run_one(check, bench)
                result = replace(result, seconds=time.perf_counter() - start)
                results.append(result)
                report(result)
    finally:
        bench.close()
    return results


def _run_one(check: Check, bench: Bench) -> CheckResult:
    measures = []

    def ended(verdict: Verdict, problem: str) -> CheckResult:
        return CheckResult(check=check, verdict=verdict, problem=problem, measures=tuple(measures))

    if check.own_robot_only and not bench.own_robot:
        return ended("skipped", "it needs the suite's own robot")
    try:
        errors = check.run(bench)
    except Skipped as reason:
        return ended("skipped", str(reason))
    except CapabilityError as error:
        lacking = set(check.capabilities) - bench.backend.capabilities
        return ended("unsupported" if lacking else "failed", str(error))
    except BackendUnavailableError:  # nothing can be tested
        raise
    except Exception as error:
        return ended("failed", f"{type(error).__name__}: {error}")
    backend = bench.backend
    for what, found in errors.items():
        if what.rpartition(" ")[2].startswith("joint_") and isinstance(found, Tensor):
            found = zip(bench.scene.robot.joint_names, found.movedim(-1, 0), strict=True)
        measured, where = largest(found)
        tolerance, unit = check.limit(what, backend.device.type, _TABLE["states"])
        known = None
        for difference in backend.known_differences:
            same = (difference.check, difference.measure) == (check.name, what)
            if same and difference.robot in (None, bench.scene.robot.name):
                known = difference
        measures.append(Measure(what, measured, tolerance, unit, where, known))
    lacking = set(check.capabilities) - backend.capabilities
    if lacking:
        return ended(
            "failed",
            f"the backend says that it cannot do {', '.join(sorted(lacking))}, but did not refuse to",
        )
    return ended(judge(measures), "")
