"""Grasps that an object's shape allows a parallel jaw, and which demonstrations a robot can follow with a rigid grasp.

A grasp is a pair of surface points that face away from each other, nearer to each other than the jaw opens, and an
angle of approach about the line between them. The hand must be clear of the object, closed and open, there and on the
way to it. No force is computed: friction of the stated cone is assumed.

Shape letters: L states of a bank, K grasps, J hand joints, N tried grasps, S demonstrations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from xreset.files.checks import frozen
from xreset.files.progress import Progress
from xreset.geometry.rotations import (
    homogeneous,
    matvec,
    quat_from_axis_angle,
    quat_to_matrix,
)
from xreset.geometry.surface import Surface, prepared_surface
from xreset.objects.sampling import centers_of_mass
from xreset.physics.tensors import Tensors, one_thread
from xreset.resets.bank import ResetBank
from xreset.retarget.arm.config import QUICK
from xreset.retarget.arm.model import ArmModel
from xreset.retarget.arm.solve import reach_poses
from xreset.retarget.hand.model import HandModel
from xreset.retarget.validity import REASONS, Thresholds
from xreset.spec import ObjectSpec, RobotSpec

_CONE = float(np.radians(25.0))
"""Largest angle between the line of a grasp and the surface's normals: a coefficient of friction of 0.47."""
_POINTS = 700
"""Surface points among which pairs are sought."""
_TRIED = 4000
"""Pairs with an angle of approach that are tried at a time."""
_ROUNDS = 8
"""Times that they are tried, at most."""
_MOST = 800
"""Grasps of an object that are enough."""
_GAP = 0.0005
"""Distance of each pad from the surface [m], as in retargeting."""
_DEEP = 0.002
"""Depth of the hand in the object that counts as a collision [m]: balls stand for the hand, a grid for the object."""
_RETREAT = (0.0, 0.03, 0.08)
"""Distances from the grasp, against the approach, at which the open hand must be clear [m]."""
_DEPTHS = (0.0, 0.45, 0.85)
"""Where the surface points touch the pads: from the middle (0) to the end of the fingers (1)."""
_TABLE_DEPTH = Thresholds().table_depth
_THRESHOLDS = Thresholds(wrist_position=0.01, wrist_orientation=float(np.radians(5.0)))
"""How exactly the arm must carry a grasp; a success allows 2 cm and 15 degrees."""
_CARRIED = 0.02
"""A bank's object is in the air if it is raised by more than this [m]."""
_AT_ONCE = 24
"""Grasps whose inverse kinematics is solved at a time for each demonstration."""

Loss = Literal[
    "no grasp", "too wide", "no approach", "grasps out of reach", "joint limit", "goal out of reach",
    "table at the goal", "collision at the goal",
]  # fmt: skip
"""Why a demonstration cannot be followed. ``no grasp``: a hand that is no jaw presses on the object in no lifted state
of the bank. ``too wide``: no two points of the object that face away from each other are
as near as the jaw opens. ``no approach``: such points exist, and the hand would be in the object or in the table at
each of them. ``grasps out of reach``: at the start, the arm reaches none of these grasps within its joint limits, clear
of the table and of itself. The others: what keeps most of the grasps that the arm reaches at the start from the
goal."""

_AT_GOAL: dict[str, Loss] = {
    "joint limit": "joint limit",
    "table collision": "table at the goal",
    "self collision": "collision at the goal",
}


@frozen
class Grasps(Tensors):
    """Grasps of one object."""

    root: Tensor
    """[K, 4, 4] pose of the hand's root in the object's mesh frame."""
    joints: Tensor
    """[K, J] of the hand."""
    opened: Tensor
    """[K, J] joints with which the hand comes; those of the grasp where no approach is known."""
    retreat: Tensor
    """[K, 3] unit vector along which the hand came, in the object's frame; 0 where no approach is known."""
    missing: Loss = "no approach"
    """Why there is no grasp, if there is none."""


def raised(bank: ResetBank, objects: Sequence[ObjectSpec]) -> np.ndarray:
    """[L] height of each state's center of mass above that at the start of its demonstration [m]."""
    names = bank.object_name
    sequence = bank.sequence_index
    start = (bank.start_pos[sequence], bank.start_quat_wxyz[sequence])
    place = centers_of_mass(objects, names, bank.object_pos, bank.object_quat_wxyz)
    return (place - centers_of_mass(objects, names, *start))[:, 2]


def carried(bank: ResetBank, robot: RobotSpec, objects: Sequence[ObjectSpec]) -> np.ndarray:
    """[L] bool: whether a state's hand presses on an object in the air."""
    hand = robot.hand_indices
    presses = (bank.targets[:, hand] != bank.joint_pos[:, hand]).any(axis=1)
    return presses & (raised(bank, objects) > _CARRIED)


def grasps_of_bank(bank: ResetBank, robot: RobotSpec, obj: ObjectSpec) -> Grasps:
    """Return the grasps of an object in which a bank's hand presses on it in the air."""
    is_carried = carried(bank, robot, (obj,))
    rows = np.flatnonzero((bank.object_name == obj.name) & bank.own_grasp & is_carried)
    model = ArmModel(robot)
    joints = torch.as_tensor(bank.joint_pos[rows], dtype=torch.float64)
    root = model.kinematics.link_poses(joints, [robot.hand_root])[:, 0]
    pose = _poses(bank.object_pos[rows], bank.object_quat_wxyz[rows])
    held = joints[:, torch.as_tensor(model.hand.joint_indices)]
    found = Grasps(
        root=torch.linalg.inv(pose) @ root,
        joints=held,
        opened=held,
        retreat=root.new_zeros(len(root), 3),
        missing="no grasp",
    )
    shuffled = torch.randperm(len(rows), generator=torch.Generator().manual_seed(0))
    return found[shuffled[:_MOST]]


@one_thread()
def planned_grasps(model: HandModel, obj: ObjectSpec) -> Grasps:
    """Plan grasps of a jaw, at most 800, in random order; the same arguments give the same grasps."""
    surface = prepared_surface(obj)
    jaw = _Jaw.of(model)
    pairs = _pairs(surface, float(jaw.opening[-1]) - 2 * _GAP)
    generator = torch.Generator().manual_seed(0)
    if not len(pairs):
        nothing = pairs.new_zeros(0)
        return replace(jaw.grasps(pairs, nothing, nothing), missing="too wide")
    found = []
    for _ in range(_ROUNDS):
        drawn = pairs[torch.randint(len(pairs), (_TRIED,), generator=generator)]
        angle = 2 * torch.pi * torch.rand(_TRIED, generator=generator, dtype=pairs.dtype)
        level = torch.randint(len(_DEPTHS), (_TRIED,), generator=generator)
        tried = jaw.grasps(drawn, angle, drawn.new_tensor(_DEPTHS)[level])
        tried = tried[_is_outside(model, surface, tried.root, tried.joints)]
        for distance in _RETREAT:
            root = _backed_off(tried, distance)
            tried = tried[_is_outside(model, surface, root, tried.opened)]
        found.append(tried)
        if sum(len(part.joints) for part in found) >= _MOST:
            break
    return Grasps.cat(found)[:_MOST]


@frozen
class _Jaw(Tensors):
    """How a jaw's pads move with its joint, in Q positions from closed to open, in the frame of the hand's root."""

    opening: Tensor
    """[Q] distance between the pads [m]."""
    joints: Tensor
    """[Q, J] of the hand."""
    middle: Tensor
    """[Q, 3] point between the pads."""
    across: Tensor
    """[Q, 3] unit vector from the thumb's pad to the finger's."""
    ahead: Tensor
    """[Q, 3] unit vector of approach."""
    reach: Tensor
    """[Q] how far the pads reach beyond their middle [m]."""

    @staticmethod
    def of(model: HandModel) -> _Jaw:
        """Move a hand's jaw through its range."""
        balls = model.balls
        kinematics = model.kinematics
        share = torch.linspace(0, 1, 257, dtype=model.home.dtype)[:, None]
        joints = kinematics.lower + share * (kinematics.upper - kinematics.lower)
        poses = kinematics.link_poses(joints, balls.links)
        own = poses[:, balls.link[model.pad_balls]]
        centers = matvec(own[..., :3, :3], balls.centers[model.pad_balls]) + own[..., :3, 3]
        of_thumb = model.robot.fingertips[0].contact_links
        is_thumb = torch.tensor([link in of_thumb for link in balls.links])
        thumb = is_thumb[balls.link[model.pad_balls]]
        across = centers[:, ~thumb].mean(dim=1) - centers[:, thumb].mean(dim=1)
        across = torch.nn.functional.normalize(across, dim=-1)
        radii = balls.radii[model.pad_balls]
        along = (centers * across[:, None]).sum(-1)
        low = (along + radii)[:, thumb].amax(dim=1)
        high = (along - radii)[:, ~thumb].amin(dim=1)
        opening = high - low
        middle = (centers[:, thumb].mean(dim=1) + centers[:, ~thumb].mean(dim=1)) / 2
        middle = middle + ((high + low) / 2 - (middle * across).sum(-1))[:, None] * across
        palm = kinematics.link_poses(joints, [model.robot.palm])[:, 0, :3, 3]
        ahead = middle - palm
        ahead = ahead - (ahead * across).sum(-1, keepdim=True) * across
        ahead = torch.nn.functional.normalize(ahead, dim=-1)
        reach = ((centers - middle[:, None]) * ahead[:, None]).sum(-1) + radii
        jaw = _Jaw(
            opening=opening,
            joints=joints,
            middle=middle,
            across=across,
            ahead=ahead,
            reach=reach.amax(dim=1),
        )
        return jaw[opening.argsort()]

    def grasps(self, pairs: Tensor, angle: Tensor, depth: Tensor) -> Grasps:
        """Return grasps [N] of pairs of points [N, 2, 3], approached at an angle [N] about their line."""
        line = pairs[:, 1] - pairs[:, 0]
        width = line.norm(dim=-1)
        line = line / width[:, None]
        chosen = torch.searchsorted(self.opening, width + 2 * _GAP).clamp_max(len(self.opening) - 1)
        helper = torch.eye(3, dtype=line.dtype)[line.abs().argmin(dim=-1)]
        side = torch.nn.functional.normalize(torch.linalg.cross(line, helper), dim=-1)
        turn = quat_to_matrix(quat_from_axis_angle(angle[:, None] * line))
        approach = matvec(turn, side)
        own = _axes(self.across[chosen], self.ahead[chosen])
        rot = _axes(line, approach) @ own.mT
        touched = self.middle[chosen] + (depth * self.reach[chosen])[:, None] * self.ahead[chosen]
        pos = pairs.mean(dim=1) - matvec(rot, touched)
        return Grasps(
            root=homogeneous(rot, pos),
            joints=self.joints[chosen],
            opened=self.joints[-1:].expand(len(chosen), -1),
            retreat=-approach,
        )


def _backed_off(grasps: Grasps, distance: float) -> Tensor:
    """[K, 4, 4] poses of the hand's root, a distance [m] before the grasps."""
    root = grasps.root.clone()
    root[:, :3, 3] += distance * grasps.retreat
    return root


def _axes(across: Tensor, ahead: Tensor) -> Tensor:
    """[..., 3, 3] rotation whose y axis is ``across`` and whose x axis is ``ahead``, unit vectors at a right angle."""
    return torch.stack((ahead, across, torch.linalg.cross(ahead, across)), dim=-1)


def _pairs(surface: Surface, widest: float) -> Tensor:
    """[P, 2, 3] points of a surface that face away from each other and are at most ``widest`` [m] apart."""
    points, normal = map(torch.as_tensor, surface.samples(_POINTS))
    line = points[None] - points[:, None]
    width = line.norm(dim=-1)
    line = line / width.clamp_min(1e-9)[..., None]
    first = -(line * normal[:, None]).sum(-1)
    second = (line * normal[None]).sum(-1)
    faces = (first > np.cos(_CONE)) & (second > np.cos(_CONE))
    one, other = (faces & (width < widest)).nonzero(as_tuple=True)
    return torch.stack((points[one], points[other]), dim=1)


def _is_outside(model: HandModel, surface: Surface, root: Tensor, joints: Tensor) -> Tensor:
    """[N] bool: whether the hand's balls are outside the object, with the hand's root at [N, 4, 4] in its frame."""
    balls = model.balls
    outside = torch.ones(len(root), dtype=torch.bool)
    poses = root[:, None] @ model.kinematics.link_poses(joints, balls.links)
    for link, (first, count) in enumerate(zip(balls.first, balls.count, strict=True)):
        own = slice(int(first), int(first + count))
        rows = outside.nonzero()[:, 0]
        centers = balls.centers[own] @ poses[rows, link, :3, :3].mT + poses[rows, link, None, :3, 3]
        radii = balls.radii[own].repeat(len(rows))
        flat = centers.flatten(0, 1)
        object_index = torch.zeros(len(flat), dtype=torch.long)
        near, _, _ = surface.field.nearer(flat, object_index, radii - _DEEP)
        outside[rows[near.div(len(balls.radii[own]), rounding_mode="floor").unique()]] = False
    return outside


def _height(model: HandModel, root: Tensor, joints: Tensor) -> Tensor:
    """[N] height of the hand's lowest ball above the table [m], with the hand's root at [N, 4, 4] in the world."""
    balls = model.balls
    poses = root[:, None] @ model.kinematics.link_poses(joints, balls.links)
    own = poses[:, balls.link]
    z = (own[..., 2, :3] * balls.centers).sum(-1) + own[..., 2, 3] - balls.radii
    return z.amin(dim=1)


# Demonstrations -------------------------------------------------------------------------------------------------------


@one_thread()
def losses(
    bank: ResetBank,
    robot: RobotSpec,
    objects: Sequence[ObjectSpec],
    *,
    progress: Progress,
) -> np.ndarray:
    """Return why each demonstration [S] of a bank cannot be followed with a rigid grasp, empty where it can.

    Grasps of a jaw are planned. Other hands have those of the bank's states, of all demonstrations of the object.
    """
    hand = HandModel(robot)
    arm = ArmModel(robot)
    reasons = np.full(len(bank.sequence_name), "", dtype=object)
    done = 0
    for obj in objects:
        mine = np.flatnonzero(bank.sequence_object == obj.name)
        if not len(mine):
            continue
        if hand.is_jaw and len(hand.pad_balls):
            grasps = planned_grasps(hand, obj)
        else:
            grasps = grasps_of_bank(bank, robot, obj)
        for number in mine:
            start = _poses(bank.start_pos[[number]], bank.start_quat_wxyz[[number]])[0]
            goal = _poses(bank.goal_pos[[number]], bank.goal_quat_wxyz[[number]])[0]
            reasons[number] = _loss(hand, arm, grasps, start, goal)
            done += 1
            progress(done, len(reasons))
    return reasons


def _loss(hand: HandModel, arm: ArmModel, grasps: Grasps, start: Tensor, goal: Tensor) -> str:
    """Return why no grasp can be carried from one pose [4, 4] of the object to another, empty if one can."""
    if not len(grasps.joints):
        return grasps.missing
    clear = _height(hand, start @ grasps.root, grasps.joints) > -_TABLE_DEPTH
    for distance in _RETREAT:
        root = start @ _backed_off(grasps, distance)
        clear &= _height(hand, root, grasps.opened) > -_TABLE_DEPTH
    grasps = grasps[clear]
    if not len(grasps.joints):
        return "no approach"
    found = []
    for first in range(0, len(grasps.joints), _AT_ONCE):
        part = grasps[first : first + _AT_ONCE]
        part = part[_reason(arm, start @ part.root, part.joints) == 0]
        before = start @ _backed_off(part, _RETREAT[-1])
        part = part[_reason(arm, before, part.opened) == 0]
        if not len(part.joints):
            continue
        at_goal = _reason(arm, goal @ part.root, part.joints)
        if (at_goal == 0).any():
            return ""
        found += at_goal.tolist()
    if not found:
        return "grasps out of reach"
    most = REASONS[int(np.bincount(found).argmax())]
    return _AT_GOAL.get(most, "goal out of reach")


def _reason(arm: ArmModel, root: Tensor, joints: Tensor) -> Tensor:
    """[N] index into ``REASONS``: why the arm cannot carry the hand's root to [N, 4, 4]; 0 if it can."""
    if not len(root):
        return torch.zeros(0, dtype=torch.long)
    _, reason = reach_poses(arm, root, joints[:, None], _THRESHOLDS, QUICK)
    return reason


def _poses(pos: np.ndarray, quat: np.ndarray) -> Tensor:
    """[N, 4, 4] poses of positions [N, 3] and quaternions [N, 4]."""
    turn = quat_to_matrix(torch.as_tensor(quat, dtype=torch.float64))
    return homogeneous(turn, torch.as_tensor(pos, dtype=torch.float64))
