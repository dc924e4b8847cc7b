"""Reader of the DexYCB data set (Chao et al. 2021) in its official folder layout.

    ROOT/20200709-subject-01/20200709_141754/meta.yml              which object, hand, cameras and calibration
                                             pose.npz              pose_y: objects, pose_m: MANO; both in the world frame
                                             SERIAL/labels_000000.npz   joint_3d: hand joints, in that camera's frame
    ROOT/calibration/extrinsics_ID/extrinsics.yml                  camera poses and the AprilTag's pose in the world frame

The world frame is the master camera's; the table frame is the AprilTag's. Object quaternions in ``pose.npz`` are (x, y, z, w). Frames
without a hand have ``pose_m`` = 0 and joints = -1.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from xreset.checks import is_rigid
from xreset.demos.archive import SIDES, Demos, concatenate
from xreset.errors import DemoError, FileFormatError
from xreset.objects.catalogue import canonical_name
from xreset.objects.ycb import NAME_OF_ID
from xreset.records import read_arrays
from xreset.text import is_plain, shown

FPS = 30.0
_MAX_FRAMES = 100_000
"""An hour of frames; DexYCB's sequences have 72."""

_META = ("extrinsics", "mano_sides", "num_frames", "serials", "ycb_grasp_ind", "ycb_ids")


@dataclass(frozen=True, kw_only=True)
class _Sequence:
    """A sequence's folder and its meta.yml."""

    folder: Path
    extrinsics: str
    side: str
    object_name: str
    object_index: int
    num_objects: int
    num_frames: int
    serials: tuple[str, ...]

    @property
    def name(self) -> str:
        return f"{self.folder.parent.name}/{self.folder.name}"


def read_dexycb(
    root: str | Path,
    *,
    objects: Iterable[str] | None = None,
    sides: Iterable[str] = SIDES,
    progress: Callable[[int, int, str], None] = lambda done, total, name: None,
) -> Demos:
    """Read all sequences below a DexYCB folder, through to the table frame.

    Args:
        root: the folder that holds the subjects' folders and ``calibration``.
        objects: only sequences that grasp one of these (official names or the paper's).
        progress: called with (sequences done, sequences in all, name) before each sequence is read.

    Raises:
        DemoError: the folder is not in DexYCB's layout, a part of a sequence is missing, or parts contradict each other.
        ObjectError: a name in ``objects`` is not one of DexYCB's.
    """
    root = Path(root)
    wanted = None if objects is None else {canonical_name(name, NAME_OF_ID.values()) for name in objects}
    found = [_meta(path) for path in sorted(root.glob("*/*/meta.yml"))]
    if not found:
        raise DemoError(
            f"there is no DexYCB sequence in {root}: expected SUBJECT/SEQUENCE/meta.yml below it, such as"
            " 20200709-subject-01/20200709_141754/meta.yml. Give the folder that holds the subjects' folders."
        )
    chosen = [
        sequence
        for sequence in found
        if sequence.side in set(sides) and (wanted is None or sequence.object_name in wanted)
    ]
    if not chosen:
        there = ", ".join(sorted({f"{sequence.object_name} ({sequence.side})" for sequence in found}))
        raise DemoError(
            f"none of the {len(found)} sequences in {root} has the objects and hands asked for; there are {there}."
        )
    calibrations: dict[str, Mapping[str, np.ndarray]] = {}
    parts = []
    for done, sequence in enumerate(chosen):
        progress(done, len(chosen), sequence.name)
        if sequence.extrinsics not in calibrations:
            calibrations[sequence.extrinsics] = _extrinsics(root, sequence.extrinsics)
        parts.append(_read(sequence, calibrations[sequence.extrinsics]))
    return concatenate(parts)


def _read(sequence: _Sequence, extrinsics: Mapping[str, np.ndarray]) -> Demos:
    T_table_world = np.linalg.inv(extrinsics["apriltag"])
    turn = Rotation.from_matrix(T_table_world[:3, :3])
    poses = _npz(sequence.folder / "pose.npz", ("pose_y", "pose_m"))
    frames = sequence.num_frames
    _expect(sequence, "pose.npz: pose_y", poses["pose_y"].shape, (frames, sequence.num_objects, 7))
    _expect(sequence, "pose.npz: pose_m", poses["pose_m"].shape, (frames, 1, 51))
    pose_object = poses["pose_y"][:, sequence.object_index].astype(float)
    pose_hand = poses["pose_m"][:, 0].astype(float)
    for name, values in (("pose_y", pose_object), ("pose_m", pose_hand)):
        if not (np.abs(values) < 1e3).all():
            raise DemoError(
                f"sequence {sequence.name}: {name} of pose.npz holds numbers that are not finite, or far too large."
            )
    if (np.linalg.norm(pose_object[:, :4], axis=1) < 0.5).any():
        raise DemoError(
            f"sequence {sequence.name}: frame {np.argmin(np.linalg.norm(pose_object[:, :4], axis=1))} has no object pose."
        )

    keypoints = np.stack(
        [_joints(sequence, frame, extrinsics) for frame in range(frames)]
    )  # world frame, NaN where there is no hand
    valid = np.isfinite(keypoints).all(axis=(1, 2)) & (pose_hand != 0).any(axis=1)
    keypoints[~valid] = np.nan
    wrist = np.full((frames, 4), np.nan)
    wrist[valid] = (turn * Rotation.from_rotvec(pose_hand[valid, :3])).as_quat(canonical=True, scalar_first=True)

    def to_table(points: np.ndarray) -> np.ndarray:
        return points @ T_table_world[:3, :3].T + T_table_world[:3, 3]

    return Demos(
        sequence_name=np.array([sequence.name]),
        subject=np.array([sequence.folder.parent.name]),
        object_name=np.array([sequence.object_name]),
        hand_side=np.array([sequence.side]),
        frame_offsets=np.array([0, frames], dtype=np.int32),
        hand_keypoints=to_table(keypoints).astype(np.float32),
        hand_valid=valid,
        wrist_quat_wxyz=wrist.astype(np.float32),
        object_pos=to_table(pose_object[:, 4:]).astype(np.float32),
        object_quat_wxyz=(turn * Rotation.from_quat(pose_object[:, :4]))
        .as_quat(canonical=True, scalar_first=True)
        .astype(np.float32),
        fps=FPS,
    )


def _joints(sequence: _Sequence, frame: int, extrinsics: Mapping[str, np.ndarray]) -> np.ndarray:
    """[21, 3] hand joints in the world frame, from the first camera that has this frame's labels; NaN where there is no hand.

    DexYCB's joint order is this project's keypoint order. All cameras' labels come from one fit, so one camera is enough.
    """
    calibrated = [serial for serial in sequence.serials if serial in extrinsics]
    for serial in calibrated:
        path = sequence.folder / serial / f"labels_{frame:06d}.npz"
        if path.is_file():
            joints = _npz(path, ("joint_3d",))["joint_3d"]
            _expect(sequence, f"{serial}/{path.name}: joint_3d", joints.shape, (1, 21, 3))
            joints = joints[0].astype(float)
            if (joints == -1).all():
                return np.full((21, 3), np.nan)
            T = extrinsics[serial]
            return joints @ T[:3, :3].T + T[:3, 3]
    if not calibrated:
        raise DemoError(
            f"sequence {sequence.name}: no camera of meta.yml ({', '.join(sequence.serials)}) is in extrinsics_{sequence.extrinsics}; the"
            " calibration folder does not belong to these sequences. Download DexYCB's calibration archive again."
        )
    raise DemoError(
        f"sequence {sequence.name}: no camera ({', '.join(calibrated)}) has labels_{frame:06d}.npz, but meta.yml says"
        f" {sequence.num_frames} frames. Unpack at least one camera's folder of this sequence completely."
    )


def _meta(path: Path) -> _Sequence:
    meta = _yaml(path)
    missing = [key for key in _META if key not in meta]
    if missing:
        raise DemoError(f"{path} has no {', '.join(missing)}; it is not a DexYCB meta.yml.")
    ids, index, frames, sides, serials = (
        meta[key] for key in ("ycb_ids", "ycb_grasp_ind", "num_frames", "mano_sides", "serials")
    )
    for key, value, fits in (
        ("ycb_ids", ids, isinstance(ids, list) and all(type(i) is int for i in ids)),
        ("ycb_grasp_ind", index, type(index) is int),
        ("num_frames", frames, type(frames) is int and 0 < frames <= _MAX_FRAMES),
        ("mano_sides", sides, isinstance(sides, list) and all(isinstance(side, str) for side in sides)),
        (
            "serials",
            serials,
            isinstance(serials, list) and all(isinstance(s, str | int) and is_plain(str(s)) for s in serials),
        ),
        ("extrinsics", meta["extrinsics"], isinstance(meta["extrinsics"], str | int)),
    ):
        if not fits:
            raise DemoError(f"{path}: {key} is {shown(value)}, which is no value of DexYCB's.")
    if not 0 <= index < len(ids):
        raise DemoError(f"{path}: ycb_grasp_ind is {index}, but there are {len(ids)} objects in ycb_ids.")
    if ids[index] not in NAME_OF_ID:
        raise DemoError(
            f"{path}: the grasped object has YCB id {ids[index]}; DexYCB's ids go from 1 to {len(NAME_OF_ID)}."
        )
    if len(sides) != 1 or sides[0] not in SIDES:
        raise DemoError(f"{path}: mano_sides is {shown(sides)}, expected one of right and left.")
    return _Sequence(
        folder=path.parent,
        extrinsics=str(meta["extrinsics"]),
        side=sides[0],
        object_name=NAME_OF_ID[ids[index]],
        object_index=index,
        num_objects=len(ids),
        num_frames=frames,
        serials=tuple(map(str, serials)),
    )


def _extrinsics(root: Path, name: str) -> dict[str, np.ndarray]:
    """Camera serial, or ``apriltag`` -> pose [4, 4] in the world frame."""
    path = root / "calibration" / f"extrinsics_{name}" / "extrinsics.yml"
    entries = _yaml(path).get("extrinsics")
    if not isinstance(entries, dict) or "apriltag" not in entries:
        raise DemoError(f"{path} has no pose 'apriltag' under 'extrinsics': without it the table frame is unknown.")
    poses = {}
    for key, values in entries.items():
        numbers = isinstance(values, list | tuple) and all(type(x) in (int, float) and abs(x) < 1e6 for x in values)
        if not numbers or len(values) != 12:
            found = f"{len(values)} numbers" if numbers else shown(values)
            raise DemoError(f"{path}: the pose {shown(key)} has {found}, expected the 12 numbers of a 3x4 matrix.")
        T = np.eye(4)
        T[:3] = np.asarray(values, dtype=float).reshape(3, 4)
        if not is_rigid(T):
            raise DemoError(
                f"{path}: the pose {shown(key)} is no rotation and translation: it is scaled, mirrored or damaged."
            )
        poses[str(key)] = T
    return poses


class _Loader(yaml.SafeLoader):
    """Plain YAML and ``!!python/tuple``, which DexYCB's calibration uses; every other tag is refused."""


def _tuple(loader: yaml.SafeLoader, node: Any) -> tuple[Any, ...]:
    return tuple(loader.construct_sequence(node))


_Loader.add_constructor("tag:yaml.org,2002:python/tuple", _tuple)


def _yaml(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise DemoError(
            f"there is no {path}; the DexYCB folder is incomplete. Unpack its calibration archive beside the subjects' folders."
        )
    try:
        if path.stat().st_size > 1 << 20:
            raise ValueError("it has more than a megabyte")
        data = yaml.load(path.read_text(), Loader=_Loader)
    except (yaml.YAMLError, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise DemoError(f"{path} is not valid YAML: {shown(str(error) or 'it is nested too deeply')}") from error
    if not isinstance(data, dict):
        raise DemoError(f"{path} holds a {type(data).__name__}, expected names and values.")
    return data


def _npz(path: Path, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    if not path.is_file():
        raise DemoError(f"there is no {path}; the sequence is incomplete. Unpack it again.")
    try:
        return read_arrays(path, names)
    except FileFormatError as error:
        raise DemoError(f"{error} It is damaged or not DexYCB's; unpack it again.") from error


def _expect(sequence: _Sequence, what: str, found: tuple[int, ...], expected: tuple[int, ...]) -> None:
    if found != expected:
        raise DemoError(
            f"sequence {sequence.name}: {what} has shape {found}, but meta.yml asks for {expected}. Is a file of another sequence there?"
        )
