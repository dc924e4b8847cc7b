"""The comparison of engines: they try the same grasps, and are measured against a reference.

Where two recordings of the same episode are compared, the first is of the tested engine, the second of the reference.
Shape letters as in :mod:`xreset.eval.engines.recording`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from xreset.eval.engines.grasps import Frames, Grasps, find_grasps
from xreset.eval.engines.recording import OpenLoopEpisode, Recording, record
from xreset.eval.engines.trials import CommonStates, ParityConfig, common_states, try_closings, try_holds
from xreset.eval.trial import Engine, engine
from xreset.objects.sampling import surface_points
from xreset.physics import Backend
from xreset.spec import ObjectSpec, RobotSpec, SceneSpec

REFERENCE = "mujoco"
SCHEMA = "xreset-parity/1"
SURFACE_POINTS = 64
"""Points on an object's surface for the distance between two poses."""
PRESS_FLOOR = 0.5
"""Forces below this [N] in both engines are no press."""

_ON_FIXED = "on a fixed object: relative difference, median over"
_OVER_ALL = "over all control steps and grasps"
_DIFFERENCE = "distance of the object's origins"
_TARGETS = {
    "press, total": (f"sum of the fingertips' forces {_ON_FIXED} the grasps", "", "at most", 0.10),
    "press, fingertip": (f"force vector of a fingertip {_ON_FIXED} all fingertips that press", "", "at most", 0.30),
    "hold, outcome": (
        "lift and shake from one common state at pair frictions {}: share that end alike",
        "",
        "at least",
        0.85,
    ),
    "hold, object in palm": (
        "object in the palm's frame after lift and shake: mean distance of its surface points, "
        "median over grasps that both hold",
        "mm",
        "at most",
        4.0,
    ),
    "closing, outcome": (
        "hand closes, lifts and shakes: share of the grasps that end alike, carried or not",
        "",
        "at least",
        0.80,
    ),
    "path, joints": (f"the joint that differs most, median {_OVER_ALL}", "rad", "at most", 5e-4),
    "path, object": (f"{_DIFFERENCE}, median {_OVER_ALL}", "mm", "at most", 0.05),
    "path, object, worst": (f"{_DIFFERENCE}, largest {_OVER_ALL}", "mm", "at most", 1.0),
}
"""Name of a metric -> claim, unit, and the target: at most or at least a value."""


@dataclass(frozen=True, kw_only=True)
class Metric:
    """One row of the table."""

    name: str
    measured: float
    """NaN if nothing could be compared."""
    n: int
    """How many numbers it is taken over."""
    detail: dict[str, Any] = field(default_factory=dict)
    """What else helps to judge it."""
    frictions: tuple[float, ...] = ()
    """Pair frictions of the holds, for the claim."""

    @property
    def unit(self) -> str:
        """Unit of the measured number; empty for a share."""
        return _TARGETS[self.name][1]

    @property
    def sense(self) -> str:
        """``at most`` or ``at least``."""
        return _TARGETS[self.name][2]

    @property
    def target(self) -> float:
        """The value of the target."""
        return _TARGETS[self.name][3]

    @property
    def ok(self) -> bool:
        """Whether the target is met; a number that could not be measured does not meet it."""
        return self.measured <= self.target if self.sense == "at most" else self.measured >= self.target

    def as_dict(self) -> dict[str, Any]:
        """Return JSON-able content; null where nothing could be compared."""
        return {
            "metric": self.name,
            "claim": _TARGETS[self.name][0].format(", ".join(f"{mu:g}" for mu in self.frictions)),
            "unit": self.unit,
            "target": self.target,
            "sense": self.sense,
            "measured": self.measured if math.isfinite(self.measured) else None,
            "n": self.n,
            "verdict": "met" if self.ok else "missed",
            "detail": self.detail,
        }


@dataclass(frozen=True, kw_only=True)
class EngineParity:
    """Results of one engine."""

    engine: Engine
    metrics: tuple[Metric, ...]
    """Against the reference; empty for the reference itself."""
    carried: dict[str, tuple[bool, ...]]
    """For each kind of try (``closing``, ``hold 0.5``, ...), which grasps carried their object."""
    broken: int
    """Worlds that were not finite or dropped contacts, over all tries."""

    @property
    def ok(self) -> bool:
        """Whether every target is met."""
        return all(metric.ok for metric in self.metrics)

    def as_dict(self) -> dict[str, Any]:
        """Return JSON-able content."""
        return {
            "backend": self.engine.name,
            "version": self.engine.version,
            "device": self.engine.device,
            "metrics": [metric.as_dict() for metric in self.metrics],
            "carried": {name: list(flags) for name, flags in self.carried.items()},
            "broken_worlds": self.broken,
        }


@dataclass(frozen=True, kw_only=True)
class Parity:
    """Results of a comparison."""

    robot: RobotSpec
    objects: tuple[ObjectSpec, ...]
    reference: EngineParity
    floor: EngineParity
    """The reference with half its timestep: how far two honest solutions of the same equations differ."""
    engines: tuple[EngineParity, ...]
    closing: Grasps
    hold: CommonStates

    def as_dict(self) -> dict[str, Any]:
        """Return JSON-able content."""
        grasps = {}
        for name, tried in (("closing", self.closing), ("hold", self.hold)):
            rows = []
            for label, i in zip(tried.label, tried.object_index.tolist(), strict=True):
                rows.append({"grasp": label, "object": self.objects[i].name})
            grasps[name] = rows
        return {
            "schema": SCHEMA,
            "robot": self.robot.name,
            "robot_fingerprint": self.robot.fingerprint,
            "objects": [{"name": o.name, "source": o.source} for o in self.objects],
            "reference": self.reference.as_dict(),
            "floor": self.floor.as_dict(),
            "engines": [tested.as_dict() for tested in self.engines],
            "grasps": grasps,
            "ok": all(tested.ok for tested in self.engines),
        }


@dataclass(kw_only=True)
class _Tries:
    """Recordings of one engine; None: not tried."""

    press: Recording | None = None
    closing: Recording | None = None
    holds: tuple[Recording, ...] = ()
    path: Recording | None = None


def compare(
    robot: RobotSpec,
    objects: Sequence[ObjectSpec],
    frames: Frames,
    engines: Iterable[Engine],
    *,
    grasps: int = 48,
    config: ParityConfig | None = None,
    reference: Engine | None = None,
    progress: Callable[[str, int, int], None] = lambda doing, done, total: None,
) -> Parity:
    """Measure engines against the reference.

    Args:
        robot: the robot.
        objects: geometry; frames of other objects are left out.
        frames: where grasps are taken from.
        engines: the engines to measure.
        grasps: number of closings, and of holds from common states.
        config: what is tried.
        reference: default: the backend ``mujoco``.
        progress: called with (what is being done, tries done, tries in all).

    Raises:
        DemoError: the frames show no grasp.
    """
    config = config or ParityConfig()
    engines = tuple(engines)
    reference = reference or engine(REFERENCE)
    floor = _at_half_timestep(reference)
    scene = SceneSpec(robot=robot, objects=tuple(objects))
    whole = [reference, floor, *(e for e in engines if e.grasps)]
    stepwise = [reference, *(e for e in engines if e.path)]
    tries = {e.name: _Tries() for e in (*whole, *stepwise)}
    total = 2 * len(whole) + len(stepwise)

    table = find_grasps(frames, robot, objects, grasps, where="table")
    for done, e in enumerate(whole):
        progress(f"{e.name}: closing {len(table)} hands", done, total)
        tries[e.name].press, tries[e.name].closing = try_closings(e, scene, table, config)
    closings = {}
    for e in whole:
        closing = tries[e.name].closing
        if closing is not None and e is not floor:
            closings[e.name] = closing
    air = find_grasps(frames, robot, objects, grasps, where="air")
    common = common_states(robot, table, air, closings, grasps, scene.control_dt, config)
    for done, e in enumerate(whole, len(whole)):
        progress(f"{e.name}: holding {len(common.label)} objects", done, total)
        tries[e.name].holds = try_holds(e, scene, common, config)
    height = config.motion.height
    firm = torch.stack([carried(recording, height) for recording in tries[reference.name].holds]).all(0)
    if len(stepwise) > 1 and bool(firm.any()):
        held = common[firm.nonzero()[: config.path_grasps, 0]]
        steps = round(config.path_time / scene.control_dt)
        still = OpenLoopEpisode(start=held.start, targets=held.start.joint_target.expand(steps, -1, -1))
        for done, e in enumerate(stepwise, 2 * len(whole)):
            progress(f"{e.name}: following {len(held.label)} objects", done, total)
            tries[e.name].path = record(e, scene, held.object_index, still)
    progress("", total, total)

    surfaces = [torch.as_tensor(surface_points(o, SURFACE_POINTS), dtype=torch.float32) for o in objects]
    points = torch.stack(surfaces)[common.object_index]
    window = round(config.press_time / scene.control_dt)
    expected = tries[reference.name]

    def judged(e: Engine) -> EngineParity:
        found = tries[e.name]
        metrics: list[Metric] = []
        recordings: dict[str, Recording] = {}
        if found.press and found.closing and expected.press and expected.closing:
            recordings["closing"] = found.closing
            for mu, recording in zip(config.frictions, found.holds, strict=True):
                recordings[f"hold {mu:g}"] = recording
            metrics += press_metrics(found.press, expected.press, window)
            metrics += hold_metrics(found.holds, expected.holds, points, config)
            outcome = carried(found.closing, height)
            metrics.append(outcome_metric("closing, outcome", outcome, carried(expected.closing, height)))
        if e.path:
            if found.path and expected.path:
                metrics += path_metrics(*path_difference(found.path, expected.path))
            else:
                metrics += path_metrics(torch.zeros(0, 0), torch.zeros(0, 0))
        every = [r for r in (found.path, *recordings.values(), found.press) if r]
        return EngineParity(
            engine=e,
            metrics=() if e is reference else tuple(metrics),
            carried={name: tuple(carried(r, height).tolist()) for name, r in recordings.items()},
            broken=sum(int(r.broken.sum()) for r in every),
        )

    return Parity(
        robot=robot,
        objects=tuple(objects),
        reference=judged(reference),
        floor=judged(floor),
        engines=tuple(judged(e) for e in engines),
        closing=table,
        hold=common,
    )


def _at_half_timestep(base: Engine) -> Engine:
    def make(scene: SceneSpec, num_worlds: int, object_index: Tensor) -> Backend:
        finer = replace(scene, timestep=scene.timestep / 2, substeps=2 * scene.substeps)
        return base.make(finer, num_worlds, object_index)

    return replace(base, name=f"{base.name} at half the timestep", make=make)


# Metrics -------------------------------------------------------------------------------------------------------------


def press_metrics(found: Recording, reference: Recording, steps: int) -> list[Metric]:
    """Compare the forces of a hand on an object that does not move, averaged over the last control steps."""
    force = found.tip_force[-steps:].mean(0)
    expected = reference.tip_force[-steps:].mean(0)
    press = force.norm(dim=-1)
    other = expected.norm(dim=-1)
    total = press.sum(-1)
    other_total = other.sum(-1)
    firm = torch.maximum(total, other_total) > PRESS_FLOOR
    bias = ((total - other_total) / torch.maximum(total, other_total))[firm]
    error = bias.abs()
    pressed = torch.maximum(press, other) > PRESS_FLOOR
    tip_error = ((force - expected).norm(dim=-1) / torch.maximum(press, other))[pressed]
    same = (press > PRESS_FLOOR) == (other > PRESS_FLOOR)
    detail = {
        "bias": _rounded(_quantile(bias)),
        "p90": _rounded(_quantile(error, 0.9)),
        "median_force_N": _rounded(_quantile(other_total)),
    }
    tip_detail = {"p90": _rounded(_quantile(tip_error, 0.9)), "touch_same": _rounded(_share(same))}
    return [
        Metric(name="press, total", measured=_quantile(error), n=len(error), detail=detail),
        Metric(name="press, fingertip", measured=_quantile(tip_error), n=len(tip_error), detail=tip_detail),
    ]


def hold_metrics(
    found: Sequence[Recording], reference: Sequence[Recording], points: Tensor, config: ParityConfig
) -> list[Metric]:
    """Compare outcome and object pose over all frictions together; points [G, P, 3] of the objects' surfaces."""
    mine = torch.cat([carried(r, config.motion.height) for r in found])
    other = torch.cat([carried(r, config.motion.height) for r in reference])
    distances = torch.cat([palm_distance(a, b, points) for a, b in zip(found, reference, strict=True)])
    both = distances[mine & other]
    detail = {"p90": _rounded(1e3 * _quantile(both, 0.9))}
    return [
        replace(outcome_metric("hold, outcome", mine, other), frictions=config.frictions),
        Metric(name="hold, object in palm", measured=1e3 * _quantile(both), n=len(both), detail=detail),
    ]


def carried(recording: Recording, lift: float) -> Tensor:
    """[G] bool: whether the object ends at least half as far above its start as the palm was lifted [m]."""
    return (recording.lifted > lift / 2) & ~recording.broken


def outcome_metric(name: str, found: Tensor, reference: Tensor) -> Metric:
    """Return the share of the tries [n] bool that end alike, carried or not."""
    detail = {
        "both": int((found & reference).sum()),
        "neither": int((~found & ~reference).sum()),
        "only_here": int((found & ~reference).sum()),
        "only_in_reference": int((~found & reference).sum()),
    }
    return Metric(name=name, measured=_share(found == reference), n=len(found), detail=detail)


def palm_distance(found: Recording, reference: Recording, points: Tensor) -> Tensor:
    """[G] mean distance of the surface points [G, P, 3] in the palm's frame at the end [m]."""
    return (found.in_palm(-1, points) - reference.in_palm(-1, points)).norm(dim=-1).mean(-1)


def path_difference(found: Recording, reference: Recording) -> tuple[Tensor, Tensor]:
    """[T, G] difference of the joint that differs most (rad, m), and distance of the objects (m), after each step."""
    joints = (found.joint_pos - reference.joint_pos).abs().amax(-1)
    return joints, (found.object_pos - reference.object_pos).norm(dim=-1)


def path_metrics(joints: Tensor, distance: Tensor) -> list[Metric]:
    """Judge the differences [T, G] of paths in contact. Long contact is chaotic, even with the same equations."""
    millimetres = 1e3 * distance
    n = distance.numel()
    above = int((millimetres.amax(0) > 1.0).sum()) if n else 0
    worst = {"worst": _rounded(_largest(joints))}
    return [
        Metric(name="path, joints", measured=_quantile(joints), n=joints.numel(), detail=worst),
        Metric(name="path, object", measured=_quantile(millimetres), n=n),
        Metric(name="path, object, worst", measured=_largest(millimetres), n=n, detail={"grasps_above": above}),
    ]


def _quantile(values: Tensor, q: float = 0.5) -> float:
    """Return a quantile, by default the median; NaN if there is no value, or one is NaN."""
    return float(values.double().flatten().quantile(q)) if values.numel() else math.nan


def _largest(values: Tensor) -> float:
    return float(values.max()) if values.numel() else math.nan


def _share(flags: Tensor) -> float:
    return float(flags.double().mean()) if flags.numel() else math.nan


def _rounded(value: float) -> float | None:
    return float(f"{value:.4g}") if math.isfinite(value) else None
