"""Reader of the DexYCB data set (Chao et al. 2021) in its official folder layout.

    ROOT/20200709-subject-01/20200709_141754/
        meta.yml                    object, hand, cameras and calibration
        pose.npz                    pose_y: objects, pose_m: MANO; both in the world frame
        SERIAL/labels_000000.npz    joint_3d: hand joints, in that camera's frame
    ROOT/calibration/extrinsics_ID/
        extrinsics.yml              camera poses and the AprilTag's pose in the world frame

The world frame is the master camera's; the table frame is the AprilTag's. Object quaternions in ``pose.npz`` are
(x, y, z, w). Frames without a hand have ``pose_m`` = 0 and joints = -1.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from xreset.demos.archive import SIDES, Demos, merge_demos, one_sequence
from xreset.errors import DemoError, FileFormatError
from xreset.files.checks import is_rigid
from xreset.files.progress import Progress, unseen
from xreset.files.records import Field, read_npz
from xreset.files.storage import matches
from xreset.files.text import shown
from xreset.geometry.shapes import transformed
from xreset.objects.ycb import NAME_OF_ID

FPS = 30.0
_POSE = (-1e3, 1e3)
"""Range of the numbers of a pose: metres, quaternions and MANO's angles are smaller by far."""
_Poses = Mapping[str, np.ndarray]
"""Camera serial, or ``apriltag`` -> pose [4, 4] in the world frame."""


def read_dexycb(root: str | Path, *, progress: Progress = unseen) -> Demos:
    """Read all sequences below a DexYCB folder, in the table frame.

    Args:
        root: the folder that holds the subjects' folders and ``calibration``.
        progress: called with (sequences done, sequences in all).

    Raises:
        DemoError: the folder is not in DexYCB's layout, or parts of a sequence are missing or contradict each other.
    """
    root = Path(root)
    found = matches(root, "*/*/meta.yml")
    if not found:
        raise DemoError(
            f"There is no DexYCB sequence in {root}: expected SUBJECT/SEQUENCE/meta.yml below it, such as"
            " 20200709-subject-01/20200709_141754/meta.yml. Give the folder that holds the subjects' folders."
        )
    calibrations: dict[str, _Poses] = {}
    parts = []
    for path in found:
        meta = _read_meta(path)
        calibration = meta["extrinsics"]
        if calibration not in calibrations:
            calibrations[calibration] = _read_extrinsics(root, calibration)
        parts.append(_read(path.parent, meta, calibrations[calibration]))
        progress(len(parts), len(found))
    return merge_demos(parts)


def _read(folder: Path, meta: Mapping[str, Any], extrinsics: _Poses) -> Demos:
    """Read one sequence, in the table frame."""
    T_table_world = np.linalg.inv(extrinsics["apriltag"])
    turn = Rotation.from_matrix(T_table_world[:3, :3])
    path = folder / "pose.npz"
    frames = meta["num_frames"]
    grasped = meta["ycb_grasp_ind"]
    pose_object, pose_hand = _read_npz(
        path,
        {
            "pose_y": Field((frames, len(meta["ycb_ids"]), 7), "fi", within=_POSE),
            "pose_m": Field((frames, 1, 51), "fi", within=_POSE),
        },
    )
    pose_object = pose_object[:, grasped]
    pose_hand = pose_hand[:, 0]
    unknown = np.linalg.norm(pose_object[:, :4], axis=1) < 0.5
    if unknown.any():
        raise DemoError(f"{path}: frame {np.argmax(unknown)} has no object pose.")

    cameras = {serial: extrinsics[serial] for serial in meta["serials"] if serial in extrinsics}
    keypoints = np.stack([_read_joints(folder, frame, cameras) for frame in range(frames)])
    valid = np.isfinite(keypoints).all(axis=(1, 2)) & (pose_hand != 0).any(axis=1)
    keypoints[~valid] = np.nan
    return one_sequence(
        name=f"{folder.parent.name}/{folder.name}",
        subject=folder.parent.name,
        object_name=NAME_OF_ID[meta["ycb_ids"][grasped]],
        side=meta["mano_sides"][0],
        fps=FPS,
        keypoints=transformed(keypoints, T_table_world),
        wrist=turn * Rotation.from_rotvec(pose_hand[valid, :3]) if valid.any() else None,
        object_pos=transformed(pose_object[:, 4:], T_table_world),
        object_rot=turn * Rotation.from_quat(pose_object[:, :4]),
    )


def _read_joints(folder: Path, frame: int, cameras: _Poses) -> np.ndarray:
    """[21, 3] hand joints in the world frame, from the first camera with labels of this frame; NaN without a hand.

    DexYCB's joint order is this project's keypoint order. One fit gave the labels of all cameras, so one camera is
    enough.
    """
    for serial, pose in cameras.items():
        path = folder / serial / f"labels_{frame:06d}.npz"
        if path.is_file():
            (joints,) = _read_npz(path, {"joint_3d": Field((1, 21, 3), "fi", within=None)})
            if (joints == -1).all():
                return np.full((21, 3), np.nan)
            return transformed(joints[0], pose)
    raise DemoError(
        f"{folder}: no calibrated camera ({', '.join(cameras) or 'none of meta.yml is'}) has labels_{frame:06d}.npz."
        " Unpack at least one camera's folder of this sequence completely, and DexYCB's calibration archive."
    )


def _read_meta(path: Path) -> dict[str, Any]:
    """Return the entries of a sequence's meta.yml, with its numbers as integers."""
    meta = _read_yaml(path)
    try:
        meta["ycb_ids"] = [int(number) for number in meta["ycb_ids"]]
        meta["serials"] = [str(serial) for serial in meta["serials"]]
        meta["extrinsics"] = str(meta["extrinsics"])
        for name in ("ycb_grasp_ind", "num_frames"):
            meta[name] = int(meta[name])
        is_known = meta["ycb_ids"][meta["ycb_grasp_ind"]] in NAME_OF_ID
        is_side = meta["mano_sides"] in [[side] for side in SIDES]
        if meta["ycb_grasp_ind"] < 0 or meta["num_frames"] < 1 or not is_known or not is_side:
            raise ValueError("a number or a side is out of range")
        return meta
    except (LookupError, TypeError, ValueError) as error:
        raise DemoError(
            f"{path} is not a meta.yml of DexYCB, with extrinsics, mano_sides, num_frames, serials, ycb_grasp_ind and"
            f" ycb_ids: {shown(error)}."
        ) from error


def _read_extrinsics(root: Path, name: str) -> _Poses:
    path = root / "calibration" / f"extrinsics_{name}" / "extrinsics.yml"
    entries = _read_yaml(path).get("extrinsics")
    if not isinstance(entries, dict) or "apriltag" not in entries:
        raise DemoError(
            f"{path} has no pose 'apriltag' under 'extrinsics': without it the table frame is unknown."
        )
    poses = {}
    for key, values in entries.items():
        T = np.eye(4)
        try:
            T[:3] = np.array([float(value) for value in values]).reshape(3, 4)
        except (TypeError, ValueError):
            T[:] = np.nan
        if not is_rigid(T):
            raise DemoError(
                f"{path}: the pose {shown(key)} is {shown(values)}, expected the 12 numbers of a rotation and a"
                " translation (3x4)."
            )
        poses[str(key)] = T
    return poses


def _read_yaml(path: Path) -> dict[str, Any]:
    """Return what a YAML file holds; numbers stay texts, and tags, which may name code, have no effect."""
    if not path.is_file():
        raise DemoError(
            f"There is no {path}; the DexYCB folder is incomplete. Unpack its calibration archive next to the"
            " subjects' folders."
        )
    try:
        data = yaml.load(path.read_text(), Loader=yaml.BaseLoader)
        if not isinstance(data, dict):
            raise ValueError(f"it holds a {type(data).__name__}, expected names and values")
        return data
    except Exception as error:  # yaml raises any kind of error at damage
        raise DemoError(
            f"{path} is not valid YAML: {shown(str(error) or 'it is nested too deeply')}"
        ) from error


def _read_npz(path: Path, schema: Mapping[str, Field]) -> list[np.ndarray]:
    """Return the arrays of a schema, as floats."""
    if not path.is_file():
        raise DemoError(f"There is no {path}; the sequence is incomplete. Unpack it again.")
    try:
        arrays = read_npz(path, None, schema, what="a file of DexYCB with the frames of meta.yml")
    except FileFormatError as error:
        raise DemoError(f"{error} Unpack the sequence again.") from error
    return [arrays[name].astype(float) for name in schema]
