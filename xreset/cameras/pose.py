"""Poses of cameras: x to the right, y down, z forward."""

from __future__ import annotations

import numpy as np

from xreset.cameras.config import CameraConfig
from xreset.geometry.shapes import transform


def look_at(eye: tuple[float, ...], target: tuple[float, ...]) -> np.ndarray:
    """Return [3, 3] unit vectors to the right, down and forward, as rows; z is up."""
    forward = np.array(target, dtype=float) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    if np.linalg.norm(right) < 1e-6:  # straight up or down
        right = np.array([1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    return np.stack((right, np.cross(forward, right), forward))


def mounted_pose(camera: CameraConfig) -> np.ndarray:
    """Return the pose [4, 4] of a camera in the frame of its link or of the world: x right, y down, z forward."""
    return transform(look_at(camera.pos, camera.target).T, camera.pos)
