"""Slots: where the joints and fingertips of each robot are in the observations and actions of a policy for several
robots.

The slots are those of the longest arm, then those of each human finger, from thumb to little finger. So a joint of an
index finger has the same slot in every hand. A slot that a robot does not fill is 0 in observations and ignored in
actions.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Self

import torch
from torch import Tensor
from torch.nn.functional import pad

from xreset.errors import RobotError
from xreset.files.checks import frozen
from xreset.geometry.urdf import robot_tree
from xreset.spec import FINGERS, RobotSpec

JointSlots = tuple[int, int]
"""Slots for joints of the arm, and of each finger."""


def needed_slots(robots: Iterable[RobotSpec]) -> JointSlots:
    """Return the least slots that every one of the robots fits into.

    Raises:
        RobotError: as for :func:`check_fits`.
    """
    arm = 0
    finger = 0
    for robot in robots:
        arm = max(arm, len(robot.arm_indices))
        finger = max(finger, *map(len, _joints_by_finger(robot).values()))
    return arm, finger


def check_fits(robot: RobotSpec, slots: JointSlots) -> None:
    """Refuse a robot that does not fit into the slots of a policy.

    Raises:
        RobotError: it has more joints than slots, two fingertips of one human finger, or a joint of the hand that moves
            no fingertip.
    """
    arm, finger = needed_slots([robot])
    if arm > slots[0] or finger > slots[1]:
        raise RobotError(
            f"The robot {robot.name!r} has {arm} joints in its arm and up to {finger} in a finger, but the policy has "
            f"slots for {slots[0]} and {slots[1]} (task.joint_slots). Train one with more slots."
        )


def _joints_by_finger(robot: RobotSpec) -> dict[str, list[int]]:
    """Return the indices of the hand's joints, in joint order, by the first human finger that each of them moves."""
    tree = robot_tree(robot)
    source = {mimic.joint: mimic.source for mimic in robot.mimics}
    left = {robot.joint_names[i]: int(i) for i in robot.hand_indices}
    link_of = {}
    for tip, finger in zip(robot.fingertips, _fingers_of_tips(robot), strict=True):
        link_of[FINGERS[finger]] = tip.link
    found = {}
    for finger in FINGERS:
        link = link_of.get(finger, tree.root)
        indices = []
        while link != tree.root:
            joint = tree.above[link]
            index = left.pop(source.get(joint.name, joint.name), None)
            if index is not None:
                indices.append(index)
            link = joint.parent
        found[finger] = sorted(indices)
    if left:
        raise RobotError(
            f"The joints {', '.join(left)} of the hand of {robot.name!r} move no fingertip, so no policy for several "
            "robots has slots for them. Train a policy for this robot alone."
        )
    return found


def _fingers_of_tips(robot: RobotSpec) -> list[int]:
    """Return which human finger each fingertip follows, from 0, the thumb."""
    names = [tip.keypoint.rstrip("1234") for tip in robot.fingertips]
    if len(set(names)) < len(names) or not set(names) <= set(FINGERS):
        raise RobotError(
            f"The fingertips of {robot.name!r} follow {', '.join(names)}, expected another human finger for each. "
            "A policy for several robots has a slot for each finger."
        )
    return [FINGERS.index(name) for name in names]


@frozen
class Slots:
    """The slots of one robot. Shape letters: A slots for joints, F slots for fingertips; J joints, E fingertips."""

    joint: Tensor
    """[A] joint in each slot; J: the slot is empty."""
    tip: Tensor
    """[F] fingertip in each slot; E: the slot is empty."""
    of_joint: Tensor
    """[J] slot of each joint."""
    num_tips: int
    """E"""

    @classmethod
    def of(
        cls, robot: RobotSpec, slots: JointSlots | None, device: torch.device | str = "cpu"
    ) -> Self | None:
        """Return a robot's slots; None if there are none, because the policy is for this robot alone.

        Raises:
            RobotError: as for :func:`check_fits`.
        """
        if slots is None:
            return None
        check_fits(robot, slots)
        arm, finger = slots
        in_slot = torch.full((arm + len(FINGERS) * finger,), len(robot.joints))
        in_slot[: len(robot.arm_indices)] = torch.as_tensor(robot.arm_indices)
        for i, indices in enumerate(_joints_by_finger(robot).values()):
            first = arm + i * finger
            in_slot[first : first + len(indices)] = torch.tensor(indices, dtype=torch.long)
        tip = torch.full((len(FINGERS),), len(robot.fingertips))
        tip[_fingers_of_tips(robot)] = torch.arange(len(robot.fingertips))
        of_joint = in_slot.argsort()[: len(robot.joints)]
        return cls(
            joint=in_slot.to(device),
            tip=tip.to(device),
            of_joint=of_joint.to(device),
            num_tips=len(robot.fingertips),
        )

    @property
    def mask(self) -> Tensor:
        """[A] 1 where there is a joint, else 0."""
        return (self.joint < len(self.of_joint)).float()

    def joints(self, values: Tensor) -> Tensor:
        """[N, A * D] values of the joints [N, J * D] in their slots; 0 in empty ones."""
        return _in_slots(values, len(self.of_joint), self.joint)

    def tips(self, values: Tensor) -> Tensor:
        """[N, F * D] values of the fingertips [N, E * D] in their slots; 0 in empty ones."""
        return _in_slots(values, self.num_tips, self.tip)


def _in_slots(values: Tensor, count: int, in_slot: Tensor) -> Tensor:
    """Return values [N, count * D] of ``count`` parts in slots; the part with this number is 0."""
    parts = values.unflatten(1, (count, -1))
    return pad(parts, (0, 0, 0, 1))[:, in_slot].flatten(1)
