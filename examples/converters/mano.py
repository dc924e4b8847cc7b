"""Keypoints from the parameters of MANO (Romero et al. 2017), with the reader's own copy of the model.

The model may not be passed on: register at mano.is.tue.mpg.de and download ``MANO_RIGHT.pkl`` and ``MANO_LEFT.pkl``.
Their arrays, for V = 778 vertices and 16 joints: ``v_template`` (V, 3), ``shapedirs`` (V, 3, 10), ``posedirs``
(V, 3, 135), ``J_regressor`` (16, V), ``weights`` (V, 16), ``kintree_table`` (2, 16), ``hands_mean`` (45) and
``hands_components`` (45, 45).
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from pickles import load_pickle
from scipy.spatial.transform import Rotation

TIPS = (744, 320, 443, 554, 671)
"""Vertices at the tips of thumb, index, middle, ring and little finger."""
_ARRAYS = (
    "v_template", "shapedirs", "posedirs", "J_regressor", "weights", "kintree_table", "hands_mean", "hands_components",
)  # fmt: skip


def load_model(path: Path) -> dict[str, np.ndarray]:
    """Read the model of one hand from its pickle."""
    data = load_pickle(path)
    return {
        name: np.asarray(data[name].toarray() if hasattr(data[name], "toarray") else data[name])
        for name in _ARRAYS
    }


def keypoints(
    model: Mapping[str, np.ndarray],
    turns: Rotation,
    trans: np.ndarray,
    betas: np.ndarray,
    *,
    fingers: np.ndarray | None = None,
    relative_to_mean: bool = False,
    wrist_at_trans: bool = False,
) -> np.ndarray:
    """Return keypoints [F, 21, 3] in MANO's order: 16 joints, then the tips of thumb, index, middle, ring, little.

    Linear blend skinning: joints J = J_regressor (template + shape), each joint turned against the one before it, and
    the tips' vertices, with the corrections of the pose, carried along by their weights.

    Args:
        model: see :func:`load_model`.
        turns: F orientations of the root.
        trans: [F, 3] translations [m].
        betas: [10] shape.
        fingers: [F, 45] angles of the 15 joints, as axis and angle; default: zeros.
        relative_to_mean: the angles are differences from the model's mean hand (``flat_hand_mean=False``).
        wrist_at_trans: the wrist is at ``trans`` (``center_idx=0``); otherwise the model's origin is, before it turns.
    """
    frames = len(trans)
    angles = np.zeros((frames, 45)) if fingers is None else np.asarray(fingers, dtype=float)
    if relative_to_mean:
        angles = angles + model["hands_mean"]
    bent = Rotation.from_rotvec(angles.reshape(-1, 3)).as_matrix().reshape(frames, 15, 3, 3)
    local = np.concatenate((turns.as_matrix()[:, None], bent), axis=1)
    vertices = model["v_template"] + model["shapedirs"][..., : len(betas)] @ betas
    joints = model["J_regressor"] @ vertices
    R = np.zeros((frames, 16, 3, 3))
    at = np.zeros((frames, 16, 3))
    R[:, 0] = local[:, 0]
    at[:, 0] = joints[0]
    for joint in range(1, 16):
        parent = int(model["kintree_table"][0, joint])
        R[:, joint] = R[:, parent] @ local[:, joint]
        at[:, joint] = at[:, parent] + R[:, parent] @ (joints[joint] - joints[parent])
    correction = (local[:, 1:] - np.eye(3)).reshape(frames, 135)
    tips = vertices[[*TIPS]] + np.einsum("vcp,fp->fvc", model["posedirs"][[*TIPS]], correction)
    weights = model["weights"][[*TIPS]]
    moved = np.einsum("fjab,fvjb->fvja", R, tips[:, :, None] - joints) + at[:, None]
    points = np.concatenate((at, np.einsum("vj,fvja->fva", weights, moved)), axis=1)
    start = points[:, :1] if wrist_at_trans else 0.0
    return points - start + np.asarray(trans)[:, None]
