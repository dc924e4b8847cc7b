"""Functions that are commands as well: their signatures are the options, and their docstrings the help.

They import most of what they need when they are called, because the help of a command is shown at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from xreset.errors import DemoError
from xreset.files.checks import (
    Option,
    Options,
    OutputFile,
    PositiveInt,
    Rule,
    Seed,
    Share,
    first_repeated,
    frozen,
    obeys_rules,
)
from xreset.files.progress import Progress, unseen
from xreset.files.records import RATE, replaces
from xreset.files.storage import file_hash

if TYPE_CHECKING:
    from xreset.demos.archive import Demos
else:  # a command has files in place of these
    Demos = Any

ArchiveFile = Annotated[OutputFile, replaces("xreset-demos/")]
Rate = Annotated[
    float, Rule(f"a number from {RATE[0]:g} to {RATE[1]:g}", lambda x: RATE[0] <= x <= RATE[1])
]


@obeys_rules
def import_dexycb(folder: str | Path, out: ArchiveFile, *, progress: Progress = unseen) -> Demos:
    """Read DexYCB in its own layout and write an archive of demonstrations.

    Args:
        folder: the folder that holds the subjects' folders and ``calibration``.
        out: archive to write.
        progress: called with (sequences done, sequences in all).

    Raises:
        DemoError: the folder is not in DexYCB's layout, or parts of a sequence are missing or contradict each other.
    """
    from xreset.demos.archive import write_demos
    from xreset.demos.dexycb import read_dexycb

    demos = read_dexycb(folder, progress=progress)
    write_demos(out, demos, config={"dataset": "dexycb"})
    return demos


@obeys_rules
def import_keypoints(
    path: str | Path,
    out: ArchiveFile | None = None,
    *,
    order: Literal["mano", "mediapipe", "openpose"],
    units: Literal["m", "mm"],
    coordinates: Literal["table", "camera"],
    table_from_camera: str | Path | None = None,
    fps: Rate | None = None,
    object_name: Annotated[str | None, Option("object")] = None,
    side: Literal["right", "left"] | None = None,
    meshes: str | Path | None = None,
    trust: Annotated[bool, Option("trust_recordings")] = False,
) -> Demos:
    """Read 21 hand keypoints and object poses of any tracker as demonstrations.

    Nothing is guessed: options must state what the files do not, and options that contradict the numbers are refused.
    The page docs/demonstrations.md has the layout of the files.

    Args:
        path: an npz file (one sequence), a CSV file (one row for each frame), or a folder of them.
        out: archive to write.
        order: order of the keypoints.
        units: unit of keypoints and object positions.
        coordinates: frame of all positions: the table's (z up, table top at z = 0) or that of a fixed camera.
        table_from_camera: file with the camera's pose in the table frame: 4x4, metres, as text.
        fps: frames per second; files with times are resampled to it.
        object_name: name of the grasped object, if the files do not state it.
        side: side of the hand, if the files do not state it.
        meshes: folder of the objects' meshes, to examine the recordings with.
        trust: take recordings that are certainly wrong all the same.

    Returns:
        The demonstrations in metres and in the table frame.

    Raises:
        DemoError: something about the numbers is unknown or contradicts itself; the message names the option that
            states it.
        FileFormatError: an npz file is damaged or does not have the arrays.
    """
    from xreset.demos.archive import write_demos
    from xreset.demos.keypoints import Convention, read_keypoints, read_transform

    T = None if table_from_camera is None else read_transform(table_from_camera)
    convention = Convention(
        order=order,
        units=units,
        frame=coordinates,
        table_from_camera=T,
        fps=fps,
        object_name=object_name,
        side=side,
    )
    demos = read_keypoints(path, convention, meshes=meshes, trust=trust)
    config = {
        "dataset": "keypoints",
        **vars(convention),
        "table_from_camera": None if T is None else T.tolist(),
    }
    inputs = {"keypoints": file_hash(path)} if Path(path).is_file() else {}
    if out is not None:
        write_demos(out, demos, config=config, inputs=inputs)
    return demos


@obeys_rules
def synthesize(
    names: Annotated[tuple[str, ...] | Iterable[str] | None, Option("objects")] = None,
    per_object: PositiveInt = 4,
    seed: Seed = 0,
    *,
    out: ArchiveFile | None = None,
    fps: Annotated[float, Option(None)] = 30.0,
    side: Literal["right", "left", "both"] = "right",
    meshes: str | Path | None = None,
    progress: Progress = unseen,
) -> Demos:
    """Synthesize demonstrations: reach, grasp, lift, turn.

    The same arguments give the same arrays, and a sequence does not depend on the other sequences.

    Args:
        names: object to grasp, or several, by their official names or the paper's; default: all.
        per_object: sequences of each object (and hand).
        seed: the same seed gives the same file. It chooses all that varies: place and heading of the object, grasp,
            paths, timing, goal pose.
        out: archive to write.
        fps: frames per second; a sequence lasts about 2.4 s.
        side: hand.
        meshes: folder of real meshes, with z up; default: the built-in stand-ins.
        progress: called with (sequences done, sequences in all).

    Raises:
        ObjectError: unknown object.
        DemoError: ``per_object`` or ``fps`` is out of range, the side is none, or an object cannot be held.
    """
    from xreset.demos.archive import write_demos
    from xreset.demos.synth import synthetic_demos

    sides = ("right", "left") if side == "both" else (side,)
    if names is not None:
        names = [names] if isinstance(names, str) else list(names)
    demos = synthetic_demos(
        names, per_object, seed, fps=fps, sides=sides, meshes=meshes, progress=progress
    )
    if out is not None:
        config = {
            "objects": names or [],
            "per_object": per_object,
            "seed": seed,
            "fps": fps,
            "side": side,
        }
        write_demos(out, demos, config=config)
    return demos


@frozen
class Selection(Options):
    """Conditions that a sequence must meet, all of them, and how many sequences of each object are kept."""

    objects: tuple[str, ...] = ()
    """Names of objects: only sequences that grasp one of them."""
    sequences: tuple[str, ...] = ()
    """Only the sequences of these names."""
    subjects: tuple[str, ...] = ()
    """Only sequences that these persons demonstrated."""
    side: Literal["right", "left", "both"] = "both"
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
        return {name: value for name, value in asdict(self).items() if value != ()}


@obeys_rules
def select_demos(
    files: Sequence[str | Path],
    *,
    out: ArchiveFile | None = None,
    rest: ArchiveFile | None = None,
    selection: Selection = Selection(),
    mirror: bool = False,
    meshes: str | Path | None = None,
    say: Callable[[str], None] = print,
) -> tuple[Demos, Demos | None]:
    """Describe archives of demonstrations, object by object, and take sequences out of them.

    Implausible sequences are listed. Without conditions, all sequences are taken; archives have the same frame rate.

    Args:
        files: archives of demonstrations, whose sequences have different names.
        out: archive to write; default: nothing is written.
        rest: archive to write: the sequences that do not meet the conditions, such as those of a test.
        selection: conditions.
        mirror: take left hands only, and mirror them, so that a right-handed robot can train on them. Objects that are
            not their own mirror image are listed and left out.
        meshes: folder of real meshes, to examine the recordings with, and whose symmetry --mirror needs; default: the
            built-in stand-ins.
        say: called with a line about each mirrored object, and about each object that only one of the two archives has.

    Returns:
        The sequences that meet the conditions; and, if they have a file, the others.

    Raises:
        DemoError: a condition is wrong, no sequence is left, or an archive is given twice.
    """
    from xreset.demos.archive import merge_demos, read_demos, write_demos

    if (i := first_repeated([Path(file).resolve() for file in files])) is not None:
        raise DemoError(f"The archive {files[i]} is given twice. Give each archive once.")
    demos = merge_demos([*map(read_demos, files)])
    inputs = {f"demos {i}": file_hash(file) for i, file in enumerate(files)}
    others = None
    if rest is None:
        kept = demos.select(**selection.conditions())
    else:
        kept, others = demos.split(**selection.conditions())
        if not selection.objects:
            _name_missing(kept, others, str(rest), say)
            _name_missing(others, kept, str(out or "the selection"), say)
    if mirror:
        kept = _mirrored(kept.select(side="left"), meshes, say)
    if rest is not None and others is not None:
        write_demos(rest, others, config={"select_others": asdict(selection)}, inputs=inputs)
    if out is not None:
        config = {"select": asdict(selection), "mirrored": mirror}
        write_demos(out, kept, config=config, inputs=inputs)
    return kept, others


def _name_missing(demos: Demos, other: Demos, name: str, say: Callable[[str], None]) -> None:
    """Name the objects of demonstrations that the other part of them, which has a name, lacks."""
    for missing in sorted({*demos.object_names} - {*other.object_names}):
        say(f"{missing}: no sequence is left for {name}")


def _mirrored(demos: Demos, meshes: str | Path | None, say: Callable[[str], None]) -> Demos:
    """Mirror demonstrations, and say how symmetric the objects are."""
    from xreset.demos.archive import demo_objects
    from xreset.demos.mirror import TOLERANCE, mirrored, symmetry

    objects = demo_objects(demos, meshes)
    symmetries = {name: symmetry(spec) for name, spec in objects.items()}
    for name, found in sorted(symmetries.items()):
        verdict = "mirrored" if found.deviation <= TOLERANCE else "left out: not symmetric enough"
        say(f"{name}: {1e3 * found.deviation:.1f} mm from its reflection, {verdict}")
    return mirrored(demos, symmetries)
