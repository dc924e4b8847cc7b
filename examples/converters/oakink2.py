"""OakInk2 (Zhan et al. 2024): one hand and one object of a sequence. Not tried on the original files.

    python examples/converters/oakink2.py anno_preview/SEQUENCE.pkl --object O02@0015@00001 --mesh scan.obj --mano MANO_RIGHT.pkl --out cup.npz

A sequence is a pickle: ``mocap_frame_id_list``, numbers of frames at 120 per second; ``raw_mano[frame]`` with
``rh__pose_coeffs`` (1, 16, 4) quaternions (w, x, y, z) relative to the flat hand, ``rh__tsl`` (1, 3), where the wrist
is, and ``rh__betas`` (1, 10), tensors of torch; ``obj_transf[object][frame]`` (4, 4). Metres, y up.
"""

import numpy as np
from mano import keypoints, load_model
from pickles import load_pickle
from scipy.spatial.transform import Rotation
from shared import Recording, convert


def read(options) -> Recording:
    """Return the recording of one sequence, at 30 frames per second."""
    data = load_pickle(options.sequence)
    objects = data["obj_transf"]
    if options.object not in objects:
        raise SystemExit(f"There is no object {options.object}. Choose from: {', '.join(objects)}.")
    frames = data["mocap_frame_id_list"][::4]
    hands = [data["raw_mano"][frame] for frame in frames]
    prefix = f"{options.side[0]}h__"
    quats = np.concatenate([np.asarray(hand[f"{prefix}pose_coeffs"]) for hand in hands])
    turns = Rotation.from_quat(quats.reshape(-1, 4), scalar_first=True).as_rotvec()
    turns = turns.reshape(len(frames), 48)
    points = keypoints(
        load_model(options.mano),
        Rotation.from_rotvec(turns[:, :3]),
        np.concatenate([np.asarray(hand[f"{prefix}tsl"]) for hand in hands]),
        np.asarray(hands[0][f"{prefix}betas"])[0],
        fingers=turns[:, 3:],
        wrist_at_trans=True,
    )
    poses = np.stack([np.asarray(objects[options.object][frame]) for frame in frames])
    return Recording(points, poses, (np.array(frames) - frames[0]) / 120)


if __name__ == "__main__":
    convert(read, __doc__.partition("\n")[0], up="0 1 0")
