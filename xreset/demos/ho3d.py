"""Reader of the HO-3D data set (Hampali et al. 2020, versions 2 and 3) in its own layout. Not yet tried on the files.

    ROOT/train/SEQUENCE/meta/0000.pkl
        handJoints3D (21, 3), objRot (3, 1) axis and angle, objTrans (3,), objName; metres

Each frame's numbers are in the camera's frame with OpenGL's axes: x right, y up, the camera looks along -z. Joints are
in MANO's order; all hands are right hands. Values that were not annotated are None. The files state neither the rate
nor the place of the table.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from xreset.demos.archive import Demos, merge_demos
from xreset.demos.keypoints import Convention, read_transform, sequence_of
from xreset.demos.pickles import array_of, read_pickle
from xreset.errors import DemoError
from xreset.files.records import Arrays
from xreset.files.text import shown

_FROM_OPENGL = np.diag([1.0, -1.0, -1.0])
"""To the axes of the cameras of :class:`xreset.demos.keypoints.Convention`: x right, y down, z forward."""
_SHAPES = {"handJoints3D": (21, 3), "objRot": (3,), "objTrans": (3,)}


def read_ho3d(
    root: str | Path,
    *,
    fps: float,
    cameras: str | Path,
) -> Demos:
    """Read the training sequences below an HO-3D folder that have a camera pose.

    Args:
        root: the folder that holds ``train``.
        fps: frames per second; consecutive numbers are consecutive frames.
        cameras: a file with the camera's pose in the table frame for all sequences (x right, y down, z forward; see
            :func:`xreset.demos.keypoints.read_transform`), or a folder with ``SEQUENCE.txt``, where sequences without
            one are omitted.

    Raises:
        DemoError: the folder is not in this layout, or a sequence contradicts itself.
    """
    cameras = Path(cameras)
    folders = [path for path in sorted(Path(root, "train").glob("*/meta")) if path.is_dir()]
    if not folders:
        raise DemoError(
            f"There is no HO-3D sequence in {root}: expected train/SEQUENCE/meta/0000.pkl below it."
        )
    parts = []
    for folder in folders:
        name = folder.parent.name
        path = cameras if cameras.is_file() else cameras / f"{name}.txt"
        if not path.is_file():
            continue
        convention = Convention(
            order="mano",
            units="m",
            frame="camera",
            table_from_camera=read_transform(path),
            fps=fps,
            side="right",
            subject=name.rstrip("0123456789"),
        )
        arrays = {"sequence": np.array(name), **_read_sequence(folder, fps)}
        parts.append(sequence_of(arrays, str(folder), convention))
    if not parts:
        raise DemoError(
            f"{cameras} contains no camera pose for any sequence. Give one file for all, or a folder with {name}.txt."
        )
    return merge_demos(parts)


def _read_sequence(folder: Path, fps: float) -> Arrays:
    """Return the arrays of a sequence for :func:`sequence_of`, from its first to its last known object pose."""
    paths = {}
    for path in sorted(folder.glob("*.pkl")):
        if not (path.stem.isdecimal() and len(path.stem) < 10):
            raise DemoError(f"{path} is not named by a frame's number, such as 0000.pkl.")
        paths[int(path.stem)] = path
    frames = {number: _read_frame(path) for number, path in sorted(paths.items())}
    known = [number for number, (_, pose, _) in frames.items() if np.isfinite(pose).all()]
    if not known:
        raise DemoError(f"{folder} has no frame with an object's pose (objRot and objTrans).")
    numbers = [number for number in frames if known[0] <= number <= known[-1]]
    joints, poses, names = zip(*(frames[number] for number in numbers), strict=True)
    if len(set(names)) > 1:
        raise DemoError(
            f"{folder}: the object changes within the sequence: {shown(sorted(set(names)))}."
        )
    return {
        "object": np.array(names[0]),
        "keypoints": np.stack(joints),
        "object_pose": np.stack(poses),
        "time": (np.array(numbers) - numbers[0]) / fps,  # missing frames are interpolated
    }


def _read_frame(path: Path) -> tuple[np.ndarray, np.ndarray, str]:
    """Return joints [21, 3] and object pose [4, 4], NaN where unknown, and the object's name."""
    data = read_pickle(path)
    lacking = sorted({*_SHAPES, "objName"} - set(data))
    if lacking:
        raise DemoError(
            f"{path} lacks {', '.join(lacking)}; it has {shown(list(data))}. Is it an annotation of HO-3D?"
        )
    name = data["objName"]
    if not isinstance(name, str):
        raise DemoError(f"{path}: objName is {shown(name)}, expected a text.")
    numbers = {}
    for field, shape in _SHAPES.items():
        numbers[field] = np.full(shape, np.nan)
        if data[field] is None:
            continue
        try:
            numbers[field] = array_of(data[field]).astype(float).reshape(shape)
        except Exception as error:  # a damaged array raises any kind of error
            raise DemoError(
                f"{path}: {field} is not an array of numbers {list(shape)}. The split evaluation has the wrist alone:"
                " use train."
            ) from error
    pose = np.eye(4)
    pose[:3, :3] = np.nan
    if np.isfinite(numbers["objRot"]).all():
        pose[:3, :3] = _FROM_OPENGL @ Rotation.from_rotvec(numbers["objRot"]).as_matrix()
    pose[:3, 3] = _FROM_OPENGL @ numbers["objTrans"]
    return numbers["handJoints3D"] @ _FROM_OPENGL, pose, name
