"""Maps from a human hand to a parallel jaw: the jaw's axis from the thumb to what opposes it, its opening their
distance, its approach along the palm.

The published paper's analytic map (Table A1) takes the thumb's tip and the middle of the opposing fingertips, and knows
nothing of the object. A hand that wraps around a handle opposes its thumb with whole fingers, so a map that is then
optimized takes where thumb and fingers touch the object they hold.

Shape letters: S sequences padded to T frames, F frames, P mapped keypoints.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from xreset.errors import RobotError
from xreset.geometry.rotations import matrix_to_quat, matvec
from xreset.retarget.hand.model import HandModel, HandState
from xreset.spec import KEYPOINTS

_OPPOSING = ("index4", "middle4")
"""Fingertips that oppose the thumb in the analytic map."""
_BASES = tuple(KEYPOINTS.index(name) for name in KEYPOINTS if name == "wrist" or name.endswith("1"))
"""Keypoints that do not move against the palm."""
_THUMB = np.array([name.startswith("thumb") for name in KEYPOINTS])
_OPENINGS = 1025
"""Joint positions among which the one with the wanted opening is chosen."""
_TOUCHING = 0.5
"""Sum of a side's contact shares below which its fingertips are followed instead."""


def jaw_keypoints(model: HandModel, keypoints: np.ndarray, contact_shares: np.ndarray | None = None) -> np.ndarray:
    """[F, P, 3] what a jaw follows of human keypoints [F, 21, 3]: its fingertips follow the thumb and what opposes it.

    Args:
        model: the jaw.
        keypoints: human keypoints.
        contact_shares: [F, 21] of :func:`contact_shares`. None: the thumb's tip and the middle of the opposing ones.
    """
    tips = np.array([name in ("thumb4", *_OPPOSING) for name in KEYPOINTS])
    chosen = keypoints[:, model.keypoint_indices]
    for tip, side in zip(model.robot.fingertips, (_THUMB, ~_THUMB), strict=True):
        weights = np.broadcast_to(tips & side, keypoints.shape[:2]).astype(float)
        if contact_shares is not None:
            touching = contact_shares * side
            weights = np.where(touching.sum(axis=1, keepdims=True) < _TOUCHING, weights, touching)
        point = np.einsum("fk,fkx->fx", weights, keypoints) / weights.sum(axis=1, keepdims=True)
        follower = np.array(model.names) == tip.keypoint
        chosen = np.where(follower[:, None], point[:, None], chosen)
    return chosen


def contact_shares(touching: np.ndarray, held: np.ndarray) -> np.ndarray:
    """[21] share of the frames with a held object [T] in which each keypoint touches it [T, 21].

    One set of shares for a whole motion makes the points that oppose each other points of the hand, which do not jump.
    """
    shares = touching[held].mean(axis=0) if held.any() else np.zeros(touching.shape[1])
    shares[list(_BASES)] = 0.0
    return shares


def jaw_state(model: HandModel, keypoints: Tensor) -> HandState:
    """Return the joint and the root's pose that put a jaw where human keypoints [S, T, P, 3] from
    :func:`jaw_keypoints` are.

    Where they are farther apart than the jaw opens, it is open and in their middle.

    Raises:
        RobotError: no link follows the wrist or a fingertip.
    """
    robot = model.robot
    kinematics = model.kinematics
    tips = [tip.link for tip in robot.fingertips]
    share = torch.linspace(0, 1, _OPENINGS, dtype=keypoints.dtype, device=keypoints.device)[:, None]
    tried = kinematics.lower + share * (kinematics.upper - kinematics.lower)
    thumb, finger = kinematics.points(tried, tips).unbind(-2)
    opening, order = (finger - thumb).norm(dim=-1).sort()
    widest = order[-1]
    palm = kinematics.link_poses(tried[widest], [robot.palm])[0, :3, 0]
    own = _axes(finger[widest] - thumb[widest], palm)

    follows = ("wrist", *(tip.keypoint for tip in robot.fingertips))
    if absent := [name for name in follows if name not in model.names]:
        raise RobotError(f"robot {robot.name!r}: the analytic map of a jaw needs a link for {', '.join(absent)}.")
    wrist, human_thumb, human_finger = (keypoints[..., model.names.index(name), :] for name in follows)
    across = human_finger - human_thumb
    middle = (human_thumb + human_finger) / 2
    chosen = order[torch.searchsorted(opening, across.norm(dim=-1).contiguous()).clamp_max(_OPENINGS - 1)]
    rot = _axes(across, middle - wrist) @ own.mT
    return HandState(
        joints=tried[chosen],
        root_pos=middle - matvec(rot, (thumb + finger)[chosen] / 2),
        root_quat=matrix_to_quat(rot),
    )


def _axes(across: Tensor, ahead: Tensor) -> Tensor:
    """[..., 3, 3] rotation whose y axis is a jaw's axis and whose x axis is nearest to its approach."""
    y = torch.nn.functional.normalize(across, dim=-1)
    x = torch.nn.functional.normalize(ahead - (ahead * y).sum(-1, keepdim=True) * y, dim=-1)
    return torch.stack((x, y, torch.linalg.cross(x, y)), dim=-1)
