"""One frame of the arm's inverse kinematics: its cost, and the joints that minimize it.

    50 |p(q) - p_t|^2 + 10 d_R(R(q), R_t)^2 + lambda_s |q - q_{t-1}|^2 + E_coll(q),   within the joint limits

E_coll = w sum of [margin - height]_+^2 over the lowest points above the table of the hand and of each of the arm's
links.

Shape letters: B batch (sequences, branches or restarts), n arm joints, C carriers, G links with support points.
"""

from __future__ import annotations

import torch
from torch import Tensor

from xreset.geometry.rotations import (
    matrix_to_quat,
    quat_conjugate,
    quat_multiply,
    quat_to_axis_angle,
)
from xreset.retarget.arm.model import ArmProblem
from xreset.retarget.least_squares import Quadratic, free_to_move, minimize

_CONVERGED = 1e-5
"""Steps smaller than this end the iteration [rad or m]."""


def solve(frame: ArmProblem, q: Tensor, iterations: int, previous: Tensor | None = None) -> Tensor:
    """[B, n] minimizer of one frame's cost, from ``q``: Levenberg-Marquardt, each element of the batch with its own
    damping.

    A joint at a limit stays there while the cost pulls it outwards; steps beyond a limit are cut off there.

    Args:
        frame: the problem of one frame, without the axis T.
        q: [B, n] first guess.
        iterations: most steps.
        previous: [B, n] joints of the frame before; None where there is none.
    """
    model = frame.model

    def evaluate(q: Tensor, _: Tensor) -> Quadratic:
        return system(frame, q, previous)

    def step(q: Tensor, here: Quadratic, damping: Tensor) -> Tensor:
        free = free_to_move(q, here.gradient, model.lower, model.upper)
        ridge = damping[:, None] * here.curvature.diagonal(dim1=-2, dim2=-1).clamp_min(
            1e-3
        ) * free + (1.0 - free)
        H = here.curvature * free[:, :, None] * free[:, None, :] + torch.diag_embed(ridge)
        moved = q + torch.linalg.solve(H, -here.gradient * free)
        return torch.minimum(torch.maximum(moved, model.lower), model.upper)

    def done(
        before: Tensor, after: Tensor, *_: Tensor
    ) -> Tensor:  # all together: the batch keeps its size
        return ((after - before).abs() < _CONVERGED).all().expand(len(before))

    return minimize(q, evaluate, step, done, iterations, damping_range=(1e-9, 1e9))


def system(frame: ArmProblem, q: Tensor, previous: Tensor | None = None) -> Quadratic:
    """Compute the cost of one frame and its Gauss-Newton approximation at ``q`` [B, n]; arguments as of
    :func:`solve`."""
    model = frame.model
    config = frame.config
    origins, rot, linear, angular = model.kinematics.jacobian(model.full(q, 0.0), model.carriers)
    linear = linear[..., model.arm]  # [B, C, 3, n]
    angular = angular[..., model.arm]
    position_scale = config.position_weight**0.5
    orientation_scale = config.orientation_weight**0.5
    turn = quat_to_axis_angle(
        quat_multiply(matrix_to_quat(rot[:, 0]), quat_conjugate(frame.root_quat))
    )
    residuals = [
        position_scale * (origins[:, 0] - frame.root_pos),
        orientation_scale * turn,
    ]
    jacobians = [
        position_scale * linear[:, 0],
        orientation_scale * angular[:, 0],
    ]
    if previous is not None:
        scale = config.smoothness_weight**0.5
        residuals.append(scale * (q - previous))
        jacobians.append(scale * torch.eye(q.shape[1], dtype=q.dtype).expand(len(q), -1, -1))
    low = model.low_points(origins, rot, frame.hand_poses, config.table_margin)
    at = (low.frame, low.carrier)
    lift = linear[at] + torch.linalg.cross(angular[at], low.lever[..., None], dim=1)
    scale = config.collision_weight**0.5
    value = scale * (config.table_margin - low.height)
    residuals.append(q.new_zeros(linear.shape[:2]).index_put(at, value))
    jacobians.append(q.new_zeros(linear[:, :, 0].shape).index_put(at, -scale * lift[:, 2]))
    return Quadratic.of_residuals(torch.cat(residuals, dim=1), torch.cat(jacobians, dim=1))
