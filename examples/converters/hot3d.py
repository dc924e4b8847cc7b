"""HOT3D (Banerjee et al. 2024): one hand and one object of a sequence. Not tried on the original files.

    python examples/converters/hot3d.py P0003_c701bd11 --object 204462113746498 --mesh 204462113746498.glb --mano MANO_RIGHT.pkl --out mug.npz

``mano_hand_pose_trajectory.jsonl`` has a line for each time: ``timestamp_ns`` and ``hand_poses``, "0" the left and "1"
the right hand, with ``pose`` (15), weights of the model's principal components around its mean hand, ``betas`` (10) and
``wrist_xform`` (``q_wxyz``, ``t_xyz``: MANO's orientation and translation). ``dynamic_objects.csv`` has the columns
``object_uid``, ``timestamp[ns]``, ``t_wo_x[m]`` and so on, and ``q_wo_w`` and so on. Metres, z up.
"""

import csv
import json

import numpy as np
from mano import keypoints, load_model
from scipy.spatial.transform import Rotation
from shared import Recording, convert


def read(options) -> Recording:
    """Return the recording of one sequence, at the times that have a pose of the object."""
    poses = {}
    with open(options.sequence / "dynamic_objects.csv", newline="") as file:
        for row in csv.DictReader(file):
            if row["object_uid"] == options.object:
                quat = [float(row[f"q_wo_{axis}"]) for axis in "wxyz"]
                T = np.eye(4)
                T[:3, :3] = Rotation.from_quat(quat, scalar_first=True).as_matrix()
                T[:3, 3] = [float(row[f"t_wo_{axis}[m]"]) for axis in "xyz"]
                poses[int(row["timestamp[ns]"])] = T
    times = sorted(poses)
    hands = {}
    with open(options.sequence / "mano_hand_pose_trajectory.jsonl") as file:
        for line in file:
            entry = json.loads(line)
            hand = entry["hand_poses"].get({"left": "0", "right": "1"}[options.side])
            if hand is not None and entry["timestamp_ns"] in poses:
                hands[entry["timestamp_ns"]] = hand
    if not hands:
        raise SystemExit(
            f"There is no {options.side} hand at the times of object {options.object}."
        )
    model = load_model(options.mano)
    seen = sorted(hands)
    weights = np.array([hands[time]["pose"] for time in seen])
    wrists = [hands[time]["wrist_xform"] for time in seen]
    points = np.full((len(times), 21, 3), np.nan)
    points[np.searchsorted(times, seen)] = keypoints(
        model,
        Rotation.from_quat([wrist["q_wxyz"] for wrist in wrists], scalar_first=True),
        np.array([wrist["t_xyz"] for wrist in wrists]),
        np.array(hands[seen[0]]["betas"]),
        fingers=weights @ model["hands_components"][: weights.shape[1]],
        relative_to_mean=True,
    )
    poses = np.stack([poses[time] for time in times])
    return Recording(points, poses, 1e-9 * (np.array(times) - times[0]))


if __name__ == "__main__":
    convert(read, __doc__.partition("\n")[0], up="0 0 1")
