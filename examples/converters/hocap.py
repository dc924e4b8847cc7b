"""HO-Cap (Wang et al. 2024): one hand and one object as one of its cameras has them. Not tried on the original files.

    python examples/converters/hocap.py subject_1/20231025_165502/105322251564 --object G01_1 --mesh G01_1/cleaned_mesh_10000.obj --up 0.1 -0.8 -0.6 --out box.npz

The folder of a camera that does not move has ``label_000000.npz`` for each frame, in the camera's frame:
``hand_joints_3d`` (2, 21, 3), right and left hand, -1 where absent, in MediaPipe's order; ``obj_poses`` (n, 4, 4) and
``obj_class_names`` (n). 30 frames per second, metres. ``--up`` is the table's normal in the camera's frame: from
``calibration/extrinsics``, or from three points of the table in the depth image.
"""

import numpy as np
from shared import Recording, convert


def read(options) -> Recording:
    """Return the recording of one sequence."""
    paths = sorted(options.sequence.glob("label_*.npz"))
    if not paths:
        raise SystemExit(f"There is no label_*.npz in {options.sequence}.")
    row = ("right", "left").index(options.side)
    points = []
    poses = []
    for path in paths:
        with np.load(path) as label:
            names = [str(name) for name in label["obj_class_names"]]
            if options.object not in names:
                raise SystemExit(
                    f"{path} has no object {options.object}. Choose from: {', '.join(names)}."
                )
            points.append(label["hand_joints_3d"][row].astype(float))
            poses.append(label["obj_poses"][names.index(options.object)].astype(float))
    points = np.stack(points)
    points[(points == -1).all(axis=(1, 2))] = np.nan
    frames = np.array([int(path.stem.removeprefix("label_")) for path in paths])
    return Recording(points, np.stack(poses), frames / 30, order="mediapipe")


if __name__ == "__main__":
    convert(read, __doc__.partition("\n")[0], up=None)
