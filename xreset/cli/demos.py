"""``xreset demos``: import, synth, select."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from xreset.cli._common import Flat, Meshes, Source, Sources
from xreset.cli._options import Output
from xreset.cli._terminal import Progress, console, show_notes, show_table
from xreset.errors import DemoError
from xreset.files.checks import Options, PositiveInt, Seed, Share, frozen
from xreset.files.storage import file_hash

if TYPE_CHECKING:
    from xreset.demos.archive import Demos

Side = Literal["right", "left", "both"]


def import_dexycb(folder: Source, *, out: Output) -> None:
    """Read DexYCB in its own layout and write an archive of demonstrations.

    Args:
        folder: The folder that holds the subjects' folders and `calibration`.
        out: Archive to write.
    """
    from xreset.demos.dexycb import read_dexycb

    with Progress() as bar:
        demos = read_dexycb(folder, progress=bar.count("reading DexYCB"))
    _save(demos, out, {"dataset": "dexycb"})


def import_keypoints(
    path: Source,
    *,
    out: Output,
    order: Literal["mano", "mediapipe", "openpose"],
    units: Literal["m", "mm"],
    coordinates: Literal["table", "camera"],
    table_from_camera: Path | None = None,
    fps: float | None = None,
    object: str | None = None,
    side: Literal["right", "left"] | None = None,
    subject: str = "unknown",
    meshes: Path | None = None,
    trust_recordings: bool = False,
) -> None:
    """Read 21 hand keypoints and object poses of any tracker and write an archive of demonstrations.

    Nothing is guessed: options must state what the files do not, and options that contradict the numbers are refused.
    The page docs/demonstrations.md has the layout of the files.

    Args:
        path: An npz file (one sequence), a CSV file (one row for each frame), or a folder of them.
        out: Archive to write.
        order: Order of the keypoints.
        units: Unit of keypoints and object positions.
        coordinates: Frame of all positions: the table's (z up, table top at z = 0) or that of a fixed camera.
        table_from_camera: File with the camera's pose in the table frame: 4x4, metres, as text.
        fps: Frames per second; files with times are resampled to it.
        object: Name of the grasped object, if the files do not state it.
        side: Side of the hand, if the files do not state it.
        subject: Name of the person, if the files do not state it.
        meshes: Folder of the objects' meshes, to examine the recordings with.
        trust_recordings: Take recordings that are certainly wrong all the same.
    """
    from xreset.demos.keypoints import Convention, read_keypoints, read_transform

    T = None if table_from_camera is None else read_transform(table_from_camera)
    convention = Convention(
        order=order,
        units=units,
        frame=coordinates,
        table_from_camera=T,
        fps=fps,
        object_name=object,
        side=side,
        subject=subject,
    )
    demos = read_keypoints(path, convention, meshes=meshes, trust=trust_recordings)
    config = {
        "dataset": "keypoints",
        **vars(convention),
        "table_from_camera": None if T is None else T.tolist(),
    }
    inputs = {"keypoints": path} if path.is_file() else {}
    _save(demos, out, config, meshes, **inputs)


def synth(
    *,
    out: Output,
    objects: tuple[str, ...] = (),
    per_object: PositiveInt = 4,
    seed: Seed = 0,
    fps: float = 30.0,
    side: Side = "right",
    meshes: Path | None = None,
) -> None:
    """Synthesize demonstrations: reach, grasp, lift, turn.

    Args:
        out: Archive to write.
        objects: Objects to grasp; default: all.
        per_object: Sequences of each object (and hand).
        seed: The same seed gives the same file.
        fps: Frames per second.
        side: Hand.
        meshes: Folder of real meshes, with z up; default: the built-in stand-ins.
    """
    from xreset.demos.archive import merge_demos
    from xreset.demos.synth import synthesize

    parts = []
    with Progress() as bar:
        for hand in ("right", "left"):
            if side in (hand, "both"):
                part = synthesize(
                    objects or None,
                    per_object,
                    seed,
                    fps=fps,
                    side=hand,
                    meshes=meshes,
                    progress=bar.count(f"{hand} hands"),
                )
                parts.append(part)
    config = {
        "objects": list(objects),
        "per_object": per_object,
        "seed": seed,
        "fps": fps,
        "side": side,
    }
    _save(merge_demos(parts), out, config)


@frozen
class Selection(Options):
    """Conditions that a sequence must meet, all of them, and how many sequences of each object are kept."""

    objects: tuple[str, ...] = ()
    """Names of objects: only sequences that grasp one of them."""
    sequences: tuple[str, ...] = ()
    """Only the sequences of these names."""
    subjects: tuple[str, ...] = ()
    """Only sequences that these persons demonstrated."""
    side: Side = "both"
    """Only sequences of this hand."""
    per_object: PositiveInt | None = None
    """Keep at most this many sequences of each object."""
    share: Share = 1.0
    """Keep this share of each object's sequences, at least one: a number from 0 to 1."""
    pick: Literal["first", "spread", "random"] = "first"
    """Which sequences --per-object and --share keep: the first, sequences spread over the archive, or random ones."""
    seed: Seed = 0
    """Seed of --pick random."""

    def conditions(self) -> dict[str, Any]:
        """Return the arguments of ``Demos.select``."""
        if self.pick != "first" and self.per_object is None and self.share == 1:
            raise DemoError(
                f"--pick {self.pick} needs a number of sequences. Add --per-object or --share."
            )
        return {
            "objects": self.objects or None,
            "names": self.sequences or None,
            "subjects": self.subjects or None,
            "sides": None if self.side == "both" else [self.side],
            "max_per_object": self.per_object,
            "share": self.share,
            "spread": self.pick == "spread",
            "seed": self.seed if self.pick == "random" else None,
        }


def select(
    files: Sources,
    *,
    out: Output | None = None,
    rest: Output | None = None,
    selection: Flat[Selection] = Selection(),
    mirror: bool = False,
    meshes: Meshes = None,
) -> None:
    """Describe archives of demonstrations, object by object, and take sequences out of them.

    Implausible sequences are listed. Without conditions, all sequences are taken; archives have the same frame rate.

    Args:
        files: Archives of demonstrations, whose sequences have different names.
        out: Archive to write; default: nothing is written.
        rest: Archive to write: the sequences that do not meet the conditions, such as those of a test.
        selection: Conditions.
        mirror: Take left hands only, and mirror them, so that a right-handed robot can train on them. Objects that are
            not their own mirror image are listed and left out.
        meshes: Folder of real meshes, to examine the recordings with, and whose symmetry --mirror needs; default: the
            built-in stand-ins.
    """
    from xreset.demos.archive import merge_demos, read_demos

    inputs = {f"demos {i}": file for i, file in enumerate(files)}
    demos = merge_demos([*map(read_demos, files)])
    if rest is None:
        kept = demos.select(**selection.conditions())
    else:
        kept, others = demos.split(**selection.conditions())
        _save(others, rest, {"select_others": asdict(selection)}, **inputs)
    if mirror:
        kept = _mirrored(kept.select(sides=["left"]), meshes)
    _save(kept, out, {"select": asdict(selection), "mirrored": mirror}, meshes, **inputs)


def _mirrored(demos: Demos, meshes: Path | None) -> Demos:
    """Mirror demonstrations, and print how symmetric the objects are."""
    from xreset.demos.archive import demo_objects
    from xreset.demos.mirror import TOLERANCE, mirrored, symmetry

    symmetries = {name: symmetry(spec) for name, spec in demo_objects(demos, meshes).items()}
    for name, found in sorted(symmetries.items()):
        verdict = "mirrored" if found.deviation <= TOLERANCE else "left out: not symmetric enough"
        console.print(f"{name}: {1e3 * found.deviation:.1f} mm from its reflection, {verdict}")
    return mirrored(demos, symmetries)


def _save(
    demos: Demos,
    out: Path | None,
    config: dict[str, Any],
    meshes: Path | None = None,
    **inputs: Path,
) -> None:
    """Write demonstrations, if there is a file for them, and print their summary; meshes: what to examine them with;
    inputs: the files that they were made from, by kind."""
    from xreset.demos.archive import start_to_goal, write_demos
    from xreset.demos.examine import examine, surfaces_of

    if out is not None:
        hashes = {name: file_hash(path) for name, path in inputs.items()}
        write_demos(out, demos, config=config, inputs=hashes)

    table = [("object", "right", "left", "frames", "hand", "lift, cm", "goal, cm", "goal, deg")]
    for name in demos.object_names:
        own = demos.select(objects=[name])
        right = np.count_nonzero(own.hand_side == "right")
        first = own.frame_offsets[:-1]
        height = own.object_pos[:, 2]
        lift = np.median(np.maximum.reduceat(height, first) - height[first])
        distance, angle = map(np.median, start_to_goal(own))
        row = (
            name,
            f"{right}",
            f"{len(own) - right}",
            f"{own.num_frames}",
            f"{own.hand_valid.mean():.0%}",
            f"{100 * lift:.1f}",
            f"{100 * distance:.1f}",
            f"{np.degrees(angle):.0f}",
        )
        table.append(row)
    show_table(
        table,
        caption="right, left: sequences. hand: frames with a hand. lift, goal: medians, from the start",
    )
    what = out or ", ".join(map(str, inputs.values()))
    console.print(
        f"{what}: {demos.num_sequences} sequences, {demos.num_frames} frames at {demos.fps:g} per second"
    )
    show_notes(map(str, examine(demos, surfaces_of(demos, meshes))))


COMMAND = {
    "import dexycb": import_dexycb,
    "import keypoints": import_keypoints,
    "synth": synth,
    "select": select,
}
