"""Reader of demonstrations of any tracker: 21 hand keypoints and the object's pose, frame by frame, as npz, CSV or a
folder of either.

The meaning of the numbers (order of the keypoints, unit, frame, quaternions, rate, hand, object) must be in the file or
be given: it is never guessed. If the numbers contradict what was given, the reader refuses and names the option that
fits. ``docs/demonstrations.md`` has the layout of the files.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.interpolate import interp1d
from scipy.spatial.transform import Rotation, Slerp

from xreset.checks import frozen, is_rigid
from xreset.demos import hand
from xreset.demos.archive import SIDES, Demos, merge_demos, one_sequence
from xreset.errors import DemoError
from xreset.files import max_bytes
from xreset.geometry.shapes import transformed
from xreset.objects.catalogue import official_name
from xreset.records import RATE, UNIT_TOLERANCE, Arrays, Field, read_npz
from xreset.text import is_plain, shown

Order = Literal["mano", "mediapipe", "openpose"]
Motion = tuple[np.ndarray, np.ndarray, Rotation]
"""Keypoints [F, 21, 3], object positions [F, 3] and F object orientations."""

ORDERS: Mapping[Order, tuple[int, ...]] = {
    "mano": (0, 13, 14, 15, 16, 1, 2, 3, 17, 4, 5, 6, 18, 10, 11, 12, 19, 7, 8, 9, 20),
    "mediapipe": tuple(range(21)),
    "openpose": tuple(range(21)),
}
"""Index of each of :data:`xreset.spec.KEYPOINTS` in another order. MANO: the 16 joints of the model (wrist, index,
middle, little, ring, thumb, base to end), then the tips of thumb, index, middle, ring and little finger (Romero et al.
2017; HO-3D's order too)."""

MAX_FRAMES = 100_000
"""Most frames that a sequence may be resampled to: 55 minutes at 30 per second, in half a gigabyte."""

_KNUCKLES = [0, 5, 9, 13, 17]
_PALM = (60.0, 140.0)
"""Range of distances from the wrist to the middle finger's knuckle [mm]: 90 to 100 in DexYCB, with room for children
and trackers."""
_ORDER_RATIO = 1.1
"""A hand in a wrong order has longer bones by at least this factor: 1.29 (MANO's read as MediaPipe's) and 1.50 at the
median."""
_BONE_SPREAD = 0.3
"""Largest relative standard deviation of a bone's length over a sequence; a tracker's noise is below, image coordinates
are above."""
_CURL = 0.015
"""Fingers that bend this far to the back of the hand, at the median of a sequence, are those of the other hand [m]."""
_CENTERED = 0.05
"""Keypoints whose mean is always this close to the origin are relative to the hand [m]."""
_START = (-0.1, 0.7)
"""Range of heights at which an object's origin may start above the table [m]."""
_UNEVEN = 0.1
"""Largest relative deviation of a time step from the median one for frames that count as evenly spaced."""
_MATRIX_BYTES = 1 << 16
"""Largest file of a matrix of 4 x 4 numbers."""

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
    subject: str = "unknown"
    """The demonstrating person."""


def read_keypoints(path: str | Path, convention: Convention) -> Demos:
    """Read a tracker's sequences: an npz (one sequence), a CSV (one, or several with a column ``sequence``), or a
    folder of them.

    Returns:
        The demonstrations in metres and in the table frame. The wrist's orientation is that of five keypoints (wrist
        and knuckles) fitted to an average hand: 3.6 degrees from MANO's at most, on DexYCB.

    Raises:
        DemoError: something about the numbers is unknown or contradicts itself; the message names the option that
            states it.
        FileFormatError: an npz file is damaged or does not have the arrays.
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
            for file in sorted(path.rglob("*"))
            if file.suffix in (".npz", ".csv") and file.is_file()
        ]
        if not files:
            raise DemoError(
                f"There is no .npz and no .csv file below {path}. Give a folder with a file for each sequence."
            )
    parts = []
    for file in files:
        name = file.relative_to(folder).with_suffix("").as_posix()
        if file.suffix == ".csv":
            sequences = _read_csv(file, name)
        else:
            arrays = read_npz(file, None, _FILE, what="a tracker's keypoints")
            sequences = [{"sequence": np.array(name)} | arrays]
        for arrays in sequences:
            parts.append(sequence_of(arrays, f"{file}, sequence {arrays['sequence']}", convention))
    return merge_demos(parts)


def read_transform(path: str | Path) -> np.ndarray:
    """Read a [4, 4] matrix from a text file of four rows.

    Raises:
        DemoError: it cannot be read, or is no rotation and translation in metres.
    """
    path = Path(path)
    try:
        if path.stat().st_size > _MATRIX_BYTES:
            raise ValueError(f"it has {path.stat().st_size} bytes")
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
    return T


# Files ----------------------------------------------------------------------------------------------------------------


def _read_csv(path: Path, name: str) -> Iterator[Arrays]:
    """Yield the arrays of each sequence of a table with one row for each frame, as an npz would hold them; an empty
    cell is NaN. The rows of a sequence follow one another."""
    arrays = {}
    try:
        if path.stat().st_size > max_bytes():
            raise ValueError(
                f"it has {path.stat().st_size >> 20} MB, more than XRESET_MAX_FILE_MB allows"
            )
        with open(path, newline="", encoding="utf-8-sig") as file:
            rows = [row for row in csv.reader(file, strict=True) if row]
        columns = list(zip(*rows, strict=True))
        table = {column.strip(): cells for column, *cells in columns}
        if len(table) < len(columns):
            raise ValueError("several columns have the same name")
        if len(rows) < 2:
            raise ValueError("it has no frame")
        for field, names in _COLUMNS.items():
            missing = sorted(set(names) - set(table))
            if not missing:
                numbers = np.column_stack([_numbers(table[column]) for column in names])
                arrays[field] = numbers.reshape(-1, *_FILE[field].shape[1:])
            elif field == "keypoints" or len(missing) < len(names):
                raise ValueError(
                    f"it lacks the columns {shown(missing)} of {field} (docs/demonstrations.md)"
                )
    except (OSError, ValueError, csv.Error) as error:
        raise DemoError(f"{path} cannot be read as a CSV table: {error}.") from error
    frames = range(len(rows) - 1)
    sequences = table.get("sequence", [name] * len(frames))
    for sequence, part in groupby(frames, key=sequences.__getitem__):
        own = list(part)
        found = {"sequence": np.array(sequence)} | {
            field: values[own] for field, values in arrays.items()
        }
        for text in ("object", "side", "subject"):
            if text not in table:
                continue
            values = {table[text][frame].strip() for frame in own}
            if len(values) > 1:
                raise DemoError(
                    f"{path}, sequence {sequence}: the column {text} changes: {shown(sorted(values))}."
                )
            found[text] = np.array(values.pop())
        yield found


def _numbers(cells: Sequence[str]) -> np.ndarray:
    return np.array([float(cell.strip() or "nan") for cell in cells])


# One sequence ---------------------------------------------------------------------------------------------------------


def sequence_of(arrays: Arrays, what: str, convention: Convention) -> Demos:
    """Return one sequence from the arrays of a file; see :func:`read_keypoints` for errors, in which ``what`` names the
    sequence."""
    try:
        return _sequence(arrays, convention)
    except DemoError as error:
        raise DemoError(f"{what}: {error}") from None


def _sequence(arrays: Arrays, convention: Convention) -> Demos:
    """Return one sequence in metres and in the table frame, checked and evenly spaced in time."""
    scale = 1e-3 if convention.units == "mm" else 1.0
    points = np.asarray(arrays["keypoints"], dtype=float) * scale
    valid = np.isfinite(points).all(axis=(1, 2))
    if not valid.any():
        raise DemoError("no frame has all 21 keypoints.")
    side = _text(arrays, "side", convention.side)
    if side not in SIDES:
        raise DemoError(f"the side is {shown(side)}, expected right or left.")
    _check_hand(points[valid], convention, side)
    points[~valid] = np.nan
    points = points[:, ORDERS[convention.order]]
    T_table = np.eye(4) if convention.table_from_camera is None else convention.table_from_camera
    points = transformed(points, T_table)
    pos, turn = _object_pose(arrays)
    pos = transformed(scale * pos, T_table)
    turn = Rotation.from_matrix(T_table[:3, :3]) * turn
    if not _START[0] <= pos[0, 2] <= _START[1]:
        raise DemoError(
            f"the object starts at z = {pos[0, 2]:.3f} m, but it must start on a table whose top is at z = 0. Are"
            " these the camera's coordinates (--coordinates camera --table-from-camera FILE), or is that matrix the"
            " inverse of what it should be?"
        )
    fps, (points, pos, turn) = _evenly(arrays, convention, (points, pos, turn))
    valid = np.asarray(np.isfinite(points).all(axis=(1, 2)))
    return one_sequence(
        name=_text(arrays, "sequence", None),
        subject=_text({"subject": np.array(convention.subject), **arrays}, "subject", None),
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


def _check_hand(points: np.ndarray, convention: Convention, side: str) -> None:
    """Refuse keypoints [F, 21, 3] in metres, in the file's order, that contradict the convention; the likeliest cause
    comes first."""
    order = ORDERS[convention.order]
    palm = 1e3 * float(np.median(np.linalg.norm(points[:, order[9]] - points[:, 0], axis=1)))
    if not _PALM[0] <= palm <= _PALM[1]:
        raise DemoError(
            f"from the wrist to the middle finger's knuckle it is {palm:.3g} mm, expected 60 to 140 mm. Is --units"
            f" {convention.units} right? Keypoints must be metric and in space, not those of an image."
        )
    lengths = {
        name: np.median(hand.bone_lengths(points[:, ORDERS[name]]).sum(axis=1)) for name in ORDERS
    }
    best = min(lengths, key=lambda name: lengths[name])
    if lengths[convention.order] > _ORDER_RATIO * lengths[best]:
        raise DemoError(
            f"in the order {convention.order} the bones of the hand are {lengths[convention.order]:.2f} m long"
            f" together, in the order {best} {lengths[best]:.2f} m. Use --order {best}."
        )
    points = points[:, order]
    bones = hand.bone_lengths(points)
    spread = np.median(bones.std(axis=0) / bones.mean(axis=0))
    if spread > _BONE_SPREAD:
        raise DemoError(
            f"the lengths of the hand's bones change by {spread:.0%} (standard deviation) during the sequence, so the"
            " keypoints are not metric. MediaPipe's normalised landmarks, for example, are coordinates of the image."
        )
    if len(points) > 1 and np.linalg.norm(points.mean(axis=1), axis=1).max() < _CENTERED:
        raise DemoError(
            "the keypoints are centred on the hand in every frame, like MediaPipe's world landmarks, so the place of"
            " the hand is unknown. Add the hand's position in the camera's or the table's frame first."
        )
    palm_normal = np.cross(points[:, 5] - points[:, 0], points[:, 17] - points[:, 0])
    if side == "left":
        palm_normal *= -1
    palm_normal /= np.linalg.norm(palm_normal, axis=1, keepdims=True)
    fingers = points[:, [8, 12, 16, 20]] - points[:, [5, 9, 13, 17]]
    curl = np.median((fingers * palm_normal[:, None]).sum(axis=-1))
    if curl < -_CURL:
        raise DemoError(
            f"as a {side} hand its fingers bend {-1e3 * curl:.0f} mm towards the back of the hand. It is the other"
            " hand (--side), or the coordinates are left-handed, as Unity's are: negate one axis of keypoints and"
            " poses."
        )


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
    if "time" not in arrays:
        rate = float(arrays["fps"]) if "fps" in arrays else convention.fps
        if rate is None:
            raise DemoError("it has neither times nor a rate. Add --fps, the frames per second.")
        if convention.fps not in (None, rate):
            raise DemoError(
                f"the file says {rate:g} frames per second, but --fps says {convention.fps:g}."
            )
        return rate, motion
    time = np.asarray(arrays["time"], dtype=float)
    steps = np.diff(time)
    if len(time) < 2 or not (steps > 0).all():
        raise DemoError("time must increase from frame to frame.")
    own = 1 / float(np.median(steps))
    if not 2 <= own <= RATE[1] or (own > 500 and convention.fps is None):
        raise DemoError(
            f"by its times it has {own:.4g} frames per second. Times must be in seconds."
        )
    even = np.abs(steps * own - 1).max() <= _UNEVEN
    if convention.fps is None and not even:
        raise DemoError(
            f"frames are {1e3 * steps.min():.1f} to {1e3 * steps.max():.1f} ms apart. Add --fps to resample them"
            " evenly."
        )
    rate = convention.fps or float(round(own, 3))
    if even and abs(rate / own - 1) < 1e-3:
        return rate, motion
    frames = (time[-1] - time[0]) * rate + 1e-6
    if frames > MAX_FRAMES:
        raise DemoError(
            f"{time[-1] - time[0]:.6g} s at {rate:g} frames per second are more than {MAX_FRAMES} frames."
            " Are the times in seconds? Split the sequence, or lower --fps."
        )
    at = np.minimum(time[0] + np.arange(int(frames) + 1) / rate, time[-1])
    points, pos, turn = motion
    # keypoints next to a frame without a hand become NaN
    points, pos = (interp1d(time, values, axis=0)(at) for values in (points, pos))
    return rate, (points, pos, Slerp(time, turn)(at))


def _wrist(points: np.ndarray, side: str) -> Rotation:
    """Fit wrist and knuckles of an average hand to keypoints [F, 21, 3] (Kabsch's algorithm); F orientations of MANO's
    root."""
    template = hand.keypoints(hand.RELAXED, side)[_KNUCKLES]
    found = points[:, _KNUCKLES]
    covariance = np.einsum(
        "ki,fkj->fij", template - template.mean(axis=0), found - found.mean(axis=1, keepdims=True)
    )
    U, _, Vt = np.linalg.svd(covariance)
    Vt[:, 2] *= np.linalg.det(U @ Vt)[:, None]
    return Rotation.from_matrix((U @ Vt).transpose(0, 2, 1))
