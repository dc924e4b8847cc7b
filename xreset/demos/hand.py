"""A simple human hand: joint angles to the 21 keypoints, for synthetic demonstrations.

The hand's frame is that of MANO's root, at the wrist: a right hand's fingers point along -x, its palm faces -y and its thumb is on the +z
side; a left hand is the mirror image in x. Lengths are rounded averages of adult hands.
"""

from __future__ import annotations

import numpy as np

PARENTS = np.array([0 if k % 4 == 1 else k - 1 for k in range(1, 21)])
"""[20] the keypoint before each of those beyond the wrist: with it, it makes a bone."""
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

FINGER_JOINTS = tuple(
    f"{finger}_{joint}" for finger in ("index", "middle", "ring", "little") for joint in ("abduction", "mcp", "pip")
)
THUMB_JOINTS = ("thumb_radial", "thumb_palmar", "thumb_twist", "thumb_mcp", "thumb_ip")
JOINTS = FINGER_JOINTS + THUMB_JOINTS
"""The 17 joint angles [rad] in the order of :func:`keypoints`; flexion is positive."""

LOWER = np.array([-0.3, -0.2, 0.0] * 4 + [-0.3, 0.1, -0.2, 0.0, -0.1])
UPPER = np.array([0.3, 1.5, 1.75] * 4 + [1.0, 1.1, 1.0, 0.9, 1.2])
"""[17] limits of the joint angles [rad]."""
RELAXED = np.array([0.0, 0.35, 0.45] * 4 + [0.4, 0.6, 0.3, 0.25, 0.25])
"""[17] a hand at ease."""


def keypoints(angles: np.ndarray, side: str = "right") -> np.ndarray:
    """[..., 21, 3] keypoints in the hand's frame for joint angles [..., 17]."""
    angles = np.asarray(angles, dtype=float)
    fingers = angles[..., :12].reshape(*angles.shape[:-1], 4, 3)
    turn = fingers[..., 0] + FINGER_SPLAY
    flexion = np.stack(
        (fingers[..., 1], fingers[..., 1] + fingers[..., 2], fingers[..., 1] + (1 + DIP_PER_PIP) * fingers[..., 2]),
        axis=-1,
    )
    cos, sin = np.cos(flexion), np.sin(flexion)
    bones = (
        np.stack((-cos * np.cos(turn)[..., None], -sin, cos * np.sin(turn)[..., None]), axis=-1)
        * FINGER_LENGTHS[..., None]
    )
    finger_points = FINGER_BASES[:, None] + np.concatenate(
        (np.zeros_like(bones[..., :1, :]), np.cumsum(bones, axis=-2)), axis=-2
    )

    radial, palmar, twist, mcp, ip = np.moveaxis(angles[..., 12:], -1, 0)
    first = np.stack((-np.cos(radial) * np.cos(palmar), -np.sin(palmar), np.sin(radial) * np.cos(palmar)), axis=-1)
    bend = np.stack(
        (np.zeros_like(twist), -np.sin(twist), -np.cos(twist)), axis=-1
    )  # where the thumb's tip goes when it flexes
    bend = bend - (bend * first).sum(axis=-1, keepdims=True) * first
    bend /= np.linalg.norm(bend, axis=-1, keepdims=True)
    bent = np.stack((np.zeros_like(mcp), mcp, mcp + ip), axis=-1)[..., None]
    bones = (np.cos(bent) * first[..., None, :] + np.sin(bent) * bend[..., None, :]) * THUMB_LENGTHS[:, None]
    thumb_points = THUMB_BASE + np.concatenate((np.zeros_like(bones[..., :1, :]), np.cumsum(bones, axis=-2)), axis=-2)

    wrist = np.zeros((*angles.shape[:-1], 1, 3))
    points = np.concatenate((wrist, thumb_points, finger_points.reshape(*angles.shape[:-1], 16, 3)), axis=-2)
    return points * (-1.0, 1.0, 1.0) if side == "left" else points


def hand_axes(direction: np.ndarray, palm: np.ndarray, side: str = "right") -> np.ndarray:
    """[3, 3] orientation of a hand whose fingers point along ``direction`` and whose palm faces ``palm`` (orthogonal unit vectors)."""
    x = -direction if side == "right" else direction
    return np.stack((x, -palm, np.cross(x, -palm)), axis=-1)


def bone_lengths(points: np.ndarray) -> np.ndarray:
    """[F, 20] lengths of the bones between keypoints [F, 21, 3]."""
    return np.linalg.norm(points[:, 1:] - points[:, PARENTS], axis=-1)
