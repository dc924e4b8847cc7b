"""GRAB (Taheri et al. 2020): one hand and the object of a sequence. Not tried on the original files.

    python examples/converters/grab.py GRAB/s1/mug_lift.npz --object mug --mesh mug.ply --mano MANO_RIGHT.pkl --out mug.npz

A sequence is an npz with pickled dictionaries: ``rhand`` and ``lhand`` have ``params`` (``global_orient`` (F, 3),
``fullpose`` (F, 45) relative to the flat hand, ``transl`` (F, 3)) and ``vtemp``, the path of the person's own hand at
rest, below the folder that holds the subjects' folders. ``object`` has ``params`` (``global_orient``, ``transl``);
its vertices are rows that are multiplied by the rotation from the right, so its pose has the inverse. 120 frames per
second, metres, z up.
"""

from zipfile import ZipFile

import numpy as np
import trimesh
from mano import keypoints, load_model
from pickles import load_npy
from scipy.spatial.transform import Rotation
from shared import Recording, convert


def read(options) -> Recording:
    """Return the recording of one sequence."""
    with ZipFile(options.sequence) as archive:
        entries = {}
        for name in (f"{options.side[0]}hand", "object", "framerate"):
            with archive.open(f"{name}.npy") as file:
                entries[name] = load_npy(file)
    hand = entries[f"{options.side[0]}hand"]
    model = load_model(options.mano)
    own = options.sequence.parents[2] / str(hand["vtemp"])
    model["v_template"] = np.asarray(trimesh.load(own, process=False).vertices)
    params = hand["params"]
    points = keypoints(
        model,
        Rotation.from_rotvec(params["global_orient"]),
        params["transl"],
        np.zeros(10),
        fingers=params["fullpose"],
    )
    params = entries["object"]["params"]
    poses = np.tile(np.eye(4), (len(points), 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(params["global_orient"]).inv().as_matrix()
    poses[:, :3, 3] = params["transl"]
    return Recording(points, poses, np.arange(len(points)) / float(entries["framerate"]))


if __name__ == "__main__":
    convert(read, __doc__.partition("\n")[0], up="0 0 1")
