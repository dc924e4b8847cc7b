"""More states where a hand closes in on an object.

People's hands come in at 0.6 to 0.9 m/s. So at 30 frames a second, a demonstration has only two or three frames with
the hand less than 10 cm from its grasp. There a policy learns whether to grasp or to press. Here the robot's joints are
interpolated between two frames of one motion, so that fingertips move by a stated distance from state to state. Physics
judges the new states like the others.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from xreset.geometry.shapes import turn_of
from xreset.resets.config import ClosingConfig
from xreset.resets.fingers import Fingers, fingers_of
from xreset.retarget.file import Retargeted
from xreset.spec import ObjectSpec, RobotSpec

TOUCH = 0.002
"""A finger nearer to the object than this touches it [m]; retargeting keeps 0.5 mm between them."""
WITHIN = 0.10
"""States are added between two frames if a finger is nearer than this to the object in one of them [m]."""
MOVED = 0.01
"""An object has been moved once its center of mass is farther than this from where it started [m]."""


def closing_states(
    retargeted: Retargeted, robot: RobotSpec, objects: Sequence[ObjectSpec], config: ClosingConfig
) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Choose the valid frames of a motion, and states between them where the hand closes in.

    A hand closes in while a finger is near the object. It has closed in when the thumb and another finger touch the
    object, or when the object has been moved. The human's first contact is too early for this end: the robot's fingers
    are then usually 5 to 10 mm away.

    Returns:
        For each state [M] the frame that it is or follows, ascending; how far it is on the way to the next frame, in
        [0, 1), where 0 is the frame itself; and joint positions [M, J], object positions [M, 3] and quaternions [M, 4].
    """
    # number of states of each frame: itself, and those that follow it
    count = retargeted.valid.astype(int)
    if config.spacing is not None:
        object_name = retargeted.object_name[retargeted.sequence_of_frame]
        poses = (retargeted.joint_pos, retargeted.object_pos, retargeted.object_quat_wxyz)
        fingers = fingers_of(robot, objects, object_name, *poses)
        shift = np.linalg.norm(retargeted.shift(objects), axis=-1)
        followed = _frames_to_follow(retargeted, fingers, moved=shift > MOVED)
        step = retargeted.fingertip_pos[followed + 1] - retargeted.fingertip_pos[followed]
        travel = np.linalg.norm(step, axis=-1).max(axis=-1)
        count[followed] = np.maximum(np.ceil(travel / config.spacing).astype(int), 1)
    frame = np.repeat(np.arange(len(count)), count)
    first = np.cumsum(count) - count
    part = (np.arange(len(frame)) - first[frame]) / count[frame]
    joint_pos = positions_between(retargeted.joint_pos, frame, part)
    object_pos = positions_between(retargeted.object_pos, frame, part)
    object_quat = rotations_between(retargeted.object_quat_wxyz, frame, part)
    return frame, part, (joint_pos, object_pos, object_quat)


def _frames_to_follow(retargeted: Retargeted, fingers: Fingers, moved: np.ndarray) -> np.ndarray:
    """Return the frames after which states are added, on the way to the next frame; ``moved`` [F]: whether the object
    is away from where it started."""
    owner = retargeted.sequence_of_frame
    start = retargeted.frame_offsets[:-1][owner]
    grasped = fingers.grasp(TOUCH).numpy()
    ends = grasped | moved
    num_ends = np.cumsum(ends)
    before_sequence = (num_ends - ends)[start]
    # in this frame, or in an earlier one of the same sequence
    has_ended = num_ends > before_sequence
    gap = fingers.gap.amin(dim=-1).numpy()
    near = np.minimum(gap[:-1], gap[1:]) < WITHIN
    same_sequence = owner[:-1] == owner[1:]
    return np.flatnonzero(
        same_sequence & retargeted.valid[:-1] & retargeted.valid[1:] & ~has_ended[:-1] & near
    )


def positions_between(values: np.ndarray, frame: np.ndarray, part: np.ndarray) -> np.ndarray:
    """[M, n] values on straight lines between frames [F, n]; those of the frames themselves stay the same."""
    following = values[np.minimum(frame + 1, len(values) - 1)]
    return values[frame] + part[:, None] * (following - values[frame])


def rotations_between(quats: np.ndarray, frame: np.ndarray, part: np.ndarray) -> np.ndarray:
    """[M, 4] quaternions that turn evenly between frames [F, 4]; those of the frames themselves keep every bit."""
    first = turn_of(quats[frame])
    second = turn_of(quats[np.minimum(frame + 1, len(quats) - 1)])
    step = Rotation.from_rotvec(part[:, None] * (first.inv() * second).as_rotvec())
    between = (first * step).as_quat(scalar_first=True)
    return np.where(part[:, None] > 0, between, quats[frame])
