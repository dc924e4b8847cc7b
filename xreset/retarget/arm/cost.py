"""One frame of the arm's inverse kinematics: its cost, and the joints that minimise it.

    50 |p(q) - p_t|^2 + 10 d_R(R(q), R_t)^2 + lambda_s |q - q_{t-1}|^2 + E_coll(q),   within the joint limits

E_coll = w sum of [margin - distance]_+^2 over the lowest point of the hand and of each of the arm's links (table) and, where asked for,
over the pairs of shapes that coal finds near each other.

Shape letters: B batch (sequences, branches or restarts), n arm joints, J all joints, C carriers, G links with support points.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from xreset.geometry.rotations import matrix_to_quat, quat_conjugate, quat_multiply, quat_to_axis_angle
from xreset.retarget.arm.config import ArmConfig
from xreset.retarget.arm.model import ArmModel
from xreset.retarget.least_squares import free_to_move, minimise
from xreset.tensors import Tensors

_CONVERGED = 1e-5
"""Steps smaller than this end the iteration [rad or m]."""


@dataclass(frozen=True, kw_only=True)
class Frame:
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
class System(Tensors):
    """Cost and its Gauss-Newton approximation."""

    cost: Tensor
    """[B]"""
    hessian: Tensor
    """[B, n, n] half the Gauss-Newton Hessian."""
    gradient: Tensor
    """[B, n] half the gradient."""


def solve(
    model: ArmModel, frame: Frame, q: Tensor, config: ArmConfig, iterations: int, *, self_collision: bool
) -> Tensor:
    """[B, n] minimiser of one frame's cost, from ``q``: Levenberg-Marquardt, each element of the batch with its own damping.

    A joint at a limit stays there while the cost pulls it outwards; steps beyond a limit are cut off there.
    """

    def step(q: Tensor, here: System, damping: Tensor) -> Tensor:
        free = free_to_move(q, here.gradient, model.lower, model.upper)
        ridge = damping[:, None] * here.hessian.diagonal(dim1=-2, dim2=-1).clamp_min(1e-3) * free + (1.0 - free)
        H = here.hessian * free[:, :, None] * free[:, None, :] + torch.diag_embed(ridge)
        return torch.minimum(torch.maximum(q + torch.linalg.solve(H, -here.gradient * free), model.lower), model.upper)

    def done(before: Tensor, after: Tensor, *_: Tensor) -> Tensor:  # all together: the batch keeps its size
        return ((after - before).abs() < _CONVERGED).all().expand(len(before))

    def evaluate(q: Tensor, _: Tensor) -> System:
        return system(model, frame, q, config, self_collision=self_collision)

    return minimise(q, evaluate, step, done, iterations, damping_range=(1e-9, 1e9))[0]


def system(model: ArmModel, frame: Frame, q: Tensor, config: ArmConfig, *, self_collision: bool) -> System:
    """Cost of one frame and its Gauss-Newton approximation at ``q`` [B, n]."""
    full = model.full(q, frame.hand_joints)
    carriers = model.kinematics.jacobian(full, model.carriers)
    linear, angular = carriers.linear[..., model.arm], carriers.angular[..., model.arm]  # [B, C, 3, n]

    turn = quat_to_axis_angle(quat_multiply(matrix_to_quat(carriers.rot[:, 0]), quat_conjugate(frame.quat)))
    residuals = [config.position_weight**0.5 * (carriers.pos[:, 0] - frame.pos), config.orientation_weight**0.5 * turn]
    jacobians = [config.position_weight**0.5 * linear[:, 0], config.orientation_weight**0.5 * angular[:, 0]]
    if frame.previous is not None:
        scale = config.smoothness_weight**0.5
        residuals.append(scale * (q - frame.previous))
        jacobians.append(scale * torch.eye(q.shape[1], dtype=q.dtype).expand(len(q), -1, -1))
    low = model.lowest(carriers.pos, carriers.rot, frame.hand_poses, config.table_margin)
    lift = (
        linear[low.frame, low.carrier, 2]
        + torch.linalg.cross(angular[low.frame, low.carrier], low.lever[..., None], dim=1)[:, 2]
    )
    value, slope = _intrusion(low.height, config.table_margin, config.collision_weight)
    residuals.append(q.new_zeros(linear.shape[:2]).index_put((low.frame, low.carrier), value))
    jacobians.append(q.new_zeros(linear[:, :, 0].shape).index_put((low.frame, low.carrier), slope[:, None] * lift))
    r, J = torch.cat(residuals, dim=1), torch.cat(jacobians, dim=1)
    system = System(cost=r.square().sum(1), hessian=J.mT @ J, gradient=(J.mT @ r[..., None])[..., 0])
    return (
        _with_self_collision(system, model, full, carriers.pos, linear, angular, config) if self_collision else system
    )


def _intrusion(distance: Tensor, margin: float, weight: float) -> tuple[Tensor, Tensor]:
    """Residual sqrt(w) [margin - d]_+ and its derivative by d."""
    scale = weight**0.5 * (distance < margin).to(distance.dtype)
    return scale * (margin - distance.clamp_max(margin)), -scale


def _with_self_collision(
    system: System, model: ArmModel, full: Tensor, origins: Tensor, linear: Tensor, angular: Tensor, config: ArmConfig
) -> System:
    """Add w [margin - d]_+^2 of every pair of near shapes; d changes by n . (v_b - v_a) at the nearest points.

    Args:
        full: [B, J] all joints.
        origins: [B, C, 3] of the carriers.
        linear: [B, C, 3, n] their Jacobians.
        angular: [B, C, 3, n]
    """
    near = model.arm_collision.near(model.kinematics.link_poses(full).numpy(), config.self_margin)
    batch = torch.as_tensor(near.configuration)
    normal, points = torch.as_tensor(near.normal), torch.as_tensor(near.points)
    approach = torch.zeros(len(batch), system.gradient.shape[1], dtype=full.dtype)
    for side, sign in ((0, -1.0), (1, 1.0)):
        carrier = model.carrier_of[torch.as_tensor(near.links[:, side])]
        reach = points[:, side] - origins[batch, carrier]
        velocity = linear[batch, carrier] + torch.linalg.cross(angular[batch, carrier], reach[..., None], dim=1)
        approach += sign * (normal[:, None] @ velocity)[:, 0]
    value, scale = _intrusion(torch.as_tensor(near.distance), config.self_margin, config.collision_weight)
    rows = scale[:, None] * approach
    return System(
        cost=system.cost.index_add(0, batch, value.square()),
        hessian=system.hessian.index_add(0, batch, rows[:, :, None] * rows[:, None, :]),
        gradient=system.gradient.index_add(0, batch, rows * value[:, None]),
    )
