"""The lift clock: when a training first succeeds from home.

The reward curves show little until a policy has lifted the object from home; after the first lift the rest follows
within minutes. So trainings are compared by this time.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path

from xreset.checks import NotNegative, Share, from_dict
from xreset.files import read_json, write_json

SCHEMA = "xreset-lift/1"
FILE = "lift.json"
"""File next to ``run.json``."""
SHARES = (0.01, 0.1, 0.5)
"""Shares of the home worlds' steps spent at the goal whose first passing is noted."""


@dataclass(frozen=True, kw_only=True)
class Passing:
    """The first iteration in which at least ``share`` of the steps of worlds that started at home were at the goal."""

    share: Share[float]
    iteration: NotNegative[int]
    env_steps: NotNegative[int]
    """Control steps of all worlds until then."""
    minutes: NotNegative[float]
    """Minutes of training until then, without compiling."""


@dataclass(frozen=True, kw_only=True)
class Lift:
    """Contents of ``lift.json``."""

    passed: tuple[Passing, ...] = ()
    """In the order of :data:`SHARES`."""
    iteration: NotNegative[int] = 0
    """Iterations done."""
    env_steps: NotNegative[int] = 0
    minutes: NotNegative[float] = 0.0
    success_from_home: Share[float] = 0.0
    """Share in the last iteration."""


@dataclass
class LiftClock:
    """Keeps ``lift.json`` of a run."""

    folder: Path
    lift: Lift = field(default_factory=Lift)

    def resume(self, iteration: int) -> None:
        """Continue from the file, if there is one, without what came after ``iteration``."""
        if iteration:
            passed = read_lift(self.folder).passed
            self.lift = Lift(passed=tuple(p for p in passed if p.iteration <= iteration))

    def tick(self, share: float, *, iteration: int, env_steps: int, seconds: float) -> None:
        """Record an iteration's share of success from home."""
        now = {"iteration": iteration, "env_steps": env_steps, "minutes": seconds / 60}
        known = {p.share for p in self.lift.passed}
        new = tuple(Passing(share=s, **now) for s in SHARES if s not in known and share >= s)
        self.lift = Lift(passed=(*self.lift.passed, *new), success_from_home=share, **now)
        if new:
            self.write()

    def write(self) -> None:
        """Write the file."""
        write_json(self.folder / FILE, {"schema": SCHEMA} | asdict(self.lift))


def read_lift(folder: Path) -> Lift:
    """Read a run's ``lift.json``; an empty one for runs of earlier versions, which have none.

    Raises:
        FileFormatError: the file is damaged.
    """
    path = folder / FILE
    if not path.is_file():
        return Lift()
    return from_dict(Lift, read_json(path, SCHEMA), str(path))
