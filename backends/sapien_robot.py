"""What a robot needs in PhysX: drives, dry friction, mimic couplings, and bits that say which of its links collide."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from xreset.backends.rigid import Mechanism, MovingJoints
from xreset.errors import RobotError, XResetError
from xreset.geometry.dynamics import mass_matrix
from xreset.spec import MimicSpec


class SapienJoints:
    """Drives, dry friction and mimic couplings of the articulation. PhysX keeps the joints in an order of its own."""

    def __init__(self, links: Sequence[Any], robot: Mechanism, dt: float) -> None:
        spec = robot.robot
        self._articulation = articulation = links[0].articulation
        active = [joint.name for joint in articulation.active_joints]
        joints = {joint.name: joint for joint in articulation.active_joints}
        self._moving = MovingJoints(spec, active)
        self._driven = self._moving.driven
        for joint in articulation.active_joints:
            joint.set_friction(0.0)
        for described in spec.joints:
            joints[described.name].set_armature(np.array([[described.drive.armature]]))
        at = [*self._driven, *self._moving.mimic]
        self._drives = [articulation.active_joints[i] for i in at]
        """[J + Q] the actuated joints, then those that follow, whose drives carry a share of their source's."""
        self._followed = np.concatenate((np.arange(len(spec.joints)), self._moving.source))
        share, rate = (
            self._moving.shares[self._followed, at],
            np.concatenate((np.ones(len(spec.joints)), self._moving.multiplier)),
        )
        self._share = np.abs(np.stack((share / rate, share / rate, share)))
        """[3, J + Q] of stiffness, damping and effort limit."""
        for mimic in spec.mimics:
            _couple(articulation, joints, mimic)

        self._set_target = [joint.set_drive_target for joint in self._drives]
        self.target = spec.home
        """[J] drive targets."""
        self._dt = dt
        self.set_drives(np.ones_like(self._moving.nominal))
        self._brakes = bool(self._moving.friction_loss.any())
        if self._brakes:
            self._felt = 1.0 / np.diag(np.linalg.inv(mass_matrix(spec, spec.home) + np.diag(self._moving.armature)))

    def reset(self, position: np.ndarray, velocity: np.ndarray, target: np.ndarray) -> None:
        """Set positions, velocities and targets [J] of the actuated joints; mimic joints follow."""
        articulation = self._articulation
        articulation.qpos, articulation.qvel = self._moving.spread(position, velocity)
        articulation.qf = np.zeros(self._moving.count)
        self.set_targets(target)

    def read(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions and velocities [J] of the actuated joints."""
        position, velocity = self._articulation.qpos, self._articulation.qvel
        return position[self._driven].astype(np.float64), velocity[self._driven].astype(np.float64)

    def set_drives(self, scale: np.ndarray) -> None:
        """Set factors (3, J) on stiffness, damping and effort limit."""
        self._kp, self._kd, self._effort = scale * self._moving.nominal
        shared = self._share * (scale * self._moving.nominal)[:, self._followed]
        for joint, (kp, kd, effort) in zip(self._drives, shared.T.tolist(), strict=True):
            joint.set_drive_properties(kp, kd, effort, "force")

    def set_targets(self, targets: np.ndarray) -> None:
        """Set the drive targets [J]."""
        self.target = targets
        followers = self._moving.multiplier * targets[self._moving.source] + self._moving.offset
        for set_target, target in zip(self._set_target, (*targets.tolist(), *followers.tolist()), strict=True):
            set_target(target)

    def brake(self) -> None:
        """Apply dry friction for one step: PhysX's joint friction is no torque, so it is a torque here.

        It is what would bring the joint to rest within the step, as far as the friction loss allows; contacts are not foreseen.
        """
        if not self._brakes:
            return
        position, velocity = self.read()
        drive = np.clip(self._kp * (self.target - position) - self._kd * velocity, -self._effort, self._effort)
        torque = np.zeros(self._moving.count)
        torque[self._driven] = np.clip(
            -self._felt * velocity / self._dt - drive, -self._moving.friction_loss, self._moving.friction_loss
        )
        self._articulation.qf = torque


_TENDON_STIFFNESS, _TENDON_DAMPING = 1e5, 1e2


def _couple(articulation: Any, joints: Mapping[str, Any], mimic: MimicSpec) -> None:
    """Tie a mimic joint to its source: a fixed tendon keeps q_mimic - multiplier q_source = offset and acts on both.

    It runs through the links between the two, whose own joints it leaves alone.

    Raises:
        RobotError: neither of the two joints' parent links carries the other joint, so PhysX has no tendon for them.
    """
    ends = [(joints[mimic.source], -mimic.multiplier), (joints[mimic.joint], 1.0)]
    for (upper, first), (lower, last) in (ends, ends[::-1]):
        between, link = [], lower.parent_link
        while link is not None and link not in (upper.parent_link, upper.child_link):
            between.append(link)
            link = link.parent
        if link is not None:
            chain = [upper.parent_link, upper.child_link, *between[::-1], lower.child_link]
            rates = [0.0, first, *[0.0] * len(between), last]
            inverse = [
                rate and 1.0 / rate for rate in rates
            ]  # what PhysX scales the tendon's force by; the rates themselves jam it
            articulation.create_fixed_tendon(
                chain, rates, inverse, rest_length=mimic.offset, stiffness=_TENDON_STIFFNESS, damping=_TENDON_DAMPING
            )
            return
    raise RobotError(
        f"the joint {mimic.joint!r} mimics {mimic.source!r}, but neither lies below the other's parent link: "
        "the backend 'sapien' cannot couple them. Use another backend."
    )


# Which shapes collide -------------------------------------------------------------------------------------------------
# Two shapes collide if a bit of one's first group is in the other's second group.

OBJECT_BIT, TABLE_BIT, _FIRST_SELF_BIT, _BITS = 1, 2, 2, 32


def self_collision_bits(robot: Mechanism) -> dict[str, tuple[int, int]]:
    """Link -> first and second group, such that exactly the links that may collide with each other do.

    A bit says "this link collides with those": one link has it in its first group, its partners in their second group. The link with most
    partners left takes the next bit, until every pair is covered.

    Raises:
        XResetError: the 30 bits do not suffice.
    """
    links = robot.robot.self_collision_links
    partners = {a: {b for b in links if robot.may_collide(a, b)} for a in links}
    bits = {link: [0, 0] for link in links}
    for bit in range(_FIRST_SELF_BIT, _BITS):
        hub = max(partners, key=lambda link: len(partners[link]), default=None)
        if hub is None or not partners[hub]:
            return {link: (kind, affinity) for link, (kind, affinity) in bits.items()}
        bits[hub][0] |= 1 << bit
        for partner in partners.pop(hub):
            bits[partner][1] |= 1 << bit
            partners[partner].discard(hub)
    raise XResetError(
        f"robot {robot.robot.name!r}: {len(links)} links collide with one another in more ways than PhysX's "
        f"{_BITS - _FIRST_SELF_BIT} collision bits can say. Shorten self_collision_links (31 links always fit)."
    )
