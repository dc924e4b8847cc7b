"""More states where a hand closes in on an object.

People come in at 0.6 to 0.9 m/s, so at 30 frames a second a demonstration shows a hand two or three times between 10 cm and first contact,
which is where a policy learns to grasp or to press. Between two frames of one motion the robot's joints are interpolated, so that
fingertips move by a stated distance from state to state; physics judges the new states like the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from xreset.checks import check_numbers
from xreset.objects import surface_points
from xreset.retarget.file import Retargeted
from xreset.spec import ObjectSpec


@dataclass(frozen=True, kw_only=True)
class ClosingConfig:
    """Where states are added, and how many."""

    spacing: float = 0.005
    """Farthest that any fingertip moves from one state to the next [m]."""
    within: float = 0.10
    """Only where a fingertip is nearer than this to the object's surface [m], before first contact."""

    def __post_init__(self) -> None:
        check_numbers(self, positive=("spacing", "within"), finite=("spacing", "within"))


def with_closing_frames(retargeted: Retargeted, objects: Sequence[ObjectSpec], config: ClosingConfig) -> Retargeted:
    """The same motion with frames added between valid ones, up to the frame of first contact.

    Args:
        retargeted: robot trajectories.
        objects: geometry of the objects that they name.
        config: where and how densely.

    Returns:
        Trajectories whose frames are no longer evenly spaced in time. Those that were there are unchanged and in their order.
    """
    owner = retargeted.sequence_of_frame
    distance = _tip_distance(retargeted, objects)
    before = np.flatnonzero(
        (owner[:-1] == owner[1:])
        & retargeted.valid[:-1]
        & retargeted.valid[1:]
        & ~retargeted.post_contact[:-1]
        & (np.minimum(distance[:-1], distance[1:]) < config.within)
    )
    travel = np.linalg.norm(retargeted.fingertip_pos[before + 1] - retargeted.fingertip_pos[before], axis=-1).max(axis=-1)
    pieces = np.ones(len(owner), dtype=int)
    pieces[before] = np.maximum(np.ceil(travel / config.spacing).astype(int), 1)
    row = np.repeat(np.arange(len(owner)), pieces)
    part = (np.arange(len(row)) - np.repeat(np.cumsum(pieces) - pieces, pieces)) / pieces[row]
    following = np.minimum(row + 1, len(owner) - 1)

    def between(values: np.ndarray) -> np.ndarray:
        share = part.reshape(-1, *[1] * (values.ndim - 1))
        return np.where(share > 0, values[row] + share * (values[following] - values[row]), values[row]).astype(values.dtype)

    def turned(quats: np.ndarray) -> np.ndarray:
        first, second = (Rotation.from_quat(quats[at], scalar_first=True) for at in (row, following))
        step = Rotation.from_rotvec(part[:, None] * (first.inv() * second).as_rotvec())
        return np.where(part[:, None] > 0, (first * step).as_quat(scalar_first=True), quats[row]).astype(quats.dtype)

    counts = np.bincount(owner[row], minlength=len(retargeted.sequence_name))
    offsets = np.concatenate(([0], np.cumsum(counts)))
    starts = np.cumsum(pieces) - pieces
    first = retargeted.first_contact
    contact_row = starts[np.where(first >= 0, retargeted.frame_offsets[:-1] + first, 0)]
    return replace(
        retargeted,
        frame_offsets=offsets.astype(retargeted.frame_offsets.dtype),
        first_contact=np.where(first >= 0, contact_row - offsets[:-1], first).astype(first.dtype),
        **{name: between(getattr(retargeted, name)) for name in ("joint_pos", "palm_pos", "fingertip_pos", "object_pos")},
        **{name: turned(getattr(retargeted, name)) for name in ("palm_quat_wxyz", "object_quat_wxyz")},
        **{name: getattr(retargeted, name)[row] for name in ("annotated", "valid", "reason", "contact", "hand_error", "wrist_error")},
    )


def _tip_distance(retargeted: Retargeted, objects: Sequence[ObjectSpec], points: int = 512) -> np.ndarray:
    """[F] distance of the nearest fingertip to points on the object's surface [m]."""
    trees = {o.name: cKDTree(surface_points(o, points)) for o in objects}
    turn = Rotation.from_quat(retargeted.object_quat_wxyz, scalar_first=True).inv().as_matrix()
    local = np.einsum("fij,fej->fei", turn, retargeted.fingertip_pos - retargeted.object_pos[:, None])
    names = np.asarray(retargeted.object_name)[retargeted.sequence_of_frame]
    distance = np.full(len(local), np.inf)
    for name, tree in trees.items():
        mine = names == name
        if mine.any():
            distance[mine] = tree.query(local[mine])[0].min(axis=-1)
    return distance
