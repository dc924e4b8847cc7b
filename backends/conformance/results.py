"""What a check is and what it yields: measures, and a result with a verdict.

The file that ``xreset engines check --out FILE.json`` writes (schema :data:`SCHEMA`)::

    {"schema": ..., "xreset_version": ..., "command": ...,
     "runs": [{"engine", "engine_version", "robot", "device", "capabilities": [...], "seconds",
               "checks": [{"check", "group", "statement", "cause", "verdict", "problem", "seconds",
                           "measures": [{"what", "measured", "tolerance", "unit", "where",
                                         "verdict", "bound", "reason"}]}]}]}

A check's verdict is passed, known difference, failed, unsupported (the backend states that it lacks the capability and
refuses as the contract asks) or skipped (the check cannot be done here; ``problem`` says why). A measure's verdict is
one of the first three; ``bound`` and ``reason`` are those of the known difference, otherwise null and empty. A number
that is not finite is written as text.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from torch import Tensor

from xreset.files.checks import frozen
from xreset.physics import Capability, KnownDifference

if TYPE_CHECKING:
    from xreset.backends.conformance.harness import Bench

SCHEMA = "xreset-conformance/2"
"""Version of the file."""

MeasureVerdict = Literal["passed", "known difference", "failed"]
Verdict = Literal["passed", "known difference", "failed", "unsupported", "skipped"]
Group = Literal["state", "worlds", "robot", "object", "contact"]
"""Part of the contract that a check belongs to."""

Differences = Tensor | np.ndarray | float
"""The largest absolute value counts."""
Found = Differences | Iterable[tuple[str, Differences]]
"""Differences, or those of several named parts: the worst part counts, and its name is shown."""
Measured = Mapping[str, Found]
"""What a check found, by the names of its measures."""


@dataclass(frozen=True)
class Measure:
    """One number of a check: how far something is from what it should be."""

    what: str
    """Such as ``joint_pos``; unique within a check."""
    measured: float
    """Distance from what it should be."""
    tolerance: float
    unit: str = ""
    where: str = ""
    """Such as the joint or the object with the largest error."""
    known: KnownDifference | None = None
    """What the backend declares about this measure."""

    @property
    def verdict(self) -> MeasureVerdict:
        """Whether the measured value is accepted; a number that is not finite fails."""
        if self.measured <= self.tolerance:
            return "passed"
        if self.known is not None and self.measured <= self.known.bound:
            return "known difference"
        return "failed"

    def as_dict(self) -> dict[str, Any]:
        """Return the content of the results file."""
        return {
            "what": self.what,
            "measured": self.measured if math.isfinite(self.measured) else str(self.measured),
            "tolerance": self.tolerance,
            "unit": self.unit,
            "where": self.where,
            "verdict": self.verdict,
            "bound": self.known and self.known.bound,
            "reason": self.known.reason if self.known else "",
        }


@frozen
class Check:
    """A contract and how to test it; the fields are explained in ``checks.toml``."""

    name: str
    group: Group
    statement: str
    cause: str
    run: Callable[[Bench], Measured]
    """Makes the measurements, by name; raises :class:`Skipped` where that is impossible."""
    capabilities: tuple[Capability, ...] = ()
    own_robot_only: bool = False
    tolerance: Mapping[str, tuple[float, str]] = field(default_factory=dict)
    states: Mapping[str, str] = field(default_factory=dict)

    def limit(
        self, what: str, device: str, state_limits: Mapping[str, Mapping[str, Any]]
    ) -> tuple[float, str]:
        """Return tolerance and unit of a measure on a device, ``cpu`` or ``cuda``."""
        for pattern, (largest, unit) in self.tolerance.items():
            if fnmatchcase(what, pattern):
                return largest, unit
        words, _, name = what.rpartition(" ")
        limits = state_limits[name]
        kind = self.states[words]
        if kind == "exact" and device == "cpu":
            return 0.0, limits["unit"]
        return limits["same" if kind == "exact" else kind], limits["unit"]


class Skipped(Exception):
    """A check cannot be done with this robot, on this device or on this machine. The message says why."""


@frozen
class CheckResult:
    """Outcome of a check."""

    check: Check
    verdict: Verdict
    measures: tuple[Measure, ...] = ()
    problem: str = ""
    """The exception, if there was one, or why the check was skipped."""
    seconds: float = 0.0

    @property
    def name(self) -> str:
        """Name of the check."""
        return self.check.name

    @property
    def worst(self) -> Measure | None:
        """The measure nearest to its tolerance, or furthest beyond it."""
        return max(self.measures, key=lambda m: share_of(m.measured, m.tolerance), default=None)

    def as_dict(self) -> dict[str, Any]:
        """Return the content of the results file."""
        return {
            "check": self.check.name,
            "group": self.check.group,
            "statement": self.check.statement,
            "cause": self.check.cause,
            "verdict": self.verdict,
            "problem": self.problem,
            "seconds": round(self.seconds, 3),
            "measures": [measure.as_dict() for measure in self.measures],
        }


def share_of(measured: float, tolerance: float) -> float:
    """Return what was measured as a share of its tolerance; infinite if it is not finite."""
    if not math.isfinite(measured):
        return math.inf
    if tolerance:
        return measured / tolerance
    return math.inf if measured else 0.0


def largest(errors: Found) -> tuple[float, str]:
    """Return the largest error and its name; NaN if there is one."""
    if isinstance(errors, Tensor | np.ndarray | float | int):
        return float(np.abs(np.asarray(errors, dtype=np.float64)).max(initial=0.0)), ""
    found = [(largest(error)[0], name) for name, error in errors]
    return max(
        found, key=lambda pair: math.inf if math.isnan(pair[0]) else pair[0], default=(0.0, "")
    )


def judge(measures: Iterable[Measure]) -> Verdict:
    """Return the verdict of a check: the worst verdict of its measures."""
    verdicts = {measure.verdict for measure in measures}
    for verdict in ("failed", "known difference"):
        if verdict in verdicts:
            return verdict
    return "passed"
