"""The comparison: engines try the same grasps, and are measured against a reference."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from xreset.eval.engines.grasps import Frames, Grasps, find_grasps
from xreset.eval.engines.metrics import (
    Metric,
    carried,
    outcome_metric,
    palm_distance,
    palm_metric,
    path_difference,
    path_metrics,
    press_metrics,
)
from xreset.eval.engines.recording import Recording
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
from xreset.objects import surface_points
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

    @property
    def ok(self) -> bool:
        """Whether all targets are met."""
        return all(metric.ok for metric in self.metrics)

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

    @property
    def ok(self) -> bool:
        """Whether every engine meets all targets."""
        return all(tested.ok for tested in self.engines)

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
            "ok": self.ok,
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
        robot: the robot.
        objects: geometry; frames of other objects are left out.
        frames: where to look for grasps.
        engines: the contenders.
        grasps: how many closings, and how many holds from common states.
        config: what is tried.
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
    closings: dict[str, Closings] = {}
    for e in whole:
        report(f"{e.name}: closing {len(table)} hands")
        closings[e.name] = try_closings(e, scene, table, config)
    sources = {e.name: closings[e.name].whole for e in whole if e is not floor}
    air = find_grasps(frames, robot, objects, grasps, where="air")
    common = common_states(robot, table, air, sources, grasps, scene.control_dt, config)
    holds: dict[str, tuple[Recording, ...]] = {}
    for e in whole:
        report(f"{e.name}: holding {len(common.label)} objects")
        holds[e.name] = try_holds(e, scene, common, config)

    lift = config.motion.height
    firm = torch.stack([carried(recording, lift) for recording in holds[reference.name]]).all(0)
    paths: dict[str, Recording] = {}
    if len(stepwise) > 1 and bool(firm.any()):
        held = common[firm.nonzero()[: config.path_grasps, 0]]
        for e in stepwise:
            report(f"{e.name}: following {len(held.label)} objects")
            paths[e.name] = try_paths(e, scene, held, config)
    progress("", total, total)

    points = _surface(objects, common.object_index)

    def judged(e: Engine) -> EngineParity:
        metrics: list[Metric] = []
        recordings: dict[str, Recording] = {}
        if e.grasps:
            mine, other = closings[e.name], closings[reference.name]
            metrics += press_metrics(mine.press, other.press, round(config.press_time / scene.control_dt))
            metrics += _hold_metrics(holds[e.name], holds[reference.name], points, config)
            metrics.append(
                outcome_metric(
                    "closing, outcome",
                    "hand closes, lifts and shakes: share of the grasps that end alike, carried or not",
                    0.80,
                    carried(mine.whole, lift),
                    carried(other.whole, lift),
                )
            )
            recordings = {"closing": mine.whole} | {f"hold {mu:g}": r for mu, r in zip(config.frictions, holds[e.name], strict=True)}
        if e.path:
            nothing = torch.zeros(0, 0)
            metrics += path_metrics(*(path_difference(paths[e.name], paths[reference.name]) if paths else (nothing, nothing)))
        everything = [*recordings.values(), *([closings[e.name].press] if e.grasps else []), *([paths[e.name]] if e.name in paths else [])]
        return EngineParity(
            engine=e,
            metrics=tuple(metrics) if e is not reference else (),
            carried={name: tuple(carried(r, lift).tolist()) for name, r in recordings.items()},
            broken=sum(int(r.broken.sum()) for r in everything),
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


def _hold_metrics(found: Sequence[Recording], reference: Sequence[Recording], points: Tensor, config: ParityConfig) -> list[Metric]:
    """Outcome and object pose, over all frictions together."""
    lift = config.motion.height
    mine, other = (torch.cat([carried(r, lift) for r in recordings]) for recordings in (found, reference))
    distances = torch.cat([palm_distance(a, b, points) for a, b in zip(found, reference, strict=True)])
    claim = (
        f"lift and shake from one common state at pair frictions {', '.join(f'{mu:g}' for mu in config.frictions)}: share that end alike"
    )
    return [outcome_metric("hold, outcome", claim, 0.85, mine, other), palm_metric(distances[mine & other])]


def _surface(objects: Sequence[ObjectSpec], object_index: Tensor) -> Tensor:
    """[G, P, 3] points of each world's object."""
    points = torch.stack([torch.as_tensor(surface_points(o, _SURFACE_POINTS), dtype=torch.float32) for o in objects])
    return points[object_index]


def _at_half_timestep(make: MakeBackend) -> MakeBackend:
    def finer(scene: SceneSpec, num_worlds: int, object_index: Tensor) -> Backend:
        return make(replace(scene, timestep=scene.timestep / 2, substeps=2 * scene.substeps), num_worlds, object_index)

    return finer
