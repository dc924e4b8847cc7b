"""The size of a user's hand beside the robot's, and the user's keypoints with the robot's size.

A sequence has one user, whose bones do not change: the factor of a sequence needs that sequence alone, and sequences stay independent.

Shape letters: S sequences padded to T frames, P mapped keypoints.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from xreset.retarget.hand.model import HandModel, finger_keypoints


def hand_scale(model: HandModel, keypoints: Tensor, annotated: Tensor) -> Tensor:
    """How many times larger the robot's hand is than each user's.

        s = sum over bones of the robot's length / sum over the same bones of the user's median length

    A bone runs from the wrist to a finger's base, or from one keypoint of a finger to the next. Where the robot leaves keypoints out, what
    is in between bends, so it is no bone. The robot is measured at home.

    Args:
        model: the robot's hand.
        keypoints: [S, T, P, 3] human keypoints; anything finite where not annotated.
        annotated: [S, T] bool; at least one frame of every sequence.

    Returns:
        [S] s; 1 for a hand without bones, such as a jaw that follows two fingertips.
    """
    bones = [(a, b) for a, b in model.pairs.tolist() if _is_bone(model.names[a], model.names[b])]
    if not bones:
        return keypoints.new_ones(len(keypoints))
    a, b = model.pairs.new_tensor(bones).unbind(1)
    robot = (model.at_home[b] - model.at_home[a]).norm(dim=-1).sum()
    lengths = (keypoints[:, :, b] - keypoints[:, :, a]).norm(dim=-1).masked_fill(~annotated[..., None], torch.nan)
    return robot / lengths.nanmedian(dim=1).values.sum(dim=-1)


def resized(keypoints: Tensor, scale: Tensor, names: Sequence[str]) -> Tensor:
    """A user's keypoints as a hand of another size would have them that touches the same things.

    Every finger grows about its own tip, x' = tip + s (x - tip), so that fingertips stay and bones keep their directions; the wrist goes
    to the mean of where the fingers would have it.

    Args:
        keypoints: [S, T, P, 3]
        scale: [S] s.
        names: of the P keypoints.

    Returns:
        [S, T, P, 3]
    """
    fingers = [finger for finger in finger_keypoints(names) if finger]
    stays = keypoints.new_zeros(len(names), len(names))
    for finger in fingers:
        stays[finger, finger[-1]] = 1.0
        if "wrist" in names:
            stays[names.index("wrist"), finger[-1]] = 1.0 / len(fingers)
    return keypoints + (1.0 - scale[:, None, None, None]) * (stays @ keypoints - keypoints)


def _is_bone(start: str, end: str) -> bool:
    """Whether two keypoints are neighbours on the human hand, along a finger."""
    if start == "wrist":
        return end.endswith("1")
    return end[:-1] == start[:-1] and int(end[-1]) == int(start[-1]) + 1
