"""A grasp that is held: fingers that touch keep their posture, and the hand keeps its place on the object.

Shape letters: S sequences padded to T frames, P mapped keypoints, J hand joints, n = J + 6 variables.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from xreset.geometry.rotations import quat_conjugate, quat_multiply, quat_rotate, quat_rotate_inverse, quat_to_axis_angle
from xreset.retarget.hand.problem import HandState, HandTargets

_GRASP = 2
"""Fingertips that must touch for the object to be grasped: one alone may push it, or slide on it."""


class HoldTerm(NamedTuple):
    """A cost of neighbouring frames and how it changes with either."""

    cost: Tensor
    """[S, T-1]"""
    earlier: Tensor
    """[S, T-1, n] half the gradient by the earlier frame's variables."""
    later: Tensor
    """[S, T-1, n] half the gradient by the later frame's."""
    curvature: Tensor
    """[S, T-1, n] half the approximate Hessian: on the diagonals of both frames' blocks and, negative, of the block between them."""


def hold(targets: HandTargets, tip_joints: Tensor, state: HandState, weight: float, length_scale: float) -> HoldTerm:
    """E = w |d|^2, where d is what changes between two frames although a held object would not let it.

    - Fingers: d = q' - q, of every joint that moves a fingertip which touches in both frames.
    - Hand on the object, where two fingertips or more touch in both frames: with the object's motion x -> R (x - o) + o' between the
      frames, d = p' - (R (p - o) + o') for the root's position and d = log(Q' (R Q)^-1) for its orientation, in world axes. A hand that
      goes with the object costs nothing, however the object moves.

    A finger is free between the frames in which its contact begins or ends. The gradients are exact: dE/dx' = 2 w d and
    dE/dx = -2 w R^-1 d (-2 w d for joints). The curvature takes R for the identity, because the solver wants diagonal blocks between
    frames; it stays positive semidefinite.

    Args:
        targets: contacts and the object's motion.
        tip_joints: [P, J] bool: which joints move each fingertip; none for other keypoints.
        state: the hand's motion.
        weight: w of joints [1 / rad^2 or 1 / m^2] and of the root's orientation; that of its position is w / ``length_scale``^2.
        length_scale: length that counts as much as one radian [m].
    """
    touches = targets.in_contact & targets.annotated[..., None] & tip_joints.any(dim=-1)
    stays = touches[:, 1:] & touches[:, :-1]
    fingers = (stays[..., None] & tip_joints).any(dim=-2)  # [S, T-1, J]
    grasped = (stays.sum(dim=-1, keepdim=True) >= _GRASP).expand(*stays.shape[:-1], 3)

    pos, quat = targets.object_pos, targets.object_quat
    turn = quat_multiply(quat[:, 1:], quat_conjugate(quat[:, :-1]))
    carried_pos = quat_rotate(turn, state.root_pos[:, :-1] - pos[:, :-1]) + pos[:, 1:]
    carried_quat = quat_multiply(turn, state.root_quat[:, :-1])
    joints = state.joints.diff(dim=1)
    shift = state.root_pos[:, 1:] - carried_pos
    rotation = quat_to_axis_angle(quat_multiply(state.root_quat[:, 1:], quat_conjugate(carried_quat)))

    held = torch.cat((fingers, grasped, grasped), dim=-1).to(joints.dtype)
    scale = joints.new_tensor([1.0] * joints.shape[-1] + [length_scale] * 3 + [1.0] * 3)
    w = weight / scale.square() * held
    d = torch.cat((joints, shift, rotation), dim=-1)
    d_back = torch.cat((joints, quat_rotate_inverse(turn, shift), quat_rotate_inverse(turn, rotation)), dim=-1)
    return HoldTerm(cost=(w * d.square()).sum(-1), earlier=-w * d_back, later=w * d, curvature=w)
