"""A robot's place in the world: what a search for it may vary, what it finds, and how that gets into the robot's description."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

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
    """Best candidates: the next round is drawn around them, and in the end they and the description's own placement are the finalists."""
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
    """Mean over the reached frames of the smallest singular value of the hand root's Jacobian, lengths in units of 0.1 m; 0 is singular."""

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
    """Share of all annotated frames that are valid when the arm follows the motions from frame to frame, as in ``xreset retarget``."""


@dataclass(frozen=True, kw_only=True)
class Search:
    """Result of :func:`xreset.robot_tools.place.place`."""

    best: Finalist
    """The one that follows most."""
    own: Finalist
    """The description's own placement."""
    home: np.ndarray | None
    """[n] arm joints that hold the hand, from the best placement, where the description's home holds it; None: it is out of reach there."""
    frames: int
    """Annotated frames of the motions."""


def write_placement(path: Path, robot: RobotSpec, search: Search, command: str) -> None:
    """Put the placement found, its home configuration and its figure into a ``robot.toml``, and leave every other line as it is.

    Raises:
        RobotError: the file does not have the lines that would change, or there is no home to put there.
    """
    if search.home is None:
        raise RobotError(
            f"robot {robot.name!r}: from the best placement the arm cannot hold the hand where home holds it; choose a home by hand."
        )
    text = path.read_text()
    text = re.sub(r"^placement *=.*\n", "", text, flags=re.MULTILINE)
    quoted = command.replace("\\", "\\\\").replace('"', '\\"')
    figures = (
        f"reached = {search.best.reach.reached:.3f}, followed = {search.best.followed:.3f}, frames = {search.frames}"
    )
    edits = [(r"^(quat *=.*)$", rf'\g<1>\nplacement = {{ {figures}, command = "{_literal(quoted)}" }}')]
    if search.best.placement != search.own.placement:  # else not a digit may change: it would be another robot
        pos, quat = (
            ", ".join(f"{v:.8g}" for v in values) for values in (search.best.placement.pos, search.best.placement.quat)
        )
        edits = [(r"^pos *=.*$", f"pos = [{pos}]"), (r"^quat *=.*$", f"quat = [{quat}]"), *edits]
        for name, value in zip((robot.joint_names[i] for i in robot.arm_indices), search.home, strict=True):
            edits.append((rf'(name *= *"{re.escape(name)}".*?\bhome *= *)[-+.\deE]+', rf"\g<1>{value:.3f}"))
    write_whole(path, edited(text, path, edits))


def edited(text: str, path: Path, edits: Sequence[tuple[str, str]]) -> str:
    """The text of a ``robot.toml`` with the first match of every pattern replaced; ``RobotError`` names one that nothing matches."""
    for pattern, new in edits:
        text, count = re.subn(pattern, new, text, count=1, flags=re.MULTILINE)
        if not count:
            raise RobotError(f"{path} has no line like {pattern!r} to change; edit it by hand: {new}")
    return text


def _literal(text: str) -> str:
    """The text as a replacement of ``re.sub``, which would take a backslash for the beginning of a group."""
    return text.replace("\\", "\\\\")
