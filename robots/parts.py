"""What builders of robots share: the links of an arm and of a hand become a tree."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Protocol

import numpy as np

from xreset.geometry.urdf import Joint, Link, RobotTree
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


class Part(Protocol):
    """A link and the joint before it."""

    @property
    def effort(self) -> float:
        """[N m] or [N]; 0 where the joint follows another."""
        ...

    def below(self, parent: str) -> tuple[Joint, Link]:
        """The joint that hangs it below another link, and the link."""
        ...


def chained(root: Link, fingers: Iterable[Sequence[ArmLink]]) -> list[tuple[str, ArmLink]]:
    """Fingers, each of whose links carries the next, as links with their parents' names."""
    return [
        (parent, link)
        for finger in fingers
        for parent, link in zip((root.name, *(link.name for link in finger)), finger, strict=False)
    ]


def robot(
    name: str,
    base: Link,
    arm: Sequence[ArmLink],
    mount: np.ndarray,
    palm: Link,
    hand: Iterable[tuple[str, Part]],
    frames: Iterable[Frame],
) -> tuple[RobotTree, dict[str, float]]:
    """An arm that carries a hand, and the effort limit of each joint that has a drive.

    Args:
        name: of the robot.
        base: the arm's base.
        arm: its links, each of which carries the next, the last one the hand.
        mount: [4, 4] pose of the palm in the frame of that link.
        palm: the link that carries the fingers.
        hand: the name of the link that carries each moving one, and that.
        frames: see :data:`Frame`.
    """
    parts = [*chained(base, [arm]), *hand]
    moved = [part.below(parent) for parent, part in parts]
    links = [base, *(link for _, link in moved[: len(arm)]), palm, *(link for _, link in moved[len(arm) :])]
    joints = [joint for joint, _ in moved]
    effort = {joint.name: part.effort for joint, (_, part) in zip(joints, parts, strict=True) if part.effort}
    joints.insert(len(arm), fixed(arm[-1].name, palm.name, mount))
    for own, parent, xyz, x, z in frames:
        links.append(frame(own))
        joints.append(fixed(parent, own, pose(xyz) @ axes(x=x, z=z)))
    return RobotTree(name=name, root=base.name, links=tuple(links), joints=tuple(joints)), effort
