"""More states where a hand closes in on an object.

People come in at 0.6 to 0.9 m/s, so at 30 frames a second a demonstration shows a hand two or three times between 10 cm and its grasp,
which is where a policy learns to grasp or to press. Between two frames of one motion the robot's joints are interpolated, so that
fingertips move by a stated distance from state to state; physics judges the new states like the others.
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
"""Once its origin is farther than this from where it started [m], an object has been moved."""


class Closing(NamedTuple):
    """Trajectories with states between frames."""

    retargeted: Retargeted
    """With more frames, no longer evenly spaced in time. Those that were there are unchanged and in their order."""
    frame: np.ndarray
    """[F] the frame that each was, or that comes before it, counted over the trajectories that were given."""
    part: np.ndarray
    """[F] how far it lies on the way to the next one, in [0, 1); 0 is the frame itself."""


def with_closing_frames(
    retargeted: Retargeted, robot: RobotSpec, objects: Sequence[ObjectSpec], config: ClosingConfig
) -> Closing:
    """The same motion with frames added between valid ones where the hand closes in.

    That is where a finger is near the object, until the thumb and another one touch it or it has been moved. It is not until the human's
    first contact: then the robot's fingers are usually 5 to 10 mm away.
    """
    owner = retargeted.sequence_of_frame
    if config.spacing is None:
        return Closing(retargeted, np.arange(len(owner)), np.zeros(len(owner)))
    fingers = fingers_in(retargeted, robot, objects)
    gap = fingers.nearest.numpy()
    touch, thumb = (fingers.gap < TOUCH).numpy(), (fingers.finger == 0).numpy()
    start = retargeted.frame_offsets[:-1][owner]
    moved = np.linalg.norm(retargeted.object_pos - retargeted.object_pos[start], axis=-1) > MOVED
    over = touch[:, thumb].any(axis=1) & touch[:, ~thumb].any(axis=1) | moved
    past = np.cumsum(over)
    over = past - (past - over)[start] > 0  # in this frame, or in one before it of the same sequence
    before = np.flatnonzero(
        (owner[:-1] == owner[1:])
        & retargeted.valid[:-1]
        & retargeted.valid[1:]
        & ~over[:-1]
        & (np.minimum(gap[:-1], gap[1:]) < config.within)
    )
    travel = np.linalg.norm(retargeted.fingertip_pos[before + 1] - retargeted.fingertip_pos[before], axis=-1).max(
        axis=-1
    )
    pieces = np.ones(len(owner), dtype=int)
    pieces[before] = np.maximum(np.ceil(travel / config.spacing).astype(int), 1)
    row = np.repeat(np.arange(len(owner)), pieces)
    part = (np.arange(len(row)) - np.repeat(np.cumsum(pieces) - pieces, pieces)) / pieces[row]
    following = np.minimum(row + 1, len(owner) - 1)

    def between(values: np.ndarray) -> np.ndarray:
        share = part.reshape(-1, *[1] * (values.ndim - 1))
        return np.where(share > 0, values[row] + share * (values[following] - values[row]), values[row]).astype(
            values.dtype
        )

    def turned(quats: np.ndarray) -> np.ndarray:
        first, second = (Rotation.from_quat(quats[at], scalar_first=True) for at in (row, following))
        step = Rotation.from_rotvec(part[:, None] * (first.inv() * second).as_rotvec())
        return np.where(part[:, None] > 0, (first * step).as_quat(scalar_first=True), quats[row]).astype(quats.dtype)

    counts = np.bincount(owner[row], minlength=len(retargeted.sequence_name))
    offsets = np.concatenate(([0], np.cumsum(counts)))
    starts = np.cumsum(pieces) - pieces
    first = retargeted.first_contact
    contact_row = starts[np.where(first >= 0, retargeted.frame_offsets[:-1] + first, 0)]
    dense = replace(
        retargeted,
        frame_offsets=offsets.astype(retargeted.frame_offsets.dtype),
        first_contact=np.where(first >= 0, contact_row - offsets[:-1], first).astype(first.dtype),
        **{
            name: between(getattr(retargeted, name))
            for name in ("joint_pos", "palm_pos", "fingertip_pos", "object_pos")
        },
        **{name: turned(getattr(retargeted, name)) for name in ("palm_quat_wxyz", "object_quat_wxyz")},
        **{
            name: getattr(retargeted, name)[row]
            for name in ("annotated", "valid", "reason", "contact", "hand_error", "wrist_error")
        },
    )
    return Closing(dense, row, part)


def fingers_in(retargeted: Retargeted, robot: RobotSpec, objects: Sequence[ObjectSpec]) -> Fingers:
    """Where the fingers are in every frame [F]."""
    names = [o.name for o in objects]
    index = np.array([names.index(str(name)) for name in retargeted.object_name])[retargeted.sequence_of_frame]
    return fingers_of(robot, objects, index, retargeted.joint_pos, retargeted.object_pos, retargeted.object_quat_wxyz)
