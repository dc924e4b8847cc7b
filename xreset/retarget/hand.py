"""Hand retargeting: hand joints and hand pose that follow human keypoints, over whole trajectories at once (the paper, appendix D.b).

The variables of a frame are the hand's joints and the pose of the link that carries the hand. The cost is

    sum over frames of  local bone geometry + global alignment + contact   +   sum over neighbouring frames of  joint and root smoothness,

and is minimised by Levenberg-Marquardt with analytic Jacobians and exact joint limits (projected steps). Neighbouring frames couple through
smoothness alone, so each step solves a block-tridiagonal system.

Shape letters: S sequences padded to T frames, B = S T frames, P mapped keypoints, C pairs of keypoints, J hand joints, n = J + 6.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from xreset.errors import RobotError
from xreset.kinematics import Kinematics
from xreset.retarget import terms
from xreset.retarget.chain import solve_chain
from xreset.rotations import (
    matrix_to_quat,
    quat_conjugate,
    quat_from_axis_angle,
    quat_multiply,
    quat_normalize,
    quat_to_axis_angle,
    quat_to_matrix,
)
from xreset.spec import FINGERS, KEYPOINTS, RobotSpec

_FRAMES_PER_CHUNK = 2048


@dataclass(frozen=True, kw_only=True)
class HandConfig:
    """Weights and limits of hand retargeting; weights as in the paper's appendix D.b."""

    local_weight: float = 10.0
    """Bone vectors and bone directions, averaged over the pairs of keypoints."""
    global_weight: float = 1.0
    """Positions of the keypoints, per keypoint."""
    tip_factor: float = 10.0
    """How much more the position of a fingertip counts than that of another keypoint."""
    contact_weight: float = 5.0
    """Contact points, per keypoint in contact."""
    contact_margin: float = 0.01
    """Distance between contact link and contact point that costs nothing [m]."""
    contact_knee: float = 0.002
    """Excess over the margin below which the contact cost is quadratic [m]."""
    smoothness_weight: float = 2.0
    """Change of joints and root between neighbouring frames."""
    length_scale: float = 0.05
    """Length that counts as much as one radian [m]: about a finger bone's length."""
    iterations: int = 40
    """Most Levenberg-Marquardt steps."""
    tolerance: float = 1e-3
    """A sequence is done when a step lowers its cost by less than this fraction."""


@dataclass(frozen=True, kw_only=True)
class HandTargets:
    """What the hand should follow."""

    keypoints: Tensor
    """[S, T, P, 3] human keypoints; anything finite where not annotated."""
    annotated: Tensor
    """[S, T] bool: frames with keypoints. Others are held by smoothness alone."""
    contact_points: Tensor
    """[S, T, P, 3] object surface points that the keypoints touch."""
    in_contact: Tensor
    """[S, T, P] bool"""


@dataclass(frozen=True, kw_only=True)
class HandMotion:
    """A hand's motion."""

    joints: Tensor
    """[S, T, J] hand joint positions, within limits."""
    root_pos: Tensor
    """[S, T, 3] position of the hand root."""
    root_quat: Tensor
    """[S, T, 4] orientation of the hand root."""
    keypoints: Tensor
    """[S, T, P, 3] the robot's keypoints."""
    cost: Tensor
    """[S] final cost."""


class HandModel:
    """A robot's hand as a floating tree, and which of its links follow which human keypoints."""

    def __init__(self, robot: RobotSpec) -> None:
        """Raises ``RobotError`` where the description does not allow retargeting: the message says which entry is wrong."""
        self.robot = robot
        self.kinematics = Kinematics(robot, root=robot.hand_root)
        if not np.array_equal(self.kinematics.joint_indices, robot.hand_indices):
            below, group = self.kinematics.joint_names, [robot.joint_names[i] for i in robot.hand_indices]
            raise RobotError(
                f"robot {robot.name!r}: the joints below the hand root {robot.hand_root!r} are {', '.join(below)}, but the hand group is "
                f"{', '.join(group)}. Choose the last link that the arm moves as hand_root."
            )
        self.names: tuple[str, ...] = tuple(spec.keypoint for spec in robot.keypoints)
        """Human keypoint of each mapped keypoint (length P)."""
        self.links: tuple[str, ...] = tuple(spec.link for spec in robot.keypoints)
        """Link of each mapped keypoint."""
        for name, link in zip(self.names, self.links, strict=True):
            if name not in KEYPOINTS:
                raise RobotError(f"robot {robot.name!r}: there is no human keypoint {name!r}; there are {', '.join(KEYPOINTS)}.")
            self.kinematics.link_index(link)
        if len(set(self.links)) < 3:
            raise RobotError(
                f"robot {robot.name!r}: {len(set(self.links))} links follow keypoints, expected 3 or more (wrist, thumb, finger)."
            )
        self.keypoint_indices = np.array([KEYPOINTS.index(name) for name in self.names])
        """[P] indices into the 21 human keypoints."""
        tips = {tip.keypoint for tip in robot.fingertips}
        self.is_tip = np.array([name in tips for name in self.names])
        """[P] whether a fingertip follows the keypoint."""
        self.pairs = torch.tensor(keypoint_pairs(self.names, self.links))
        """[C, 2] pairs of mapped keypoints whose difference is matched."""
        self.home = torch.as_tensor(robot.home[robot.hand_indices])
        """[J] home configuration of the hand."""

    def keypoints(self, joints: Tensor, root_pos: Tensor, root_quat: Tensor) -> Tensor:
        """[..., P, 3] positions of the keypoint links."""
        return self.kinematics.points(joints, self.links, base=_pose(root_pos, root_quat))

    def keypoint_jacobian(self, joints: Tensor, root_pos: Tensor, root_quat: Tensor) -> tuple[Tensor, Tensor]:
        """Keypoints [..., P, 3] and their Jacobian [..., P, 3, J + 6]: joints, then root translation, then root rotation (world axes)."""
        base = _pose(root_pos, root_quat)
        points = self.kinematics.jacobian(joints, self.links, base=base)
        arm = points.pos - root_pos[..., None, :]
        identity = torch.eye(3, dtype=arm.dtype)
        turn = torch.linalg.cross(identity.expand(*arm.shape[:-1], 3, 3), arm[..., None, :])  # row i: e_i x arm
        return points.pos, torch.cat((points.linear, identity.expand_as(turn), turn.mT), dim=-1)


def keypoint_pairs(names: Sequence[str], links: Sequence[str]) -> list[tuple[int, int]]:
    """Pairs of mapped keypoints: along each finger from the wrist, between neighbouring knuckles, and from the thumb's tip to the others.

    Works for any subset of the 21 keypoints; pairs on one and the same link say nothing and are left out.
    """
    wrist = [i for i, name in enumerate(names) if name == "wrist"]
    fingers = [sorted((i for i, name in enumerate(names) if name.startswith(finger)), key=lambda i: names[i]) for finger in FINGERS]
    pairs = [pair for finger in fingers for pair in pairwise(wrist + finger)]
    thumb, others = fingers[0], [finger for finger in fingers[1:] if finger]
    for left, right in pairwise(others):
        pairs += [(left[0], right[0]), (left[-1], right[-1])]
    pairs += [(thumb[-1], finger[-1]) for finger in others if thumb]
    return [(a, b) for a, b in dict.fromkeys(pairs) if links[a] != links[b]]


def retarget_hand(
    model: HandModel, targets: HandTargets, config: HandConfig | None = None, progress: Callable[[float], None] | None = None
) -> HandMotion:
    """Hand motions that minimise the cost; sequences are independent of one another.

    Args:
        model: the hand.
        targets: what to follow; a sequence must have at least one annotated frame.
        config: weights.
        progress: called with the fraction of iterations that is done.
    """
    config = config or HandConfig()
    sequences, frames = targets.annotated.shape
    joints = model.kinematics.clamp(model.home).expand(sequences, frames, -1).clone()
    root_pos, root_quat = _align_root(model, targets)
    damping = torch.full((sequences,), 1e-3, dtype=torch.float64)
    cost = _cost(model, targets, config, joints, root_pos, root_quat)
    active = torch.arange(sequences)
    for iteration in range(config.iterations):
        if progress:
            progress(iteration / config.iterations)
        if not len(active):
            break
        now = _select(targets, active)
        q, p, r = joints[active], root_pos[active], root_quat[active]
        diagonal, coupling, gradient = _normal_equations(model, now, config, q, p, r)
        step = _limited_step(model, q, diagonal, coupling, gradient, damping[active])
        trial = _retract(model, q, p, r, step)
        trial_cost = _cost(model, now, config, *trial)
        better = trial_cost < cost[active]
        chosen = active[better]
        joints[chosen], root_pos[chosen], root_quat[chosen] = (x[better] for x in trial)
        gain = (cost[active] - trial_cost) / cost[active].clamp_min(1e-12)
        cost[chosen] = trial_cost[better]
        damping[active] = torch.where(better, damping[active] * 0.2, damping[active] * 8.0)
        done = (better & (gain < config.tolerance)) | (damping[active] > 1e6)
        active = active[~done]
    return HandMotion(
        joints=joints, root_pos=root_pos, root_quat=root_quat, keypoints=model.keypoints(joints, root_pos, root_quat), cost=cost
    )


def _select(targets: HandTargets, sequences: Tensor) -> HandTargets:
    return HandTargets(
        keypoints=targets.keypoints[sequences],
        annotated=targets.annotated[sequences],
        contact_points=targets.contact_points[sequences],
        in_contact=targets.in_contact[sequences],
    )


def _pose(pos: Tensor, quat: Tensor) -> Tensor:
    T = pos.new_zeros(*pos.shape[:-1], 4, 4)
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = quat_to_matrix(quat), pos, 1.0
    return T


def _align_root(model: HandModel, targets: HandTargets) -> tuple[Tensor, Tensor]:
    """First guess of the root: the rigid motion that carries the hand's keypoints at home onto the human's (Kabsch's method)."""
    identity = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)
    at_home = model.keypoints(model.kinematics.clamp(model.home), torch.zeros(3, dtype=torch.float64), identity)  # [P, 3]
    human = targets.keypoints
    centre_home, centre_human = at_home.mean(0), human.mean(-2, keepdim=True)
    U, _, Vt = torch.linalg.svd((human - centre_human).mT @ (at_home - centre_home))
    flip = torch.ones(*U.shape[:-2], 3, dtype=torch.float64)
    flip[..., 2] = torch.det(U) * torch.det(Vt)
    rot = (U * flip[..., None, :]) @ Vt
    pos = centre_human[..., 0, :] - (rot @ centre_home[:, None])[..., 0]
    nearest = _nearest_annotated(targets.annotated)
    rows = torch.arange(len(nearest))[:, None]
    return pos[rows, nearest], matrix_to_quat(rot)[rows, nearest]


def _nearest_annotated(annotated: Tensor) -> Tensor:
    """[S, T] index of the annotated frame that is nearest in time; ``ValueError`` if a sequence has none."""
    if not bool(annotated.any(dim=1).all()):
        raise ValueError("a sequence has no annotated frame")
    time = torch.arange(annotated.shape[1])
    distance = (time[:, None] - time).abs().expand(len(annotated), -1, -1)
    return distance.masked_fill(~annotated[:, None, :], len(time) * 2).argmin(dim=-1)


def _retract(model: HandModel, joints: Tensor, root_pos: Tensor, root_quat: Tensor, step: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    count = joints.shape[-1]
    turned = quat_normalize(quat_multiply(quat_from_axis_angle(step[..., count + 3 :]), root_quat))
    return model.kinematics.clamp(joints + step[..., :count]), root_pos + step[..., count : count + 3], turned


def _smoothness_scale(config: HandConfig, joints: int) -> Tensor:
    """[n] square root of the smoothness weight of each variable: joints and root rotation in rad, root position in length scales."""
    scale = torch.ones(joints + 6, dtype=torch.float64)
    scale[joints : joints + 3] /= config.length_scale
    return scale * config.smoothness_weight**0.5


def _changes(joints: Tensor, root_pos: Tensor, root_quat: Tensor) -> Tensor:
    """[S, T-1, n] change of every variable between neighbouring frames; rotations as rotation vectors in world axes."""
    turn = quat_to_axis_angle(quat_multiply(root_quat[:, 1:], quat_conjugate(root_quat[:, :-1])))
    return torch.cat((joints.diff(dim=1), root_pos.diff(dim=1), turn), dim=-1)


def _weights(model: HandModel, targets: HandTargets, config: HandConfig) -> tuple[Tensor, Tensor, Tensor]:
    """Weights per frame of pairs [B, C], keypoints [B, P] and contacts [B, P]: zero where there is no annotation or no contact."""
    on = targets.annotated.flatten().to(torch.float64)[:, None]
    tip = torch.as_tensor(np.where(model.is_tip, config.tip_factor, 1.0))
    count = len(model.pairs)
    local = on.expand(-1, count) * (config.local_weight / count)
    return local, on * config.global_weight * tip, on * config.contact_weight * targets.in_contact.flatten(0, 1)


def _cost(model: HandModel, targets: HandTargets, config: HandConfig, joints: Tensor, root_pos: Tensor, root_quat: Tensor) -> Tensor:
    """[S] the cost of each sequence."""
    scale = config.length_scale
    x = model.keypoints(joints, root_pos, root_quat).flatten(0, 1) / scale
    h, c = targets.keypoints.flatten(0, 1) / scale, targets.contact_points.flatten(0, 1) / scale
    local, alignment, touch = _weights(model, targets, config)
    none = x.new_zeros(*x.shape, 0)
    cost = terms.contact_cost(x, c, touch, config.contact_margin / scale, config.contact_knee / scale)
    for residual in (
        terms.bone_lengths(x, none, h, model.pairs, local),
        terms.bone_directions(x, none, h, model.pairs, local),
        terms.global_alignment(x, none, h, alignment),
    ):
        cost = cost + residual.value.square().sum(-1)
    smooth = (_changes(joints, root_pos, root_quat) * _smoothness_scale(config, joints.shape[-1])).square().sum((1, 2))
    return cost.view(targets.annotated.shape).sum(1) + smooth


def _normal_equations(
    model: HandModel, targets: HandTargets, config: HandConfig, joints: Tensor, root_pos: Tensor, root_quat: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Gauss-Newton system: diagonal blocks [S, T, n, n], coupling [S, T-1, n] (see :func:`solve_chain`) and half gradient [S, T, n]."""
    sequences, frames, count = joints.shape
    scale = config.length_scale
    n = count + 6
    h, c = targets.keypoints.flatten(0, 1) / scale, targets.contact_points.flatten(0, 1) / scale
    weights = _weights(model, targets, config)
    flat = (joints.flatten(0, 1), root_pos.flatten(0, 1), root_quat.flatten(0, 1))
    H = torch.zeros(sequences * frames, n, n, dtype=torch.float64)
    g = torch.zeros(sequences * frames, n, dtype=torch.float64)
    for begin in range(0, len(H), _FRAMES_PER_CHUNK):
        part = slice(begin, begin + _FRAMES_PER_CHUNK)
        x, J = model.keypoint_jacobian(*(v[part] for v in flat))
        x, J = x / scale, J / scale
        local, alignment, touch = (w[part] for w in weights)
        for value, jacobian in (
            terms.bone_lengths(x, J, h[part], model.pairs, local),
            terms.bone_directions(x, J, h[part], model.pairs, local),
            terms.global_alignment(x, J, h[part], alignment),
            terms.contact(x, J, c[part], touch, config.contact_margin / scale, config.contact_knee / scale),
        ):
            H[part] += jacobian.mT @ jacobian
            g[part] += (jacobian.mT @ value[..., None])[..., 0]
    H, g = H.view(sequences, frames, n, n), g.view(sequences, frames, n)

    squared = _smoothness_scale(config, count).square()
    change = _changes(joints, root_pos, root_quat) * squared
    neighbours = torch.full((frames,), 2.0, dtype=torch.float64)
    neighbours[0] -= 1.0
    neighbours[-1] -= 1.0
    H.diagonal(dim1=-2, dim2=-1).add_(neighbours[:, None] * squared)
    g[:, 1:] += change
    g[:, :-1] -= change
    return H, -squared.expand(sequences, frames - 1, n), g


def _limited_step(model: HandModel, joints: Tensor, diagonal: Tensor, coupling: Tensor, gradient: Tensor, damping: Tensor) -> Tensor:
    """[S, T, n] Levenberg-Marquardt step in which joints at a limit stay there if the cost pulls them outwards (Bertsekas' projection)."""
    count = joints.shape[-1]
    lower, upper = model.kinematics.lower, model.kinematics.upper
    free = torch.ones_like(gradient)
    pull = gradient[..., :count]
    free[..., :count] = (~((joints <= lower + 1e-9) & (pull > 0)) & ~((joints >= upper - 1e-9) & (pull < 0))).to(torch.float64)
    H = diagonal * free[..., :, None] * free[..., None, :]
    ridge = damping[:, None, None] * diagonal.diagonal(dim1=-2, dim2=-1).clamp_min(1e-6) * free + (1.0 - free)
    H = H + torch.diag_embed(ridge)
    link = coupling * free[:, 1:] * free[:, :-1]
    return solve_chain(H, link, -gradient * free)
