"""ARCTIC (Fan et al. 2023): one hand and the base of an object whose lid stays as it is. Not tried on the original files.

    python examples/converters/arctic.py raw_seqs/s01/box_grab_01.mano.npy --object box --mesh box/mesh.obj --mesh-scale 0.001 --mano MANO_RIGHT.pkl --out box.npz

``NAME.mano.npy`` is a pickled dictionary of ``right`` and ``left``: ``rot`` (F, 3), ``pose`` (F, 45) relative to
MANO's mean hand, ``trans`` (F, 3) in metres, ``shape`` (10). ``NAME.object.npy`` next to it has rows of the hinge's
angle, the base's rotation (axis and angle) and its translation in millimetres. 30 frames per second.
"""

import numpy as np
from mano import keypoints, load_model
from pickles import load_npy
from scipy.spatial.transform import Rotation
from shared import Recording, convert

MOST_OPENING = np.radians(5)
"""Largest change of the hinge's angle of an object that counts as rigid [rad]."""


def read(options) -> Recording:
    """Return the recording of one sequence."""
    with open(options.sequence, "rb") as file:
        hand = load_npy(file)[options.side]
    path = options.sequence.with_name(options.sequence.name.replace(".mano.", ".object."))
    with open(path, "rb") as file:
        rows = np.asarray(load_npy(file), dtype=float)
    own = slice(*options.frames)
    opening = np.ptp(rows[own, 0])
    if opening > MOST_OPENING:
        raise SystemExit(
            f"The lid turns by {np.degrees(opening):.0f} degrees, and xreset knows rigid objects only. Choose a part"
            " in which the lid stays (--frames FIRST LAST)."
        )
    points = keypoints(
        load_model(options.mano),
        Rotation.from_rotvec(hand["rot"]),
        hand["trans"],
        np.reshape(hand["shape"], (-1, 10))[0],
        fingers=hand["pose"],
        relative_to_mean=True,
    )
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(rows[:, 1:4]).as_matrix()
    poses[:, :3, 3] = 1e-3 * rows[:, 4:7]
    return Recording(points, poses, np.arange(len(rows)) / 30)


if __name__ == "__main__":
    convert(read, __doc__.partition("\n")[0], up="0 0 1")
