"""The comparison: engines try the same grasps, and are measured against a reference: one number each, and how large it may be.

Of two recordings of the same episode, the first is the engine's under test, the second the reference's. Shape letters as in
:mod:`xreset.eval.engines.episodes`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal

import torch
from torch import Tensor

from xreset.eval.engines.episodes import Recording
from xreset.eval.engines.grasps import Frames, Grasps, find_grasps
from xreset.eval.engines.trials import (
    Closings,
    CommonStates,
    ParityConfig,
    common_states,
    try_closings,
    try_holds,
    try_paths,
)
from xreset.eval.trial import Engine, MakeBackend, engine
from xreset.objects.sampling import surface_points
from xreset.physics import Backend
from xreset.spec import ObjectSpec, RobotSpec, SceneSpec

REFERENCE = "mujoco"
SCHEMA = "xreset-parity/1"
_SURFACE_POINTS = 64  # of an object, for the distance between two poses


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

    def as_dict(self) -> dict[str, Any]:
        """JSON-able content."""
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
        """JSON-able content."""

        def described(grasps: Grasps | CommonStates) -> list[dict[str, str]]:
            return [
                {"grasp": label, "object": self.objects[i].name}
                for label, i in zip(grasps.label, grasps.object_index.tolist(), strict=True)
            ]

        return {
            "schema": SCHEMA,
            "robot": self.robot.name,
            "robot_fingerprint": self.robot.fingerprint,
            "objects": [{"name": o.name, "source": o.source} for o in self.objects],
            "reference": self.reference.as_dict(),
            "floor": self.floor.as_dict(),
            "engines": [tested.as_dict() for tested in self.engines],
            "grasps": {"closing": described(self.closing), "hold": described(self.hold)},
            "ok": all(metric.ok for tested in self.engines for metric in tested.metrics),
        }


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
        objects: geometry; frames of other objects are left out.
        grasps: how many closings, and how many holds from common states.
        reference: default: the backend ``mujoco``.
        progress: called with (what is being done, tries done, tries in all).

    Raises:
        DemoError: the frames show no grasp.
    """
    config = config or ParityConfig()
    engines = tuple(engines)
    reference = reference or engine(REFERENCE)
    floor = replace(reference, name=f"{reference.name} at half the timestep", make=_at_half_timestep(reference.make))
    scene = SceneSpec(robot=robot, objects=tuple(objects))
    whole = [reference, floor, *(e for e in engines if e.grasps)]
    stepwise = [reference, *(e for e in engines if e.path)]
    total, done = 2 * len(whole) + len(stepwise), 0

    def report(doing: str) -> None:
        nonlocal done
        progress(doing, done, total)
        done += 1

    table = find_grasps(frames, robot, objects, grasps, where="table")
    tries = _Tries()
    for e in whole:
        report(f"{e.name}: closing {len(table)} hands")
        tries.closings[e.name] = try_closings(e, scene, table, config)
    sources = {e.name: tries.closings[e.name].whole for e in whole if e is not floor}
    air = find_grasps(frames, robot, objects, grasps, where="air")
    common = common_states(robot, table, air, sources, grasps, scene.control_dt, config)
    for e in whole:
        report(f"{e.name}: holding {len(common.label)} objects")
        tries.holds[e.name] = try_holds(e, scene, common, config)
    firm = torch.stack([carried(recording, config.motion.height) for recording in tries.holds[reference.name]]).all(0)
    if len(stepwise) > 1 and bool(firm.any()):
        held = common[firm.nonzero()[: config.path_grasps, 0]]
        for e in stepwise:
            report(f"{e.name}: following {len(held.label)} objects")
            tries.paths[e.name] = try_paths(e, scene, held, config)
    progress("", total, total)
    judged = partial(_judged, reference, tries, _surface(objects, common.object_index), config, scene.control_dt)
    return Parity(
        robot=robot,
        objects=tuple(objects),
        reference=judged(reference),
        floor=judged(floor),
        engines=tuple(judged(e) for e in engines),
        closing=table,
        hold=common,
    )


@dataclass(frozen=True, kw_only=True)
class _Tries:
    """What every engine did, by its name."""

    closings: dict[str, Closings] = field(default_factory=dict)
    holds: dict[str, tuple[Recording, ...]] = field(default_factory=dict)
    paths: dict[str, Recording] = field(default_factory=dict)


def _judged(
    reference: Engine, tries: _Tries, points: Tensor, config: ParityConfig, dt: float, e: Engine
) -> EngineParity:
    """An engine against the reference; points [G, P, 3] of the objects that are held."""
    lift, metrics, recordings = config.motion.height, [], {}
    everything = [tries.paths[e.name]] if e.name in tries.paths else []
    if e.grasps:
        mine, other = tries.closings[e.name], tries.closings[reference.name]
        holds = tries.holds[e.name]
        metrics += press_metrics(mine.press, other.press, round(config.press_time / dt))
        metrics += _hold_metrics(holds, tries.holds[reference.name], points, config)
        claim = "hand closes, lifts and shakes: share of the grasps that end alike, carried or not"
        metrics.append(
            outcome_metric("closing, outcome", claim, 0.80, carried(mine.whole, lift), carried(other.whole, lift))
        )
        recordings = {"closing": mine.whole} | {
            f"hold {mu:g}": r for mu, r in zip(config.frictions, holds, strict=True)
        }
        everything += [*recordings.values(), mine.press]
    if e.path:
        nothing = torch.zeros(0, 0), torch.zeros(0, 0)
        metrics += path_metrics(
            *(path_difference(tries.paths[e.name], tries.paths[reference.name]) if tries.paths else nothing)
        )
    return EngineParity(
        engine=e,
        metrics=tuple(metrics) if e is not reference else (),
        carried={name: tuple(carried(r, lift).tolist()) for name, r in recordings.items()},
        broken=sum(int(r.broken.sum()) for r in everything),
    )


def _hold_metrics(
    found: Sequence[Recording], reference: Sequence[Recording], points: Tensor, config: ParityConfig
) -> list[Metric]:
    """Outcome and object pose, over all frictions together."""
    lift = config.motion.height
    mine, other = (torch.cat([carried(r, lift) for r in recordings]) for recordings in (found, reference))
    distances = torch.cat([palm_distance(a, b, points) for a, b in zip(found, reference, strict=True)])
    claim = f"lift and shake from one common state at pair frictions {', '.join(f'{mu:g}' for mu in config.frictions)}: share that end alike"
    return [outcome_metric("hold, outcome", claim, 0.85, mine, other), palm_metric(distances[mine & other])]


def _surface(objects: Sequence[ObjectSpec], object_index: Tensor) -> Tensor:
    """[G, P, 3] points of each world's object."""
    points = torch.stack([torch.as_tensor(surface_points(o, _SURFACE_POINTS), dtype=torch.float32) for o in objects])
    return points[object_index]


def _at_half_timestep(make: MakeBackend) -> MakeBackend:
    def finer(scene: SceneSpec, num_worlds: int, object_index: Tensor) -> Backend:
        return make(replace(scene, timestep=scene.timestep / 2, substeps=2 * scene.substeps), num_worlds, object_index)

    return finer


# Metrics ---------------------------------------------------------------------------------------------------------------------------------


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
_OVER_ALL = "over all control steps and grasps"
_ON_FIXED, _DIFFERENCE = "on a fixed object: relative difference, median over", "distance of the object's origins"
_TARGETS: dict[str, tuple[str, str, float]] = {
    "press, total": (f"sum of the fingertips' forces {_ON_FIXED} the grasps", "", 0.10),
    "press, fingertip": (f"force vector of a fingertip {_ON_FIXED} all fingertips that press", "", 0.30),
    "hold, object in palm": (
        "object in the palm's frame after lift and shake: mean distance of its surface points, median over grasps that both hold",
        "mm",
        4.0,
    ),
    "path, joints": (f"the joint that differs most, median {_OVER_ALL}", "rad", 5e-4),
    "path, object": (f"{_DIFFERENCE}, median {_OVER_ALL}", "mm", 0.05),
    "path, object, worst": (f"{_DIFFERENCE}, largest {_OVER_ALL}", "mm", 1.0),
}
"""Name -> claim, unit, and the value that may not be exceeded."""


def _metric(name: str, measured: float, n: int, **detail: Any) -> Metric:
    claim, unit, target = _TARGETS[name]
    return Metric(
        name=name, claim=claim, unit=unit, target=target, sense="at most", measured=measured, n=n, detail=detail
    )


def press_metrics(found: Recording, reference: Recording, steps: int) -> list[Metric]:
    """Forces with which a hand presses on an object that does not move, averaged over the last control steps."""
    force, expected = (recording.tip_force[-steps:].mean(0) for recording in (found, reference))
    press, other = force.norm(dim=-1), expected.norm(dim=-1)
    total, other_total = press.sum(-1), other.sum(-1)
    firm = torch.maximum(total, other_total) > PRESS_FLOOR
    pressed = torch.maximum(press, other) > PRESS_FLOOR
    bias = ((total - other_total) / torch.maximum(total, other_total))[firm]
    error, tip_error = bias.abs(), ((force - expected).norm(dim=-1) / torch.maximum(press, other))[pressed]
    p90, median_force = _rounded(_quantile(error, 0.9)), _rounded(_median(other_total))
    same = _rounded(_share((press > PRESS_FLOOR) == (other > PRESS_FLOOR)))
    return [
        _metric(
            "press, total",
            _median(error),
            len(error),
            bias=_rounded(_median(bias)),
            p90=p90,
            median_force_N=median_force,
        ),
        _metric(
            "press, fingertip",
            _median(tip_error),
            len(tip_error),
            p90=_rounded(_quantile(tip_error, 0.9)),
            touch_same=same,
        ),
    ]


def carried(recording: Recording, lift: float) -> Tensor:
    """[G] bool: whether the object ends up at least half as much higher than it began as the palm was lifted [m]."""
    return (recording.object_pos[-1, :, 2] - recording.start.object_pos[:, 2] > lift / 2) & ~recording.broken


def outcome_metric(name: str, claim: str, target: float, found: Tensor, reference: Tensor) -> Metric:
    """Share of the tries [n] bool that end alike, carried or not."""
    pairs = {
        "both": found & reference,
        "neither": ~found & ~reference,
        "only_here": found & ~reference,
        "only_in_reference": ~found & reference,
    }
    return Metric(
        name=name, claim=claim, unit="", target=target, sense="at least", measured=_share(found == reference), n=len(found),
        detail={which: int(flags.sum()) for which, flags in pairs.items()},
    )  # fmt: skip


def palm_metric(distances: Tensor) -> Metric:
    """The distances [n] of :func:`palm_distance`, over all grasps that both engines hold."""
    p90 = _rounded(1e3 * _quantile(distances, 0.9))
    return _metric("hold, object in palm", 1e3 * _median(distances), len(distances), p90=p90)


def palm_distance(found: Recording, reference: Recording, points: Tensor) -> Tensor:
    """[G] mean distance of the objects' surface points [G, P, 3] in the palm's frame at the end [m]: place and orientation in one."""
    return (found.in_palm(-1, points) - reference.in_palm(-1, points)).norm(dim=-1).mean(-1)


def path_difference(found: Recording, reference: Recording) -> tuple[Tensor, Tensor]:
    """After each step, the joint that differs most [T, G] (rad, m) and the distance between the objects' origins [T, G] (m)."""
    joints = (found.joint_pos - reference.joint_pos).abs().amax(-1)
    return joints, (found.object_pos - reference.object_pos).norm(dim=-1)


def path_metrics(joints: Tensor, distance: Tensor) -> list[Metric]:
    """The differences [T, G] of paths in contact: between engines that solve the same equations only, for long contact is chaotic."""
    thing, n = 1e3 * distance, distance.numel()
    above = int((thing.amax(0) > 1.0).sum()) if n else 0
    return [
        _metric("path, joints", _median(joints), joints.numel(), worst=_rounded(_largest(joints))),
        _metric("path, object", _median(thing), n),
        _metric("path, object, worst", _largest(thing), n, grasps_above=above),
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
