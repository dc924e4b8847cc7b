"""Pictures of rows of a view: for papers, for reports, and where there is no browser."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from xreset.description import load_robot
from xreset.pictures.render import Camera, Points, Renderer, pose_matrix
from xreset.pictures.view.colors import CONTACT_COLOR, HUMAN_COLOR, REACHED_COLOR, TOUCH_COLOR, reason_color
from xreset.pictures.view.data import BONES, Human, View
from xreset.plugins import robot_names
from xreset.spec import SceneSpec

_BONE_DOTS = 6
"""Dots along a bone of the human hand, with both ends."""
_NEAR = 0.52
"""Distance of the camera from the middle of a near picture [m]."""
_NEAR_REACH = 0.20
"""Largest distance of hand and object that is visible from there; the camera moves away in proportion beyond it [m]."""
_NEAR_RISE = np.radians(25.0)
"""Elevation of the camera of a near picture."""
_NEAR_TURN = 70.0
"""Angle seen from above between the directions from the object to the hand and to the camera [degrees]: neither hides
the other."""
_NEAR_SIDE = np.array([0.76, -0.65])
"""Preferred horizontal direction to the camera: from the front right, like :class:`~xreset.pictures.render.Camera`."""


class Drawer:
    """Draws rows of a view. Colors are those of :mod:`xreset.pictures.view.colors`; the goal is a translucent
    object."""

    def __init__(self, view: View, *, size: tuple[int, int] = (640, 480), smooth: bool = False) -> None:
        """Prepare the meshes; see :class:`~xreset.pictures.render.Renderer` for the options."""
        robot = view.robot or load_robot(robot_names()[0])  # a scene needs one; it is drawn only if the view has one
        self._view = view
        self._renderer = Renderer(SceneSpec(robot=robot, objects=view.objects), size=size, smooth=smooth)

    def draw(self, row: int, *, near: bool = False) -> np.ndarray:
        """Return the [H, W, 3] uint8 picture of one row: of the whole scene, or ``near`` to hand and object."""
        view = self._view
        sequence = view.sequence[row]
        reason = view.reason[row]
        points = []
        if view.human is not None:
            points += _human_points(view.human, row)
        if view.fingertips is not None:
            points.append(Points(pos=view.fingertips[row], color=REACHED_COLOR, radius=0.003))
        return self._renderer.draw(
            None if view.joint_pos is None else view.joint_pos[row],
            pose_matrix(view.object_pos[row], view.object_quat[row]),
            goal_pose=pose_matrix(view.goal_pos[sequence], view.goal_quat[sequence]),
            object_index=int(view.object_index[row]),
            robot_tint=reason_color(reason) if reason else None,
            points=points,
            camera=self._near_camera(row) if near else None,
        )

    def _near_camera(self, row: int) -> Camera:
        view = self._view
        body = view.object_pos[row]
        hand = np.full(3, np.nan)
        if view.robot is not None and view.joint_pos is not None:
            hand = self._renderer.link_frames(view.joint_pos[row], [view.robot.palm]).poses[0, :3, 3]
        elif view.human is not None:
            hand = view.human.keypoints[row].mean(axis=0)
        if not np.isfinite(hand).all():
            hand = body
        distance = _NEAR * max(1.0, float(np.linalg.norm(hand - body)) / _NEAR_REACH)
        direction = np.append(np.cos(_NEAR_RISE) * _side_of(hand - body), np.sin(_NEAR_RISE))
        target = (hand + body) / 2
        return Camera(eye=tuple(target + distance * direction), target=tuple(target))


def _side_of(to_hand: np.ndarray) -> np.ndarray:
    """Return the horizontal direction [2] to the camera of a near picture, for the direction [3] from object to
    hand."""
    flat = np.append(to_hand[:2], 0.0)
    length = np.linalg.norm(flat)
    if length < 1e-3:
        return _NEAR_SIDE
    both_sides = Rotation.from_euler("z", [[_NEAR_TURN], [-_NEAR_TURN]], degrees=True).apply(flat / length)[:, :2]
    return both_sides[np.argmax(both_sides @ _NEAR_SIDE)]


def _human_points(human: Human, row: int) -> list[Points]:
    keypoints = human.keypoints[row]
    touching = human.touching[row]
    start = keypoints[BONES[:, 0]]
    end = keypoints[BONES[:, 1]]
    dots = np.linspace(start, end, _BONE_DOTS)[1:-1]
    return [
        Points(pos=dots, color=HUMAN_COLOR, radius=0.0018),
        Points(pos=human.contacts[row], color=CONTACT_COLOR, radius=0.003),
        Points(pos=keypoints[~touching], color=HUMAN_COLOR),
        Points(pos=keypoints[touching], color=TOUCH_COLOR, radius=0.005),
    ]
