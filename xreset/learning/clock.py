"""The lift clock: when a training first succeeds from home.

The reward curves show little until a policy has lifted the object from home; after the first lift the rest follows
within minutes. So trainings are compared by this time.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from xreset.files.checks import NonNegativeFloat, NonNegativeInt, Share, from_dict, frozen
from xreset.files.storage import read_json, write_json

EARLIER = "lift.json"
"""File of earlier versions in the run folder."""
SHARES = (0.01, 0.1, 0.5)
"""Shares of success from home whose first passing is recorded."""


@frozen
class Passing:
    """The first iteration in which at least ``share`` of the steps of worlds that started at home were at the goal."""

    share: Share
    iteration: NonNegativeInt
    env_steps: NonNegativeInt
    """Control steps of all worlds until then."""
    minutes: NonNegativeFloat
    """Minutes of training until then, without compiling."""


@frozen
class Lift:
    """The entry ``lift`` of ``run.json``."""

    passed: tuple[Passing, ...] = ()
    """In the order of :data:`SHARES`."""
    iteration: NonNegativeInt = 0
    """Iterations done."""
    env_steps: NonNegativeInt = 0
    minutes: NonNegativeFloat = 0.0
    success_from_home: Share = 0.0
    """Share in the last iteration."""

    def up_to(self, iteration: int) -> Lift:
        """Return the contents without what came after an iteration."""
        return Lift(passed=tuple(p for p in self.passed if p.iteration <= iteration))

    def after(self, share: float, *, iteration: int, env_steps: int, seconds: float) -> Lift:
        """Return the contents after another iteration, with the share of success from home in it."""
        now = {"iteration": iteration, "env_steps": env_steps, "minutes": seconds / 60}
        known = {p.share for p in self.passed}
        new = [Passing(share=s, **now) for s in SHARES if s not in known and share >= s]
        return Lift(passed=(*self.passed, *new), success_from_home=share, **now)


def write_lift(folder: Path, lift: Lift) -> None:
    """Write the entry ``lift`` of ``run.json``."""
    path = folder / "run.json"
    stated = read_json(path) if path.is_file() else {}
    write_json(path, stated | {"lift": asdict(lift)})


def read_lift(folder: Path) -> Lift:
    """Read the entry ``lift`` of ``run.json``; an empty one for a run that has none.

    Raises:
        FileFormatError: the file is damaged.
    """
    path = folder / "run.json"
    entry = read_json(path).get("lift") if path.is_file() else None
    where = f"{path}: lift"
    if entry is None and (folder / EARLIER).is_file():
        entry = read_json(folder / EARLIER)
        entry = {name: x for name, x in entry.items() if name not in ("schema", "xreset")}
        where = str(folder / EARLIER)
    return Lift() if entry is None else from_dict(Lift, entry, where)
