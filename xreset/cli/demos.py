"""``xreset demos``: import, synth, select."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from xreset.cli._terminal import console, show_notes, show_table
from xreset.cli._verbs import REQUIRED, verb
from xreset.demos import verbs
from xreset.files.text import quantity

if TYPE_CHECKING:
    from xreset.demos.archive import Demos


def _show(demos: Demos, options: Mapping[str, Any]) -> None:
    _summarize(demos, options["out"])


def _show_recorded(demos: Demos, options: Mapping[str, Any]) -> None:
    _summarize(demos, options["out"], options["meshes"])


def _show_selected(found: tuple[Demos, Demos | None], options: Mapping[str, Any]) -> None:
    kept, others = found
    if others is not None:
        _summarize(others, options["rest"])
    files = ", ".join(map(str, options["files"]))
    _summarize(kept, options["out"] or files, options["meshes"])


def _summarize(demos: Demos, what: object, meshes: Path | None = None) -> None:
    """Print a row for each object, and the doubts about the recordings; meshes: what to examine them with."""
    from xreset.demos.archive import demo_objects
    from xreset.demos.examine import examine, surfaces_of
    from xreset.geometry.shapes import turn_of

    objects = demo_objects(demos, meshes).values() if meshes else ()
    table = [("object", "right", "left", "frames", "hand", "lift, cm", "goal, cm", "goal, deg")]
    for name in demos.object_names:
        own = demos.select(objects=[name])
        right = np.count_nonzero(own.hand_side == "right")
        shift = own.shift([*objects])
        lift = np.maximum.reduceat(shift[:, 2], own.frame_offsets[:-1])
        goal = np.linalg.norm(shift[own.frame_offsets[1:] - 1], axis=1)
        turn = turn_of(own.goal_pose[1]) * turn_of(own.start_pose[1]).inv()
        row = (
            name,
            f"{right}",
            f"{len(own) - right}",
            f"{own.num_frames}",
            f"{own.hand_valid.mean():.0%}",
            f"{100 * np.median(lift):.1f}",
            f"{100 * np.median(goal):.1f}",
            f"{np.degrees(np.median(turn.magnitude())):.0f}",
        )
        table.append(row)
    show_table(
        table,
        caption="right, left: sequences. hand: frames with a hand. lift, goal: medians, from the start, of the center"
        " of mass (with --meshes; else of the origin)",
    )
    console.print(
        f"{what}: {quantity(demos.num_sequences, 'sequence')}, {quantity(demos.num_frames, 'frame')} at "
        f"{demos.fps:g} per second"
    )
    show_notes(map(str, examine(demos, surfaces_of(demos, meshes))))


COMMAND = {
    "import dexycb": verb(verbs.import_dexycb, _show),
    "import keypoints": verb(verbs.import_keypoints, _show_recorded, out=REQUIRED),
    "synth": verb(verbs.synthesize, _show, names=(), out=REQUIRED),
    "select": verb(verbs.select_demos, _show_selected),
}
