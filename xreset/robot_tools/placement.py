"""A robot's place in the world: what a search for it may vary, what it finds, and how that gets into the robot's
description."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from xreset.errors import RobotError
from xreset.files import write_whole
from xreset.spec import RobotSpec


@dataclass(frozen=True, kw_only=True)
class PlaceConfig:
    """What is searched, and how hard."""

    x: tuple[float, float] = (-0.3, 1.4)
    """Range of the base's position [m]; the defaults are the table and what is beside it."""
    y: tuple[float, float] = (-0.5, 1.2)
    z: tuple[float, float] = (0.0, 0.8)
    tilt: tuple[float, float] | None = None
    """Range of the angle between the base's z axis and the vertical [degrees]; None: as the description has it."""
    clear: float = 0.20
    """Distance that the base's origin keeps from every wrist and object of the demonstrations [m]."""
    frames: int = 100
    """Frames that each candidate is tried on, each on its own."""
    final_frames: int = 600
    """Other frames, on which the finalists are tried."""
    candidates: int = 40
    """Of each round."""
    rounds: int = 5
    """Of candidates; 0 measures the description's own placement only."""
    elite: int = 5
    """Best candidates: the next round is drawn around them, and in the end they and the description's own placement are
    the finalists."""
    position: float = 0.005
    """Largest distance of a reached hand root from its target [m]."""
    orientation: float = 5.0
    """Largest angle of a reached hand root to its target [degrees]."""
    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class Placement:
    """A place of the robot's base in the world."""

    pos: tuple[float, float, float]
    """[m]"""
    quat: tuple[float, float, float, float]
    """(w, x, y, z)"""


@dataclass(frozen=True, kw_only=True)
class Reach:
    """What a robot reaches from a placement."""

    reached: float
    """Share of the frames within the tolerances, clear of table and self."""
    dexterity: float
    """Mean over the reached frames of the smallest singular value of the hand root's Jacobian, lengths in units of 0.1
    m; 0 is singular."""

    @property
    def rank(self) -> tuple[int, float]:
        """For comparison: reach to half a percent, then dexterity."""
        return (round(self.reached * 200), self.dexterity)


@dataclass(frozen=True, kw_only=True)
class Finalist:
    """A placement that was also tried on whole motions."""

    placement: Placement
    reach: Reach
    """On the final frames."""
    followed: float
    """Share of all annotated frames that are valid when the arm follows the motions from frame to frame, as in ``xreset
    retarget``."""
    home: tuple[float, ...] | None = None
    """Arm joints at home; None: no home was found."""
    home_rule: str = ""
    """How home was chosen."""


@dataclass(frozen=True, kw_only=True)
class Search:
    """Result of :func:`xreset.robot_tools.place.place`."""

    finalists: tuple[Finalist, ...]
    """Those that follow most first. The description's own placement is one of them."""
    own: Finalist
    """The description's own placement."""
    frames: int
    """Annotated frames of the motions."""

    @property
    def best(self) -> Finalist:
        """The finalist that follows most and has a home."""
        return next((finalist for finalist in self.finalists if finalist.home is not None), self.finalists[0])

    @property
    def home(self) -> tuple[float, ...] | None:
        """Arm joints at home in the best placement."""
        return self.best.home


def write_placement(path: Path, robot: RobotSpec, search: Search, command: str) -> None:
    """Put the placement found, its home configuration and its figures into a ``robot.toml``; all other lines stay as
    they are.

    Raises:
        RobotError: the file does not have the lines that would change, or there is no home to put there.
    """
    if search.home is None:
        raise RobotError(
            f"robot {robot.name!r}: no placement has a home. Put base.pos = {_listed(search.best.placement.pos)} and "
            f"base.quat = {_listed(search.best.placement.quat)} into {path}, and choose a home of the arm's joints "
            "there: look at it with xreset robots check --picture."
        )
    text = re.sub(r"^placement *=.*\n", "", path.read_text(), flags=re.MULTILINE)
    best = search.best
    figures = f"reached = {best.reach.reached:.3f}, followed = {best.followed:.3f}, frames = {search.frames}"
    command = json.dumps(command, ensure_ascii=False)
    edits = [(r"^quat *=.*()$", f"\nplacement = {{ {figures}, command = {command} }}")]
    if best.placement != search.own.placement:  # else not a digit may change: it would be another robot
        edits.append((r"^pos *= *(.*)$", _listed(best.placement.pos)))
        edits.append((r"^quat *= *(.*)$", _listed(best.placement.quat)))
        for index, value in zip(robot.arm_indices, search.home, strict=True):
            name = re.escape(robot.joint_names[index])
            edits.append((rf'name *= *"{name}".*?\bhome *= *([-+.\deE]+)', f"{value:.3f}"))
    write_whole(path, edited(text, path, edits))


def _listed(values: Sequence[float]) -> str:
    return f"[{', '.join(f'{value:.8g}' for value in values)}]"


def edited(text: str, path: Path, edits: Sequence[tuple[str, str]]) -> str:
    """Return the text of a ``robot.toml`` with the first match of each pattern, or of the group in it, replaced.

    Raises:
        RobotError: names a pattern that matches nothing.
    """
    for pattern, new in edits:
        match = re.search(pattern, text, flags=re.MULTILINE)
        if match is None:
            raise RobotError(f"{path} has no line like {pattern!r} to change; edit it by hand: {new}")
        start, end = match.span(match.re.groups)
        text = text[:start] + new + text[end:]
    return text
