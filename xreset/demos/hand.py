"""A simple human hand: joint angles to the 21 keypoints, for synthetic demonstrations.

The hand's frame is that of MANO's root, at the wrist: a right hand's fingers point along -x, its palm faces -y and its
thumb is on the +z side; a left hand is the mirror image in x. Lengths are rounded averages of adult hands.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation  # which the help of `xreset view` must not load

Order = Literal["mano", "mediapipe", "openpose"]
ORDERS: Mapping[Order, tuple[int, ...]] = {
    "mano": (0, 13, 14, 15, 16, 1, 2, 3, 17, 4, 5, 6, 18, 10, 11, 12, 19, 7, 8, 9, 20),
    "mediapipe": tuple(range(21)),
    "openpose": tuple(range(21)),
}
"""Index of each of :data:`xreset.spec.KEYPOINTS` in another order. MANO: the 16 joints of the model (wrist, index,
middle, little, ring, thumb, base to end), then the tips of thumb, index, middle, ring and little finger (Romero et al.
2017)."""

PARENTS = np.array([0, 1, 2, 3, 0, 5, 6, 7, 0, 9, 10, 11, 0, 13, 14, 15, 0, 17, 18, 19])
"""[20] the keypoint before each of the keypoints 1 to 20: the other end of its bone."""
FLESH = np.full(40, 0.007)
FLESH[[3, 7, 11, 15, 19]] = 0.001
"""[40] thickness of the flesh around the points of :func:`flesh`, where fingertips are on the skin [m]."""
FINGER_BASES = np.array([[-90, -4, 22], [-95, -2, 0], [-87, -4, -21], [-77, -9, -40]]) * 1e-3
"""[4, 3] the knuckles of index, middle, ring and little finger [m]."""
FINGER_LENGTHS = np.array([[38, 23, 23], [42, 26, 24], [38, 25, 24], [29, 19, 21]]) * 1e-3
"""[4, 3] their phalanges, base to tip [m]."""
FINGER_SPLAY = np.array([0.06, 0.0, -0.05, -0.12])
"""[4] direction of the straight fingers in the palm's plane, positive towards the thumb [rad]."""
THUMB_BASE = np.array([-25, -15, 26]) * 1e-3
"""[3] the thumb's carpometacarpal joint [m]."""
THUMB_LENGTHS = np.array([42, 33, 30]) * 1e-3
"""[3] metacarpal and the two phalanges [m]."""
DIP_PER_PIP = 0.6
"""Flexion of a finger's last joint per flexion of its middle joint: one tendon bends both."""

# The 17 joint angles [rad]; flexion is positive. Of each finger, index to little: abduction, base joint (MCP), middle
# joint (PIP). Of the thumb: radial and palmar abduction, twist, MCP, IP.
LOWER = np.array([-0.3, -0.2, 0.0] * 4 + [-0.3, 0.1, -0.2, 0.0, -0.1])
UPPER = np.array([0.3, 1.5, 1.75] * 4 + [1.0, 1.1, 1.0, 0.9, 1.2])
"""[17] limits of the joint angles [rad]."""
RELAXED = np.array([0.0, 0.35, 0.45] * 4 + [0.4, 0.6, 0.3, 0.25, 0.25])
"""[17] joint angles of a hand at ease [rad]."""


def keypoints(angles: np.ndarray, side: str = "right") -> np.ndarray:
    """[..., 21, 3] keypoints in the hand's frame for joint angles [..., 17]."""
    angles = np.asarray(angles, dtype=float)
    wrist = np.zeros((*angles.shape[:-1], 1, 3))
    fingers = _fingers(angles[..., :12]).reshape(*angles.shape[:-1], 16, 3)
    points = np.concatenate((wrist, _thumb(angles[..., 12:]), fingers), axis=-2)
    return points * (-1.0, 1.0, 1.0) if side == "left" else points


def placed(pos: np.ndarray, rotation: Rotation, angles: np.ndarray, side: str) -> np.ndarray:
    """[n, 21, 3] keypoints of hands with wrist positions [n, 3], n orientations and joint angles [n, 17]."""
    turned = np.einsum("nij,nkj->nki", rotation.as_matrix(), keypoints(angles, side))
    return turned + pos[:, None]


def _fingers(angles: np.ndarray) -> np.ndarray:
    """[..., 4, 4, 3] points of the four fingers for their joint angles [..., 12]."""
    abduction, mcp, pip = np.moveaxis(angles.reshape(*angles.shape[:-1], 4, 3), -1, 0)
    turn = (abduction + FINGER_SPLAY)[..., None]
    flexion = np.stack((mcp, mcp + pip, mcp + (1 + DIP_PER_PIP) * pip), axis=-1)
    cos = np.cos(flexion)
    directions = np.stack((-cos * np.cos(turn), -np.sin(flexion), cos * np.sin(turn)), axis=-1)
    return _chain(FINGER_BASES[:, None], directions * FINGER_LENGTHS[..., None])


def _thumb(angles: np.ndarray) -> np.ndarray:
    """[..., 4, 3] points of the thumb for its joint angles [..., 5]."""
    radial, palmar, twist, mcp, ip = np.moveaxis(angles, -1, 0)
    zero = np.zeros_like(twist)
    first = np.stack(
        (-np.cos(radial) * np.cos(palmar), -np.sin(palmar), np.sin(radial) * np.cos(palmar)),
        axis=-1,
    )
    # where the tip goes when the thumb flexes
    bend = np.stack((zero, -np.sin(twist), -np.cos(twist)), axis=-1)
    bend = bend - (bend * first).sum(axis=-1, keepdims=True) * first
    bend /= np.linalg.norm(bend, axis=-1, keepdims=True)
    flexion = np.stack((zero, mcp, mcp + ip), axis=-1)[..., None]
    directions = np.cos(flexion) * first[..., None, :] + np.sin(flexion) * bend[..., None, :]
    return _chain(THUMB_BASE, directions * THUMB_LENGTHS[:, None])


def _chain(base: np.ndarray, bones: np.ndarray) -> np.ndarray:
    """[..., 4, 3] joints of a chain of three bones [..., 3, 3] from its base."""
    start = np.zeros_like(bones[..., :1, :])
    return base + np.concatenate((start, np.cumsum(bones, axis=-2)), axis=-2)


def hand_axes(direction: np.ndarray, palm: np.ndarray, side: str) -> np.ndarray:
    """[3, 3] orientation of a hand whose fingers point along ``direction`` [3] and whose palm faces ``palm`` [3], two
    orthogonal unit vectors."""
    x = -direction if side == "right" else direction
    return np.stack((x, -palm, np.cross(x, -palm)), axis=-1)


def bone_lengths(points: np.ndarray) -> np.ndarray:
    """[F, 20] lengths of the bones between keypoints [F, 21, 3] [m]."""
    return np.linalg.norm(points[:, 1:] - points[:, PARENTS], axis=-1)


def flesh(points: np.ndarray) -> np.ndarray:
    """[..., 40, 3] points that stand for the hand's flesh: the keypoints 1 to 20 of [..., 21, 3], and the middles of
    their bones."""
    joints = points[..., 1:, :]
    middles = (joints + points[..., PARENTS, :]) / 2
    return np.concatenate((joints, middles), axis=-2)
