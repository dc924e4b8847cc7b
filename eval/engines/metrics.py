"""How far two recordings of the same episode differ, in one number each, and how far they may.

The first recording is the engine's under test, the second the reference's. Shape letters as in :mod:`xreset.eval.engines.recording`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from torch import Tensor

from xreset.eval.engines.recording import Recording


@dataclass(frozen=True, kw_only=True)
class Metric:
    """One row of the table."""

    name: str
    claim: str
    """What is compared, and how."""
    unit: str
    target: float
    sense: Literal["at most", "at least"]
    measured: float
    """NaN if nothing could be compared."""
    n: int
    """How many numbers it is taken over."""
    detail: dict[str, Any] = field(default_factory=dict)
    """What else helps to judge it."""

    @property
    def ok(self) -> bool:
        """Whether the target is met; a number that could not be measured does not meet it."""
        return self.measured <= self.target if self.sense == "at most" else self.measured >= self.target

    def as_dict(self) -> dict[str, Any]:
        """JSON-able content; null where nothing could be compared."""
        return {
            "metric": self.name,
            "claim": self.claim,
            "unit": self.unit,
            "target": self.target,
            "sense": self.sense,
            "measured": self.measured if math.isfinite(self.measured) else None,
            "n": self.n,
            "verdict": "met" if self.ok else "missed",
            "detail": self.detail,
        }


PRESS_FLOOR = 0.5
"""Forces below this [N] in both engines are no press."""


def press_metrics(found: Recording, reference: Recording, steps: int) -> list[Metric]:
    """Forces with which a hand presses on an object that does not move, averaged over the last control steps."""
    force, expected = (recording.tip_force[-steps:].mean(0) for recording in (found, reference))
    press, other = force.norm(dim=-1), expected.norm(dim=-1)
    total, other_total = press.sum(-1), other.sum(-1)
    firm = torch.maximum(total, other_total) > PRESS_FLOOR
    pressed = torch.maximum(press, other) > PRESS_FLOOR
    total_error = ((total - other_total).abs() / torch.maximum(total, other_total))[firm]
    tip_error = ((force - expected).norm(dim=-1) / torch.maximum(press, other))[pressed]
    bias = ((total - other_total) / torch.maximum(total, other_total))[firm]
    return [
        Metric(
            name="press, total",
            claim="sum of the fingertips' forces on a fixed object: relative difference, median over the grasps",
            unit="",
            target=0.10,
            sense="at most",
            measured=_median(total_error),
            n=len(total_error),
            detail={
                "bias": _rounded(_median(bias)),
                "p90": _rounded(_quantile(total_error, 0.9)),
                "median_force_N": _rounded(_median(other_total)),
            },
        ),
        Metric(
            name="press, fingertip",
            claim="force vector of a fingertip on a fixed object: relative difference, median over all fingertips that press",
            unit="",
            target=0.30,
            sense="at most",
            measured=_median(tip_error),
            n=len(tip_error),
            detail={
                "p90": _rounded(_quantile(tip_error, 0.9)),
                "touch_same": _rounded(_share((press > PRESS_FLOOR) == (other > PRESS_FLOOR))),
            },
        ),
    ]


def carried(recording: Recording, lift: float) -> Tensor:
    """[G] bool: whether the object ends up at least half as much higher than it began as the palm was lifted [m]."""
    return (recording.object_pos[-1, :, 2] - recording.start.object_pos[:, 2] > lift / 2) & ~recording.broken


def outcome_metric(name: str, claim: str, target: float, found: Tensor, reference: Tensor) -> Metric:
    """Share of the tries [n] bool that end alike, carried or not."""
    return Metric(
        name=name,
        claim=claim,
        unit="",
        target=target,
        sense="at least",
        measured=_share(found == reference),
        n=len(found),
        detail={
            "both": int((found & reference).sum()),
            "neither": int((~found & ~reference).sum()),
            "only_here": int((found & ~reference).sum()),
            "only_in_reference": int((~found & reference).sum()),
        },
    )


def palm_metric(distances: Tensor) -> Metric:
    """The distances [n] of :func:`palm_distance`, over all grasps that both engines hold."""
    return Metric(
        name="hold, object in palm",
        claim="object in the palm's frame after lift and shake: mean distance of its surface points, median over grasps that both hold",
        unit="mm",
        target=4.0,
        sense="at most",
        measured=1e3 * _median(distances),
        n=len(distances),
        detail={"p90": _rounded(1e3 * _quantile(distances, 0.9))},
    )


def palm_distance(found: Recording, reference: Recording, points: Tensor) -> Tensor:
    """[G] mean distance of the objects' surface points [G, P, 3] in the palm's frame at the end [m]: place and orientation in one."""
    return (found.in_palm(-1, points) - reference.in_palm(-1, points)).norm(dim=-1).mean(-1)


def path_difference(found: Recording, reference: Recording) -> tuple[Tensor, Tensor]:
    """After each step, the joint that differs most [T, G] (rad, m) and the distance between the objects' origins [T, G] (m)."""
    joints = (found.joint_pos - reference.joint_pos).abs().amax(-1)
    return joints, (found.object_pos - reference.object_pos).norm(dim=-1)


def path_metrics(joints: Tensor, distance: Tensor) -> list[Metric]:
    """The differences [T, G] of paths in contact: between engines that solve the same equations only, for long contact is chaotic."""
    thing = 1e3 * distance
    what = "over all control steps and grasps"
    return [
        Metric(
            name="path, joints",
            claim=f"the joint that differs most, median {what}",
            unit="rad",
            target=5e-4,
            sense="at most",
            measured=_median(joints),
            n=joints.numel(),
            detail={"worst": _rounded(_largest(joints))},
        ),
        Metric(
            name="path, object",
            claim=f"distance of the object's origins, median {what}",
            unit="mm",
            target=0.05,
            sense="at most",
            measured=_median(thing),
            n=thing.numel(),
        ),
        Metric(
            name="path, object, worst",
            claim=f"distance of the object's origins, largest {what}",
            unit="mm",
            target=1.0,
            sense="at most",
            measured=_largest(thing),
            n=thing.numel(),
            detail={"grasps_above": int((thing.amax(0) > 1.0).sum()) if thing.numel() else 0},
        ),
    ]


def _median(values: Tensor) -> float:
    return _quantile(values, 0.5)


def _quantile(values: Tensor, q: float) -> float:
    """NaN if there are none, or one is NaN."""
    return float(values.double().flatten().quantile(q)) if values.numel() else math.nan


def _largest(values: Tensor) -> float:
    return float(values.max()) if values.numel() else math.nan


def _share(flags: Tensor) -> float:
    return float(flags.double().mean()) if flags.numel() else math.nan


def _rounded(value: float) -> float | None:
    return float(f"{value:.4g}") if math.isfinite(value) else None


def met(metrics: Sequence[Metric]) -> bool:
    """Whether all targets are met."""
    return all(metric.ok for metric in metrics)
