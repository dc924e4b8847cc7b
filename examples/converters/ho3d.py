"""HO-3D (Hampali et al. 2020), versions 2 and 3: a sequence of its training split. Not tried on the original files.

    python examples/converters/ho3d.py train/ABF10 --object 021_bleach_cleanser --mesh textured_simple.obj --up 0.1 0.8 0.6 --out bleach.npz

``train/SEQUENCE/meta/0000.pkl`` has, for each frame, ``handJoints3D`` (21, 3) in MANO's order, ``objRot`` (3, 1) axis
and angle, ``objTrans`` (3) and ``objName``, in the camera's frame with OpenGL's axes (x right, y up, the camera looks
along -z); None where a value was not annotated. All hands are right hands. Metres. The files
state neither the rate, for which 30 per second are taken, nor where the table is: ``--up`` is its normal in the
camera's frame.
"""

import numpy as np
from pickles import load_pickle
from scipy.spatial.transform import Rotation
from shared import Recording, convert


def read(options) -> Recording:
    """Return the recording of one sequence, in the frames that have a pose of the object."""
    paths = sorted(options.sequence.glob("meta/*.pkl"))
    frames = []
    points = []
    poses = []
    for path in paths:
        label = load_pickle(path)
        if label["objRot"] is None or label["objTrans"] is None:
            continue
        if label["objName"] != options.object:
            raise SystemExit(
                f"{path} has the object {label['objName']}, expected {options.object}."
            )
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec(np.ravel(label["objRot"])).as_matrix()
        pose[:3, 3] = np.ravel(label["objTrans"])
        joints = label["handJoints3D"]
        absent = np.full((21, 3), np.nan)
        frames.append(int(path.stem))
        points.append(absent if joints is None else np.asarray(joints, dtype=float))
        poses.append(pose)
    if not frames:
        raise SystemExit(f"{options.sequence} has no meta/*.pkl with a pose of the object.")
    return Recording(np.stack(points), np.stack(poses), np.array(frames) / 30)


if __name__ == "__main__":
    convert(read, __doc__.partition("\n")[0], up=None)
