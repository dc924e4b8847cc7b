"""Distances between the fingers' collision shapes and the object's, and drive targets with which fingers press.

Shape letters: M states, J joints, E fingers, G contact links of all fingers.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy.optimize import nnls
from torch import Tensor

from xreset.files.checks import frozen
from xreset.geometry.balls import link_balls
from xreset.geometry.fields import DistanceFields
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.rotations import matvec, quat_rotate, quat_rotate_inverse
from xreset.geometry.surface import prepared_surface
from xreset.resets.programs import pressing_targets
from xreset.spec import GRAVITY, ObjectSpec, RobotSpec


@frozen
class Fingers:
    """Where each finger's contact links come nearest to the object."""

    links: tuple[str, ...]
    """The contact links (length G)."""
    finger: Tensor
    """[G] finger of each link, thumb first."""
    gap: Tensor
    """[M, G] signed distance from a link's shapes, approximated by balls, to the object's collision pieces [m]. A link
    without shapes is a point."""
    point: Tensor
    """[M, G, 3] nearest point of the link, in the link's frame."""
    inward: Tensor
    """[M, G, 3] unit vector into the object there, world frame."""
    lever: Tensor
    """[M, G, 3] from the object's centre of mass to this point, world frame."""
    weight: Tensor
    """[M] weight of each state's object [N]."""

    @property
    def leading(self) -> Tensor:
        """[M, G] bool: whether a link is the nearest one of its finger; the first one if several are equally near."""
        lead = torch.zeros_like(self.gap, dtype=torch.bool)
        for number in self.finger.unique():
            mine = (self.finger == number).nonzero()[:, 0]
            lead.scatter_(1, mine[self.gap[:, mine].argmin(dim=-1)][:, None], True)
        return lead

    def pressing(self, within: float) -> Tensor:
        """Return which links press: of each finger the nearest one, if it is nearer to the object than a distance [m]:
        [M, G] bool."""
        return self.leading & (self.gap < within)

    def grasp(self, within: float) -> Tensor:
        """Return whether the thumb and another finger are nearer to the object than a distance [m]: [M] bool."""
        near = self.gap < within
        thumb = self.finger == 0
        return near[:, thumb].any(dim=1) & near[:, ~thumb].any(dim=1)


def fingers_of(
    robot: RobotSpec,
    objects: Sequence[ObjectSpec],
    object_name: np.ndarray,
    joint_pos: np.ndarray,
    object_pos: np.ndarray,
    object_quat: np.ndarray,
) -> Fingers:
    """Measure how near the fingers of states are to their objects.

    Args:
        robot: the hand, with its fingertips' contact links.
        objects: geometry of the states' objects.
        object_name: [M] object of each state.
        joint_pos: [M, J]
        object_pos: [M, 3]
        object_quat: [M, 4]
    """
    q, pos, quat = (
        torch.as_tensor(array, dtype=torch.float64)
        for array in (joint_pos, object_pos, object_quat)
    )
    links = []
    finger = []
    for number, tip in enumerate(robot.fingertips):
        links += tip.contact_links
        finger += [number] * len(tip.contact_links)
    kinematics = Kinematics(robot)
    poses = kinematics.link_poses(q, links)
    names = [obj.name for obj in objects]
    fields = DistanceFields.join([prepared_surface(obj).field for obj in objects])
    which = torch.tensor([names.index(name) for name in object_name], dtype=torch.long)
    gap = q.new_zeros(len(q), len(links))
    point = q.new_zeros(len(q), len(links), 3)
    inward = torch.zeros_like(point)
    lever = torch.zeros_like(point)
    com = torch.as_tensor(np.stack([obj.com for obj in objects]))[which]
    com_world = pos + quat_rotate(quat, com)
    for g, link in enumerate(links):
        shapes = kinematics.tree.link(link).collisions
        balls = link_balls(shapes) if shapes else (np.zeros((1, 3)), np.zeros(1))
        centers, radii = map(torch.as_tensor, balls)
        R = poses[:, g, :3, :3]
        world = centers @ R.mT + poses[:, g, None, :3, 3]
        local = quat_rotate_inverse(quat[:, None].expand(-1, len(centers), 4), world - pos[:, None])
        distance, gradient = fields.signed_distance(
            local.flatten(0, 1), which.repeat_interleave(len(centers))
        )
        gap[:, g], nearest = (distance.view(-1, len(centers)) - radii).min(dim=-1)
        gradient = gradient.view(-1, len(centers), 3)[torch.arange(len(nearest)), nearest]
        inward[:, g] = -quat_rotate(quat, torch.nn.functional.normalize(gradient, dim=-1))
        point[:, g] = centers[nearest] + radii[nearest, None] * matvec(R.mT, inward[:, g])
        lever[:, g] = matvec(R, point[:, g]) + poses[:, g, :3, 3] - com_world
    weight = GRAVITY * torch.tensor([obj.mass for obj in objects], dtype=torch.float64)[which]
    return Fingers(
        links=tuple(links),
        finger=torch.tensor(finger),
        gap=gap,
        point=point,
        inward=inward,
        lever=lever,
        weight=weight,
    )


_REACH = 0.005
"""A finger of a bank's state presses if it is nearer than this to the object [m]: the object's weight may be on it in
the first step of an episode."""


def grip_forces(fingers: Fingers, force: float) -> Tensor:
    """Return the normal forces [M, G] with which links hold their object: ``force`` [N] and the object's weight for
    each finger, in balance.

    With one force for all objects, heavy ones slip and light ones tilt.
    """
    pressing = fingers.pressing(_REACH)
    return (force + fingers.weight[:, None]) * pressing * _balance(fingers, pressing)


def squeeze_targets(
    robot: RobotSpec, fingers: Fingers, joint_pos: np.ndarray, force: Tensor
) -> np.ndarray:
    """Return drive targets [M, J] with which the fingers press, within joint limits and the drives' largest torques.

    A finger that presses on the object with a normal force f needs joint torques J^T f. A drive gives them where its
    target is J^T f / kp beyond the joint (:func:`~xreset.resets.programs.pressing_targets`). The rest of the balance is
    left to the drives, which are soft: the object moves by millimetres until what it rests against presses back.
    Targets of joints that do not press are the joints' positions.

    Args:
        robot: robot of the states.
        fingers: how near its fingers are to the objects.
        joint_pos: [M, J]
        force: [M, G] normal force of each link [N].
    """
    q = torch.as_tensor(joint_pos, dtype=torch.float64)
    kinematics = Kinematics(robot)
    jacobian = kinematics.jacobian(q, fingers.links, fingers.point).linear
    torque = torch.einsum("mgi,mgij->mj", force[..., None] * fingers.inward, jacobian)
    return pressing_targets(kinematics, q, torque).numpy()


_LEVER = 0.05
"""Lever arm [m] with which a remaining torque weighs as much as a force."""
_EVEN = 0.1
"""Weight of the factors' differences from 1, next to the remaining force and torque."""


def _balance(fingers: Fingers, pressing: Tensor) -> Tensor:
    """Return a factor on the force of each pressing finger [M, G], with mean 1, so that all forces nearly cancel.

    With equal forces four fingers push an object out past the one thumb that opposes them. The factors are the least
    squares solution without negative values. The errors are the remaining force and torque on the object, and the
    differences of the factors from 1.
    """
    arm = torch.linalg.cross(fingers.lever, fingers.inward) / _LEVER
    wrench = torch.cat((fingers.inward, arm), dim=-1).numpy()
    factor = pressing.double().numpy()
    for state, presses in enumerate(pressing.numpy()):
        count = presses.sum()
        if count < 2:
            continue
        even = np.sqrt(_EVEN) * np.eye(count)
        wanted = np.concatenate((np.zeros(6), np.full(count, np.sqrt(_EVEN))))
        found, _ = nnls(np.concatenate((wrench[state, presses].T, even)), wanted)
        factor[state, presses] = found / found.mean()
    return torch.as_tensor(factor)
