"""What builders of robots share: an arm and the fingers of a hand, each a chain of links, become a tree."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np

from xreset.geometry.urdf import Link, RobotTree
from xreset.geometry.urdf_writer import ArmLink, axes, fixed, frame, pose

ROTOR_INERTIA = 0.002
"""Reflected rotor inertia [kg m^2] on the diagonal of every moving hand link. Makers have it as joint armature, or not at all, but not
every engine has armature, and emulating it loses grasps; a link's inertia means the same thing in all of them."""

Vector = tuple[float, ...]

Frame = tuple[str, str, Vector, Vector, Vector]
"""A link that is only a frame: its name, the link that it is fixed to, its position there [m], its x axis there (along the fingers) and its
z axis (out of the palm's inner side, or the fingertip's pad)."""


def with_rotor(inertia: Vector) -> Vector:
    """ixx ixy ixz iyy iyz izz of a link with :data:`ROTOR_INERTIA` about every axis [kg m^2]."""
    ixx, ixy, ixz, iyy, iyz, izz = inertia
    return ixx + ROTOR_INERTIA, ixy, ixz, iyy + ROTOR_INERTIA, iyz, izz + ROTOR_INERTIA


def robot(
    name: str,
    base: Link,
    arm: Sequence[ArmLink],
    mount: np.ndarray,
    palm: Link,
    fingers: Iterable[Sequence[ArmLink]],
    frames: Iterable[Frame],
) -> tuple[RobotTree, dict[str, float]]:
    """An arm that carries a hand, and the effort limit of each moving joint.

    Args:
        name: of the robot.
        base: the arm's base.
        arm: its links, each of which carries the next, the last one the hand.
        mount: [4, 4] pose of the palm in the frame of that link.
        palm: the link that carries the fingers.
        fingers: their links, each of which carries the next.
        frames: see :data:`Frame`.
    """
    hand = [(parent, link) for finger in fingers for parent, link in pairwise((palm, *finger)) if isinstance(link, ArmLink)]
    moved = [link.below(parent.name) for parent, link in [*zip((base, *arm), arm, strict=False), *hand]]
    links = [base, *(link for _, link in moved[: len(arm)]), palm, *(link for _, link in moved[len(arm) :])]
    joints = [joint for joint, _ in moved]
    joints.insert(len(arm), fixed(arm[-1].name, palm.name, mount))
    for own, parent, xyz, x, z in frames:
        links.append(frame(own))
        joints.append(fixed(parent, own, pose(xyz) @ axes(x=x, z=z)))
    effort = {link.joint: link.effort for link in (*arm, *(link for _, link in hand))}
    return RobotTree(name=name, root=base.name, links=tuple(links), joints=tuple(joints)), effort
