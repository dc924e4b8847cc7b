"""A jaw's pads, which lie against the object that the human holds.

Thumb and fingers of a human press on an object wherever their joints let them; a jaw presses along one axis. Drawn to the human's
fingertips alone it touches the object aslant, with an edge of either pad, and squeezes it out.

Shape letters: H frames, N balls of pads, n variables.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from xreset.geometry.balls import Balls
from xreset.geometry.kinematics import Kinematics
from xreset.spec import FingertipSpec
from xreset.tensors import Tensors

if TYPE_CHECKING:
    from xreset.retarget.hand.clearance import Objects
    from xreset.retarget.hand.model import Bodies, HandModel

_FRONT = 1e-3
"""Balls of a finger that come within this of its foremost one, towards the other finger, are its pad [m]."""


@dataclass(frozen=True, kw_only=True)
class Pads(Tensors):
    """The balls that stand for a jaw's two pads; none for any other hand."""

    ball: Tensor
    """[N]"""
    share: Tensor
    """[N] of each in its pad: they add up to 1 for either."""


def pads_of(fingertips: Sequence[FingertipSpec], hand: Kinematics, balls: Balls, home: Tensor) -> Pads:
    """The pads of a hand whose one joint moves two fingers: where these face each other at home.

    Args:
        fingertips: the hand's.
        hand: its kinematics.
        balls: on any device.
        home: [J]
    """
    pads: list[Tensor] = []
    if len(home) == 1 and len(fingertips) == 2:
        tips = hand.points(home, [tip.link for tip in fingertips])
        for tip, ahead in zip(fingertips, (tips[1] - tips[0], tips[0] - tips[1]), strict=True):
            links = [link for link in tip.contact_links if link in balls.links]
            poses = hand.link_poses(home, links)
            rows, front = [], []
            for link, pose in zip(links, poses, strict=True):
                own = (balls.link == balls.links.index(link)).nonzero()[:, 0]
                centers = balls.centers[own] @ pose[:3, :3].mT + pose[:3, 3]
                rows.append(own)
                front.append(centers @ (ahead / ahead.norm().clamp_min(1e-9)) + balls.radii[own])
            if links:
                foremost = torch.cat(front)
                pads.append(torch.cat(rows)[foremost > foremost.max() - _FRONT])
    if len(pads) < 2:
        pads = [torch.zeros(0, dtype=torch.long, device=home.device)]
    return Pads(
        ball=torch.cat(pads), share=torch.cat([home.new_full((len(pad),), 1.0 / max(len(pad), 1)) for pad in pads])
    )


def off_object(model: HandModel, bodies: Bodies, objects: Objects, frame: Tensor) -> tuple[Tensor, Tensor]:
    """Signed distances [H, N] of the pads' balls from the object [m], and their derivatives [H, N, n].

    Args:
        frame: [H] which of the frames of bodies and objects.
    """
    ball = model.pads.ball.repeat(len(frame))
    frame = frame.repeat_interleave(len(model.pads.ball))
    centers = model.ball_centers(bodies, frame, ball)
    distance, direction = objects.signed_distance(centers, frame)
    slope = model.point_slope(bodies, frame, model.balls.link[ball], centers, direction)
    value = distance - model.balls.radii[ball]
    return value.view(-1, len(model.pads.ball)), slope.view(-1, len(model.pads.ball), slope.shape[-1])
