"""What a check is, and what it yields: measures, and a result with a verdict.

The file that ``xreset engines check --json`` writes (schema :data:`SCHEMA`)::

    {"schema": ..., "xreset_version": ..., "command": ...,
     "runs": [{"engine", "engine_version", "robot", "device", "capabilities": [...], "seconds",
               "checks": [{"check", "group", "statement", "cause", "verdict", "problem", "seconds",
                           "measures": [{"what", "measured", "tolerance", "unit", "where", "verdict", "bound", "reason"}]}]}]}

A check's verdict is passed, known difference, failed, unsupported (the backend states that it lacks the capability, and refuses as the
contract asks) or skipped (it cannot be done here: ``problem`` says why). A measure's is one of the first three; ``bound`` and ``reason``
are those of the known difference, else null and empty. A number that is not finite is written as text.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from xreset.physics import Capability, KnownDifference

if TYPE_CHECKING:
    from xreset.backends.conformance.harness import Bench

SCHEMA = "xreset-conformance/2"
"""Version of the file."""

MeasureVerdict = Literal["passed", "known difference", "failed"]
Verdict = Literal["passed", "known difference", "failed", "unsupported", "skipped"]
Group = Literal["state", "worlds", "robot", "object", "contact"]
"""Part of the contract that a check belongs to."""


@dataclass(frozen=True)
class Measure:
    """One number of a check: how far something is from what it should be."""

    what: str
    """Such as ``joint_pos``; no two of a check are called the same."""
    measured: float
    """Distance from what it should be."""
    tolerance: float
    unit: str = ""
    where: str = ""
    """Such as the joint or the object that came out worst."""
    known: KnownDifference | None = None
    """What the backend declares about it."""

    @property
    def verdict(self) -> MeasureVerdict:
        """A number that is not finite fails."""
        if math.isfinite(self.measured) and self.measured <= self.tolerance:
            return "passed"
        if self.known is not None and math.isfinite(self.measured) and self.measured <= self.known.bound:
            return "known difference"
        return "failed"

    def as_dict(self) -> dict[str, Any]:
        """JSON-able content."""
        return {
            "what": self.what,
            "measured": self.measured if math.isfinite(self.measured) else str(self.measured),
            "tolerance": self.tolerance,
            "unit": self.unit,
            "where": self.where,
            "verdict": self.verdict,
            "bound": None if self.known is None else self.known.bound,
            "reason": "" if self.known is None else self.known.reason,
        }


@dataclass(frozen=True, kw_only=True)
class Check:
    """A contract and how to test it."""

    name: str
    group: Group
    statement: str
    """What is asserted."""
    cause: str
    """What usually causes a failure."""
    run: Callable[[Bench], list[Measure]]
    """Measures it; :class:`Skipped` where that cannot be done."""
    capabilities: tuple[Capability, ...] = ()
    """Capabilities that it needs and that a backend may lack."""
    own_robot_only: bool = False
    """Whether it needs the suite's own robot."""
    last: bool = False
    """Whether it comes after all others, for it may take the process with it."""


def checks_of(group: Group) -> Callable[..., Callable[[Callable[[Bench], list[Measure]]], Check]]:
    """The decorator ``(statement, cause, **options)`` that makes a :class:`Check` of a function, under its name."""
    return lambda statement, cause, **options: (
        lambda run: Check(name=run.__name__, group=group, statement=statement, cause=cause, run=run, **options)
    )


class Skipped(Exception):
    """A check cannot be done with this robot, on this device or on this machine; says why."""


@dataclass(frozen=True, kw_only=True)
class CheckResult:
    """Outcome of a check."""

    check: Check
    verdict: Verdict
    measures: tuple[Measure, ...] = ()
    problem: str = ""
    """What was raised, if something was, or why it was skipped."""
    seconds: float = 0.0

    @property
    def name(self) -> str:
        """The check's."""
        return self.check.name

    @property
    def worst(self) -> Measure | None:
        """The measure nearest to its tolerance, or furthest beyond it."""

        def share(measure: Measure) -> float:
            if not math.isfinite(measure.measured):
                return math.inf
            return measure.measured / measure.tolerance if measure.tolerance else measure.measured and math.inf

        return max(self.measures, key=share, default=None)

    def as_dict(self) -> dict[str, Any]:
        """JSON-able content."""
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


def judge(measures: tuple[Measure, ...]) -> Verdict:
    """The verdict of a check by its measures: the worst of theirs."""
    verdicts = {measure.verdict for measure in measures}
    return "failed" if "failed" in verdicts else "known difference" if "known difference" in verdicts else "passed"
