"""A sheet of retargeted grasps: the robot's hand and the object, with the human keypoints drawn over them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from xreset.demos.archive import Demos
from xreset.render import Camera, Points, Renderer, pose_matrix
from xreset.retarget.file import Retargeted
from xreset.spec import ObjectSpec, RobotSpec, SceneSpec

_VIEW = np.array([0.40, -0.34, 0.26])
"""From the palm to the camera [m]."""
_TARGET = (0.85, 0.10, 0.45)
_REACHED = (0.10, 0.55, 0.90)


def grasp_sheet(
    retargeted: Retargeted,
    demos: Demos,
    robot: RobotSpec,
    objects: Sequence[ObjectSpec],
    *,
    size: tuple[int, int] = (420, 360),
    columns: int = 3,
) -> np.ndarray:
    """One grasp per object, the human's keypoints in red, the robot's fingertips in blue.

    Args:
        retargeted: trajectories.
        demos: the demonstrations that they were made from, resting on the table (:func:`xreset.retarget.pipeline.rest_on_table`).
        robot: the robot.
        objects: geometry of the objects.
        size: width and height of one tile [pixels].
        columns: tiles beside one another.

    Returns:
        [H, W, 3] uint8.
    """
    tiles = []
    for spec in objects:
        frame = _grasp_frame(retargeted, spec.name)
        if frame is None:
            continue
        palm = retargeted.palm_pos[frame]
        camera = Camera(eye=tuple(palm + _VIEW), target=tuple(palm))
        draw = Renderer(SceneSpec(robot=robot, objects=(spec,)), size=size, camera=camera, smooth=True).draw
        tiles.append(
            draw(
                retargeted.joint_pos[frame],
                pose_matrix(retargeted.object_pos[frame], retargeted.object_quat_wxyz[frame]),
                points=(
                    Points(pos=demos.hand_keypoints[frame], color=_TARGET),
                    Points(pos=retargeted.fingertip_pos[frame], color=_REACHED, radius=0.003),
                ),
            )
        )
    width, height = size
    rows = -(-len(tiles) // columns)
    sheet = np.full((max(rows, 1) * height, columns * width, 3), 255, dtype=np.uint8)
    for i, tile in enumerate(tiles):
        row, column = divmod(i, columns)
        sheet[row * height : (row + 1) * height, column * width : (column + 1) * width] = tile
    return sheet


def _grasp_frame(retargeted: Retargeted, name: str) -> int | None:
    """The middle one of an object's annotated frames after first contact, in the first sequence that has any; valid ones first."""
    for usable in (retargeted.valid, retargeted.annotated):
        for i in np.flatnonzero(retargeted.object_name == name):
            start, end = retargeted.frame_offsets[i], retargeted.frame_offsets[i + 1]
            first = int(retargeted.first_contact[i])
            frames = start + first + np.flatnonzero(usable[start + first : end]) if first >= 0 else np.zeros(0, dtype=int)
            if len(frames):
                return int(frames[len(frames) // 2])
    return None
