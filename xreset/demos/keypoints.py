"""Reader of demonstrations of any tracker: 21 hand keypoints and the object's pose, frame by frame, as npz, CSV or a
folder of either.

The meaning of the numbers (order of the keypoints, unit, frame, quaternions, rate, hand, object) must be in the file or
be given: it is never guessed. If the numbers contradict what was given, the reader refuses and names the option that
fits. ``docs/demonstrations.md`` has the layout of the files.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.interpolate import interp1d
from scipy.spatial.transform import Rotation, Slerp

from xreset.demos import hand
from xreset.demos.archive import SIDES, Demos, merge_demos, one_sequence
from xreset.demos.causes import length_text
from xreset.demos.examine import examine, refuse_wrong, surfaces_of
from xreset.demos.hand import ORDERS, Order
from xreset.errors import DemoError
from xreset.files.checks import frozen, is_rigid
from xreset.files.records import POSITION, RATE, UNIT_TOLERANCE, Arrays, Field, read_npz
from xreset.files.storage import matches, max_bytes, must_exist
from xreset.files.text import is_plain, shown
from xreset.geometry.shapes import transformed
from xreset.objects.catalogue import official_name

Motion = tuple[np.ndarray, np.ndarray, Rotation]
"""Keypoints [F, 21, 3], object positions [F, 3] and F object orientations."""

MAX_FRAMES = 100_000
"""Most frames that a sequence may be resampled to: 55 minutes at 30 per second, in half a gigabyte."""

_KNUCKLES = [0, 5, 9, 13, 17]
_UNEVEN = 0.1
"""Largest relative deviation of a time step from the median one for frames that count as evenly spaced."""
_SAME_RATE = 1e-3
"""Relative difference of rates that count as one."""
_GAP = 0.3
"""Longest time between two frames over which the hand and a moving object are interpolated [s]."""
_GAP_MOTION = 0.02
"""An object of which a point at 10 cm from its origin moves farther in such a time moves [m]."""
_USUAL_RATES = (24 / 1.001, 30 / 1.001, 60 / 1.001, 120 / 1.001)
"""Rates of video that are no whole numbers [1/s]."""

_TEXTS = ("sequence", "object", "side", "subject")
_FILE = {
    "keypoints": Field(("F", 21, 3), "fi", within=None),
    "object_pose": Field(("F", 4, 4), "fi", required=False),
    "object_pos": Field(("F", 3), "fi", required=False),
    "object_quat_wxyz": Field(("F", 4), "fi", required=False),
    "object_quat_xyzw": Field(("F", 4), "fi", required=False),
    "time": Field(("F",), "fi", required=False),
    "fps": Field((), "fi", required=False, within=RATE),
} | {name: Field((), "U", required=False) for name in _TEXTS}
"""Arrays of a sequence of F frames. Keypoints are NaN where the hand was not seen; ``time`` [s]."""

_COLUMNS = {
    "keypoints": [f"{'xyz'[axis]}{k}" for k, axis in np.ndindex(21, 3)],
    "object_pos": ["object_x", "object_y", "object_z"],
    "object_quat_wxyz": ["object_qw", "object_qx", "object_qy", "object_qz"],
    "time": ["time"],
}
"""Columns of a CSV that hold the numbers of an array, row by row of the array."""


@frozen
class Convention:
    """Meaning of a tracker's numbers; None: as the file says, or refuse."""

    order: Order
    """Order of the 21 keypoints."""
    units: Literal["m", "mm"]
    """Unit of keypoints and object positions."""
    frame: Literal["table", "camera"]
    """``table``: z up, table top at z = 0. ``camera``: the frame of a camera that does not move."""
    table_from_camera: np.ndarray | None = None
    """[4, 4] pose of the camera in the table frame [m]; with ``frame="camera"``."""
    fps: float | None = None
    """Frames per second of a file without times; files with times are resampled to it."""
    object_name: str | None = None
    """The grasped object."""
    side: Literal["right", "left"] | None = None
    """The hand."""


def read_keypoints(
    path: str | Path,
    convention: Convention,
    *,
    meshes: str | Path | None = None,
    trust: bool = False,
) -> Demos:
    """Read a tracker's sequences: an npz (one sequence), a CSV (one, or several with a column ``sequence``), or a
    folder of them; see :func:`~xreset.demos.verbs.import_keypoints`.

    The wrist's orientation is that of five keypoints (wrist and knuckles) fitted to an average hand: 3.9 degrees from
    MANO's at most, on DexYCB.
    """
    path = Path(path)
    if (convention.frame == "camera") != (convention.table_from_camera is not None):
        raise DemoError(
            f"The coordinates are those of the {convention.frame}. Coordinates of a camera need the camera's pose in"
            " the table frame (--table-from-camera FILE), and coordinates of the table must not have one."
        )
    folder = path.parent
    files = [path]
    if path.is_dir():
        folder = path
        files = [
            file
            for file in matches(path, "**/*")
            if file.suffix.lower() in (".npz", ".csv")
            and file.is_file()
            and not file.name.startswith(".")
        ]
        if not files:
            raise DemoError(
                f"There is no .npz and no .csv file below {path}. Give a folder with a file for each sequence."
            )
    parts = []
    for file in files:
        name = file.relative_to(folder).with_suffix("").as_posix()
        if file.suffix.lower() == ".csv":
            sequences = _read_csv(file, name)
        else:
            arrays = read_npz(file, None, _FILE, what="a tracker's keypoints")
            sequences = [{"sequence": np.array(name)} | arrays]
        for arrays in sequences:
            try:
                sequence = _sequence(arrays, convention)
                if not trust:
                    surfaces = surfaces_of(sequence, meshes)
                    camera = convention.table_from_camera
                    refuse_wrong(examine(sequence, surfaces, camera=camera), trust=False)
            except DemoError as error:
                raise DemoError(f"{file}, sequence {arrays['sequence']}: {error}") from None
            parts.append(sequence)
    return merge_demos(parts)


def read_transform(path: str | Path) -> np.ndarray:
    """Read a [4, 4] matrix from a text file of four rows.

    Raises:
        DemoError: it cannot be read, or is no rotation and translation in metres.
    """
    path = Path(path)
    try:
        T = np.loadtxt(path, ndmin=2)
    except Exception as error:  # numpy's parsers raise any kind of error
        raise DemoError(
            f"{path} cannot be read as a matrix: {shown(str(error))}. Write its four rows as four lines of four"
            " numbers."
        ) from error
    if T.shape != (4, 4) or not is_rigid(T):
        raise DemoError(
            f"{path} holds {T.shape} numbers {shown(T.tolist())}, expected the 4x4 matrix of a rotation and a"
            " translation, with the last row 0 0 0 1."
        )
    if np.abs(T[:3, 3]).max() > POSITION[1]:
        raise DemoError(
            f"{path} has the translation {T[:3, 3].tolist()}. Are these millimetres? It must be in metres."
        )
    return T


# Files ----------------------------------------------------------------------------------------------------------------


def _read_csv(path: Path, name: str) -> Iterator[Arrays]:
    """Yield the arrays of each sequence of a table with one row for each frame, as an npz would hold them; an empty
    cell is NaN. The rows of a sequence follow one another."""
    must_exist(path, "a tracker's keypoints")
    try:
        table = _table(path)
        arrays = {}
        for field, names in _COLUMNS.items():
            missing = sorted(set(names) - set(table))
            if not missing:
                numbers = np.column_stack([_numbers(table, column) for column in names])
                arrays[field] = numbers.reshape(-1, *_FILE[field].shape[1:])
            elif field == "keypoints" or len(missing) < len(names):
                raise ValueError(
                    f"it lacks the columns {shown(missing)} of {field}; its first line is"
                    f" {shown(','.join(table))} (docs/demonstrations.md)"
                )
        beyond = sorted(name for name in table if re.fullmatch("[xyz][0-9]+", name))
        beyond = [name for name in beyond if name not in _COLUMNS["keypoints"]]
        if beyond:
            raise ValueError(
                f"it has columns of more than 21 keypoints, such as {beyond[0]}. Keep those of wrist, thumb, index,"
                " middle, ring and little finger, four each: of OpenXR's 26 points number 1, 2 to 5, 7 to 10, 12 to"
                " 15, 17 to 20 and 22 to 25"
            )
    except (OSError, ValueError, csv.Error) as error:
        raise DemoError(f"{path} cannot be read as a CSV table: {error}.") from error
    frames = range(len(arrays["keypoints"]))
    sequences = table.get("sequence", [name] * len(frames))
    for sequence, part in groupby(frames, key=sequences.__getitem__):
        own = list(part)
        found = {"sequence": np.array(sequence)} | {
            field: values[own] for field, values in arrays.items()
        }
        for text in ("object", "side", "subject"):
            if text not in table:
                continue
            values = {table[text][frame] for frame in own}
            if len(values) > 1:
                raise DemoError(
                    f"{path}, sequence {sequence}: the column {text} changes: {shown(sorted(values))}."
                )
            found[text] = np.array(values.pop())
        yield found


def _table(path: Path) -> dict[str, list[str]]:
    """Return the cells below each column's name. Lines that begin with # are comments."""
    if path.stat().st_size > max_bytes():
        raise ValueError(
            f"it has {path.stat().st_size >> 20} MB, more than XRESET_MAX_FILE_MB allows"
        )
    with open(path, newline="", encoding="utf-8-sig") as file:
        lines = csv.reader(file, strict=True)
        rows = [
            (lines.line_num, [*map(str.strip, row)])
            for row in lines
            if row and not row[0].startswith("#")
        ]
    if len(rows) < 2:
        raise ValueError("it has no frame")
    names = rows[0][1]
    for separator, word in ((";", "semicolons"), ("\t", "tabs")):
        if len(names) == 1 and separator in names[0]:
            raise ValueError(
                f"its cells are separated by {word}, expected commas, and points in decimal numbers"
            )
    if any(re.fullmatch(r"[-+.\d]+(e[-+]?\d+)?", name) for name in names):
        raise ValueError(
            "its first line has numbers, expected the names of the columns (docs/demonstrations.md)"
        )
    if len(set(names)) < len(names):
        raise ValueError("several columns have the same name")
    for number, row in rows:
        if len(row) != len(names):
            cut = " It is the last line: the file is cut off." * (number == rows[-1][0])
            raise ValueError(
                f"line {number} has {len(row)} cells, but the first line names {len(names)} columns.{cut} Repair or"
                " remove this line"
            )
    cells = zip(*(row for _, row in rows[1:]), strict=True)
    return {name: list(column) for name, column in zip(names, cells, strict=True)}


def _numbers(table: dict[str, list[str]], column: str) -> np.ndarray:
    try:
        return np.array([float(cell or "nan") for cell in table[column]])
    except ValueError as error:
        raise ValueError(
            f"column {column}: {error}. Leave cells empty where the hand was not seen"
        ) from error


# One sequence ---------------------------------------------------------------------------------------------------------


def _sequence(arrays: Arrays, convention: Convention) -> Demos:
    """Return one sequence in metres and in the table frame, checked and evenly spaced in time."""
    scale = 1e-3 if convention.units == "mm" else 1.0
    points = np.asarray(arrays["keypoints"], dtype=float) * scale
    valid = np.isfinite(points).all(axis=(1, 2))
    if not valid.any():
        raise DemoError("no frame has all 21 keypoints.")
    arrays = dict(arrays)
    if "side" in arrays:
        arrays["side"] = np.char.lower(arrays["side"])
    side = _text(arrays, "side", convention.side)
    if side not in SIDES:
        raise DemoError(f"the side is {shown(side)}, expected right or left.")
    points[~valid] = np.nan
    points = points[:, ORDERS[convention.order]]
    T_table = np.eye(4) if convention.table_from_camera is None else convention.table_from_camera
    points = transformed(points, T_table)
    pos, turn = _object_pose(arrays)
    pos = transformed(scale * pos, T_table)
    turn = Rotation.from_matrix(T_table[:3, :3]) * turn
    fps, (points, pos, turn) = _evenly(arrays, convention, (points, pos, turn))
    valid = np.asarray(np.isfinite(points).all(axis=(1, 2)))
    return one_sequence(
        name=_text(arrays, "sequence", None),
        subject=_text({"subject": np.array("unknown"), **arrays}, "subject", None),
        object_name=official_name(_text(arrays, "object", convention.object_name)),
        side=side,
        fps=fps,
        keypoints=points,
        wrist=_wrist(points[valid], side) if valid.any() else None,
        object_pos=pos,
        object_rot=turn,
    )


def _text(arrays: Arrays, field: str, option: str | None) -> str:
    """Return a text of the file or of the command line, which must not contradict each other."""
    if field not in arrays and option is None:
        raise DemoError(f"the {field} is neither in the file nor given. Add --{field}.")
    text = str(arrays[field]) if field in arrays else str(option)
    if option not in (None, text):
        raise DemoError(
            f"the file says {field} {shown(text)}, but --{field} says {shown(option)}. Omit the option."
        )
    if not text or not is_plain(text):
        raise DemoError(f"the {field} is {shown(text)}, expected a name of printable characters.")
    return text


def _object_pose(arrays: Arrays) -> tuple[np.ndarray, Rotation]:
    """Return position [F, 3] and orientation of the object, in the file's unit and frame."""
    given = [name for name in _FILE if name.startswith("object_") and name in arrays]
    if given not in (
        ["object_pose"],
        ["object_pos", "object_quat_wxyz"],
        ["object_pos", "object_quat_xyzw"],
    ):
        raise DemoError(
            "the object's pose must be given once, as object_pose (matrices) or as object_pos and"
            f" object_quat_wxyz or _xyzw; found {', '.join(given) or 'none'}."
        )
    name = given[-1]
    what = " and ".join(given)
    values = np.asarray(arrays[name], dtype=float)
    if name == "object_pose":
        pos = values[:, :3, 3]
        fits = np.array([is_rigid(T) for T in values])
        expected = "a rotation and translation with the last row 0 0 0 1"
    else:
        pos = np.asarray(arrays["object_pos"], dtype=float)
        fits = np.abs(np.linalg.norm(values, axis=1) - 1) <= UNIT_TOLERANCE
        expected = "a position and a unit quaternion"
    fits &= np.isfinite(pos).all(axis=1)
    if not fits.all():
        raise DemoError(
            f"{what} of frame {np.argmin(fits)} should be {expected}. Remove frames without a pose at the ends,"
            " interpolate the others."
        )
    if name == "object_pose":
        return pos, Rotation.from_matrix(values[:, :3, :3])
    return pos, Rotation.from_quat(values, scalar_first=name == "object_quat_wxyz")


def _evenly(arrays: Arrays, convention: Convention, motion: Motion) -> tuple[float, Motion]:
    """Return the rate, and the motion at that rate: as it is, or interpolated between its own times."""
    if len(motion[1]) < 2:
        raise DemoError(
            "it has one frame. A demonstration has the start and the goal of the object. In a CSV, the rows of a"
            " sequence must follow one another."
        )
    if "time" not in arrays:
        rate = float(arrays["fps"]) if "fps" in arrays else convention.fps
        if rate is None:
            raise DemoError("it has neither times nor a rate. Add --fps, the frames per second.")
        stated = convention.fps or rate
        if abs(stated / rate - 1) > _SAME_RATE:  # single precision has not all digits of 29.97
            raise DemoError(f"the file says {rate:g} frames per second, but --fps says {stated:g}.")
        return stated, motion
    time = np.asarray(arrays["time"], dtype=float)
    steps = np.diff(time)
    if not (steps > 0).all():
        frame = int(np.argmin(steps > 0))
        later = f"{time[frame + 1]:.15g}"
        raise DemoError(
            f"time must increase from frame to frame, but it is {time[frame]:.15g} in frame {frame} and {later} in the"
            " next one. Remove frames that are there twice; save times since 1970 in double precision (float64)."
        )
    own = 1 / float(np.median(steps))
    if not 2 <= own <= RATE[1] or (own > 500 and convention.fps is None):
        raise DemoError(
            f"by its times it has {own:.4g} frames per second. Times must be in seconds."
        )
    stated = float(arrays.get("fps", own))
    if abs(stated / own - 1) > _UNEVEN:
        raise DemoError(
            f"the file says {stated:g} frames per second, but by its times it has {own:.4g}. Remove one of them."
        )
    even = np.abs(steps * own - 1).max() <= _UNEVEN
    if convention.fps is None and not even:
        raise DemoError(
            f"frames are {1e3 * steps.min():.1f} to {1e3 * steps.max():.1f} ms apart. Add --fps to resample them"
            " evenly."
        )
    own = _rate(time) if even else own
    rate = convention.fps or own
    if even and abs(rate / own - 1) < _SAME_RATE:
        return rate, motion
    return rate, _resampled(time, rate, motion)


def _resampled(time: np.ndarray, rate: float, motion: Motion) -> Motion:
    """Return the motion at a rate, interpolated between its times [F]. In a gap the hand counts as not seen."""
    frames = (time[-1] - time[0]) * rate + 1e-6
    if frames > MAX_FRAMES:
        raise DemoError(
            f"{time[-1] - time[0]:.6g} s at {rate:g} frames per second are more than {MAX_FRAMES} frames."
            " Are the times in seconds? Split the sequence, or lower --fps."
        )
    at = np.minimum(time[0] + np.arange(int(frames) + 1) / rate, time[-1])
    points, pos, turn = motion
    steps = np.diff(time)
    is_gap = steps > max(_GAP, 3 * float(np.median(steps)))
    moves = np.linalg.norm(np.diff(pos, axis=0), axis=1)
    turns = (turn[1:] * turn[:-1].inv()).magnitude()
    lost = is_gap & (moves + 0.1 * turns > _GAP_MOTION)
    if lost.any():
        gap = int(np.argmax(lost))
        raise DemoError(
            f"nothing is known for {steps[gap]:.2f} s after frame {gap}, in which the object moves by"
            f" {length_text(moves[gap])} and turns by {np.degrees(turns[gap]):.0f} degrees. Give the frames before and"
            " after as two sequences."
        )
    # keypoints next to a frame without a hand become NaN
    points, pos = (interp1d(time, values, axis=0)(at) for values in (points, pos))
    before = np.searchsorted(time, at).clip(1) - 1
    points[is_gap[before] & (at > time[before]) & (at < time[before + 1])] = np.nan
    return points, pos, Slerp(time, turn)(at)


def _rate(time: np.ndarray) -> float:
    """Return the rate of evenly spaced times [F]: a usual one if the times are its own but for rounding."""
    frames = np.arange(len(time)) - (len(time) - 1) / 2
    exact = 1e-9 + 2 * float(np.spacing(np.abs(time).max()))
    time = time - time[0]
    digits = next((d for d in range(7) if np.abs(time - time.round(d)).max() < exact), 7)
    step = float(frames @ time / (frames @ frames))
    rounding = max(0.6 * 10.0**-digits, 0.01 * step)
    for usual in (float(round(1 / step)), *_USUAL_RATES):
        off = time - time.mean() - frames / usual
        if np.abs(off).max() <= rounding:
            return usual
    return float(round(1 / step, 3))


def _wrist(points: np.ndarray, side: str) -> Rotation:
    """Fit wrist and knuckles of an average hand to keypoints [F, 21, 3] (Kabsch's algorithm); F orientations of MANO's
    root."""
    template = hand.keypoints(hand.RELAXED, side)[_KNUCKLES]
    template -= template.mean(axis=0)
    turns = []
    for found in points[:, _KNUCKLES]:
        turns.append(Rotation.align_vectors(found - found.mean(axis=0), template)[0])
    return Rotation.concatenate(turns)
