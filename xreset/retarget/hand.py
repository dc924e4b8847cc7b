"""Hand retargeting: hand joints and hand pose that follow human keypoints, over whole trajectories at once (the paper, appendix D.b).

The variables of a frame are the hand's joints and the pose of the link that carries the hand. The cost is

    sum over frames of  local bone geometry + global alignment + contact + clearance
    + sum over neighbouring frames of  joint and root smoothness,

and is minimised by Levenberg-Marquardt with analytic Jacobians and exact joint limits (projected steps). Neighbouring frames couple through
smoothness alone, so each step solves a block-tridiagonal system. The clearance term is not the paper's: it keeps the hand out of the
object, the table and itself, without which many grasps are rejected when they are spawned in physics.

Shape letters: S sequences padded to T frames, B = S T frames, P mapped keypoints, C pairs of keypoints, J hand joints, n = J + 6.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from xreset.retarget import terms
from xreset.retarget.chain import solve_chain
from xreset.retarget.collision import height_above_table
from xreset.retarget.hand_model import Bodies, HandModel
from xreset.retarget.surface import Surface
from xreset.rotations import (
    matrix_to_quat,
    quat_conjugate,
    quat_from_axis_angle,
    quat_multiply,
    quat_normalize,
    quat_to_axis_angle,
    quat_to_matrix,
)

_FRAMES_PER_CHUNK = 1024


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
    clearance_weight: float = 2000.0
    """Depth of the hand in the object, the table and itself, beyond what is allowed."""
    object_clearance: float = 0.0005
    """Distance that the hand keeps from the object [m]. Deeper grasps are pushed apart in physics: at -0.001 a third fewer are accepted."""
    self_depth: float = 0.002
    """Depth of the hand's links in one another that is allowed [m]."""
    smoothness_weight: float = 2.0
    """Change of joints and root between neighbouring frames. Positive: it alone holds what no keypoint determines."""
    length_scale: float = 0.10
    """Length that counts as much as one radian [m]: about a finger's length."""
    iterations: int = 40
    """Most Levenberg-Marquardt steps."""
    tolerance: float = 1e-3
    """A sequence is done when a step lowers its cost by less than this fraction."""

    def __post_init__(self) -> None:
        if not (self.smoothness_weight > 0 and self.length_scale > 0):
            raise ValueError(f"smoothness_weight ({self.smoothness_weight}) and length_scale ({self.length_scale}) must be positive")


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
    object_pos: Tensor
    """[S, T, 3]"""
    object_quat: Tensor
    """[S, T, 4]"""
    surfaces: tuple[Surface, ...]
    """(S) each sequence's object."""

    def select(self, sequences: Tensor) -> HandTargets:
        """Those of some sequences."""
        tensors = {name: value[sequences] for name, value in vars(self).items() if name != "surfaces"}
        return HandTargets(**tensors, surfaces=tuple(self.surfaces[i] for i in sequences.tolist()))

    def by_surface(self) -> Iterator[tuple[Tensor, Surface]]:
        """Every object, and the frames [.] (of the S T) that it is in."""
        frames = torch.arange(self.annotated.numel()).view(self.annotated.shape)
        for surface in dict.fromkeys(self.surfaces):
            yield frames[[i for i, other in enumerate(self.surfaces) if other is surface]].flatten(), surface


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
    root_pos, root_quat = _align_root(model, targets)
    state = _State(joints=model.kinematics.clamp(model.home).expand(sequences, frames, -1).clone(), root_pos=root_pos, root_quat=root_quat)
    damping = torch.full((sequences,), 1e-3, dtype=torch.float64)
    active = torch.arange(sequences)
    now, system = state, _system(model, targets, config, state)
    final = system.cost.clone()
    for iteration in range(config.iterations):
        if progress:
            progress(iteration / config.iterations)
        trial = _retract(model, now, _limited_step(model, config, now, system, damping))
        tried = _system(model, targets.select(active), config, trial)
        better = tried.cost < system.cost
        gain = (system.cost - tried.cost) / system.cost.clamp_min(1e-12)
        now = _State(**{name: torch.where(better[:, None, None], value, getattr(now, name)) for name, value in vars(trial).items()})
        system = _System(
            cost=torch.where(better, tried.cost, system.cost),
            diagonal=torch.where(better[:, None, None, None], tried.diagonal, system.diagonal),
            gradient=torch.where(better[:, None, None], tried.gradient, system.gradient),
        )
        damping = torch.where(better, damping * 0.2, damping * 8.0)
        for name, value in vars(now).items():
            getattr(state, name)[active] = value
        final[active] = system.cost
        left = ~((better & (gain < config.tolerance)) | (damping > 1e6))
        if not bool(left.any()):
            break
        active, damping = active[left], damping[left]
        now = _State(**{name: value[left] for name, value in vars(now).items()})
        system = _System(**{name: value[left] for name, value in vars(system).items()})
    keypoints = model.keypoints(state.joints, state.root_pos, state.root_quat)
    return HandMotion(joints=state.joints, root_pos=state.root_pos, root_quat=state.root_quat, keypoints=keypoints, cost=final)


@dataclass(frozen=True)
class _State:
    """The variables."""

    joints: Tensor
    """[S, T, J]"""
    root_pos: Tensor
    """[S, T, 3]"""
    root_quat: Tensor
    """[S, T, 4]"""


@dataclass(frozen=True)
class _System:
    """Cost and its Gauss-Newton approximation; blocks beside the diagonal are minus the squared smoothness scale."""

    cost: Tensor
    """[S]"""
    diagonal: Tensor
    """[S, T, n, n] diagonal blocks."""
    gradient: Tensor
    """[S, T, n] half the gradient."""


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


def _retract(model: HandModel, state: _State, step: Tensor) -> _State:
    count = state.joints.shape[-1]
    turned = quat_normalize(quat_multiply(quat_from_axis_angle(step[..., count + 3 :]), state.root_quat))
    return _State(
        joints=model.kinematics.clamp(state.joints + step[..., :count]),
        root_pos=state.root_pos + step[..., count : count + 3],
        root_quat=turned,
    )


def _smoothness_scale(config: HandConfig, joints: int) -> Tensor:
    """[n] square root of the smoothness weight of each variable: joints and root rotation in rad, root position in length scales."""
    scale = torch.ones(joints + 6, dtype=torch.float64)
    scale[joints : joints + 3] /= config.length_scale
    return scale * config.smoothness_weight**0.5


def _changes(state: _State) -> Tensor:
    """[S, T-1, n] change of every variable between neighbouring frames; rotations as rotation vectors in world axes."""
    turn = quat_to_axis_angle(quat_multiply(state.root_quat[:, 1:], quat_conjugate(state.root_quat[:, :-1])))
    return torch.cat((state.joints.diff(dim=1), state.root_pos.diff(dim=1), turn), dim=-1)


def _weights(model: HandModel, targets: HandTargets, config: HandConfig) -> tuple[Tensor, Tensor, Tensor]:
    """Weights per frame of pairs [B, C], keypoints [B, P] and contacts [B, P]: zero where there is no annotation or no contact."""
    on = targets.annotated.flatten().to(torch.float64)[:, None]
    tip = torch.as_tensor(np.where(model.is_tip, config.tip_factor, 1.0))
    count = len(model.pairs)
    local = on.expand(-1, count) * (config.local_weight / count)
    return local, on * config.global_weight * tip, on * config.contact_weight * targets.in_contact.flatten(0, 1)


def _system(model: HandModel, targets: HandTargets, config: HandConfig, state: _State) -> _System:
    """Cost of every sequence and its Gauss-Newton approximation."""
    sequences, frames, count = state.joints.shape
    n = count + 6
    scale = config.length_scale
    cost = torch.zeros(sequences, dtype=torch.float64)
    H = torch.zeros(sequences, frames, n, n, dtype=torch.float64)
    g = torch.zeros(sequences, frames, n, dtype=torch.float64)
    for part in torch.arange(sequences).split(max(1, _FRAMES_PER_CHUNK // frames)):
        now = targets.select(part)
        bodies = model.bodies(*(value[part].flatten(0, 1) for value in (state.joints, state.root_pos, state.root_quat)))
        x, J = model.keypoints_of(bodies)
        x, J, h, c = x / scale, J / scale, now.keypoints.flatten(0, 1) / scale, now.contact_points.flatten(0, 1) / scale
        local, alignment, touch = _weights(model, now, config)
        distance, slope, frame = _clearances(model, now, config, bodies)
        touching = terms.contact(x, J, c, touch, config.contact_margin / scale, config.contact_knee / scale)
        squares = (
            terms.bone_lengths(x, J, h, model.pairs, local),
            terms.bone_directions(x, J, h, model.pairs, local),
            terms.global_alignment(x, J, h, alignment),
            terms.clearance(distance / scale, slope / scale, frame, len(x), config.clearance_weight, 0.0),
        )
        per_frame = terms.contact_cost(x, c, touch, config.contact_margin / scale, config.contact_knee / scale)
        for residual in squares:
            per_frame = per_frame + residual.value.square().sum(-1)
        cost[part] = per_frame.view(len(part), frames).sum(1)
        value, jacobian = (torch.cat(rows, dim=1) for rows in zip(touching, *squares, strict=True))
        H[part] = (jacobian.mT @ jacobian).view(len(part), frames, n, n)
        g[part] = (jacobian.mT @ value[..., None]).view(len(part), frames, n)

    squared = _smoothness_scale(config, count).square()
    change = _changes(state)
    cost += (change.square() * squared).sum((1, 2))
    neighbours = torch.full((frames,), 2.0, dtype=torch.float64)
    neighbours[0] -= 1.0
    neighbours[-1] -= 1.0
    H.diagonal(dim1=-2, dim2=-1).add_(neighbours[:, None] * squared)
    g[:, 1:] += change * squared
    g[:, :-1] -= change * squared
    return _System(cost=cost, diagonal=H, gradient=g)


def _clearances(model: HandModel, targets: HandTargets, config: HandConfig, bodies: Bodies) -> tuple[Tensor, Tensor, Tensor]:
    """Balls of the hand that come too near to the object, the table or each other.

    Returns:
        [A] distance, less what is allowed [m]; [A, n] its derivative; [A] frame, ascending.
    """
    balls = model.balls
    centers = bodies.pos[:, model.ball_links] + (bodies.rot[:, model.ball_links] @ balls.centers[..., None])[..., 0]  # [B, Q, 3]
    annotated = targets.annotated.flatten()
    found: list[tuple[Tensor, Tensor, Tensor, Tensor, Tensor]] = []  # frame, first ball, second ball or -1, distance, direction

    table = height_above_table(centers, balls.radii, model.table)
    frame, ball = ((table < 0) & annotated[:, None]).nonzero(as_tuple=True)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=centers.dtype)
    found.append((frame, ball, torch.full_like(ball, -1), table[frame, ball], up.expand(len(frame), 3)))

    for rows, surface in targets.by_surface():
        T = quat_to_matrix(targets.object_quat.flatten(0, 1)[rows])
        local = (centers[rows] - targets.object_pos.flatten(0, 1)[rows][:, None]) @ T  # R^T p, as a row
        reach = balls.radii[:, None] + torch.zeros(3)
        low, high = torch.as_tensor(surface.low) - reach, torch.as_tensor(surface.high) + reach
        row, ball = (((local > low) & (local < high)).all(-1) & annotated[rows][:, None]).nonzero(as_tuple=True)
        distance, slope = surface.signed_distance(local[row, ball])
        distance = distance - balls.radii[ball] - config.object_clearance
        near = distance < 0
        row, ball = row[near], ball[near]
        direction = (T[row] @ slope[near][..., None])[..., 0]
        found.append((rows[row], ball, torch.full_like(ball, -1), distance[near], direction))

    a, b = balls.pairs.unbind(1)
    gap = centers[:, a] - centers[:, b]
    distance = gap.norm(dim=-1)
    apart = distance - balls.radii[a] - balls.radii[b] + config.self_depth
    frame, pair = ((apart < 0) & annotated[:, None]).nonzero(as_tuple=True)
    direction = gap[frame, pair] / distance[frame, pair, None].clamp_min(1e-9)
    found.append((frame, a[pair], b[pair], apart[frame, pair], direction))

    frame, first, second, distance, direction = (torch.cat(values) for values in zip(*found, strict=True))
    order = frame.argsort(stable=True)
    frame, first, second, distance, direction = frame[order], first[order], second[order], distance[order], direction[order]
    slope = model.ball_slope(bodies, frame, first, centers, direction)
    both = (second >= 0).nonzero()[:, 0]
    slope[both] -= model.ball_slope(bodies, frame[both], second[both], centers, direction[both])
    return distance, slope, frame


def _limited_step(model: HandModel, config: HandConfig, state: _State, system: _System, damping: Tensor) -> Tensor:
    """[S, T, n] Levenberg-Marquardt step in which joints at a limit stay there if the cost pulls them outwards (Bertsekas' projection)."""
    joints = state.joints
    count = joints.shape[-1]
    pull = system.gradient[..., :count]
    outward = ((joints <= model.kinematics.lower) & (pull > 0)) | ((joints >= model.kinematics.upper) & (pull < 0))
    free = torch.ones_like(system.gradient)
    free[..., :count] = (~outward).to(free.dtype)
    ridge = damping[:, None, None] * system.diagonal.diagonal(dim1=-2, dim2=-1).clamp_min(1e-6) * free + (1.0 - free)
    H = system.diagonal * free[..., :, None] * free[..., None, :] + torch.diag_embed(ridge)
    coupling = -_smoothness_scale(config, count).square() * free[:, 1:] * free[:, :-1]
    return solve_chain(H, coupling, -system.gradient * free)
