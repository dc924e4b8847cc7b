"""TACO (Liu et al. 2024): the right hand and the tool, or the left hand and the target. Not tried on the original files.

    python examples/converters/taco.py "Hand_Poses/(stir, spoon, bowl)/20231105_019" --object tool_014 --mesh 014_cm.obj --mesh-scale 0.01 --mano MANO_RIGHT.pkl --out spoon.npz

``Hand_Poses/TRIPLET/SEQUENCE/right_hand.pkl`` is a pickled dictionary from "00001" on to ``hand_pose`` (48), the
root's and 15 joints' axes and angles relative to the flat hand, and ``hand_trans`` (3), where the wrist is; tensors of
torch. ``right_hand_shape.pkl`` has ``hand_shape`` (10). ``Object_Poses/TRIPLET/SEQUENCE/tool_014.npy`` has the tool's
poses (F, 4, 4). 30 frames per second, metres; meshes in centimetres.
"""

import numpy as np
from mano import keypoints, load_model
from pickles import load_pickle
from scipy.spatial.transform import Rotation
from shared import Recording, convert


def read(options) -> Recording:
    """Return the recording of one sequence."""
    folder = options.sequence
    path = folder.parents[2] / "Object_Poses" / folder.parent.name / folder.name
    poses = np.load(path / f"{options.object}.npy").astype(float)
    frames = load_pickle(folder / f"{options.side}_hand.pkl")
    shape = load_pickle(folder / f"{options.side}_hand_shape.pkl")["hand_shape"]
    points = np.full((len(poses), 21, 3), np.nan)
    names = [name for name in sorted(frames) if int(name) <= len(poses)]
    angles = np.stack([np.asarray(frames[name]["hand_pose"]) for name in names])
    points[[int(name) - 1 for name in names]] = keypoints(
        load_model(options.mano),
        Rotation.from_rotvec(angles[:, :3]),
        np.stack([np.asarray(frames[name]["hand_trans"]) for name in names]),
        np.asarray(shape).reshape(10),
        fingers=angles[:, 3:],
        wrist_at_trans=True,
    )
    return Recording(points, poses, np.arange(len(poses)) / 30)


if __name__ == "__main__":
    convert(read, __doc__.partition("\n")[0], up="0 0 1")
