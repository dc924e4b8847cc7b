"""``xreset retarget``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from xreset.cli._common import depth_text, show_accounts
from xreset.cli._terminal import console, show_notes
from xreset.cli._verbs import REQUIRED, verb
from xreset.files.text import quantity
from xreset.retarget import verbs

if TYPE_CHECKING:
    from xreset.retarget.file import Retargeted


def _show(motion: Retargeted, options: Mapping[str, Any]) -> None:
    # not for the help: these import torch and scipy
    from xreset.geometry.description import load_robot
    from xreset.robot_tools.draft import hand_side

    side = hand_side(load_robot(options["robot"]))
    others = np.count_nonzero(motion.hand_side != side)
    if side and others:
        other = "left" if side == "right" else "right"
        note = (
            f"{others} of {len(motion.hand_side)} sequences are of {other} hands, but the robot's hand is a {side} "
            f"one. Use xreset demos select --side {side}"
        )
        if side == "right":
            note += "; --mirror makes right hands of the others"
        show_notes([note])
    show_accounts(
        [row.without("not annotated") for row in motion.accounts()],
        f"{motion.robot}: annotated frames that are valid",
    )
    if motion.annotated.any():
        console.print(_distances(motion))
        took = 1e3 * options["seconds"] / motion.annotated.sum()
        console.print(f"{took:.0f} ms a frame, with all preparation")
    valid = quantity(int(motion.valid.sum()), "valid frame")
    console.print(
        f"{valid} of {len(motion.valid)} in {options['out']}; xreset view shows why the others are not"
    )


def _distances(motion: Retargeted) -> str:
    """Return how near a motion comes to the human's hand and to the object."""
    text = f"fingertips are {1e3 * motion.hand_error[motion.annotated].mean():.1f} mm from the human's on average"
    if motion.contact_error is not None and np.isfinite(motion.contact_error).any():
        touching = np.isfinite(motion.contact_error)
        text += f", links {1e3 * motion.contact_error[touching].mean():.1f} mm from the points that they touch"
    reason = np.asarray(motion.reason_names)[motion.reason]
    followed = np.isin(reason, ("valid", "object collision"))
    if motion.object_depth is not None and followed.any():
        depth = motion.object_depth[followed]
        text += f"; {depth_text(depth, 'frames that are valid otherwise')}"
    return text


COMMAND = verb(verbs.retarget_demos, _show, out=REQUIRED)
