"""What the page shows, as pictures: for papers, for reports, and where there is no browser."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from xreset.render import INVALID_COLOR, Points, Renderer, pose_matrix
from xreset.spec import SceneSpec
from xreset.view.data import BONES, View

HUMAN_COLOR = (0.85, 0.10, 0.45)
TOUCH_COLOR = (1.00, 0.80, 0.00)
"""Of keypoints in contact with the object."""
REACHED_COLOR = (0.10, 0.55, 0.90)
"""Of the robot's fingertips."""
_BONE_DOTS = 6


def drawer(view: View, *, size: tuple[int, int] = (640, 480), smooth: bool = False) -> Callable[[int], np.ndarray]:
    """A function that draws one row of a view as [H, W, 3] uint8.

    The robot is red where the row is not valid; the object stands translucent at its goal; human keypoints are pink, those in contact
    yellow, and the robot's fingertips blue.
    """
    from xreset import robots

    robot = view.robot or robots.load(robots.robot_names()[0])  # a scene has one; it is drawn only if the view has one too
    renderer = Renderer(SceneSpec(robot=robot, objects=view.objects), size=size, smooth=smooth)

    def draw(row: int) -> np.ndarray:
        sequence = view.sequence[row]
        return renderer.draw(
            None if view.joint_pos is None else view.joint_pos[row],
            pose_matrix(view.object_pos[row], view.object_quat[row]),
            goal_pose=pose_matrix(view.goal_pos[sequence], view.goal_quat[sequence]),
            object_index=int(view.object_index[row]),
            robot_tint=INVALID_COLOR if view.reason[row] else None,
            points=_points(view, row),
        )

    return draw


def _points(view: View, row: int) -> list[Points]:
    points = []
    if view.human is not None:
        keypoints, touching = view.human.keypoints[row], view.human.touching[row]
        start, end = keypoints[BONES[:, 0], None], keypoints[BONES[:, 1], None]
        along = np.linspace(0, 1, _BONE_DOTS)[1:-1, None]
        points.append(Points(pos=(start + along * (end - start)).reshape(-1, 3), color=HUMAN_COLOR, radius=0.0018))
        points.append(Points(pos=keypoints[~touching], color=HUMAN_COLOR))
        points.append(Points(pos=keypoints[touching], color=TOUCH_COLOR, radius=0.005))
    if view.fingertips is not None:
        points.append(Points(pos=view.fingertips[row], color=REACHED_COLOR, radius=0.003))
    return points
