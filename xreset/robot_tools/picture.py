"""Draws a robot at home with its frames, for whoever writes a description."""

from __future__ import annotations

import numpy as np

from xreset.geometry.kinematics import Kinematics
from xreset.pictures.render import Camera, Renderer
from xreset.spec import RobotSpec, SceneSpec

_SIDES = ((0.9, -1.0, 0.7), (-0.5, -0.9, -0.25))
"""Directions of the close views of the hand: from above its thumb's side, and from the other side, above the
table."""
_PANEL = (480, 360)


def robot_picture(robot: RobotSpec) -> np.ndarray:
    """[720, 960, 3] uint8: above, the robot at its table, from the front and from the side; below, its hand from two
    sides.

    The wide views show the frames of the moving joints' links, the close views show the frames of the palm and the
    fingertips (left) and of the links that follow the human's keypoints (right). x is red, y green, z blue.
    """
    kinematics = Kinematics(robot)
    points = kinematics.points(kinematics.home, robot.tracked_links).numpy()
    middle = points.mean(axis=0)
    distance = max(3.0 * np.ptp(points, axis=0).max(), 0.25)
    moving = list(kinematics.tree.moved_by)
    followed = list(dict.fromkeys(keypoint.link for keypoint in robot.keypoints))
    close = []
    for side in _SIDES:
        eye = middle + distance * np.array(side) / np.linalg.norm(side)
        close.append(Camera(eye=tuple(eye), target=tuple(middle)))
    views = (
        (Camera(eye=(1.75, -0.65, 1.25), target=(0.55, 0.50, 0.38)), moving, 0.05),
        (Camera(eye=(-0.95, -0.35, 1.00), target=(0.55, 0.55, 0.40)), moving, 0.05),
        (close[0], list(robot.tracked_links), 0.02),
        (close[1], followed, 0.012),
    )
    scene = SceneSpec(robot=robot, objects=())
    panels = []
    for camera, links, length in views:
        renderer = Renderer(scene, size=_PANEL, camera=camera, smooth=True)
        panels.append(
            renderer.draw(robot.home, points=renderer.link_frames(robot.home, links, length=length))
        )
    return np.vstack((np.hstack(panels[:2]), np.hstack(panels[2:])))
