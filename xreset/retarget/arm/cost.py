"""One frame of the arm's inverse kinematics: its cost, and the joints that minimize it.

    50 |p(q) - p_t|^2 + 10 d_R(R(q), R_t)^2 + lambda_s |q - q_{t-1}|^2 + E_coll(q),   within the joint limits

E_coll = w sum of [margin - distance]_+^2 over the lowest point of the hand and of each of the arm's links (table) and,
on request, over the pairs of shapes that coal finds near each other.

Shape letters: B batch (sequences, branches or restarts), n arm joints, J all joints, C carriers, G links with support
points, A pairs of near shapes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from xreset.geometry.rotations import (
    matrix_to_quat,
    matvec,
    quat_conjugate,
    quat_multiply,
    quat_to_axis_angle,
)
from xreset.retarget.arm.config import ArmConfig
from xreset.retarget.arm.model import ArmModel
from xreset.retarget.least_squares import free_to_move, minimize
from xreset.tensors import Tensors

_CONVERGED = 1e-5
"""Steps smaller than this end the iteration [rad or m]."""


class Frame(NamedTuple):
    """One frame's problem for a batch."""

    pos: Tensor
    """[B, 3] position of the hand root."""
    quat: Tensor
    """[B, 4] orientation of the hand root."""
    hand_poses: Tensor
    """[B, G, 4, 4] see :meth:`ArmModel.hand_poses`."""
    hand_joints: Tensor
    """[B, J_hand]"""
    previous: Tensor | None
    """[B, n] joints of the frame before; None where there is none."""


@dataclass(frozen=True, kw_only=True)
class ArmSystem(Tensors):
    """Cost and its Gauss-Newton approximation."""

    cost: Tensor
    """[B]"""
    hessian: Tensor
    """[B, n, n] half the Gauss-Newton Hessian."""
    gradient: Tensor
    """[B, n] half the gradient."""


def solve(
    model: ArmModel,
    frame: Frame,
    q: Tensor,
    config: ArmConfig,
    iterations: int,
    *,
    self_collision: bool,
) -> Tensor:
    """[B, n] minimizer of one frame's cost, from ``q``: Levenberg-Marquardt, each element of the batch with its own
    damping.

    A joint at a limit stays there while the cost pulls it outwards; steps beyond a limit are cut off there.
    """

    def evaluate(q: Tensor, _: Tensor) -> ArmSystem:
        return system(model, frame, q, config, self_collision=self_collision)

    def step(q: Tensor, here: ArmSystem, damping: Tensor) -> Tensor:
        free = free_to_move(q, here.gradient, model.lower, model.upper)
        ridge = damping[:, None] * here.hessian.diagonal(dim1=-2, dim2=-1).clamp_min(1e-3) * free + (1.0 - free)
        H = here.hessian * free[:, :, None] * free[:, None, :] + torch.diag_embed(ridge)
        moved = q + torch.linalg.solve(H, -here.gradient * free)
        return torch.minimum(torch.maximum(moved, model.lower), model.upper)

    def done(before: Tensor, after: Tensor, *_: Tensor) -> Tensor:  # all together: the batch keeps its size
        return ((after - before).abs() < _CONVERGED).all().expand(len(before))

    return minimize(q, evaluate, step, done, iterations, damping_range=(1e-9, 1e9))[0]


def system(
    model: ArmModel,
    frame: Frame,
    q: Tensor,
    config: ArmConfig,
    *,
    self_collision: bool,
) -> ArmSystem:
    """Compute the cost of one frame and its Gauss-Newton approximation at ``q`` [B, n]."""
    full = model.full(q, frame.hand_joints)
    origins, rot, linear, angular = model.kinematics.jacobian(full, model.carriers)
    linear = linear[..., model.arm]  # [B, C, 3, n]
    angular = angular[..., model.arm]

    def velocity(row: Tensor, carrier: Tensor, lever: Tensor) -> Tensor:
        """[A, 3, n] derivative of points at levers [A, 3] from their carrier's origin."""
        return linear[row, carrier] + torch.linalg.cross(angular[row, carrier], lever[..., None], dim=1)

    position_scale = config.position_weight**0.5
    orientation_scale = config.orientation_weight**0.5
    turn = quat_to_axis_angle(quat_multiply(matrix_to_quat(rot[:, 0]), quat_conjugate(frame.quat)))
    residuals = [
        position_scale * (origins[:, 0] - frame.pos),
        orientation_scale * turn,
    ]
    jacobians = [
        position_scale * linear[:, 0],
        orientation_scale * angular[:, 0],
    ]
    if frame.previous is not None:
        scale = config.smoothness_weight**0.5
        residuals.append(scale * (q - frame.previous))
        jacobians.append(scale * torch.eye(q.shape[1], dtype=q.dtype).expand(len(q), -1, -1))
    low = model.low_points(origins, rot, frame.hand_poses, config.table_margin)
    lift = velocity(low.frame, low.carrier, low.lever)[:, 2]
    value, slope = _intrusion(low.height, config.table_margin, config.collision_weight)
    at = (low.frame, low.carrier)
    residuals.append(q.new_zeros(linear.shape[:2]).index_put(at, value))
    jacobians.append(q.new_zeros(linear[:, :, 0].shape).index_put(at, slope[:, None] * lift))
    r = torch.cat(residuals, dim=1)
    J = torch.cat(jacobians, dim=1)
    cost = r.square().sum(1)
    hessian = J.mT @ J
    gradient = matvec(J.mT, r)
    if self_collision:
        # w [margin - d]_+^2 of every pair of near shapes; d changes by n . (v_b - v_a) at the nearest points.
        near = model.arm_collision.near(model.kinematics.link_poses(full).numpy(), config.self_margin)
        batch = torch.as_tensor(near.configuration)
        normal = torch.as_tensor(near.normal)[:, None]
        approach = q.new_zeros(len(batch), q.shape[1])
        for side, sign in ((0, -1.0), (1, 1.0)):
            carrier = model.carrier_of[torch.as_tensor(near.links[:, side])]
            reach = torch.as_tensor(near.points[:, side]) - origins[batch, carrier]
            approach += sign * (normal @ velocity(batch, carrier, reach))[:, 0]
        value, slope = _intrusion(
            torch.as_tensor(near.distance),
            config.self_margin,
            config.collision_weight,
        )
        rows = slope[:, None] * approach
        cost = cost.index_add(0, batch, value.square())
        hessian = hessian.index_add(0, batch, rows[:, :, None] * rows[:, None, :])
        gradient = gradient.index_add(0, batch, rows * value[:, None])
    return ArmSystem(cost=cost, hessian=hessian, gradient=gradient)


def _intrusion(distance: Tensor, margin: float, weight: float) -> tuple[Tensor, Tensor]:
    """Return the residual sqrt(w) [margin - d]_+ and its derivative by d."""
    scale = weight**0.5 * (distance < margin).to(distance.dtype)
    return scale * (margin - distance.clamp_max(margin)), -scale
