"""Pictures of rows of a view: for papers, for reports, and where there is no browser."""

from __future__ import annotations

import numpy as np

from xreset.geometry.description import load_robot
from xreset.physics.plugins import robot_names
from xreset.pictures.render import Points, Renderer, Size
from xreset.pictures.view.colors import HUMAN_COLOR, REACHED_COLOR, TOUCH_COLOR, reason_color
from xreset.pictures.view.data import BONES, View
from xreset.spec import SceneSpec

_BONE_DOTS = 6
"""Dots along a bone of the human hand, with both ends."""


class Drawer:
    """Draws rows of a view. Colors are those of :mod:`xreset.pictures.view.colors`; the goal is a translucent
    object."""

    def __init__(self, view: View, *, size: Size = (640, 480), smooth: bool = False) -> None:
        """Prepare the meshes; see :class:`~xreset.pictures.render.Renderer` for the options."""
        # a scene needs one; it is drawn only if the view has one
        robot = view.robot or load_robot(robot_names()[0])
        self._view = view
        self._renderer = Renderer(
            SceneSpec(robot=robot, objects=view.objects), size=size, smooth=smooth
        )

    def draw(self, row: int) -> np.ndarray:
        """Return the [H, W, 3] uint8 picture of one row."""
        view = self._view
        sequence = view.sequence[row]
        points = []
        if view.human_keypoints is not None and view.human_touching is not None:
            points += _human_points(view.human_keypoints[row], view.human_touching[row])
        if view.fingertips is not None:
            points.append(Points(pos=view.fingertips[row], color=REACHED_COLOR, radius=0.003))
        return self._renderer.draw(
            None if view.joint_pos is None else view.joint_pos[row],
            (view.object_pos[row], view.object_quat[row]),
            goal_pose=(view.goal_pos[sequence], view.goal_quat[sequence]),
            object_index=int(view.object_index[row]),
            robot_tint=reason_color(view.reason[row]),
            points=points,
        )


def _human_points(keypoints: np.ndarray, touching: np.ndarray) -> list[Points]:
    start = keypoints[BONES[:, 0]]
    end = keypoints[BONES[:, 1]]
    dots = np.linspace(start, end, _BONE_DOTS)[1:-1]
    return [
        Points(pos=dots, color=HUMAN_COLOR, radius=0.0018),
        Points(pos=keypoints[~touching], color=HUMAN_COLOR),
        Points(pos=keypoints[touching], color=TOUCH_COLOR, radius=0.005),
    ]
