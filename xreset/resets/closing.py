"""More states where a hand closes in on an object.

People's hands come in at 0.6 to 0.9 m/s. So at 30 frames a second a demonstration shows a hand two or three times
between 10 cm and its grasp, where a policy learns whether to grasp or to press. Here the robot's joints are
interpolated between two frames of one motion, so that fingertips move by a stated distance from state to state. Physics
judges the new states like the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from xreset.resets.config import ClosingConfig
from xreset.resets.fingers import Fingers, fingers_of
from xreset.retarget.file import Retargeted
from xreset.spec import ObjectSpec, RobotSpec

TOUCH = 0.002
"""A finger nearer to the object than this touches it [m]; retargeting keeps 0.5 mm between them."""
MOVED = 0.01
"""An object has been moved once its origin is farther than this from where it started [m]."""

_POSITIONS = ("joint_pos", "palm_pos", "fingertip_pos", "object_pos")
_ROTATIONS = ("palm_quat_wxyz", "object_quat_wxyz")
_REPEATED = ("annotated", "valid", "reason", "contact", "hand_error", "wrist_error")


class Closing(NamedTuple):
    """Trajectories with states between frames."""

    retargeted: Retargeted
    """With more frames, no longer evenly spaced in time. The given frames are unchanged and in their order."""
    frame: np.ndarray
    """[F] given frame that each frame is or follows, counted over the given trajectories."""
    part: np.ndarray
    """[F] how far each frame is on the way to the next given one, in [0, 1); 0 is the given frame itself."""


def with_closing_frames(
    retargeted: Retargeted, robot: RobotSpec, objects: Sequence[ObjectSpec], config: ClosingConfig
) -> Closing:
    """Return the same motion with frames added between valid ones where the hand closes in.

    That is where a finger is near the object, until the thumb and another finger touch the object or the object has
    been moved. The human's first contact is not the end: there the robot's fingers are usually 5 to 10 mm away.
    """
    owner = retargeted.sequence_of_frame
    if config.spacing is None:
        return Closing(retargeted, np.arange(len(owner)), np.zeros(len(owner)))
    before = _frames_to_follow(retargeted, fingers_in(retargeted, robot, objects), config.within)
    step = retargeted.fingertip_pos[before + 1] - retargeted.fingertip_pos[before]
    travel = np.linalg.norm(step, axis=-1).max(axis=-1)
    pieces = np.ones(len(owner), dtype=int)
    pieces[before] = np.maximum(np.ceil(travel / config.spacing).astype(int), 1)
    frame = np.repeat(np.arange(len(owner)), pieces)
    first_row = np.cumsum(pieces) - pieces
    part = (np.arange(len(frame)) - first_row[frame]) / pieces[frame]

    arrays = {name: getattr(retargeted, name)[frame] for name in _REPEATED}
    for name in _POSITIONS:
        arrays[name] = _positions_between(getattr(retargeted, name), frame, part)
    for name in _ROTATIONS:
        arrays[name] = _rotations_between(getattr(retargeted, name), frame, part)
    counts = np.bincount(owner[frame], minlength=len(retargeted.sequence_name))
    offsets = np.concatenate(([0], np.cumsum(counts)))
    contact = retargeted.first_contact
    contact_row = first_row[np.where(contact >= 0, retargeted.frame_offsets[:-1] + contact, 0)]
    dense = replace(
        retargeted,
        frame_offsets=offsets.astype(retargeted.frame_offsets.dtype),
        first_contact=np.where(contact >= 0, contact_row - offsets[:-1], contact).astype(contact.dtype),
        **arrays,
    )
    return Closing(dense, frame, part)


def _frames_to_follow(retargeted: Retargeted, fingers: Fingers, within: float) -> np.ndarray:
    """Return the frames between which and their next ones states are added."""
    owner = retargeted.sequence_of_frame
    start = retargeted.frame_offsets[:-1][owner]
    touch = (fingers.gap < TOUCH).numpy()
    thumb = (fingers.finger == 0).numpy()
    grasped = touch[:, thumb].any(axis=1) & touch[:, ~thumb].any(axis=1)
    moved = np.linalg.norm(retargeted.object_pos - retargeted.object_pos[start], axis=-1) > MOVED
    over = grasped | moved
    count = np.cumsum(over)
    over = count - (count - over)[start] > 0  # in this frame, or in an earlier one of the same sequence
    gap = fingers.nearest.numpy()
    near = np.minimum(gap[:-1], gap[1:]) < within
    same_sequence = owner[:-1] == owner[1:]
    return np.flatnonzero(same_sequence & retargeted.valid[:-1] & retargeted.valid[1:] & ~over[:-1] & near)


def _positions_between(values: np.ndarray, frame: np.ndarray, part: np.ndarray) -> np.ndarray:
    """[F, ...] values on straight lines; given frames stay the same bit for bit."""
    following = values[np.minimum(frame + 1, len(values) - 1)]
    share = part.reshape(-1, *[1] * (values.ndim - 1))
    between = values[frame] + share * (following - values[frame])
    return np.where(share > 0, between, values[frame]).astype(values.dtype)


def _rotations_between(quats: np.ndarray, frame: np.ndarray, part: np.ndarray) -> np.ndarray:
    """[F, 4] quaternions that turn evenly; given frames stay the same bit for bit."""
    first = Rotation.from_quat(quats[frame], scalar_first=True)
    second = Rotation.from_quat(quats[np.minimum(frame + 1, len(quats) - 1)], scalar_first=True)
    step = Rotation.from_rotvec(part[:, None] * (first.inv() * second).as_rotvec())
    between = (first * step).as_quat(scalar_first=True)
    return np.where(part[:, None] > 0, between, quats[frame]).astype(quats.dtype)


def fingers_in(retargeted: Retargeted, robot: RobotSpec, objects: Sequence[ObjectSpec]) -> Fingers:
    """Measure where the fingers are in every frame [F]."""
    names = [o.name for o in objects]
    index = np.array([names.index(str(name)) for name in retargeted.object_name])[retargeted.sequence_of_frame]
    return fingers_of(robot, objects, index, retargeted.joint_pos, retargeted.object_pos, retargeted.object_quat_wxyz)
