"""What a robot needs in PhysX: drives, dry friction, mimic couplings, and bits that say which of its links collide."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from xreset.backends.rigid import Mechanism, MovingJoints, rotate
from xreset.errors import RobotError, XResetError
from xreset.geometry.dynamics import mass_matrix
from xreset.spec import MimicSpec

LENGTH = 32.0
"""PhysX's units of length in a metre: a power of two, so that nothing is rounded. With 1, PhysX misses 8 % of the
contacts of capsules with hulls of real objects, with 8 less than 1 %, with 16 to 64 none."""


def joint_unit(joint: Any) -> float:
    """Return PhysX's units of a joint's position in a metre or a radian."""
    return LENGTH if joint.type == "prismatic" else 1.0


class SapienJoints:
    """Drives, dry friction and mimic couplings of the articulation. PhysX keeps the joints in an order of its own."""

    def __init__(self, links: Sequence[Any], robot: Mechanism, dt: float, substep: float) -> None:
        spec = robot.robot
        self._dt = dt
        self._articulation = articulation = links[0].articulation
        joints = {joint.name: joint for joint in articulation.active_joints}
        self._moving = moving = MovingJoints(spec, list(joints))
        self.driven = moving.driven
        """[J] the actuated joints."""
        self.by_body = [list(joints).index(name) for name in robot.joint_names]
        """[D] the moving joints in the order of the bodies."""
        for joint in articulation.active_joints:
            joint.set_friction(0.0)
        self._unit = np.array([joint_unit(joint) for joint in joints.values()])
        """[D] PhysX's units of position in a metre or a radian; a torque's is LENGTH**2 / unit."""
        for described, i in zip(spec.joints, moving.driven, strict=True):
            armature = described.drive.armature * (LENGTH / self._unit[i]) ** 2
            joints[described.name].set_armature(np.array([[armature]]))

        at = [*moving.driven, *moving.mimic]
        self._drives = [articulation.active_joints[i] for i in at]
        """[J + Q] the actuated joints, then those that follow, whose drives carry a share of their source's."""
        self._set_target = [joint.set_drive_target for joint in self._drives]
        self._followed = np.concatenate((np.arange(len(spec.joints)), moving.source))
        share = moving.shares[self._followed, at]
        rate = np.concatenate((np.ones(len(spec.joints)), moving.multiplier))
        self._drive_unit = self._unit[at]
        stiffness = share / rate * (LENGTH / self._drive_unit) ** 2
        effort = share * LENGTH**2 / self._drive_unit
        self._share = np.abs(np.stack((stiffness, stiffness, effort)))
        """[3, J + Q] of stiffness, damping and effort limit, in PhysX's units."""
        for mimic in spec.mimics:
            _couple(articulation, joints, mimic, substep)

        self.target = spec.home
        """[J] drive targets."""
        self.set_drives(np.ones_like(moving.nominal))
        if moving.has_dry_friction:
            mass = mass_matrix(spec, spec.home) + np.diag(moving.armature)
            self._inertia = 1.0 / np.diag(np.linalg.inv(mass))

    def reset(self, position: np.ndarray, velocity: np.ndarray, target: np.ndarray) -> None:
        """Set positions, velocities and targets [J] of the actuated joints; mimic joints follow."""
        position, velocity = self._moving.spread(position, velocity)
        self._articulation.qpos = self._unit * position
        self._articulation.qvel = self._unit * velocity
        self._articulation.qf = np.zeros(self._moving.count)
        self.set_targets(target)

    def read(self, joints: Sequence[int] | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return positions and velocities of :attr:`driven` joints, or of all :attr:`by_body`."""
        unit = self._unit[joints]
        return self._articulation.qpos[joints] / unit, self._articulation.qvel[joints] / unit

    def set_drives(self, scale: np.ndarray) -> None:
        """Set factors [3, J] on stiffness, damping and effort limit."""
        scaled = scale * self._moving.nominal
        self._kp, self._kd, self._effort = scaled
        shared = self._share * scaled[:, self._followed]
        for joint, (kp, kd, effort) in zip(self._drives, shared.T.tolist(), strict=True):
            joint.set_drive_properties(kp, kd, effort, "force")

    def set_targets(self, targets: np.ndarray) -> None:
        """Set the drive targets [J]."""
        self.target = targets
        followers = self._moving.multiplier * targets[self._moving.source] + self._moving.offset
        all_targets = self._drive_unit * np.concatenate((targets, followers))
        for set_target, target in zip(self._set_target, all_targets.tolist(), strict=True):
            set_target(target)

    def brake(self) -> None:
        """Apply dry friction for one step as a torque, because PhysX's joint friction is not a torque.

        The torque would bring the joint to rest within the step, as far as the friction loss allows; contacts are not
        foreseen.
        """
        if not self._moving.has_dry_friction:
            return
        position, velocity = self.read(self.driven)
        drive = np.clip(
            self._kp * (self.target - position) - self._kd * velocity, -self._effort, self._effort
        )
        loss = self._moving.friction_loss
        torque = np.zeros(self._moving.count)
        torque[self.driven] = np.clip(-self._inertia * velocity / self._dt - drive, -loss, loss)
        self._articulation.qf = torque * LENGTH**2 / self._unit


_SOFT = 0.1
"""Stiffness of a coupling times h^2, and its damping times h, over the inertia that it holds; h: the solver's substep.

PhysX divides a tendon's force on each joint by 1 plus these numbers, with the joint's own inertia. Where they are
large, the forces on two joints have the ratio of the joints' inertias, and a coupling makes work.
"""


def _couple(articulation: Any, joints: Mapping[str, Any], mimic: MimicSpec, substep: float) -> None:
    """Tie a mimic joint to its source: a fixed tendon keeps q_mimic - multiplier q_source = offset and acts on both.

    It runs through the links between the two, whose own joints it does not act on.

    Raises:
        RobotError: neither of the two joints' parent links carries the other joint, so PhysX has no tendon for them.
    """
    unit = joint_unit(joints[mimic.joint])
    multiplier = mimic.multiplier * unit / joint_unit(joints[mimic.source])
    source = (joints[mimic.source], -multiplier)
    follower = (joints[mimic.joint], 1.0)
    for (upper, first), (lower, last) in ((source, follower), (follower, source)):
        between = []
        link = lower.parent_link
        while link is not None and link not in (upper.parent_link, upper.child_link):
            between.append(link)
            link = link.parent
        if link is not None:
            chain = [upper.child_link, *between[::-1], lower.child_link]
            rates = [first, *[0.0] * len(between), last]
            carried = chain if link == upper.child_link else chain[1:]
            inertia = min(_own_inertia(follower[0]), _own_inertia(source[0]) / multiplier**2)
            articulation.create_fixed_tendon(
                [upper.parent_link, *chain],
                [0.0, *rates],
                [0.0, *rates[: -len(carried)], *_forces(carried, rates[-len(carried) :])],
                rest_length=unit * mimic.offset,
                stiffness=_SOFT * inertia / substep**2,
                damping=_SOFT * inertia / substep,
            )
            return
    raise RobotError(
        f"The joint {mimic.joint!r} mimics {mimic.source!r}, but neither is below the other's parent link: "
        "the engine 'sapien' cannot couple them. Use another engine."
    )


def _own_inertia(joint: Any) -> float:
    """Return the least inertia that a joint moves: mass, or smallest moment of its own link, in PhysX's units."""
    link = joint.child_link
    own = link.mass if joint.type == "prismatic" else link.inertia.min()
    return float(own + joint.armature.sum())


def _forces(chain: Sequence[Any], rates: Sequence[float]) -> list[float]:
    """Return the forces of a tendon on links, each the parent of the next, that act on their joints as the rates say.

    PhysX lets a tendon act on a link without a reaction on the link's parent, so a torque on a link turns the joints
    above it, too. Joints that slide and joints that turn are taken as independent of each other.
    """
    axes = [_axis(link) for link in chain]
    forces = np.zeros(len(chain))
    for i in reversed(range(len(chain))):
        passed_on = forces @ [
            float(axes[i] @ axis) if link.joint.type == chain[i].joint.type else 0.0
            for link, axis in zip(chain, axes, strict=True)
        ]
        forces[i] = rates[i] - passed_on
    return forces.tolist()


def _axis(link: Any) -> np.ndarray:
    """[3] world axis of the joint that carries a link; PhysX turns and slides along x."""
    pose = link.entity_pose * link.joint.pose_in_child
    return rotate(pose.q.astype(float), np.array([1.0, 0.0, 0.0]))


# Which shapes collide -------------------------------------------------------------------------------------------------
# Two shapes collide if a bit of the first group of one is in the second group of the other.

OBJECT_BIT = 1
TABLE_OF_TIPS_BIT = 2
TABLE_OF_LINKS_BIT = 4
_SELF_BITS = range(3, 32)


def self_collision_bits(robot: Mechanism) -> dict[str, tuple[int, int, int]]:
    """Return the bits such that exactly the links that may collide with each other do, each pair once.

    Of a pair, the shapes of one link touch copies of the other's shapes, whose friction is solved for that pair. A
    fingertip's own shapes touch the copies of another link.

    Returns:
        Link -> its own bit; those of its partners of the same kind that its copies touch; those of the fingertips that
        its copies touch.

    Raises:
        XResetError: the robot has more links than there are bits.
    """
    links = robot.robot.self_collision_links
    if len(links) > len(_SELF_BITS):
        raise XResetError(
            f"Robot {robot.robot.name!r}: {len(links)} links may collide with one another, and PhysX has bits for "
            f"{len(_SELF_BITS)}. Shorten self_collision_links."
        )
    bits = {link: 1 << bit for link, bit in zip(links, _SELF_BITS, strict=False)}
    of_same_kind = dict.fromkeys(links, 0)
    of_tips = dict.fromkeys(links, 0)
    for link, other in robot.colliding_links:
        if (link in robot.tip_of) == (other in robot.tip_of):
            of_same_kind[other] |= bits[link]
        elif link in robot.tip_of:
            of_tips[other] |= bits[link]
        else:
            of_tips[link] |= bits[other]
    return {link: (bits[link], of_same_kind[link], of_tips[link]) for link in links}
