"""How near the fingers of a state are to its object: between their collision shapes and the object's, not between frames;
and drive targets with which they press, and do not only stand where they are.

Shape letters: M states, J joints, E fingers, G contact links of all fingers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from xreset.geometry.balls import shape_balls
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.rotations import quat_rotate, quat_rotate_inverse
from xreset.geometry.surface import Surface
from xreset.resets.config import SqueezeConfig
from xreset.spec import ObjectSpec, RobotSpec


@dataclass(frozen=True, kw_only=True)
class Fingers:
    """Where each finger's contact links come nearest to the object."""

    links: tuple[str, ...]
    """The contact links (length G)."""
    finger: Tensor
    """[G] finger of each link, thumb first."""
    gap: Tensor
    """[M, G] signed distance from a link's shapes to the object's collision pieces [m]; balls stand for the shapes."""
    point: Tensor
    """[M, G, 3] that point of the link, in its frame."""
    inward: Tensor
    """[M, G, 3] unit vector into the object there, world frame."""

    @property
    def nearest(self) -> Tensor:
        """[M] the smallest gap."""
        return self.gap.amin(dim=-1)

    @property
    def leading(self) -> Tensor:
        """[M, G] bool: whether a link is the nearest of its finger; the first of those that are equally near."""
        lead = torch.zeros_like(self.gap, dtype=torch.bool)
        for number in self.finger.unique():
            mine = (self.finger == number).nonzero()[:, 0]
            lead.scatter_(1, mine[self.gap[:, mine].argmin(dim=-1)][:, None], True)
        return lead


def fingers_of(
    robot: RobotSpec,
    objects: Sequence[ObjectSpec],
    object_index: np.ndarray,
    joint_pos: np.ndarray,
    object_pos: np.ndarray,
    object_quat: np.ndarray,
) -> Fingers:
    """Measure states.

    Args:
        object_index: [M] which of them each state has.
        joint_pos: [M, J]
        object_pos: [M, 3]
        object_quat: [M, 4]
    """
    q, pos, quat = (torch.as_tensor(array, dtype=torch.float64) for array in (joint_pos, object_pos, object_quat))
    owned = [(number, link) for number, tip in enumerate(robot.fingertips) for link in tip.contact_links]
    links = tuple(link for _, link in owned)
    kinematics, surfaces = Kinematics(robot), {n: Surface(objects[n]) for n in np.unique(object_index).tolist()}
    poses = kinematics.link_poses(q, links)
    gap = q.new_zeros(len(q), len(links))
    point, inward = q.new_zeros(len(q), len(links), 3), q.new_zeros(len(q), len(links), 3)
    for g, link in enumerate(links):
        balls = [shape_balls(shape) for shape in kinematics.tree.link(link).collisions] or [
            (np.zeros((1, 3)), np.zeros(1))
        ]
        centers, radii = (torch.as_tensor(np.concatenate(part)) for part in zip(*balls, strict=True))
        R, p = poses[:, g, :3, :3], poses[:, g, :3, 3]
        for number, surface in surfaces.items():
            mine = torch.as_tensor(object_index == number)
            world = centers @ R[mine].transpose(-1, -2) + p[mine, None]
            turn = quat[mine, None].expand(-1, len(centers), 4)
            distance, gradient = surface.signed_distance(
                quat_rotate_inverse(turn, world - pos[mine, None]).flatten(0, 1)
            )
            distance, best = (distance.view(-1, len(centers)) - radii).min(dim=-1)
            gradient = gradient.view(-1, len(centers), 3)[torch.arange(len(best)), best]
            into = -quat_rotate(quat[mine], torch.nn.functional.normalize(gradient, dim=-1))
            gap[mine, g], inward[mine, g] = distance, into
            point[mine, g] = centers[best] + radii[best, None] * (R[mine].transpose(-1, -2) @ into[..., None])[..., 0]
    return Fingers(
        links=links, finger=torch.tensor([number for number, _ in owned]), gap=gap, point=point, inward=inward
    )


def squeeze_targets(robot: RobotSpec, fingers: Fingers, joint_pos: np.ndarray, config: SqueezeConfig) -> np.ndarray:
    """[M, J] targets: the joints' positions, and for hand joints what presses, within joint limits and the drives' largest torques.

    A finger that presses on the object with a normal force f needs joint torques J^T f, and a drive gives them where its target lies
    J^T f / kp beyond the joint. What the other parts of the hand would have to do for balance is left to them: drives are soft, and the
    object moves by millimetres until what it rests against presses back.

    Args:
        joint_pos: [M, J]
    """
    q = torch.as_tensor(joint_pos, dtype=torch.float64)
    kinematics = Kinematics(robot)
    jacobian = kinematics.jacobian(q, fingers.links, fingers.point).linear
    pressing = fingers.leading & (fingers.gap < config.reach)
    torque = torch.einsum("mgi,mgij->mj", config.force * pressing[..., None] * fingers.inward, jacobian)
    drives = [joint.drive for joint in robot.joints]
    effort, kp = (
        torch.tensor([getattr(drive, name) for drive in drives], dtype=torch.float64) for name in ("effort", "kp")
    )
    is_hand = torch.tensor([joint.group == "hand" and joint.drive.kp > 0 for joint in robot.joints])
    beyond = torch.where(is_hand, torque.clamp(-effort, effort) / kp.clamp_min(1e-9), 0.0)
    return torch.where(beyond != 0, kinematics.clamp(q + beyond), q).numpy()
