"""What hand retargeting follows and what it looks for: targets and variables.

Shape letters: S sequences padded to T frames, P mapped keypoints, J hand joints.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from xreset.geometry.fields import DistanceFields
from xreset.tensors import Tensors


@dataclass(frozen=True, kw_only=True)
class HandTargets(Tensors):
    """What the hand should follow; all tensors on one device."""

    keypoints: Tensor
    """[S, T, P, 3] human keypoints; anything finite where not annotated."""
    annotated: Tensor
    """[S, T] bool: frames with keypoints. Others are held by smoothness alone."""
    contact_points: Tensor
    """[S, T, P, 3] object surface points that the keypoints touch."""
    in_contact: Tensor
    """[S, T, P] bool"""
    held: Tensor
    """[S, T] bool: the thumb and another finger of the human touch the object."""
    object_pos: Tensor
    """[S, T, 3]"""
    object_quat: Tensor
    """[S, T, 4]"""
    object_index: Tensor
    """[S] which of the objects of ``fields`` each sequence has."""
    fields: DistanceFields
    """Signed distances to the objects' surfaces."""


@dataclass(frozen=True)
class HandState(Tensors):
    """The variables: joints and root pose of every frame."""

    joints: Tensor
    """[S, T, J]"""
    root_pos: Tensor
    """[S, T, 3]"""
    root_quat: Tensor
    """[S, T, 4]"""
