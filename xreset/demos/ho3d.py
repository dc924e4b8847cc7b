"""Reader of the HO-3D data set (Hampali et al. 2020, versions 2 and 3) in its own layout. Not yet tried on the files.

    ROOT/train/SEQUENCE/meta/0000.pkl
        handJoints3D (21, 3), objRot (3, 1) axis and angle, objTrans (3,), objName; metres

Each frame's numbers are in the camera's frame with OpenGL's axes: x right, y up, the camera looks along -z. Joints are
in MANO's order; all hands are right hands. Values that were not annotated are None. The files state neither the rate
nor the place of the table.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from xreset.demos.archive import Demos, Progress, merge_demos, no_progress
from xreset.demos.keypoints import Convention, read_transform, sequence_of
from xreset.demos.pickles import read_pickle
from xreset.errors import DemoError
from xreset.text import shown

_FROM_OPENGL = np.diag([1.0, -1.0, -1.0])
"""To the axes of the cameras of :class:`xreset.demos.keypoints.Convention`: x right, y down, z forward."""
_SHAPES = {"handJoints3D": (21, 3), "objRot": (3,), "objTrans": (3,)}


def read_ho3d(
    root: str | Path,
    *,
    fps: float,
    cameras: str | Path,
    progress: Progress = no_progress,
) -> Demos:
    """Read the training sequences below an HO-3D folder that have a camera pose.

    Args:
        root: the folder that holds ``train``.
        fps: frames per second; consecutive numbers are consecutive frames.
        cameras: a file with the camera's pose in the table frame for all sequences (x right, y down, z forward; see
            :func:`xreset.demos.keypoints.read_transform`), or a folder with ``SEQUENCE.txt`` or ``.npy``, where
            sequences without one are omitted.
        progress: called with (sequences done, sequences in all, name) before each is read.

    Raises:
        DemoError: the folder is not in this layout, or a sequence contradicts itself.
    """
    cameras = Path(cameras)
    folders = [path for path in sorted(Path(root, "train").glob("*/meta")) if path.is_dir()]
    if not folders:
        raise DemoError(f"There is no HO-3D sequence in {root}: expected train/SEQUENCE/meta/0000.pkl below it.")
    poses = {}
    for folder in folders:
        name = folder.parent.name
        for path in (cameras / f"{name}.txt", cameras / f"{name}.npy", cameras):
            if path.is_file():
                poses[folder] = read_transform(path)
                break
    if not poses:
        raise DemoError(
            f"{cameras} contains no camera pose for any sequence. Give one file for all, or a folder with"
            f" {folders[0].parent.name}.txt."
        )
    parts = []
    for done, (folder, pose) in enumerate(poses.items()):
        name = folder.parent.name
        progress(done, len(poses), name)
        convention = Convention(
            order="mano",
            units="m",
            frame="camera",
            table_from_camera=pose,
            fps=fps,
            side="right",
            subject=name.rstrip("0123456789"),
        )
        arrays = {"sequence": np.array(name), **_read_sequence(folder, fps)}
        parts.append(sequence_of(arrays, str(folder), convention))
    return merge_demos(parts)


def _read_sequence(folder: Path, fps: float) -> dict[str, np.ndarray]:
    """Return the arrays of a sequence for :func:`sequence_of`, from its first to its last known object pose."""
    frames = {}
    for path in sorted(folder.glob("*.pkl")):
        if not (path.stem.isdecimal() and len(path.stem) < 10):
            raise DemoError(f"{path} is not named by a frame's number, such as 0000.pkl.")
        frames[int(path.stem)] = _read_frame(path)
    known = [number for number, frame in frames.items() if frame["pose"] is not None]
    if not known:
        raise DemoError(f"{folder} has no frame with an object's pose (objRot and objTrans).")
    frames = {number: frame for number, frame in frames.items() if known[0] <= number <= known[-1]}
    missing = sorted(set(frames) - set(known))
    if missing:
        raise DemoError(
            f"{folder}: the object's pose is unknown in {len(missing)} frames between others, first in"
            f" {missing[0]:04d}.pkl."
        )
    names = sorted({frame["name"] for frame in frames.values()})
    if len(names) > 1:
        raise DemoError(f"{folder}: the object changes within the sequence: {shown(names)}.")
    arrays = {
        "object": np.array(names[0]),
        "keypoints": np.stack([frame["joints"] for frame in frames.values()]),
        "object_pose": np.stack([frame["pose"] for frame in frames.values()]),
    }
    numbers = np.array(list(frames))
    if (np.diff(numbers) > 1).any():  # missing frames are interpolated
        arrays["time"] = (numbers - numbers[0]) / fps
    return arrays


def _read_frame(path: Path) -> dict[str, Any]:
    """Return joints [21, 3] (NaN if unknown), object pose [4, 4] (None if unknown) and object name."""
    data = read_pickle(path)
    lacking = sorted({*_SHAPES, "objName"} - set(data))
    if lacking:
        raise DemoError(
            f"{path} lacks {', '.join(lacking)}; it has {shown(sorted(data))}. Is it an annotation of HO-3D?"
        )
    if not isinstance(data["objName"], str):
        raise DemoError(f"{path}: objName is {shown(data['objName'])}, expected a text.")
    joints, rotation, position = (_numbers(path, data, name) for name in _SHAPES)
    pose = None
    if rotation is not None and position is not None:
        pose = np.eye(4)
        pose[:3, :3] = _FROM_OPENGL @ Rotation.from_rotvec(rotation).as_matrix()
        pose[:3, 3] = _FROM_OPENGL @ position
    points = np.full((21, 3), np.nan) if joints is None else joints @ _FROM_OPENGL
    return {"joints": points, "pose": pose, "name": data["objName"]}


def _numbers(path: Path, data: Mapping[str, Any], name: str) -> np.ndarray | None:
    value = data[name]
    shape = _SHAPES[name]
    if value is None:
        return None
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fi":
        raise DemoError(f"{path}: {name} is {shown(value)}, expected numbers {list(shape)}.")
    if value.size != np.prod(shape) or (value.ndim > 1 and value.shape[0] != shape[0]):
        hint = ""
        if name == "handJoints3D" and value.size == 3:
            hint = " The evaluation split gives the wrist alone. Use the split train."
        raise DemoError(f"{path}: {name} has shape {list(value.shape)}, expected {list(shape)}.{hint}")
    if not np.isfinite(value).all():
        raise DemoError(f"{path}: {name} holds numbers that are not finite.")
    return value.astype(float).reshape(shape)
