"""Quaternions and rotations over batched torch tensors: pure functions. Quaternions are (w, x, y, z) in the last
dimension.

For numpy arrays use ``scipy.spatial.transform.Rotation`` with ``scalar_first=True``.
"""

from __future__ import annotations

import torch
from torch import Tensor


def quat_multiply(a: Tensor, b: Tensor) -> Tensor:
    """[..., 4] Hamilton product: rotation b first, then a; both broadcast, with equally many dimensions."""
    aw, u = a.split((1, 3), dim=-1)
    bw, v = b.split((1, 3), dim=-1)
    pw, products = (a * b).split((1, 3), dim=-1)
    w = pw - products.sum(dim=-1, keepdim=True)
    xyz = torch.addcmul(torch.addcmul(torch.linalg.cross(u, v), aw, v), bw, u)
    return torch.cat((w, xyz), dim=-1)


def quat_conjugate(q: Tensor) -> Tensor:
    """[..., 4] inverse of a unit quaternion."""
    return torch.cat((q[..., :1], -q[..., 1:]), dim=-1)


def quat_rotate(q: Tensor, v: Tensor) -> Tensor:
    """[..., 3] vector v rotated by the unit quaternion q [..., 4]; both broadcast."""
    w, u = q.split((1, 3), dim=-1)
    u, v = torch.broadcast_tensors(u, v)
    t = 2.0 * torch.linalg.cross(u, v)
    return torch.addcmul(v, w, t) + torch.linalg.cross(u, t)


def quat_rotate_inverse(q: Tensor, v: Tensor) -> Tensor:
    """[..., 3] vector v rotated by the inverse of the unit quaternion q."""
    return quat_rotate(quat_conjugate(q), v)


def relative_pose(
    pos: Tensor, quat: Tensor, frame_pos: Tensor, frame_quat: Tensor
) -> tuple[Tensor, Tensor]:
    """Return positions [..., 3] and orientations [..., 4] in the frames that have the poses ``frame_...``."""
    relative = quat_rotate_inverse(frame_quat, pos - frame_pos)
    return relative, quat_multiply(quat_conjugate(frame_quat), quat)


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
    unit_vectors = torch.eye(3, dtype=q.dtype, device=q.device)
    columns = quat_rotate(q[..., None, :], unit_vectors)
    return columns.mT


def matrix_to_quat(R: Tensor) -> Tensor:
    """[..., 4] unit quaternion (w >= 0) of a rotation matrix [..., 3, 3].

    Shepperd's method: of the four candidates, the one with the largest divisor is used, so half turns lose no
    precision.
    """
    x, y, z = R.diagonal(dim1=-2, dim2=-1).unbind(-1)
    antisymmetric = R - R.mT
    symmetric = R + R.mT
    a = antisymmetric[..., 2, 1]
    b = antisymmetric[..., 0, 2]
    c = antisymmetric[..., 1, 0]
    d = symmetric[..., 1, 0]
    e = symmetric[..., 0, 2]
    f = symmetric[..., 2, 1]
    t = torch.stack((1 + x + y + z, 1 + x - y - z, 1 - x + y - z, 1 - x - y + z), dim=-1)
    t0, t1, t2, t3 = t.unbind(-1)
    candidates = torch.stack(
        (t0, a, b, c, a, t1, d, e, b, d, t2, f, c, e, f, t3), dim=-1
    ).unflatten(-1, (4, 4))
    best = t.argmax(dim=-1)[..., None, None].expand(*t.shape[:-1], 1, 4)
    return quat_normalize(candidates.gather(-2, best).squeeze(-2))


def matrix_to_axis_angle(R: Tensor) -> Tensor:
    """[..., 3] rotation vector (axis times angle in [0, pi], rad) of a rotation matrix [..., 3, 3].

    With a fifth of the operations of the way through quaternions, which is taken next to a half turn, where R is nearly
    symmetric.
    """
    trace = R.diagonal(dim1=-2, dim2=-1).sum(dim=-1, keepdim=True)  # 1 + 2 cos(angle)
    if (trace < -1.0 + 1e-5).any():
        return quat_to_axis_angle(matrix_to_quat(R))
    v = (R - R.mT).flatten(-2)[..., [7, 2, 3]]  # 2 sin(angle) times the axis
    size = v.norm(dim=-1, keepdim=True)
    angle = torch.atan2(size, trace - 1.0)
    return v * torch.where(size > 1e-9, angle / size.clamp_min(1e-12), 0.5)


def homogeneous(R: Tensor, pos: Tensor) -> Tensor:
    """[..., 4, 4] pose of a rotation matrix [..., 3, 3] and a position [..., 3]."""
    T = pos.new_zeros(*pos.shape[:-1], 4, 4)
    T[..., :3, :3] = R
    T[..., :3, 3] = pos
    T[..., 3, 3] = 1.0
    return T


def matvec(matrix: Tensor, vector: Tensor) -> Tensor:
    """[..., n] product of matrices [..., n, m] and vectors [..., m]; both broadcast."""
    return (matrix @ vector[..., None])[..., 0]
