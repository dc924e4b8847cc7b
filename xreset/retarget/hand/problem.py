"""What hand retargeting follows and what it looks for: targets and variables.

Shape letters: S sequences padded to T frames, P mapped keypoints, J hand joints.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from xreset.geometry.fields import DistanceFields


@dataclass(frozen=True, kw_only=True)
class HandTargets:
    """What the hand should follow; all tensors on one device."""

    keypoints: Tensor
    """[S, T, P, 3] human keypoints; anything finite where not annotated."""
    annotated: Tensor
    """[S, T] bool: frames with keypoints. Others are held by smoothness alone."""
    contact_points: Tensor
    """[S, T, P, 3] object surface points that the keypoints touch."""
    in_contact: Tensor
    """[S, T, P] bool"""
    object_pos: Tensor
    """[S, T, 3]"""
    object_quat: Tensor
    """[S, T, 4]"""
    object_index: Tensor
    """[S] which of the objects of ``fields`` each sequence has."""
    fields: DistanceFields
    """Signed distances to the objects' surfaces."""

    def select(self, sequences: Tensor) -> HandTargets:
        """Those of some sequences."""
        tensors = {name: value[sequences] for name, value in self._tensors().items()}
        return HandTargets(**tensors, fields=self.fields)

    def to(self, device: torch.device | str) -> HandTargets:
        """The same on another device."""
        return HandTargets(**{name: value.to(device) for name, value in self._tensors().items()}, fields=self.fields.to(device))

    def _tensors(self) -> dict[str, Tensor]:
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "fields"}


@dataclass(frozen=True)
class HandState:
    """The variables: joints and root pose of every frame."""

    joints: Tensor
    """[S, T, J]"""
    root_pos: Tensor
    """[S, T, 3]"""
    root_quat: Tensor
    """[S, T, 4]"""

    def select(self, sequences: Tensor) -> HandState:
        """That of some sequences."""
        return HandState(**{name: value[sequences] for name, value in vars(self).items()})
