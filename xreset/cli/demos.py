"""``xreset demos``: import, synth, select, split, merge, mirror, noise, info."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from xreset.cli._common import Flat, Source, Sources
from xreset.cli._terminal import Progress, console, show_notes, show_table
from xreset.errors import DemoError
from xreset.files.checks import Options, frozen
from xreset.files.storage import file_hash

if TYPE_CHECKING:
    from xreset.demos.archive import Demos

Side = Literal["right", "left", "both"]


def import_dexycb(folder: Source, *, out: Path) -> None:
    """Read DexYCB in its own layout and write an archive of demonstrations.

    Args:
        folder: The folder that holds the subjects' folders and `calibration`.
        out: Archive to write.
    """
    from xreset.demos.dexycb import read_dexycb

    with Progress() as bar:
        demos = read_dexycb(folder, progress=bar.count("reading DexYCB"))
    _save(demos, out, {"dataset": "dexycb"})


def import_ho3d(folder: Source, *, out: Path, fps: float, cameras: Path) -> None:
    """Read HO-3D (versions 2 and 3) in its own layout and write an archive of demonstrations. This was not yet tried on
    the original files.

    Args:
        folder: The folder that holds `train`.
        out: Archive to write.
        fps: Frames per second; the files do not state it.
        cameras: File with the camera's pose in the table frame (4x4, metres, as text; x right, y down, z
            forward) for all sequences; or a folder with SEQUENCE.txt, where sequences without one are left out.
    """
    from xreset.demos.ho3d import read_ho3d

    demos = read_ho3d(folder, fps=fps, cameras=cameras)
    _save(demos, out, {"dataset": "ho3d", "fps": fps})
    every = {path.parent.name for path in folder.glob("train/*/meta")}
    if without := sorted(every.difference(demos.sequence_name)):
        show_notes([f"left out, because {cameras} has no camera's pose: {', '.join(without)}"])


def import_keypoints(
    path: Source,
    *,
    out: Path,
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
    out: Path,
    objects: tuple[str, ...] = (),
    per_object: int = 4,
    seed: int = 0,
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
    per_object: int | None = None
    """Keep at most this many sequences of each object."""
    share: float = 1.0
    """Keep this share of each object's sequences, at least one: a number from 0 to 1."""
    pick: Literal["first", "spread", "random"] = "first"
    """Which sequences --per-object and --share keep: the first, sequences spread over the archive, or random ones."""
    seed: int = 0
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


def select(file: Source, *, out: Path, selection: Flat[Selection] = Selection()) -> None:
    """Take some sequences out of an archive.

    Args:
        file: Archive of demonstrations.
        out: Archive to write.
        selection: Conditions.
    """
    _save(
        _read(file).select(**selection.conditions()), out, {"select": asdict(selection)}, demos=file
    )


def split(file: Source, *, out: Path, rest: Path, selection: Flat[Selection] = Selection()) -> None:
    """Split an archive into two, for training and test: what the options select, and the rest.

    Args:
        file: Archive of demonstrations.
        out: Archive to write: the sequences that meet the conditions.
        rest: Archive to write: all other sequences.
        selection: Conditions.
    """
    kept, others = _read(file).split(**selection.conditions())
    _save(kept, out, {"select": asdict(selection)}, demos=file)
    _save(others, rest, {"select_others": asdict(selection)}, demos=file)


def merge(files: Sources, *, out: Path) -> None:
    """Merge archives of one frame rate, whose sequences have different names.

    Args:
        files: Archives of demonstrations.
        out: Archive to write.
    """
    from xreset.demos.archive import merge_demos

    inputs = {f"demos {i}": file for i, file in enumerate(files)}
    _save(merge_demos([*map(_read, files)]), out, {"merge": len(files)}, **inputs)


def reflect(
    file: Source,
    *,
    out: Path,
    meshes: Path | None = None,
    tolerance: float = 0.004,
) -> None:
    """Mirror demonstrations of left hands, so that a right-handed robot can train on them.

    Only objects that are their own mirror image within the tolerance can be mirrored; the others are
    listed.

    Args:
        file: Archive with left hands.
        out: Archive to write.
        meshes: Folder of real meshes; default: the built-in stand-ins.
        tolerance: Largest distance between an object's surface and its reflection, over 95 % of it [m].
    """
    from xreset.demos.archive import demo_objects
    from xreset.demos.mirror import mirrored, symmetry

    demos = _read(file).select(sides=["left"])
    symmetries = {name: symmetry(spec) for name, spec in demo_objects(demos, meshes).items()}
    for name, found in sorted(symmetries.items()):
        verdict = "mirrored" if found.deviation <= tolerance else "left out: not symmetric enough"
        console.print(f"{name}: {1e3 * found.deviation:.1f} mm from its reflection, {verdict}")
    _save(
        mirrored(demos, symmetries, tolerance=tolerance),
        out,
        {"mirrored": True, "tolerance": tolerance},
        demos=file,
    )


def add_noise(
    file: Source, *, out: Path, tier: Literal["low", "medium", "high"] = "medium", seed: int = 0
) -> None:
    """Add the errors of a worse hand tracker to demonstrations: the published paper's tiers.

    Args:
        file: Archive of demonstrations.
        out: Archive to write.
        tier: The hand is off by at most 10, 20 or 40 mm along each axis, and each keypoint of its fingers by 3, 6 or
            12 mm, before the bones get their lengths back.
        seed: Seed of the errors.
    """
    from xreset.demos.noise import TIERS, with_noise

    _save(
        with_noise(_read(file), **TIERS[tier], seed=seed),
        out,
        {"noise": tier, "seed": seed},
        demos=file,
    )


def describe(file: Source, *, meshes: Path | None = None) -> None:
    """Describe an archive of demonstrations, object by object, and warn of implausible sequences.

    Args:
        file: The archive.
        meshes: Folder of the objects' meshes, to examine the recordings with.
    """
    _print_summary(_read(file), file, meshes)


def _read(file: Path) -> Demos:
    from xreset.demos.archive import read_demos

    return read_demos(file)


def _save(
    made: Demos, out: Path, config: dict[str, Any], meshes: Path | None = None, **inputs: Path
) -> None:
    """Write demonstrations and print their summary; meshes: what to examine them with; inputs: the files that they
    were made from, by kind."""
    from xreset.demos.archive import write_demos

    write_demos(
        out, made, config=config, inputs={name: file_hash(path) for name, path in inputs.items()}
    )
    _print_summary(made, out, meshes)


def _print_summary(demos: Demos, path: Path, meshes: Path | None) -> None:
    from xreset.demos.archive import start_to_goal
    from xreset.demos.examine import examine, surfaces_of

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
    console.print(
        f"{path}: {demos.num_sequences} sequences, {demos.num_frames} frames at {demos.fps:g} per second"
    )
    show_notes(map(str, examine(demos, surfaces_of(demos, meshes))))


COMMAND = {
    "import dexycb": import_dexycb,
    "import ho3d": import_ho3d,
    "import keypoints": import_keypoints,
    "synth": synth,
    "select": select,
    "split": split,
    "merge": merge,
    "mirror": reflect,
    "noise": add_noise,
    "info": describe,
}
