"""Reader of the HO-3D data set (Hampali et al. 2020, versions 2 and 3) in its own layout. Not yet tried on the original files.

    ROOT/train/SEQUENCE/meta/0000.pkl     handJoints3D (21, 3), objRot (3, 1) axis and angle, objTrans (3,), objName; metres

Each frame's numbers are in the camera's frame with OpenGL's axes: x right, y up, the camera looks along -z. Joints are in MANO's order; all
hands are right hands. What was not annotated is None. The files say neither the rate nor where the table is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from xreset.demos.archive import Demos, concatenate
from xreset.demos.keypoints import Convention, read_transform, sequence_of
from xreset.demos.pickles import read_pickle
from xreset.errors import DemoError
from xreset.text import shown

_FROM_OPENGL = np.diag([1.0, -1.0, -1.0])
"""To the axes of :class:`xreset.demos.Convention`'s cameras: x right, y down, z where it looks."""


def read_ho3d(
    root: str | Path,
    *,
    fps: float,
    cameras: str | Path,
    progress: Callable[[int, int, str], None] = lambda done, total, name: None,
) -> Demos:
    """Read the training sequences below an HO-3D folder whose camera's place is known.

    Args:
        root: the folder that holds ``train``.
        fps: frames per second; consecutive numbers are consecutive frames.
        cameras: a file with the camera's pose in the table frame (:func:`xreset.demos.read_transform`; x right, y down, z where it looks)
            for all sequences, or a folder with ``SEQUENCE.txt`` or ``.npy``; sequences without one are left out.
        progress: called with (sequences done, sequences in all, name) before each is read.

    Raises:
        DemoError: the folder is not in this layout, or a sequence contradicts itself.
    """
    root, cameras = Path(root), Path(cameras)
    folders = {path.parent.name: path for path in sorted((root / "train").glob("*/meta")) if path.is_dir()}
    if not folders:
        raise DemoError(f"there is no HO-3D sequence in {root}: expected train/SEQUENCE/meta/0000.pkl below it.")
    places = {
        name: [cameras / f"{name}.txt", cameras / f"{name}.npy"] if cameras.is_dir() else [cameras] for name in folders
    }
    poses = {
        name: next(path for path in paths if path.is_file())
        for name, paths in places.items()
        if any(map(Path.is_file, paths))
    }
    if not poses:
        raise DemoError(
            f"{cameras} says of no sequence where its camera stands; expected {next(iter(folders))}.txt, or a file for all."
        )
    parts = []
    for done, (name, place) in enumerate(poses.items()):
        progress(done, len(poses), name)
        convention = Convention(
            order="mano", units="m", frame="camera", table_from_camera=read_transform(place), fps=fps, side="right"
        )
        parts.append(_sequence(folders[name], name, convention))
    return concatenate(parts)


@dataclass(frozen=True)
class _Frame:
    number: int
    joints: np.ndarray
    """[21, 3] NaN if not annotated."""
    pose: np.ndarray | None
    """[4, 4]"""
    name: str


def _sequence(folder: Path, name: str, convention: Convention) -> Demos:
    frames = [_frame(path) for path in sorted(folder.glob("*.pkl"))]
    known = [i for i, frame in enumerate(frames) if frame.pose is not None]
    if not known:
        raise DemoError(f"{folder} has no frame with an object's pose (objRot and objTrans).")
    frames = frames[known[0] : known[-1] + 1]
    if missing := [frame.number for frame in frames if frame.pose is None]:
        raise DemoError(
            f"{folder}: the object's pose is not known in {len(missing)} frames amid others, first in {missing[0]:04d}.pkl."
        )
    if len(names := {frame.name for frame in frames}) > 1:
        raise DemoError(f"{folder}: the object changes within the sequence: {shown(sorted(names))}.")
    numbers = np.array([frame.number for frame in frames])
    arrays = {
        "sequence": np.array(name),
        "object": np.array(frames[0].name),
        "keypoints": np.stack([frame.joints for frame in frames]),
        "object_pose": np.stack([frame.pose for frame in frames if frame.pose is not None]),
    }
    if (np.diff(numbers) > 1).any():  # frames that were left out are interpolated
        assert convention.fps is not None
        arrays["time"] = (numbers - numbers[0]) / convention.fps
    return sequence_of(arrays, str(folder), replace(convention, subject=name.rstrip("0123456789")))


def _frame(path: Path) -> _Frame:
    if not path.stem.isdecimal():
        raise DemoError(f"{path} is not named by a frame's number, such as 0000.pkl.")
    data = read_pickle(path)
    if lacking := sorted({"handJoints3D", "objRot", "objTrans", "objName"} - set(data)):
        raise DemoError(
            f"{path} lacks {', '.join(lacking)}; is it an annotation of HO-3D? It has {shown(sorted(data))}."
        )
    joints = _numbers(path, data, "handJoints3D", (21, 3))
    rotation, position = _numbers(path, data, "objRot", (3,)), _numbers(path, data, "objTrans", (3,))
    pose = None
    if rotation is not None and position is not None:
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = _FROM_OPENGL @ Rotation.from_rotvec(rotation).as_matrix(), _FROM_OPENGL @ position
    points = np.full((21, 3), np.nan) if joints is None else joints @ _FROM_OPENGL
    return _Frame(int(path.stem), points, pose, str(data["objName"]))


def _numbers(path: Path, data: dict[str, Any], name: str, shape: tuple[int, ...]) -> np.ndarray | None:
    value = data[name]
    if value is None:
        return None
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fi":
        raise DemoError(f"{path}: {name} is {shown(value)}, expected numbers {list(shape)}.")
    if value.size != np.prod(shape) or (value.ndim > 1 and value.shape[0] != shape[0]):
        evaluation = (
            " The evaluation split gives the wrist alone: use train."
            if name == "handJoints3D" and value.size == 3
            else ""
        )
        raise DemoError(f"{path}: {name} has shape {list(value.shape)}, expected {list(shape)}.{evaluation}")
    if not np.isfinite(value).all():
        raise DemoError(f"{path}: {name} holds numbers that are not finite.")
    return value.astype(float).reshape(shape)
