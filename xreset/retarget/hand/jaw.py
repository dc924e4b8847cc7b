"""The published paper's analytic map from a human hand to a parallel jaw (Table A1).

The jaw's axis goes from the thumb's tip to the middle of the opposing fingertips, its opening is their distance, and
its approach is along the palm.

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
"""Fingertips that oppose the thumb."""
_OPENINGS = 1025
"""Number of joint positions that are tried for the wanted opening."""


def jaw_keypoints(model: HandModel, keypoints: np.ndarray) -> np.ndarray:
    """[F, P, 3] points that a jaw follows, from human keypoints [F, 21, 3]: its fingertips follow the thumb's tip and
    the middle of the opposing fingertips."""
    chosen = keypoints[:, model.keypoint_indices]
    for tip, followed in zip(model.robot.fingertips, (("thumb4",), _OPPOSING), strict=True):
        point = keypoints[:, [KEYPOINTS.index(name) for name in followed]].mean(axis=1)
        chosen[:, np.array(model.keypoint_names) == tip.keypoint] = point[:, None]
    return chosen


def jaw_state(model: HandModel, keypoints: Tensor) -> HandState:
    """Return the joint and the root's pose that put a jaw's fingertips onto human keypoints [S, T, P, 3] from
    :func:`jaw_keypoints`.

    If the keypoints are farther apart than the jaw opens, the jaw is open, in their middle.

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
    if absent := [name for name in follows if name not in model.keypoint_names]:
        raise RobotError(
            f"robot {robot.name!r}: the analytic map of a jaw needs a link for {', '.join(absent)}."
        )
    wrist, human_thumb, human_finger = (
        keypoints[..., model.keypoint_names.index(name), :] for name in follows
    )
    across = human_finger - human_thumb
    middle = (human_thumb + human_finger) / 2
    wanted = across.norm(dim=-1).contiguous()
    chosen = order[torch.searchsorted(opening, wanted).clamp_max(_OPENINGS - 1)]
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
