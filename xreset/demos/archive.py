"""The archive of demonstrations: all sequences one after another, in one npz file.

Shape letters: S sequences, F frames of all sequences, 21 keypoints (``xreset.spec.KEYPOINTS``). Metres, quaternions (w,
x, y, z). Poses are in the table frame: z up, table top at z = 0, the person at +y.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from xreset.errors import DemoError, ObjectError
from xreset.files.checks import Seed, frozen, is_rigid, obeys_rules
from xreset.files.records import (
    POSITION,
    RATE,
    UNIT_TOLERANCE,
    Arrays,
    Field,
    arrays_of,
    offsets_problem,
    read_record,
    record_problem,
    write_record,
)
from xreset.files.text import Brief, quantity, shown, texts
from xreset.geometry.shapes import quat_of, turn_of
from xreset.objects.catalogue import canonical_names, load_object, object_names, official_name
from xreset.objects.rest import rest_height
from xreset.objects.sampling import centers_of_mass
from xreset.objects.standins import STAND_INS
from xreset.spec import ObjectSpec, objects_named

SCHEMA_NAME = "xreset-demos/1"
SIDES = ("right", "left")

_ON_TABLE = 0.020
"""Largest height above the table at which an object counts as standing on it [m]. In 270 sequences of DexYCB all but
one are within 12 mm; that one is 44 mm up."""
_SAME_RATE = 1e-4
"""Frame rates that differ by less than this share are rounded ones: 59.999 and 60."""
_HAND = 0.5
"""Largest distance of a keypoint from its wrist [m]; the longest hand on record has 0.33 m."""
OneText = Annotated[str, Field((), "U")]
SequenceTexts = Annotated[np.ndarray, Field(("S",), "U")]
SequencePositions = Annotated[np.ndarray, Field(("S", 3), "f", within=POSITION)]
SequenceQuaternions = Annotated[np.ndarray, Field(("S", 4), "f", unit=True)]
FrameFlags = Annotated[np.ndarray, Field(("F",), "b")]
FramePositions = Annotated[np.ndarray, Field(("F", 3), "f", within=POSITION)]
FrameQuaternions = Annotated[np.ndarray, Field(("F", 4), "f", unit=True)]

_PER_SEQUENCE = ("sequence_name", "subject", "object_name", "hand_side")
_PER_FRAME = ("hand_keypoints", "hand_valid", "wrist_quat_wxyz", "object_pos", "object_quat_wxyz")


class ObjectMotions(Brief):
    """Motions of objects one after another: S sequences, F frames of all of them. Base of records of frames."""

    fps: float
    sequence_name: np.ndarray
    object_name: np.ndarray
    frame_offsets: np.ndarray
    object_pos: np.ndarray
    object_quat_wxyz: np.ndarray

    def __repr__(self) -> str:
        sequences = quantity(len(self.sequence_name), "sequence")
        frames = quantity(len(self.object_pos), "frame")
        objects = quantity(len(self.object_names), "object")
        return f"{type(self).__name__}({sequences}, {frames}, {objects})"

    @property
    def object_names(self) -> tuple[str, ...]:
        """Names of the objects, sorted."""
        return tuple(np.unique(self.object_name).tolist())

    def frames(self, sequence: int) -> slice:
        """Frames of a sequence."""
        return slice(int(self.frame_offsets[sequence]), int(self.frame_offsets[sequence + 1]))

    @property
    def sequence_of_frame(self) -> np.ndarray:
        """[F] index of the sequence that owns each frame."""
        return np.repeat(np.arange(len(self.sequence_name)), np.diff(self.frame_offsets))

    @property
    def start_pose(self) -> tuple[np.ndarray, np.ndarray]:
        """Object pose in each sequence's first frame: [S, 3] and [S, 4]."""
        first = self.frame_offsets[:-1]
        return self.object_pos[first], self.object_quat_wxyz[first]

    @property
    def goal_pose(self) -> tuple[np.ndarray, np.ndarray]:
        """Object pose in each sequence's last frame, the goal of the task: [S, 3] and [S, 4]."""
        last = self.frame_offsets[1:] - 1
        return self.object_pos[last], self.object_quat_wxyz[last]

    def shift(self, objects: Sequence[ObjectSpec]) -> np.ndarray:
        """[F, 3] from each object's center of mass in its sequence's first frame to the present one [m]. Objects that
        are not given have the shift of their origin, which depends on their mesh file."""
        owner = self.sequence_of_frame
        names = self.object_name[owner]
        places = centers_of_mass(objects, names, self.object_pos, self.object_quat_wxyz)
        return places - places[self.frame_offsets[:-1]][owner]


@frozen
class Demos(ObjectMotions):
    """Demonstrations of one or several objects; the attributes are the arrays of the file."""

    sequence_name: SequenceTexts
    """[S] text; unique."""
    subject: SequenceTexts
    """[S] text: the demonstrating person."""
    object_name: SequenceTexts
    """[S] text: the grasped object's official name."""
    hand_side: SequenceTexts
    """[S] ``right`` or ``left``."""
    frame_offsets: Annotated[np.ndarray, Field(("S+1",), "i", dtype=np.int32)]
    """[S+1] sequence i owns frames ``frame_offsets[i] : frame_offsets[i + 1]``; see :meth:`frames`."""
    hand_keypoints: Annotated[np.ndarray, Field(("F", 21, 3), "f", within=None)]
    """[F, 21, 3] NaN where the hand was not annotated."""
    hand_valid: FrameFlags
    """[F] bool: whether the hand was annotated."""
    wrist_quat_wxyz: Annotated[np.ndarray, Field(("F", 4), "f", within=None)]
    """[F, 4] orientation of MANO's root: a right hand's fingers point along its -x, its palm faces -y; NaN where not
    annotated."""
    object_pos: FramePositions
    """[F, 3] origin of the object's mesh frame."""
    object_quat_wxyz: FrameQuaternions
    """[F, 4]"""
    fps: Annotated[float, Field((), "f", within=RATE, dtype=np.float32)]
    """Frames per second."""
    subjects: Annotated[np.ndarray, Field(("B",), "U")] | None = None
    """[B] the subjects that ``T_level_from_table`` is given for."""
    T_level_from_table: Annotated[np.ndarray, Field(("B", 4, 4), "f", within=POSITION)] | None = (
        None
    )
    """[B, 4, 4] per subject: takes poses to a frame whose z axis is the true table's normal
    (:func:`levelled`)."""

    @property
    def num_sequences(self) -> int:
        """Number of sequences (S)."""
        return len(self.sequence_name)

    @property
    def num_frames(self) -> int:
        """Number of frames of all sequences (F)."""
        return len(self.object_pos)

    def __len__(self) -> int:
        return self.num_sequences

    @obeys_rules
    def select(
        self,
        *,
        objects: Iterable[str] | None = None,
        sequences: Iterable[str] | None = None,
        subjects: Iterable[str] | None = None,
        side: Literal["right", "left", "both"] = "both",
        per_object: int | None = None,
        share: float = 1.0,
        pick: Literal["first", "spread", "random"] = "first",
        seed: Seed = 0,
        indices: Iterable[int] | None = None,
    ) -> Demos:
        """Return the sequences that meet every given condition. A single name need not be in a list.

        Args:
            objects: object names, official or the paper's.
            sequences: names of sequences.
            subjects: names of the demonstrating persons.
            side: hand.
            per_object: keep at most this many sequences of each object.
            share: keep this share of each object's sequences, at least one.
            pick: which ones of an object these are: the ``first``, which in most archives are one person's, some from
                all over the archive (``spread``), or ``random`` ones, whose choice does not depend on other objects.
            seed: of random ones.
            indices: sequence indices; the result has their order.

        Raises:
            DemoError: unknown or repeated index, unknown name, object or subject (the message names all of them), no
                such hand, a share that is none, ``pick`` or ``seed`` without effect, or nothing is left.
        """
        if pick not in ("first", "spread", "random"):
            raise DemoError(f"pick is {shown(pick)}, expected first, spread or random.")
        if pick != "first" and per_object is None and share == 1:
            raise DemoError(
                f"--pick {pick} needs a number of sequences. Add --per-object or --share."
            )
        if seed and pick != "random":
            raise DemoError(f"--seed {seed} is for random picks. Add --pick random, or omit it.")
        chosen = np.arange(len(self))
        if indices is not None:
            chosen = np.asarray(list(indices))
            if chosen.size and chosen.dtype.kind not in "iu":
                raise DemoError(
                    f"indices is {shown(indices)}, expected whole numbers. Of a mask: np.flatnonzero(mask)."
                )
            chosen = chosen.astype(np.int64)
            if not np.isin(chosen, range(len(self))).all():
                raise DemoError(
                    f"Unknown sequence index in {chosen.tolist()}: there are {len(self)} sequences."
                )
            if len({*chosen.tolist()}) < len(chosen):
                raise DemoError(f"A sequence index occurs twice in {chosen.tolist()}.")
        if objects is not None:
            try:
                objects = canonical_names(objects, self.object_names)
            except ObjectError as error:
                raise DemoError(f"The demonstrations lack an object: {error}") from None
        wanted = {
            "sequence_name": sequences,
            "object_name": objects,
            "hand_side": None if side == "both" else side,
            "subject": subjects,
        }
        for field, values in wanted.items():
            if values is not None:
                chosen = chosen[np.isin(getattr(self, field)[chosen], self._known(field, values))]
        if not 0 < share <= 1:
            raise DemoError(f"The share is {share:g}, expected a number above 0 and at most 1.")
        if per_object is not None or share < 1:
            chosen = self._few_per_object(chosen, per_object, share, pick, seed)
        if not len(chosen):
            raise DemoError("No sequence meets all conditions of the selection. Relax one of them.")
        frames = [np.r_[self.frames(i)] for i in chosen.tolist()]
        rows = np.concatenate(frames)
        changes = {name: getattr(self, name)[chosen] for name in _PER_SEQUENCE}
        changes |= {name: getattr(self, name)[rows] for name in _PER_FRAME}
        return replace(self, frame_offsets=_offsets([len(part) for part in frames]), **changes)

    def split(self, **conditions: Any) -> tuple[Demos, Demos]:
        """Return the sequences that :meth:`select` keeps, and the others, in the archive's order.

        Raises:
            DemoError: one of the two would be empty, or a condition is wrong.
        """
        kept = self.select(**conditions)
        others = np.flatnonzero(~np.isin(self.sequence_name, kept.sequence_name))
        if not len(others):
            raise DemoError(
                "Every sequence meets the conditions, so that none is left for the other part. Add one."
            )
        return kept, self.select(indices=others)

    def _known(self, field: str, wanted: Iterable[str]) -> tuple[str, ...]:
        """Return the wanted values of a field, all of which exist."""
        wanted = texts(wanted)
        known = np.unique(getattr(self, field)).tolist()
        if missing := [name for name in wanted if name not in known]:
            what = field.removesuffix("_name").replace("_", " ")
            names = ", ".join(map(shown, known[:8])) + " and more" * (len(known) > 8)
            raise DemoError(
                f"The demonstrations have no {what} {', '.join(missing)}. Choose from: {names}."
            )
        return wanted

    def _few_per_object(
        self, chosen: np.ndarray, most: int | None, share: float, pick: str, seed: int
    ) -> np.ndarray:
        """Return some of the chosen sequences of each object; arguments as of :meth:`select`."""
        names = self.object_name[chosen]
        objects = np.unique(names)
        kept = []
        for number, name in enumerate(objects):
            rows = np.flatnonzero(names == name)
            count = max(1, round(share * len(rows)))
            if most is not None:
                count = min(count, max(most, 0))
            if pick == "random":
                random = np.random.default_rng([seed, zlib.crc32(name.encode())])
                rows = random.permutation(rows)
            elif pick == "spread":
                # one from each of n even parts, at another place in the parts for every object
                place = (number + 0.5) / len(objects)
                rows = rows[((np.arange(count) + place) * len(rows) / count).astype(int)]
            kept.extend(rows[:count])
        return chosen[np.sort(np.array(kept, dtype=int))]


def one_sequence(
    *,
    name: str,
    subject: str,
    object_name: str,
    side: str,
    fps: float,
    keypoints: np.ndarray,
    wrist: Rotation | None,
    object_pos: np.ndarray,
    object_rot: Rotation,
) -> Demos:
    """Make the demonstrations of one sequence of F frames, in the types of the file.

    Args:
        keypoints: [F, 21, 3] NaN in frames without a hand.
        wrist: orientations in the frames with a hand; None: no frame has one (scipy 1.14 refuses zero
            orientations).
        object_pos: [F, 3]
        object_rot: F orientations.
    """
    valid = np.asarray(np.isfinite(keypoints).all(axis=(1, 2)))
    wrist_quat = np.full((len(keypoints), 4), np.nan, dtype=np.float32)
    if wrist is not None:
        wrist_quat[valid] = quat_of(wrist)
    return Demos(
        sequence_name=np.array([name]),
        subject=np.array([subject]),
        object_name=np.array([object_name]),
        hand_side=np.array([side]),
        frame_offsets=_offsets([len(keypoints)]),
        hand_keypoints=keypoints.astype(np.float32),
        hand_valid=valid,
        wrist_quat_wxyz=wrist_quat,
        object_pos=object_pos.astype(np.float32),
        object_quat_wxyz=quat_of(object_rot).astype(np.float32),
        fps=float(fps),
    )


def merge_demos(parts: Sequence[Demos]) -> Demos:
    """Join several sets of demonstrations, one after another, levelled.

    Raises:
        DemoError: there is nothing to join, the parts differ in their frame rates, or two sequences have the same name.
    """
    if not parts:
        raise DemoError("There are no demonstrations to join. Give one archive, or several.")
    rates = sorted({round(float(part.fps), 3) for part in parts})
    if rates[-1] > (1 + _SAME_RATE) * rates[0]:
        raise DemoError(
            f"Demonstrations in one file must have one frame rate, but these have the frame rates {rates}. Import them"
            " with --fps, which resamples files that have times."
        )
    parts = [levelled(part) for part in parts]
    joined = {}
    for name in _PER_SEQUENCE + _PER_FRAME:
        joined[name] = np.concatenate([getattr(part, name) for part in parts])
    demos = Demos(
        frame_offsets=_offsets(np.concatenate([np.diff(part.frame_offsets) for part in parts])),
        fps=parts[0].fps,
        **joined,
    )
    if problem := record_problem(Demos, arrays_of(Demos, demos), _problem):
        raise DemoError(f"The demonstrations cannot be used: {problem}")
    return demos


def levelled(demos: Demos) -> Demos:
    """Return the demonstrations in a frame whose z axis is the true table's normal, by ``T_level_from_table`` (the
    paper, appendix D.a).

    DexYCB's tag plane is tilted by about one degree against the table. Demonstrations without the transforms stay
    unchanged.

    Raises:
        DemoError: some subjects have a transform, but another does not.
    """
    if demos.T_level_from_table is None or demos.subjects is None:
        return demos
    known = demos.subjects.tolist()
    if missing := sorted(set(demos.subject.tolist()) - set(known)):
        raise DemoError(
            f"T_level_from_table is given for {', '.join(known)}, but not for {', '.join(missing)}."
        )
    subject = np.array([known.index(name) for name in demos.subject.tolist()])
    T = demos.T_level_from_table[subject][demos.sequence_of_frame]
    R = T[:, :3, :3]
    valid = demos.hand_valid
    wrist = demos.wrist_quat_wxyz.copy()
    wrist[valid] = _turned(R[valid], wrist[valid])
    keypoints = np.einsum("fij,fkj->fki", R, demos.hand_keypoints) + T[:, None, :3, 3]
    pos = np.einsum("fij,fj->fi", R, demos.object_pos) + T[:, :3, 3]
    return replace(
        demos,
        hand_keypoints=keypoints.astype(demos.hand_keypoints.dtype),
        wrist_quat_wxyz=wrist,
        object_pos=pos.astype(demos.object_pos.dtype),
        object_quat_wxyz=_turned(R, demos.object_quat_wxyz),
        subjects=None,
        T_level_from_table=None,
    )


def _turned(R: np.ndarray, quats: np.ndarray) -> np.ndarray:
    """[F, 4] orientations turned by rotation matrices [F, 3, 3]."""
    turned = Rotation.from_matrix(R) * turn_of(quats)
    return turned.as_quat(scalar_first=True).astype(quats.dtype)


def grounded(demos: Demos, objects: Mapping[str, ObjectSpec]) -> Demos:
    """Shift every sequence along z so that its object's lowest vertex is at z = 0 in the first frame.

    A sequence whose object starts on top of something stays where it is, or its hand would reach into the table. The
    scene does not have what is below the object, so in physics the object first drops by that height.
    """
    heights = []  # of the object's lowest vertex
    for name, pos, quat in zip(demos.object_name.tolist(), *demos.start_pose, strict=True):
        heights.append(pos[2] - rest_height(objects[name], quat))
    height = np.array(heights)
    height[height > _ON_TABLE] = 0.0
    shift = np.zeros((demos.num_frames, 3))
    shift[:, 2] = -height[demos.sequence_of_frame]
    return replace(
        demos,
        hand_keypoints=(demos.hand_keypoints + shift[:, None]).astype(demos.hand_keypoints.dtype),
        object_pos=(demos.object_pos + shift).astype(demos.object_pos.dtype),
    )


def read_demos(path: str | Path) -> Demos:
    """Read an archive; all of it is checked before any of it is used. Objects get their official names.

    Raises:
        FileFormatError: the file is missing, damaged or not an archive, or a value in it is wrong: the message names
            sequence and frame.
    """
    demos = read_record(Demos, path, SCHEMA_NAME, what="an archive of xreset demos", check=_problem)
    names = [official_name(name) for name in demos.object_name.tolist()]
    if names != demos.object_name.tolist():
        demos = replace(demos, object_name=np.array(names))
    return demos


def write_demos(
    path: str | Path,
    demos: Demos,
    *,
    config: Mapping[str, Any] | None = None,
    inputs: Mapping[str, str] | None = None,
) -> None:
    """Write an archive (see :func:`xreset.files.records.write_npz` for ``config`` and ``inputs``).

    Raises:
        DemoError: the demonstrations hold a value that the archive may not hold.
    """
    write_record(
        Demos,
        path,
        SCHEMA_NAME,
        demos,
        check=_problem,
        error=DemoError,
        config=config,
        inputs=inputs,
    )


def demo_objects(demos: Demos, meshes: str | Path | None = None) -> dict[str, ObjectSpec]:
    """Return the objects of the demonstrations by name: stand-ins, or the meshes of a folder.

    Raises:
        DemoError: objects are unknown, in which case the message names all of them and the known objects, or have
            another name.
        ObjectError: a mesh cannot be used.
    """
    names = list(dict.fromkeys(demos.object_name.tolist()))
    try:
        found = canonical_names(names, object_names(meshes), meshes)
    except ObjectError as error:
        raise DemoError(f"The demonstrations need objects that are not there. {error}") from None
    for name, full in zip(names, found, strict=True):
        if full != name and name not in STAND_INS:
            raise DemoError(
                f"The demonstrations name an object {shown(name)}, which is {shown(full)} here. Rename its mesh, or"
                " make the demonstrations with this name."
            )
    return {name: load_object(name, meshes) for name in names}


def _offsets(lengths: Sequence[int] | np.ndarray) -> np.ndarray:
    return np.cumsum([0, *lengths], dtype=np.int32)


def sequences_problem(arrays: Arrays) -> str | None:
    """Return what is wrong with the sequences of motions: their frames, their names, or the sides of the hands [S]."""
    if problem := offsets_problem(arrays, len(arrays["object_pos"])):
        return problem
    names = arrays["sequence_name"]
    for name, side in zip(names.tolist(), arrays["hand_side"].tolist(), strict=True):
        if side not in SIDES:
            return f"sequence {name} has hand_side {shown(side)}, expected 'right' or 'left'."
    return None


def _problem(arrays: Arrays) -> str | None:
    """Return the first contradiction, or None. Types, shapes and the fields' own ranges have been checked."""
    offsets = arrays["frame_offsets"]
    names = arrays["sequence_name"]
    if problem := sequences_problem(arrays):
        return problem
    level = arrays.get("T_level_from_table")
    if (arrays.get("subjects") is None) != (level is None):
        return "subjects and T_level_from_table belong together, but one of them is missing."
    if level is not None and not all(is_rigid(T) for T in np.asarray(level, dtype=float)):
        return "T_level_from_table has a matrix that is not a rotation and translation."
    # the values of the hand's arrays do not matter in frames without a hand
    valid = arrays["hand_valid"]
    hand = np.where(valid[:, None, None], arrays["hand_keypoints"], 0.0)
    with np.errstate(invalid="ignore"):
        size = np.linalg.norm(hand[:, 1:] - hand[:, :1], axis=2).max(axis=1)
        length = np.linalg.norm(arrays["wrist_quat_wxyz"], axis=1)
    for problem, fits in (
        (
            f"hand_keypoints are not finite or more than {_HAND} m from the wrist. Are these millimetres?",
            size <= _HAND,
        ),
        ("hand_keypoints are far from the table.", np.abs(hand[:, 0]).max(axis=1) <= POSITION[1]),
        (
            "wrist_quat_wxyz is not a unit quaternion.",
            ~valid | (np.abs(length - 1) <= UNIT_TOLERANCE),
        ),
    ):
        if not fits.all():
            frame = np.argmin(fits)
            sequence = np.searchsorted(offsets, frame, side="right") - 1
            where = f"First in frame {frame - offsets[sequence]} of sequence {sequence} ({names[sequence]!s})."
            return f"{problem} {where} If the hand is unknown there, set hand_valid to False."
    return None


def rest_on_table(demos: Demos, objects: Sequence[ObjectSpec]) -> Demos:
    """Return the demonstrations over a level table on which each object rests in its first frame (the paper, appendix
    D.a); keypoints and object poses are in double precision.

    Raises:
        DemoError: an object of the demonstrations is not among ``objects``.
    """
    demos = grounded(levelled(demos), objects_named(objects, demos.object_names))
    names = ("hand_keypoints", "object_pos", "object_quat_wxyz")
    return replace(demos, **{name: getattr(demos, name).astype(np.float64) for name in names})
