"""Reader of demonstrations of any tracker: 21 hand keypoints and the object's pose, frame by frame, as npz, CSV or a folder of either.

What the numbers mean (order of the keypoints, unit, frame, quaternions, rate, hand, object) must be in the file or be said: it is never
guessed. Where the numbers contradict what was said, the reader refuses and names the option that fits. ``docs/demonstrations.md`` has the
layout of the files.
"""

from __future__ import annotations

import csv
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from xreset.checks import is_rigid
from xreset.demos import hand
from xreset.demos.archive import SIDES, Demos, concatenate
from xreset.errors import DemoError
from xreset.files import max_bytes
from xreset.records import RATE, UNIT_TOLERANCE, Field, read_npz
from xreset.text import is_plain, shown

Order = Literal["mano", "mediapipe", "openpose"]
Unit = Literal["m", "mm"]
Frame = Literal["table", "camera"]
Quaternion = Literal["wxyz", "xyzw"]

ORDERS: Mapping[Order, tuple[int, ...]] = {
    "mano": (0, 13, 14, 15, 16, 1, 2, 3, 17, 4, 5, 6, 18, 10, 11, 12, 19, 7, 8, 9, 20),
    "mediapipe": tuple(range(21)),
    "openpose": tuple(range(21)),
}
"""Where each of :data:`xreset.spec.KEYPOINTS` stands in the order of others. MANO: the 16 joints of the model (wrist, index, middle,
little, ring, thumb, base to end), then the tips of thumb, index, middle, ring and little finger (Romero et al. 2017; HO3D's order too)."""

_KNUCKLES = np.array([0, 5, 9, 13, 17])
_PALM = (0.06, 0.14)
"""[m] Range of distances from the wrist to the middle finger's knuckle: 0.09 to 0.10 in DexYCB, with room for children and for trackers."""
_ORDER_RATIO = 1.1
"""A hand read in a wrong order has bones at least so much longer in sum: 1.29 (MANO's read as MediaPipe's) and 1.50 at the median."""
_BONE_SPREAD = 0.3
"""Largest relative standard deviation of a bone's length over a sequence; a tracker's noise is below, image coordinates are above."""
_CURL = 0.015
"""[m] Fingers that bend so far to the back of the hand, at the median of a sequence, are those of the other hand."""
_START = (-0.1, 0.7)
"""[m] Range of heights at which an object's origin may start above the table."""
_UNEVEN = 0.1
"""Largest deviation of a time step from the median one, as a share of it, for the frames to count as evenly spaced."""

_FILE = {
    "keypoints": Field(("F", 21, 3), "fi", within=None),
    "object_pose": Field(("F", 4, 4), "fi", required=False),
    "object_pos": Field(("F", 3), "fi", required=False),
    "object_quat": Field(("F", 4), "fi", required=False),
    "object_quat_wxyz": Field(("F", 4), "fi", required=False),
    "object_quat_xyzw": Field(("F", 4), "fi", required=False),
    "time": Field(("F",), "fi", required=False),
    "fps": Field((), "fi", required=False, within=RATE),
    "sequence": Field((), "U", required=False),
    "object": Field((), "U", required=False),
    "side": Field((), "U", required=False),
    "subject": Field((), "U", required=False),
}
"""A sequence of F frames. Keypoints are NaN where the hand was not seen; ``time`` [s]."""

_TEXTS = ("sequence", "object", "side", "subject")
_COLUMNS = {
    "keypoints": tuple(f"{axis}{k}" for k in range(21) for axis in "xyz"),
    "object_pose": tuple(f"object_{row}{column}" for row in range(3) for column in range(4)),
    "object_pos": ("object_x", "object_y", "object_z"),
    "object_quat": tuple(f"object_q{i}" for i in range(4)),
    "object_quat_wxyz": tuple(f"object_q{axis}" for axis in "wxyz"),
    "time": ("time",),
}


@dataclass(frozen=True, kw_only=True)
class Convention:
    """What the numbers of a tracker mean; None: as the file says, or refuse."""

    order: Order | None = None
    """Order of the 21 keypoints."""
    units: Unit | None = None
    """Of keypoints and object positions."""
    frame: Frame | None = None
    """``table``: z up, table top at z = 0. ``camera``: of a camera that does not move."""
    table_from_camera: np.ndarray | None = None
    """[4, 4] pose of the camera in the table frame [m]; with ``frame="camera"``."""
    quat: Quaternion | None = None
    """Order of the object's quaternions, where their names do not say it."""
    fps: float | None = None
    """Frames per second of a file without times; or what files with times are resampled to."""
    object_name: str | None = None
    """The grasped object."""
    side: Literal["right", "left"] | None = None
    """The hand."""
    subject: str = "unknown"
    """Who demonstrated."""


_MATRIX_BYTES = 1 << 16
"""Largest file of a matrix of 4 x 4 numbers."""


def read_keypoints(
    path: str | Path,
    convention: Convention | None = None,
    *,
    progress: Callable[[int, int, str], None] = lambda done, total, name: None,
) -> Demos:
    """Read a tracker's sequences: an npz (one sequence), a CSV (one, or several with a column ``sequence``), or a folder of them.

    Args:
        progress: called with (files done, files in all, name) before each file is read.

    Returns:
        The demonstrations in metres and in the table frame. The wrist's orientation is that of five keypoints (wrist and knuckles) fitted
        to an average hand: 3.6 degrees from MANO's at most, on DexYCB.

    Raises:
        DemoError: something about the numbers is not known or contradicts itself; the message names the option that says it.
        FileFormatError: an npz file is damaged or does not have the arrays.
    """
    path, convention = Path(path), convention or Convention()
    _must_be_known(convention)
    if path.is_dir():
        files = sorted(file for file in path.rglob("*") if file.suffix in (".npz", ".csv") and file.is_file())
        names = [file.relative_to(path).with_suffix("").as_posix() for file in files]
        if not files:
            raise DemoError(
                f"there is no .npz and no .csv file below {path}; give a folder with one file for each sequence."
            )
    else:
        files, names = [path], [path.stem]
    parts = []
    for done, (file, name) in enumerate(zip(files, names, strict=True)):
        progress(done, len(files), name)
        sequences = _read_csv(file, name) if file.suffix == ".csv" else [_read_npz(file, name)]
        parts += [sequence_of(arrays, f"{file}, sequence {arrays['sequence']}", convention) for arrays in sequences]
    return concatenate(parts)


def read_transform(path: str | Path) -> np.ndarray:
    """[4, 4] from a text file of four rows, or an npy file.

    Raises:
        DemoError: it cannot be read, or is no rotation and translation in metres.
    """
    path = Path(path)
    try:
        if path.stat().st_size > _MATRIX_BYTES:
            raise ValueError(f"it has {path.stat().st_size} bytes")
        T = np.load(path, mmap_mode="r", allow_pickle=False) if path.suffix == ".npy" else np.loadtxt(path, ndmin=2)
    except Exception as error:  # numpy's own parsers raise whatever they meet
        problem = shown(str(error))
        raise DemoError(
            f"{path} cannot be read as a matrix: {problem}. Write its four rows as four lines of four numbers."
        ) from error
    if T.shape != (4, 4) or not is_rigid(T):
        raise DemoError(
            f"{path} holds no 4x4 matrix of a rotation and a translation (last row 0 0 0 1), but {T.shape}: {shown(T.tolist())}."
        )
    if np.abs(T[:3, 3]).max() > 20:
        raise DemoError(f"{path} moves by {np.linalg.norm(T[:3, 3]):.0f} m. Its translation must be in metres.")
    return T.astype(float)


def _must_be_known(convention: Convention) -> None:
    missing = []
    if convention.order is None:
        missing.append("the order of the keypoints: --order mano, mediapipe or openpose")
    if convention.units is None:
        missing.append("the unit of lengths: --units m or mm")
    if convention.frame is None:
        missing.append("the frame of the coordinates: --coordinates table or camera")
    if convention.frame == "camera" and convention.table_from_camera is None:
        missing.append(
            "where the camera stands: --table-from-camera FILE, its pose in the table frame (z up, table top at z = 0), 4x4, metres"
        )
    if missing:
        raise DemoError("the numbers alone do not tell\n  - " + "\n  - ".join(missing))
    if convention.frame == "table" and convention.table_from_camera is not None:
        raise DemoError(
            "--table-from-camera was given, but --coordinates says that the coordinates are in the table frame already."
        )


# Files -----------------------------------------------------------------------------------------------------------------------------------


def _read_npz(path: Path, name: str) -> dict[str, np.ndarray]:
    return {"sequence": np.array(name)} | read_npz(path, None, _FILE, what="a tracker's keypoints")


def _read_csv(path: Path, name: str) -> list[dict[str, np.ndarray]]:
    """The sequences of a table with one row for each frame, in their order; frames of one must stand together."""
    try:
        if path.stat().st_size > max_bytes():
            raise DemoError(
                f"{path} has {path.stat().st_size >> 20} MB; set XRESET_MAX_FILE_MB to read it, or split it."
            )
        with open(path, newline="", encoding="utf-8-sig") as file:
            rows = list(csv.reader(file, strict=True))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DemoError(f"{path} cannot be read as a CSV table: {error}.") from error
    header = [cell.strip() for cell in rows[0]] if rows else []
    if twice := sorted({column for column in header if header.count(column) > 1}):
        raise DemoError(f"{path} has the columns {', '.join(twice)} more than once.")
    at = {column: i for i, column in enumerate(header)}
    fields = {field: columns for field, columns in _COLUMNS.items() if any(column in at for column in columns)}
    for field, columns in {"keypoints": _COLUMNS["keypoints"], **fields}.items():
        if missing := [column for column in columns if column not in at]:
            raise DemoError(
                f"{path} lacks the columns {shown(missing)} of {field}; the first line must name x0, y0, z0 to z20 and the object's pose"
                " (docs/demonstrations.md). Found: " + shown(header)
            )
    known = {column for columns in fields.values() for column in columns} | {*_TEXTS, "frame"}
    if unknown := sorted(set(header) - known):
        logging.getLogger(__name__).warning("%s also has the columns %s, which are left aside.", path, shown(unknown))
    body = [(number, row) for number, row in enumerate(rows[1:], start=2) if any(cell.strip() for cell in row)]
    for number, row in body:
        if len(row) != len(header):
            raise DemoError(f"{path}, line {number}: {len(row)} cells, expected {len(header)} as in the first line.")
    owners = [row[at["sequence"]].strip() if "sequence" in at else name for _, row in body]
    starts = [i for i, owner in enumerate(owners) if i == 0 or owner != owners[i - 1]]
    if not starts:
        raise DemoError(f"{path} has no line after the names of its columns.")
    sequences = []
    for begin, end in zip(starts, [*starts[1:], len(body)], strict=True):
        part = body[begin:end]
        arrays: dict[str, np.ndarray] = {"sequence": np.array(owners[begin])}
        for text in set(_TEXTS[1:]) & set(at):
            values = {row[at[text]].strip() for _, row in part}
            if len(values) > 1:
                raise DemoError(
                    f"{path}, sequence {owners[begin]}: the column {text} changes within it: {shown(sorted(values))}."
                )
            arrays[text] = np.array(values.pop())
        for field, columns in fields.items():
            arrays[field] = np.array(
                [[_number(row[at[column]], path, number, column) for column in columns] for number, row in part]
            )
        arrays["keypoints"] = arrays["keypoints"].reshape(-1, 21, 3)
        if "time" in arrays:
            arrays["time"] = arrays["time"][:, 0]
        if "object_pose" in arrays:
            arrays["object_pose"] = np.concatenate(
                (arrays["object_pose"].reshape(-1, 3, 4), np.broadcast_to([0.0, 0, 0, 1], (len(part), 1, 4))), axis=1
            )
        sequences.append(arrays)
    return sequences


def _number(cell: str, path: Path, line: int, column: str) -> float:
    try:
        return float(cell) if cell.strip() else np.nan
    except ValueError:
        raise DemoError(
            f"{path}, line {line}, column {column}: {shown(cell)} is no number; leave a cell empty if it is not known."
        ) from None


# One sequence ----------------------------------------------------------------------------------------------------------------------------


def sequence_of(arrays: Mapping[str, np.ndarray], what: str, convention: Convention) -> Demos:
    """One sequence from the arrays of a file; see :func:`read_keypoints`, whose errors it raises. ``what`` names it in them."""
    assert convention.order is not None
    scale = 1e-3 if convention.units == "mm" else 1.0
    points = np.asarray(arrays["keypoints"], dtype=float) * scale
    valid = np.isfinite(points).all(axis=(1, 2))
    if not valid.any():
        raise DemoError(f"{what}: no frame has all 21 keypoints.")
    side = _said(what, "side", arrays, convention.side)
    if side not in SIDES:
        raise DemoError(f"{what}: the side is {shown(side)}, expected right or left.")
    _check_hand(points[valid], what, convention, side)
    points = points[:, ORDERS[convention.order]]
    pos, turn = _object(arrays, what, convention, scale)
    if convention.table_from_camera is not None:
        T = convention.table_from_camera
        points, pos = points @ T[:3, :3].T + T[:3, 3], pos @ T[:3, :3].T + T[:3, 3]
        turn = Rotation.from_matrix(T[:3, :3]) * turn
    if not _START[0] <= pos[0, 2] <= _START[1]:
        raise DemoError(
            f"{what}: the object starts at z = {pos[0, 2]:.3f} m, but it must start on a table whose top is at z = 0. Are these the"
            " camera's coordinates (--coordinates camera --table-from-camera FILE), or is that matrix the inverse of what it should be?"
        )
    points[~valid] = np.nan
    fps, (points, pos, turn) = _evenly(arrays, what, convention, points, pos, turn)
    valid = np.asarray(np.isfinite(points).all(axis=(1, 2)))
    wrist = np.full((len(points), 4), np.nan)
    if valid.any():
        wrist[valid] = _wrist(points[valid], side).as_quat(canonical=True, scalar_first=True)
    return Demos(
        sequence_name=np.array([_plain(what, "sequence", str(arrays["sequence"]))]),
        subject=np.array([_plain(what, "subject", str(arrays.get("subject", convention.subject)))]),
        object_name=np.array([_said(what, "object", arrays, convention.object_name)]),
        hand_side=np.array([side]),
        frame_offsets=np.array([0, len(points)], dtype=np.int32),
        hand_keypoints=points.astype(np.float32),
        hand_valid=valid,
        wrist_quat_wxyz=wrist.astype(np.float32),
        object_pos=pos.astype(np.float32),
        object_quat_wxyz=turn.as_quat(canonical=True, scalar_first=True).astype(np.float32),
        fps=fps,
    )


def _said(what: str, field: str, arrays: Mapping[str, np.ndarray], option: str | None) -> str:
    """A text of the file or of the command line, which must not contradict each other."""
    if field not in arrays:
        if option is None:
            raise DemoError(f"{what}: the {field} is neither in the file nor given; say it with --{field}.")
        return _plain(what, field, option)
    found = str(arrays[field])
    if option not in (None, found):
        raise DemoError(f"{what}: the file says {field} {shown(found)}, but --{field} says {shown(option)}.")
    return _plain(what, field, found)


def _plain(what: str, field: str, text: str) -> str:
    if not text or not is_plain(text):
        raise DemoError(f"{what}: the {field} is {shown(text)}, expected a name of printable characters.")
    return text


def _check_hand(points: np.ndarray, what: str, convention: Convention, side: str) -> None:
    """Refuse keypoints [F, 21, 3] in metres, in their own order, that contradict the convention."""
    assert convention.order is not None
    palm = float(np.median(np.linalg.norm(points[:, ORDERS[convention.order][9]] - points[:, 0], axis=1)))
    if not _PALM[0] <= palm <= _PALM[1]:
        other = {"m": ("mm", 1e-3), "mm": ("m", 1e3)}[convention.units or "m"]
        fits = f" In --units {other[0]} it would." if _PALM[0] <= palm * other[1] <= _PALM[1] else ""
        raise DemoError(
            f"{what}: from the wrist to the middle finger's knuckle it is {1e3 * palm:.3g} mm; no hand measures other than"
            f" {1e3 * _PALM[0]:.0f} to {1e3 * _PALM[1]:.0f} mm.{fits} Keypoints must be metric and in space, not those of an image."
        )
    sums = {order: float(np.median(hand.bone_lengths(points[:, ORDERS[order]]).sum(axis=1))) for order in ORDERS}
    best = min(sums, key=lambda order: sums[order])
    if sums[convention.order] > _ORDER_RATIO * sums[best]:
        raise DemoError(
            f"{what}: in the order {convention.order} the bones of the hand are {sums[convention.order]:.2f} m long together, in the order"
            f" {best} {sums[best]:.2f} m. Say --order {best}."
        )
    ordered = points[:, ORDERS[convention.order]]
    lengths = hand.bone_lengths(ordered)
    spread = float(np.median(lengths.std(axis=0) / lengths.mean(axis=0)))
    if spread > _BONE_SPREAD:
        raise DemoError(
            f"{what}: the lengths of the hand's bones change by {spread:.0%} (standard deviation) in the course of the sequence; these are"
            " no metric keypoints. MediaPipe's normalised landmarks, for one, are coordinates of the image."
        )
    if len(points) > 1 and np.linalg.norm(ordered.mean(axis=1), axis=1).max() < 0.05:
        raise DemoError(
            f"{what}: the keypoints are centred on the hand in every frame, as MediaPipe's world landmarks are: they do not say where"
            " the hand is. Add the hand's position in the camera's or the table's frame first."
        )
    palm_normal = np.cross(ordered[:, 5] - ordered[:, 0], ordered[:, 17] - ordered[:, 0]) * (
        1 if side == "right" else -1
    )
    palm_normal /= np.linalg.norm(palm_normal, axis=1, keepdims=True)
    bent = ordered[:, [8, 12, 16, 20]] - ordered[:, [5, 9, 13, 17]]
    curl = float(np.median((bent * palm_normal[:, None]).sum(axis=-1)))
    if curl < -_CURL:
        raise DemoError(
            f"{what}: as a {side} hand its fingers bend {-1e3 * curl:.0f} mm towards the back of the hand. It is the other hand (--side)"
            " or the coordinates are left-handed, as Unity's are: negate one axis of keypoints and poses."
        )


def _object(
    arrays: Mapping[str, np.ndarray], what: str, convention: Convention, scale: float
) -> tuple[np.ndarray, Rotation]:
    """Position [F, 3] in metres and orientation of the object, still in the file's frame."""
    given = [name for name in ("object_pose", "object_quat", "object_quat_wxyz", "object_quat_xyzw") if name in arrays]
    if len(given) != 1 or ("object_pos" in arrays) != (given[0] != "object_pose"):
        raise DemoError(
            f"{what}: the object's pose must be given once, as object_pose (matrices) or as object_pos and object_quat_wxyz or _xyzw;"
            f" found {', '.join(given + ['object_pos'] * ('object_pos' in arrays)) or 'none'}."
        )
    values = np.asarray(arrays[given[0]], dtype=float)
    if not np.isfinite(values).all() or ("object_pos" in arrays and not np.isfinite(arrays["object_pos"]).all()):
        raise DemoError(
            f"{what}: the object's pose is not known in every frame; leave out those at the ends, interpolate the others."
        )
    if given[0] == "object_pose":
        bad = ~np.array([is_rigid(T) for T in values])
        if bad.any():
            raise DemoError(
                f"{what}: object_pose of frame {np.argmax(bad)} is no rotation and translation with the last row 0 0 0 1."
            )
        return values[:, :3, 3] * scale, Rotation.from_matrix(values[:, :3, :3])
    order = given[0].removeprefix("object_quat").removeprefix("_") or convention.quat
    if order is None:
        raise DemoError(
            f"{what}: nothing says whether object_quat is (w, x, y, z) or (x, y, z, w); say --quat wxyz or xyzw."
        )
    bad = np.abs(np.linalg.norm(values, axis=1) - 1) > UNIT_TOLERANCE
    if bad.any():
        frame = int(np.argmax(bad))
        raise DemoError(
            f"{what}: the quaternion of frame {frame} has length {np.linalg.norm(values[frame]):.4f}, expected 1."
        )
    return np.asarray(arrays["object_pos"], dtype=float) * scale, Rotation.from_quat(
        values, scalar_first=order == "wxyz"
    )


def _evenly(
    arrays: Mapping[str, np.ndarray],
    what: str,
    convention: Convention,
    points: np.ndarray,
    pos: np.ndarray,
    turn: Rotation,
) -> tuple[float, tuple[np.ndarray, np.ndarray, Rotation]]:
    """The rate, and the sequence at that rate: as it is, or interpolated between its own times."""
    stated = float(arrays["fps"]) if "fps" in arrays else None
    if "time" not in arrays:
        rate = stated if stated is not None else convention.fps
        if rate is None:
            raise DemoError(f"{what}: it has neither times nor a rate; say how many frames a second has with --fps.")
        if convention.fps not in (None, rate):
            raise DemoError(f"{what}: the file says {rate:g} frames per second, but --fps says {convention.fps:g}.")
        return rate, (points, pos, turn)
    time = np.asarray(arrays["time"], dtype=float)
    steps = np.diff(time)
    if len(time) < 2 or not np.isfinite(time).all() or (steps <= 0).any():
        raise DemoError(f"{what}: time must increase from frame to frame.")
    own = 1 / float(np.median(steps))
    if not RATE[0] <= own <= RATE[1] or (own > 500 and convention.fps is None) or own < 2:
        raise DemoError(f"{what}: by its times it has {own:.4g} frames per second. Times must be in seconds.")
    even = np.abs(steps * own - 1).max() <= _UNEVEN
    if convention.fps is None and not even:
        raise DemoError(
            f"{what}: frames are {1e3 * steps.min():.1f} to {1e3 * steps.max():.1f} ms apart; say --fps to resample them evenly."
        )
    rate = convention.fps or float(round(own, 3))
    if even and abs(rate / own - 1) < 1e-3:
        return rate, (points, pos, turn)
    at = time[0] + np.arange(int((time[-1] - time[0]) * rate + 1e-6) + 1) / rate
    after = np.clip(np.searchsorted(time, at), 1, len(time) - 1)
    share = np.clip((at - time[after - 1]) / steps[after - 1], 0.0, 1.0)
    points = (
        points[after - 1] * (1 - share)[:, None, None] + points[after] * share[:, None, None]
    )  # NaN beside a frame without a hand
    pos = pos[after - 1] * (1 - share)[:, None] + pos[after] * share[:, None]
    return rate, (points, pos, Slerp(time, turn)(np.clip(at, time[0], time[-1])))


def _wrist(points: np.ndarray, side: str) -> Rotation:
    """Orientation of MANO's root from keypoints [F, 21, 3]: wrist and knuckles laid over those of an average hand (Kabsch's algorithm)."""
    template = np.concatenate((np.zeros((1, 3)), hand.FINGER_BASES)) * ((1 if side == "right" else -1), 1, 1)
    found = points[:, _KNUCKLES]
    covariance = np.einsum("ki,fkj->fij", template - template.mean(axis=0), found - found.mean(axis=1, keepdims=True))
    U, _, Vt = np.linalg.svd(covariance)
    Vt[:, 2] *= np.linalg.det(U @ Vt)[:, None]
    return Rotation.from_matrix((U @ Vt).transpose(0, 2, 1))
