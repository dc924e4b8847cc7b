"""The archive of demonstrations: all sequences behind one another, in one npz file.

Shape letters: S sequences, F frames of all sequences, 21 keypoints (``xreset.spec.KEYPOINTS``). Metres, quaternions (w, x, y, z). Poses
are in the table frame: z up, table top at z = 0, the person at +y.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from xreset.checks import is_rigid
from xreset.errors import DemoError, ObjectError
from xreset.objects.catalogue import canonical_name, load_object, object_names
from xreset.records import POSITION, RATE, UNIT_TOLERANCE, Field, arrays_of, offsets_problem, read_record, write_record
from xreset.spec import ObjectSpec

SCHEMA_NAME = "xreset-demos/1"
SIDES = ("right", "left")

_HAND = 0.5
"""[m] No keypoint is so far from its wrist: the longest hand on record has 33 cm."""


class ObjectMotions:
    """Motions of objects behind one another: S sequences, F frames of all of them. Base of what files of frames hold."""

    fps: float
    sequence_name: np.ndarray
    object_name: np.ndarray
    frame_offsets: np.ndarray
    object_pos: np.ndarray
    object_quat_wxyz: np.ndarray

    def frames(self, sequence: int) -> slice:
        """The frames of a sequence."""
        return slice(int(self.frame_offsets[sequence]), int(self.frame_offsets[sequence + 1]))

    @property
    def sequence_of_frame(self) -> np.ndarray:
        """[F] index of the sequence that owns each frame."""
        return np.repeat(np.arange(len(self.sequence_name)), np.diff(self.frame_offsets))

    @property
    def start_pose(self) -> tuple[np.ndarray, np.ndarray]:
        """Object pose in each sequence's first frame: [S, 3] and [S, 4]."""
        return self.object_pos[self.frame_offsets[:-1]], self.object_quat_wxyz[self.frame_offsets[:-1]]

    @property
    def goal_pose(self) -> tuple[np.ndarray, np.ndarray]:
        """Object pose in each sequence's last frame, the goal of the task: [S, 3] and [S, 4]."""
        return self.object_pos[self.frame_offsets[1:] - 1], self.object_quat_wxyz[self.frame_offsets[1:] - 1]


@dataclass(frozen=True, kw_only=True)
class Demos(ObjectMotions):
    """Demonstrations of one or several objects; the attributes are the arrays of the file."""

    sequence_name: Annotated[np.ndarray, Field(("S",), "U")]
    """[S] text; unique."""
    subject: Annotated[np.ndarray, Field(("S",), "U")]
    """[S] text: who demonstrated."""
    object_name: Annotated[np.ndarray, Field(("S",), "U")]
    """[S] text: the grasped object's official name."""
    hand_side: Annotated[np.ndarray, Field(("S",), "U")]
    """[S] ``right`` or ``left``."""
    frame_offsets: Annotated[np.ndarray, Field(("S+1",), "i", dtype=np.int32)]
    """[S+1] sequence i owns frames ``frame_offsets[i] : frame_offsets[i + 1]``; see :meth:`frames`."""
    hand_keypoints: Annotated[np.ndarray, Field(("F", 21, 3), "f", within=None)]
    """[F, 21, 3] NaN where the hand was not annotated."""
    hand_valid: Annotated[np.ndarray, Field(("F",), "b")]
    """[F] bool: whether the hand was annotated."""
    wrist_quat_wxyz: Annotated[np.ndarray, Field(("F", 4), "f", within=None)]
    """[F, 4] orientation of MANO's root: a right hand's fingers point along its -x, its palm faces -y; NaN where not annotated."""
    object_pos: Annotated[np.ndarray, Field(("F", 3), "f", within=None)]
    """[F, 3] origin of the object's mesh frame."""
    object_quat_wxyz: Annotated[np.ndarray, Field(("F", 4), "f", within=None)]
    """[F, 4]"""
    fps: Annotated[float, Field((), "f", within=None, dtype=np.float32)]
    """Frames per second."""
    subjects: Annotated[np.ndarray, Field(("B",), "U")] | None = None
    """[B] the subjects that ``T_level_from_table`` is given for."""
    T_level_from_table: Annotated[np.ndarray, Field(("B", 4, 4), "f", within=POSITION)] | None = None
    """[B, 4, 4] per subject: takes poses to a frame whose z axis is the true table's normal; see :func:`xreset.demos.levelled`."""

    @property
    def num_sequences(self) -> int:
        """S."""
        return len(self.sequence_name)

    @property
    def num_frames(self) -> int:
        """F."""
        return len(self.object_pos)

    def __len__(self) -> int:
        return self.num_sequences

    def select(
        self,
        *,
        indices: Iterable[int] | None = None,
        names: Iterable[str] | None = None,
        objects: Iterable[str] | None = None,
        sides: Iterable[str] | None = None,
        max_per_object: int | None = None,
        spread: bool = False,
    ) -> Demos:
        """The sequences that meet every condition given.

        Args:
            indices: sequence indices; the result has their order.
            objects: object names, official or the paper's.
            max_per_object: keep the first so many of each object.
            spread: keep so many of each object from all over the archive in place of the first, which in most archives are one person's.

        Raises:
            DemoError: an index, name, object or side that is not there, or nothing is left.
        """
        chosen = np.arange(self.num_sequences) if indices is None else np.asarray(list(indices), dtype=np.int64)
        if ((chosen < 0) | (chosen >= self.num_sequences)).any():
            raise DemoError(
                f"sequence indices {chosen.tolist()} asked for; there are {self.num_sequences} sequences, counted from 0."
            )
        if names is not None:
            chosen = chosen[np.isin(self.sequence_name[chosen], _all_there("sequences", names, self.sequence_name))]
        if objects is not None:
            there = sorted(set(self.object_name.tolist()))
            try:
                wanted = [canonical_name(name, there) for name in objects]
            except ObjectError as error:
                raise DemoError(f"these demonstrations do not have what was asked for: {error}") from None
            chosen = chosen[np.isin(self.object_name[chosen], wanted)]
        if sides is not None:
            chosen = chosen[np.isin(self.hand_side[chosen], _all_there("hand sides", sides, self.hand_side))]
        if max_per_object is not None:
            objects_of = self.object_name[chosen]
            different = np.unique(objects_of)
            kept = []
            for number, name in enumerate(different):
                rows = np.flatnonzero(objects_of == name)
                picks = np.arange(min(max_per_object, len(rows)))
                if spread:  # from as many even parts, and from another place in them for every object
                    picks = ((picks + (number + 0.5) / len(different)) * len(rows) / max(len(picks), 1)).astype(int)
                kept.append(rows[picks])
            chosen = chosen[np.sort(np.concatenate(kept))] if kept else chosen
        if not len(chosen):
            raise DemoError("no sequence meets all the conditions of the selection; relax one of them.")
        return self._take(chosen)

    def _take(self, chosen: np.ndarray) -> Demos:
        lengths = np.diff(self.frame_offsets)[chosen]
        frames = np.concatenate([np.arange(*self.frames(i).indices(self.num_frames)) for i in chosen])
        per_sequence = {name: getattr(self, name)[chosen] for name in _PER_SEQUENCE}
        per_frame = {name: getattr(self, name)[frames] for name in _PER_FRAME}
        return replace(self, frame_offsets=_offsets(lengths), **per_sequence, **per_frame)


_PER_SEQUENCE = ("sequence_name", "subject", "object_name", "hand_side")
_PER_FRAME = ("hand_keypoints", "hand_valid", "wrist_quat_wxyz", "object_pos", "object_quat_wxyz")


def concatenate(parts: Sequence[Demos]) -> Demos:
    """Several sets of demonstrations behind one another.

    Raises:
        DemoError: nothing to concatenate, different frame rates, or one sequence name twice.
    """
    if not parts:
        raise DemoError("there are no demonstrations to concatenate.")
    rates = sorted({round(float(part.fps), 3) for part in parts})
    if len(rates) > 1:
        raise DemoError(
            f"demonstrations with different frame rates ({', '.join(map(str, rates))} per second) cannot share a file."
        )
    joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in (*_PER_SEQUENCE, *_PER_FRAME)}
    levels: dict[str, np.ndarray] = {}
    for part in parts:
        if part.subjects is not None and part.T_level_from_table is not None:
            levels |= dict(zip(part.subjects.tolist(), part.T_level_from_table, strict=True))
    demos = Demos(
        frame_offsets=_offsets(np.concatenate([np.diff(part.frame_offsets) for part in parts])),
        fps=parts[0].fps,
        subjects=np.array(list(levels)) if levels else None,
        T_level_from_table=np.array(list(levels.values())) if levels else None,
        **joined,
    )
    if problem := _problem(arrays_of(demos)):
        raise DemoError(f"the demonstrations do not fit together: {problem}")
    return demos


def read_demos(path: str | Path) -> Demos:
    """Read an archive; all of it is checked before any of it is used.

    Raises:
        FileFormatError: the file is missing, damaged or not an archive, or a value in it is wrong: the message names sequence and frame.
    """
    return read_record(Demos, path, SCHEMA_NAME, what="an archive of demonstrations", check=_problem)


def write_demos(
    path: str | Path, demos: Demos, *, config: Mapping[str, Any] | None = None, inputs: Mapping[str, str] | None = None
) -> None:
    """Write an archive (see :func:`xreset.records.write_npz` for ``config`` and ``inputs``).

    Raises:
        DemoError: the demonstrations hold a value that the archive may not hold.
    """
    if problem := _problem(arrays_of(demos)):
        raise DemoError(f"these demonstrations cannot be written: {problem}")
    write_record(path, SCHEMA_NAME, demos, config=config, inputs=inputs)


def demo_objects(demos: Demos, folder: Path | None = None) -> dict[str, ObjectSpec]:
    """The objects that the demonstrations need, by name: stand-ins, or the meshes of a folder.

    Raises:
        DemoError: an object is unknown; the message names a sequence that needs it, and the objects that there are.
        ObjectError: a mesh cannot be used.
    """
    known = object_names(folder)
    objects: dict[str, ObjectSpec] = {}
    for name, sequence in zip(demos.object_name.tolist(), demos.sequence_name.tolist(), strict=True):
        if name in objects:
            continue
        try:
            canonical_name(name, known)
        except ObjectError as error:
            where = (
                "among the built-in stand-ins; give a folder of meshes with --objects"
                if folder is None
                else f"in {folder}"
            )
            raise DemoError(f"sequence {sequence!r} needs the object {name!r}, which is not {where}: {error}") from None
        objects[name] = load_object(name, folder)
    return objects


def _offsets(lengths: np.ndarray) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32)


def _all_there(what: str, wanted: Iterable[str], there: np.ndarray) -> list[str]:
    wanted, known = list(wanted), sorted(set(there.tolist()))
    missing = [name for name in wanted if name not in known]
    if missing:
        shown = ", ".join(known[:8]) + (f" and {len(known) - 8} more" if len(known) > 8 else "")
        raise DemoError(f"these demonstrations have no {what} {', '.join(missing)}; there are {shown}.")
    return wanted


def _problem(arrays: Mapping[str, Any]) -> str | None:
    """What is wrong with the values, or None. Types and shapes have been checked."""
    offsets, names = np.asarray(arrays["frame_offsets"]), arrays["sequence_name"]
    frames = len(arrays["object_pos"])
    if problem := offsets_problem(arrays, frames):
        return problem
    wrong = ~np.isin(arrays["hand_side"], SIDES)
    if wrong.any():
        i = int(np.argmax(wrong))
        return f"sequence {i} ({names[i]!s}) has hand_side {str(arrays['hand_side'][i])!r}, expected 'right' or 'left'."
    if not RATE[0] <= arrays["fps"] <= RATE[1]:
        return f"fps is {arrays['fps']}, expected a positive number, from {RATE[0]:g} to {RATE[1]:g}."
    if (arrays.get("subjects") is None) != (arrays.get("T_level_from_table") is None):
        return "subjects and T_level_from_table belong together, but one of them is missing."
    level = arrays.get("T_level_from_table")
    if level is not None and not (
        np.isfinite(level).all() and all(is_rigid(T) for T in np.asarray(level, dtype=float))
    ):
        return "T_level_from_table has a matrix that is no rotation and translation."

    def first(bad: np.ndarray) -> str:
        frame = int(np.argmax(bad))
        sequence = int(np.searchsorted(offsets, frame, side="right")) - 1
        return f"frame {frame - offsets[sequence]} of sequence {sequence} ({names[sequence]!s})"

    valid = np.asarray(arrays["hand_valid"])
    for name, where in (
        ("object_pos", True),
        ("object_quat_wxyz", True),
        ("hand_keypoints", valid),
        ("wrist_quat_wxyz", valid),
    ):
        bad = ~np.isfinite(arrays[name]).reshape(frames, -1).all(axis=1) & where
        if bad.any():
            hint = "; mark the frame in hand_valid if the hand is not known there" if where is valid else ""
            return f"{name} is not finite in {first(bad)}{hint}."
    for name, where in (("object_quat_wxyz", np.ones(frames, dtype=bool)), ("wrist_quat_wxyz", valid)):
        norm = np.linalg.norm(np.where(where[:, None], arrays[name], [1.0, 0, 0, 0]), axis=1)
        bad = np.abs(norm - 1) > UNIT_TOLERANCE
        if bad.any():
            return f"{name} has length {norm[np.argmax(bad)]:.4f} in {first(bad)}, expected unit quaternions."
    bad = (np.abs(arrays["object_pos"]) > POSITION[1]).any(axis=1)
    if bad.any():
        place = np.round(arrays["object_pos"][np.argmax(bad)], 3).tolist()
        return f"object_pos is {place} in {first(bad)}, expected metres in the table frame."
    hand = np.where(valid[:, None, None], arrays["hand_keypoints"], 0.0)
    bad = np.linalg.norm(hand[:, 1:] - hand[:, :1], axis=2).max(axis=1) > _HAND
    if bad.any():
        size = float(np.linalg.norm(hand[:, 1:] - hand[:, :1], axis=2).max(axis=1)[np.argmax(bad)])
        unit = " Are these millimetres?" if 0.05 < size / 1000 < _HAND else ""
        return f"hand_keypoints are up to {size:.4g} m from the wrist in {first(bad)}, expected the metres of a hand.{unit}"
    bad = np.abs(hand).max(axis=(1, 2)) > POSITION[1]
    if bad.any():
        return f"hand_keypoints are over {POSITION[1]:g} m away in {first(bad)}, expected metres in the table frame."
    return None
