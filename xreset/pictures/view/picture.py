"""What the page shows, as pictures: for papers, for reports, and where there is no browser."""

from __future__ import annotations

import math

import numpy as np

from xreset.description import load_robot
from xreset.pictures.raster import Camera, Points, Renderer, pose_matrix
from xreset.pictures.view.colors import CONTACT_COLOR, HUMAN_COLOR, REACHED_COLOR, TOUCH_COLOR, reason_color
from xreset.pictures.view.data import BONES, View
from xreset.plugins import robot_names
from xreset.spec import SceneSpec

_BONE_DOTS = 6
_NEAR = 0.52
"""[m] from a near picture's camera to what it looks at."""
_NEAR_REACH = 0.20
"""[m] between hand and object up to which that is near enough to show both."""
_NEAR_RISE = math.radians(25.0)
"""Elevation of a near picture's camera."""
_NEAR_TURN = math.radians(70.0)
"""Angle, seen from above, between the directions from the object to the hand and to the camera: the hand then hides nothing and is not
hidden."""
_NEAR_SIDE = np.array([0.76, -0.65])
"""Horizontal direction from which it looks if there is a choice: from the front right, like :class:`~xreset.pictures.raster.Camera`."""


class Drawer:
    """Draws rows of a view. Colours are those of :mod:`xreset.pictures.view.colors`; the object stands translucent at its goal."""

    def __init__(self, view: View, *, size: tuple[int, int] = (640, 480), smooth: bool = False) -> None:
        """Prepare the meshes; ``size`` is width and height in pixels, ``smooth`` draws at twice the size and averages."""
        robot = view.robot or load_robot(robot_names()[0])  # a scene has one; it is drawn only if the view has one too
        self._view = view
        self._renderer = Renderer(SceneSpec(robot=robot, objects=view.objects), size=size, smooth=smooth)

    def draw(self, row: int, *, near: bool = False) -> np.ndarray:
        """[H, W, 3] uint8 picture of one row: of the whole scene, or ``near`` to hand and object."""
        view, sequence, reason = self._view, self._view.sequence[row], self._view.reason[row]
        return self._renderer.draw(
            None if view.joint_pos is None else view.joint_pos[row],
            pose_matrix(view.object_pos[row], view.object_quat[row]),
            goal_pose=pose_matrix(view.goal_pos[sequence], view.goal_quat[sequence]),
            object_index=int(view.object_index[row]),
            robot_tint=reason_color(reason) if reason else None,
            points=_points(view, row),
            camera=self._near_camera(row) if near else None,
        )

    def _near_camera(self, row: int) -> Camera:
        view, body = self._view, self._view.object_pos[row]
        hand = view.human.keypoints[row].mean(axis=0) if view.human is not None else np.full(3, np.nan)
        if view.robot is not None and view.joint_pos is not None:
            hand = self._renderer.link_frames(view.joint_pos[row], [view.robot.palm]).poses[0, :3, 3]
        if not np.isfinite(hand).all():
            hand = body
        side = _beside(hand[:2] - body[:2])
        distance = _NEAR * max(1.0, float(np.linalg.norm(hand - body)) / _NEAR_REACH)
        target = (hand + body) / 2
        eye = target + distance * np.array([*(math.cos(_NEAR_RISE) * side), math.sin(_NEAR_RISE)])
        return Camera(eye=tuple(eye), target=tuple(target))


def _beside(hand: np.ndarray) -> np.ndarray:
    """The horizontal direction [2] to a near picture's camera, for a hand [2] seen from the object."""
    length = np.linalg.norm(hand)
    if length < 1e-3:
        return _NEAR_SIDE
    c, s = math.cos(_NEAR_TURN), math.sin(_NEAR_TURN)
    sides = np.array([[[c, -s], [s, c]], [[c, s], [-s, c]]]) @ (hand / length)
    return sides[np.argmax(sides @ _NEAR_SIDE)]


def _points(view: View, row: int) -> list[Points]:
    points = []
    if view.human is not None:
        keypoints, touching = view.human.keypoints[row], view.human.touching[row]
        start, end = keypoints[BONES[:, 0], None], keypoints[BONES[:, 1], None]
        along = np.linspace(0, 1, _BONE_DOTS)[1:-1, None]
        points.append(Points(pos=(start + along * (end - start)).reshape(-1, 3), color=HUMAN_COLOR, radius=0.0018))
        points.append(Points(pos=view.human.contacts[row], color=CONTACT_COLOR, radius=0.003))
        points.append(Points(pos=keypoints[~touching], color=HUMAN_COLOR))
        points.append(Points(pos=keypoints[touching], color=TOUCH_COLOR, radius=0.005))
    if view.fingertips is not None:
        points.append(Points(pos=view.fingertips[row], color=REACHED_COLOR, radius=0.003))
    return points
