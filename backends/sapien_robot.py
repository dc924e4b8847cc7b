"""What a robot needs in PhysX: drives, dry friction, mimic couplings, and bits that say which of its links collide."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
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
        self._drives = [joints[name] for name in spec.joint_names]
        for joint in articulation.active_joints:
            joint.set_friction(0.0)
        for joint, described in zip(self._drives, spec.joints, strict=True):
            joint.set_armature(np.array([[described.drive.armature]]))
        for mimic in spec.mimics:
            _couple(articulation, joints, _by_a_neighbour(mimic, spec.mimics, joints))

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
        for joint, kp, kd, effort in zip(self._drives, self._kp.tolist(), self._kd.tolist(), self._effort.tolist(), strict=True):
            joint.set_drive_properties(kp, kd, effort, "force")

    def set_targets(self, targets: np.ndarray) -> None:
        """Set the drive targets [J]."""
        self.target = targets
        for set_target, target in zip(self._set_target, targets.tolist(), strict=True):
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
        torque[self._driven] = np.clip(-self._felt * velocity / self._dt - drive, -self._moving.friction_loss, self._moving.friction_loss)
        self._articulation.qf = torque


_TENDON_STIFFNESS, _TENDON_DAMPING = 1e5, 1e2


def _by_a_neighbour(mimic: MimicSpec, mimics: Iterable[MimicSpec], joints: Mapping[str, Any]) -> MimicSpec:
    """The same coupling to another joint that follows the same source, where the source is no neighbour and that one is."""
    if _adjacent(joints[mimic.joint], joints[mimic.source]):
        return mimic
    for other in mimics:
        if other.source == mimic.source and other.multiplier and other != mimic and _adjacent(joints[mimic.joint], joints[other.joint]):
            rate = mimic.multiplier / other.multiplier
            return MimicSpec(joint=mimic.joint, source=other.joint, multiplier=rate, offset=mimic.offset - rate * other.offset)
    return mimic


def _adjacent(a: Any, b: Any) -> bool:
    return a.parent_link in (b.parent_link, b.child_link) or b.parent_link == a.child_link


def _couple(articulation: Any, joints: Mapping[str, Any], mimic: MimicSpec) -> None:
    """Tie a mimic joint to its source: a fixed tendon keeps q_mimic - multiplier q_source = offset and acts on both.

    Raises:
        RobotError: the two joints neither share their parent link nor follow one another, so PhysX has no tendon for them.
    """
    follower, leader = joints[mimic.joint], joints[mimic.source]
    if follower.parent_link == leader.parent_link or follower.parent_link == leader.child_link:
        chain, rates = [leader.parent_link, leader.child_link, follower.child_link], [0.0, -mimic.multiplier, 1.0]
    elif leader.parent_link == follower.child_link:
        chain, rates = [follower.parent_link, follower.child_link, leader.child_link], [0.0, 1.0, -mimic.multiplier]
    else:
        raise RobotError(
            f"the joint {mimic.joint!r} mimics {mimic.source!r}, but they neither share a parent link nor follow one another: "
            "the backend 'sapien' cannot couple them. Use another backend."
        )
    articulation.create_fixed_tendon(chain, rates, rates, rest_length=mimic.offset, stiffness=_TENDON_STIFFNESS, damping=_TENDON_DAMPING)


# Which shapes collide --------------------------------------------------------------------------------------------------------------------
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
