"""Quaternions and rotations over batched torch tensors: pure functions, (w, x, y, z), last dimension first come.

For numpy arrays use ``scipy.spatial.transform.Rotation`` with ``scalar_first=True``.
"""

from __future__ import annotations

import torch
from torch import Tensor


def quat_multiply(a: Tensor, b: Tensor) -> Tensor:
    """[..., 4] Hamilton product: rotation b first, then a; both broadcast."""
    aw, u, bw, v = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    product = a * b
    w = product[..., :1] - product[..., 1:].sum(dim=-1, keepdim=True)
    return torch.cat((w, torch.addcmul(torch.addcmul(torch.linalg.cross(u, v), aw, v), bw, u)), dim=-1)


def quat_conjugate(q: Tensor) -> Tensor:
    """[..., 4] the inverse of a unit quaternion."""
    return torch.cat((q[..., :1], -q[..., 1:]), dim=-1)


def quat_rotate(q: Tensor, v: Tensor) -> Tensor:
    """[..., 3] vector v turned by the unit quaternion q [..., 4]; both broadcast."""
    w, u = q[..., :1], q[..., 1:]
    u, v = torch.broadcast_tensors(u, v)
    t = 2.0 * torch.linalg.cross(u, v)
    return torch.addcmul(v, w, t) + torch.linalg.cross(u, t)


def quat_rotate_inverse(q: Tensor, v: Tensor) -> Tensor:
    """[..., 3] vector v turned by the inverse of the unit quaternion q."""
    return quat_rotate(quat_conjugate(q), v)


def quat_normalize(q: Tensor) -> Tensor:
    """[..., 4] unit quaternion with w >= 0."""
    q = q / q.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    return torch.where(q[..., :1] < 0, -q, q)


def quat_angle(a: Tensor, b: Tensor) -> Tensor:
    """[...] geodesic distance between two orientations, in [0, pi] rad."""
    d = quat_multiply(quat_conjugate(a), b)
    return 2.0 * torch.atan2(d[..., 1:].norm(dim=-1), d[..., 0].abs())


def quat_from_axis_angle(v: Tensor) -> Tensor:
    """[..., 4] unit quaternion of a rotation vector [..., 3] (axis times angle, rad)."""
    half = v.norm(dim=-1, keepdim=True) / 2.0
    return torch.cat((torch.cos(half), torch.sinc(half / torch.pi) * v / 2.0), dim=-1)


def quat_to_axis_angle(q: Tensor) -> Tensor:
    """[..., 3] rotation vector (axis times angle in [0, pi], rad) of a unit quaternion."""
    q = torch.where(q[..., :1] < 0, -q, q)
    s = q[..., 1:].norm(dim=-1, keepdim=True)
    angle = 2.0 * torch.atan2(s, q[..., :1])
    return torch.where(s > 1e-9, q[..., 1:] * angle / s.clamp_min(1e-12), 2.0 * q[..., 1:])


def quat_to_matrix(q: Tensor) -> Tensor:
    """[..., 3, 3] rotation matrix of a unit quaternion [..., 4]."""
    turned = quat_rotate(
        q[..., None, :], torch.eye(3, dtype=q.dtype, device=q.device)
    )  # the unit vectors: the matrix's columns
    return turned.mT


def matrix_to_quat(R: Tensor) -> Tensor:
    """[..., 4] unit quaternion (w >= 0) of a rotation matrix [..., 3, 3].

    The largest of the four candidates is used (Shepperd's method), so there is no loss of precision near half turns.
    """
    m = R
    t = torch.stack(
        (
            1 + m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2],
            1 + m[..., 0, 0] - m[..., 1, 1] - m[..., 2, 2],
            1 - m[..., 0, 0] + m[..., 1, 1] - m[..., 2, 2],
            1 - m[..., 0, 0] - m[..., 1, 1] + m[..., 2, 2],
        ),
        dim=-1,
    )
    a, b, c = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    d, e, f = m[..., 1, 0] + m[..., 0, 1], m[..., 0, 2] + m[..., 2, 0], m[..., 2, 1] + m[..., 1, 2]
    candidates = torch.stack(
        (
            torch.stack((t[..., 0], a, b, c), dim=-1),
            torch.stack((a, t[..., 1], d, e), dim=-1),
            torch.stack((b, d, t[..., 2], f), dim=-1),
            torch.stack((c, e, f, t[..., 3]), dim=-1),
        ),
        dim=-2,
    )
    best = t.argmax(dim=-1)[..., None, None].expand(*t.shape[:-1], 1, 4)
    return quat_normalize(candidates.gather(-2, best).squeeze(-2))
