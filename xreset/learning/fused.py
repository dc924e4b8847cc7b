"""The PointNet as one GPU kernel: a cloud's activations never leave the chip (Triton, bfloat16 products, float32 sums).

The plain layers write some 500 values per point to memory and read them back, forward and backward; that, not
arithmetic, is their cost. Here one program takes a cloud through all three layers and the maximum. The backward kernel
computes the activations again and starts from the points that were the maximum of a channel: no other point has a
gradient.

Letters: F clouds, P points, K numbers per point, A, B, C widths of the three layers.
:class:`xreset.learning.model.PointNet` is the reference.
"""

# Triton takes plain numbers for its constants; a type checker sees the kernels' own declarations.
# pyright: reportArgumentType=false

from __future__ import annotations

import functools
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

FACTORS = torch.bfloat16
"""Precision of the matrix products' factors. (Triton's interpreter, with which tests run the kernels on a CPU, knows no
bfloat16.)"""
_FORWARD = {"num_warps": 2, "num_stages": 3}
_BACKWARD = {"num_warps": 4, "num_stages": 1}
_FORWARD_PROGRAMS = 8
_BACKWARD_PROGRAMS = 2
"""Programs on each multiprocessor; each loops over clouds and loads the weights once. These settings were the fastest
ones tried on an H100: 65,536 clouds of 64 points forward in 0.8 ms and backward in 3.6 ms, where plain layers in
bfloat16 take 12.5 ms."""


@triton.jit
def _elu(x):
    return tl.where(x > 0, x, tl.exp(tl.minimum(x, 0.0)) - 1.0)


@triton.jit
def _elu_slope(activated):
    return tl.where(activated > 0, 1.0, activated + 1.0)


@triton.jit
def _first_layer(cloud, frame, w1, b1, P: tl.constexpr, K: tl.constexpr, A: tl.constexpr):
    """The first layer before its activation [P, A]: K multiplications, no matrix product."""
    p = tl.arange(0, P)
    a = tl.arange(0, A)
    point = cloud + frame * (K * P) + p * K
    total = tl.load(point)[:, None] * tl.load(w1 + a * K)[None, :]
    for k in tl.static_range(1, K):  # pyright: ignore[reportGeneralTypeIssues]
        total += tl.load(point + k)[:, None] * tl.load(w1 + a * K + k)[None, :]
    return total + tl.load(b1 + a)[None, :]


@triton.jit
def _points(cloud, frame, low, P: tl.constexpr, K: tl.constexpr, W: tl.constexpr):
    """[P, W] a point's K numbers, 1, then what rounding took from the numbers, then zeros.

    With these columns, sums over points are products of the matrix units, too.
    """
    p = tl.arange(0, P)
    column = tl.arange(0, W)
    number = column % (K + 1)
    at = cloud + frame * (K * P) + p[:, None] * K + number[None, :]
    exact = tl.load(at, mask=(number < K)[None, :], other=1.0)
    rounded = exact.to(low)
    rest = tl.where((column < 2 * K + 1)[None, :], exact - rounded.to(tl.float32), 0.0).to(low)
    return tl.where((column < K + 1)[None, :], rounded, rest)


@triton.jit
def _forward(
    cloud, w1, b1, w2, b2, w3, b3, out, winner, frames,
    P: tl.constexpr, K: tl.constexpr, A: tl.constexpr, B: tl.constexpr, C: tl.constexpr,
):  # fmt: skip
    a = tl.arange(0, A)
    b = tl.arange(0, B)
    c = tl.arange(0, C)
    second = tl.load(w2 + b[None, :] * A + a[:, None])  # [A, B], in the factors' precision
    third = tl.load(w3 + c[None, :] * B + b[:, None])  # [B, C]
    bias2 = tl.load(b2 + b)
    bias3 = tl.load(b3 + c)
    for frame in range(tl.program_id(0), frames, tl.num_programs(0)):
        z2 = (
            tl.dot(_elu(_first_layer(cloud, frame, w1, b1, P, K, A)).to(second.dtype), second)
            + bias2[None, :]
        )
        z3 = tl.dot(_elu(z2).to(second.dtype), third)
        best, point = tl.max(z3, axis=0, return_indices=True)
        at = frame * C + c
        tl.store(out + at, best + bias3)
        tl.store(winner + at, point.to(tl.int16))


@triton.jit
def _backward(
    cloud, w1, b1, w2, b2, w3, gradient, winner, d1, d2, db2, d3, frames,
    P: tl.constexpr, K: tl.constexpr, A: tl.constexpr, B: tl.constexpr, C: tl.constexpr,
    W: tl.constexpr, LOWER: tl.constexpr,
):  # fmt: skip
    """One partial sum per program: of d1 [W, A], d2 [A, B] and db2 [W, B] if LOWER, else of d3 [B, C].

    The rows of d1 and db2 are the columns of :func:`_points`. Together the sums would not fit into the registers.
    """
    a = tl.arange(0, A)
    b = tl.arange(0, B)
    c = tl.arange(0, C)
    p = tl.arange(0, P)
    k = tl.arange(0, W)
    second = tl.load(w2 + b[None, :] * A + a[:, None])  # [A, B]
    second_t = tl.load(w2 + b[:, None] * A + a[None, :])  # [B, A]
    third_t = tl.load(w3 + c[:, None] * B + b[None, :])  # [C, B]
    bias2 = tl.load(b2 + b)
    sum_1 = tl.zeros([W, A], tl.float32)
    sum_2 = tl.zeros([A, B], tl.float32)
    sum_b2 = tl.zeros([W, B], tl.float32)
    sum_3 = tl.zeros([B, C], tl.float32)
    for frame in range(tl.program_id(0), frames, tl.num_programs(0)):
        a1 = _elu(_first_layer(cloud, frame, w1, b1, P, K, A))
        a1_low = a1.to(second.dtype)
        a2 = _elu(tl.dot(a1_low, second) + bias2[None, :])
        at = frame * C + c
        g3 = tl.where(
            tl.load(winner + at).to(tl.int32)[None, :] == p[:, None],
            tl.load(gradient + at)[None, :],
            0.0,
        ).to(second.dtype)
        if LOWER:
            points = tl.trans(_points(cloud, frame, second.dtype, P, K, W))
            g2 = (tl.dot(g3, third_t) * _elu_slope(a2)).to(second.dtype)
            sum_b2 = tl.dot(points, g2, sum_b2)
            sum_2 = tl.dot(tl.trans(a1_low), g2, sum_2)
            g1 = (tl.dot(g2, second_t) * _elu_slope(a1)).to(second.dtype)
            sum_1 = tl.dot(points, g1, sum_1)
        else:
            sum_3 = tl.dot(tl.trans(a2.to(second.dtype)), g3, sum_3)
    program = tl.program_id(0)
    if LOWER:
        tl.store(d1 + program * W * A + k[:, None] * A + a[None, :], sum_1)
        tl.store(d2 + program * A * B + a[:, None] * B + b[None, :], sum_2)
        tl.store(db2 + program * W * B + k[:, None] * B + b[None, :], sum_b2)
    else:
        tl.store(d3 + program * B * C + b[:, None] * C + c[None, :], sum_3)


class _FusedPointNet(torch.autograd.Function):
    """(cloud [F, P, K], weights and biases of three layers) -> [F, C]. Clouds are observations: they get no
    gradient."""

    @staticmethod
    def forward(
        ctx: Any,
        cloud: Tensor,
        w1: Tensor,
        b1: Tensor,
        w2: Tensor,
        b2: Tensor,
        w3: Tensor,
        b3: Tensor,
    ) -> Tensor:
        frames, points, width = cloud.shape
        sizes = {"P": points, "K": width, "A": len(w1), "B": len(w2), "C": len(w3)}
        if cloud.numel() >= 2**31:
            raise ValueError(
                f"{frames} clouds of {points} points are more than the kernels can address at once; pass fewer"
            )
        low2 = w2.to(FACTORS)
        low3 = w3.to(FACTORS)
        out = torch.empty(frames, len(w3), device=cloud.device)
        winner = torch.empty(frames, len(w3), dtype=torch.int16, device=cloud.device)
        grid = (min(frames, _FORWARD_PROGRAMS * _processors(cloud.device)),)
        _forward[grid](cloud, w1, b1, low2, b2, low3, b3, out, winner, frames, **sizes, **_FORWARD)
        ctx.save_for_backward(cloud, w1, b1, low2, b2, low3, winner)
        ctx.sizes = sizes
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        cloud, w1, b1, low2, b2, low3, winner = ctx.saved_tensors
        gradient = gradients[0].contiguous()
        programs = min(len(cloud), _BACKWARD_PROGRAMS * _processors(cloud.device))
        a = len(w1)
        b = len(low2)
        c = len(low3)

        def partial_sums(*shape: int) -> Tensor:
            return torch.empty(programs, *shape, device=cloud.device)

        width = ctx.sizes["K"]
        # columns of _points: the least power of two that holds 2 K + 1, and 16 at least
        columns = max(16, 1 << (2 * width).bit_length())
        d1 = partial_sums(columns, a)
        d2 = partial_sums(a, b)
        db2 = partial_sums(columns, b)
        d3 = partial_sums(b, c)
        for lower in (False, True):
            _backward[(programs,)](
                cloud, w1, b1, low2, b2, low3, gradient, winner, d1, d2, db2, d3, len(cloud),
                **ctx.sizes, W=columns, LOWER=lower, **_BACKWARD,
            )  # fmt: skip
        first = d1.sum(dim=0)
        return (
            None,
            (first[:width] + first[width + 1 : 2 * width + 1]).T,
            first[width],
            d2.sum(dim=0).T,
            db2[:, width].sum(dim=0),
            d3.sum(dim=0).T,
            gradient.sum(dim=0),
        )


@functools.cache
def _processors(device: torch.device) -> int:
    """Multiprocessors of a GPU; 2 elsewhere, where Triton's interpreter runs the programs one after the other."""
    if device.type != "cuda":
        return 2
    return torch.cuda.get_device_properties(device).multi_processor_count


def supports(points: int, widths: tuple[int, ...]) -> bool:
    """Whether the kernels can take clouds of that many points through layers of these widths: three of them, powers of
    two."""
    return (
        len(widths) == 3
        and all(n >= 16 and n & (n - 1) == 0 for n in (points, *widths))
        and max(widths) <= 128
        and points <= 128
    )


def fused_pointnet(
    cloud: Tensor, w1: Tensor, b1: Tensor, w2: Tensor, b2: Tensor, w3: Tensor, b3: Tensor
) -> Tensor:
    """Embed clouds [..., P, K] as [..., C]: layers K -> A -> B -> C (weights as in ``nn.Linear``) with ELU between,
    maximum over points.

    Matrix products take bfloat16 factors: against the plain layers in float32 the result differs by some 1e-3 of its
    size.
    """
    frames = cloud.reshape(-1, *cloud.shape[-2:]).contiguous()
    embedded: Any = _FusedPointNet.apply(frames, w1, b1, w2, b2, w3, b3)
    return embedded.reshape(*cloud.shape[:-2], -1)
