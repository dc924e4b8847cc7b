"""A robot's place in the world: what a search for it may vary, what it finds, and how that gets into the robot's
description."""

from __future__ import annotations

import re
from collections.abc import Iterable
from math import inf
from pathlib import Path
from typing import Annotated

from xreset.errors import RobotError
from xreset.files.checks import Checked, NonNegativeFloat, NonNegativeInt, Rule, frozen
from xreset.files.storage import write_whole
from xreset.spec import RobotSpec

Span = Annotated[
    tuple[float, float],
    Rule("two finite numbers, the lower one first", lambda x: -inf < x[0] <= x[1] < inf),
]


@frozen
class PlaceConfig(Checked):
    """What is searched, and how hard."""

    x: Span = (-0.3, 1.4)
    """Range of the base's position [m]; the defaults are the table and what is next to it."""
    y: Span = (-0.5, 1.2)
    z: Span = (0.0, 0.8)
    clear: NonNegativeFloat = 0.30
    """Least distance [m] from the base's origin to every wrist and object of the demonstrations; what is below an
    upright base keeps the same distance."""
    rounds: NonNegativeInt = 5
    """Rounds of candidates; 0 measures only the description's own placement."""


@frozen
class Finalist:
    """A placement that was also tried on whole motions."""

    robot: RobotSpec
    """The robot that stands there, with its home."""
    reached: float
    """Share of the final frames, each on its own, within the tolerances, clear of table and self."""
    dexterity: float
    """Mean over the reached frames of the smallest singular value of the hand root's Jacobian, lengths in units of 0.1
    m; 0 is singular."""
    followed: float
    """Share of all annotated frames that are valid when the arm follows the motions from frame to frame, as in ``xreset
    retarget``."""
    frames: int
    """Annotated frames of the motions."""
    sequences: int
    """Number of motions."""
    home_rule: str
    """How home was chosen; empty: no home was found."""


def write_placement(path: Path, robot: RobotSpec, best: Finalist, command: str) -> None:
    """Put a placement, its home configuration and its figures into a ``robot.toml``; all other lines stay as they are.

    Raises:
        RobotError: the file does not have the lines that would change, or there is no home to put there.
    """
    pos = _listed(best.robot.base_pos)
    quat = _listed(best.robot.base_quat)
    by_hand = f"Put base.pos = {pos} and base.quat = {quat} into {path}, and "
    if not best.home_rule:
        raise RobotError(
            f"robot {robot.name!r}: no placement has a home. {by_hand}choose a home of the arm's joints there: look at "
            "it with xreset robots check --picture."
        )
    figures = f"reaches {100 * best.reached:.1f} % and follows {100 * best.followed:.1f} % of {best.frames} frames"
    edits = [(r"^quat *=.*()$", f"\n# Placement: {figures}: {' '.join(command.split())}")]
    if best.robot != robot:  # else not a digit may change: it would be another robot
        edits += [(r"^pos *= *(.*)$", pos), (r"^quat *= *(.*)$", quat)]
        for joint in best.robot.joints:
            if joint.group == "arm":
                pattern = rf'name *= *"{re.escape(joint.name)}".*?\bhome *= *([-+.\deE]+)'
                edits.append((pattern, f"{joint.home:.8g}"))
    text = re.sub(r"^(# Placement:|placement *=).*\n", "", path.read_text(), flags=re.MULTILINE)
    for pattern, new in edits:
        match = re.search(pattern, text, flags=re.MULTILINE)
        if match is None:
            home = _listed(best.robot.home[best.robot.arm_indices])
            raise RobotError(
                f"{path} has no line like {pattern!r} to change. {by_hand}the arm's home = {home}, joint by joint."
            )
        text = text[: match.start(1)] + new + text[match.end(1) :]
    write_whole(path, text)


def _listed(values: Iterable[float]) -> str:
    return f"[{', '.join(f'{value:.8g}' for value in values)}]"
