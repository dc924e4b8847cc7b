"""The comparison of engines: they try the same grasps, and are measured against a reference.

Where two recordings of the same episode are compared, the first is of the tested engine, the second of the reference.
Shape letters as in :mod:`xreset.eval.engines.recording`.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from xreset.checks import frozen
from xreset.eval.engines.grasps import (
    LIFT_HEIGHT,
    Grasps,
    closing_episode,
    closing_steps,
    find_grasps,
    lifting_targets,
    squeezed,
)
from xreset.eval.engines.recording import Recording, play
from xreset.eval.rollout import Engine, engine
from xreset.geometry.kinematics import Kinematics
from xreset.objects.sampling import surface_points
from xreset.physics import Backend, State
from xreset.progress import NamedProgress, unseen
from xreset.retarget.file import Retargeted
from xreset.spec import ObjectSpec, RobotSpec, SceneSpec

REFERENCE = "mujoco"
SCHEMA = "xreset-parity/1"
SURFACE_POINTS = 64
"""Points on an object's surface for the distance between two poses."""
FRICTIONS = (0.5, 0.8)
"""Pair frictions of hand and object in the holds."""
IN_AIR = 1 / 3
"""Share of the common states that demonstrations show in the air; the others come from closings."""
PRESS_MASS = 1e6
"""Factor on the mass of an object that nothing shall move."""
PRESS_FLOOR = 0.5
"""Forces below this [N] in both engines are no press."""
PRESS_TIME = 0.25
"""Forces are averaged over the last of these seconds of a press."""

_METRICS = tomllib.loads(Path(__file__).with_name("metrics.toml").read_text())


@frozen
class Metric:
    """One row of the table. The first fields are explained in ``metrics.toml``."""

    metric: str
    claim: str
    unit: str
    sense: str
    target: float
    measured: float | None
    """None if nothing could be compared."""
    n: int
    """How many numbers it is taken over."""
    verdict: str
    """``met`` or ``missed``; a number that could not be measured does not meet the target."""

    @classmethod
    def of(cls, name: str, values: Tensor, mean: bool = False) -> Metric:
        """Judge the median, or the mean, of some numbers [n]."""
        row = _METRICS[name]
        numbers = values.double().flatten()
        measured = math.nan
        if len(numbers):
            measured = float(numbers.mean() if mean else numbers.quantile(0.5))
        met = measured <= row["target"] if row["sense"] == "at most" else measured >= row["target"]
        return cls(
            metric=name,
            **row,
            measured=measured if math.isfinite(measured) else None,
            n=len(numbers),
            verdict="met" if met else "missed",
        )

    @property
    def ok(self) -> bool:
        """Whether the target is met."""
        return self.verdict == "met"


@frozen
class CommonStates:
    """States from which every engine lifts and shakes."""

    label: tuple[str, ...]
    """Sequence, frame, and whether the demonstration shows it or which engine closed the hand."""
    object_index: Tensor
    """[G]"""
    start: State
    """[G, ...]"""


def try_closings(tested: Engine, scene: SceneSpec, grasps: Grasps) -> tuple[Recording, Recording]:
    """Close each hand at the scene's frictions.

    Returns:
        The closing around objects too heavy to move, up to the lift; and the whole try around objects at rest on the
        table.
    """
    start, targets = closing_episode(scene, grasps)
    with tested.make(scene, len(grasps), grasps.object_index) as backend:
        whole = play(backend, start, targets)
        mass = torch.tensor([thing.mass for thing in scene.objects])[grasps.object_index]
        backend.set_object_mass(PRESS_MASS * mass.to(backend.device))
        backend.set_object_gravity(torch.zeros_like(mass, device=backend.device))
        return play(backend, start, targets[: closing_steps(scene.control_dt)]), whole


def try_holds(tested: Engine, scene: SceneSpec, common: CommonStates) -> tuple[Recording, ...]:
    """Lift and shake, once with each of the frictions."""
    targets = lifting_targets(scene, common.start)
    recordings = []
    with tested.make(scene, len(common.object_index), common.object_index) as backend:
        for mu in FRICTIONS:
            friction = torch.tensor([mu, mu, scene.friction.table], device=backend.device)
            backend.set_friction(friction.repeat(backend.num_worlds, 1))
            recordings.append(play(backend, common.start, targets))
    return tuple(recordings)


def common_states(
    scene: SceneSpec, table: Grasps, air: Grasps, closings: Mapping[str, Recording], count: int
) -> CommonStates:
    """Return states that favor no engine: some from demonstrations in the air, the others from the closings of all
    engines in turn.

    A closing counts if a fingertip touches the object when the hand has closed.

    Args:
        scene: robot and control step.
        table: grasps of the closings.
        air: grasps in the air.
        closings: whole closings, by engine.
        count: largest number of states; there are fewer where hands have closed on nothing.
    """
    shown = air[: round(count * IN_AIR)]
    closed = squeezed(Kinematics(scene.robot), shown.joint_pos)
    states = [State.at_rest(shown.joint_pos, shown.object_pos, shown.object_quat, closed)]
    labels = [f"{label} as demonstrated" for label in shown.label]
    index = [shown.object_index]
    last = closing_steps(scene.control_dt) - 1
    names = list(closings)
    for g in range(len(table)):
        first = g % len(names)
        for name in names[first:] + names[:first]:
            if len(labels) < count and closings[name].tip_touch[last, g].any():
                labels.append(f"{table.label[g]} closed in {name}")
                states.append(closings[name].state_after(last)[torch.tensor([g])])
                index.append(table.object_index[[g]])
                break
    return CommonStates(label=tuple(labels), object_index=torch.cat(index), start=State.cat(states))


@frozen
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
        """Return JSON-able content."""
        return {
            "backend": self.engine.name,
            "version": self.engine.version,
            "device": self.engine.device,
            "metrics": [vars(metric) for metric in self.metrics],
            "carried": self.carried,
            "broken_worlds": self.broken,
        }


@frozen
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
    def missed(self) -> list[str]:
        """Engine and name of every metric that misses its target."""
        names = []
        for tested in self.engines:
            names += [f"{tested.engine.name}: {m.metric}" for m in tested.metrics if not m.ok]
        return names

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
            "ok": not self.missed,
        }


def compare(
    robot: RobotSpec,
    objects: Sequence[ObjectSpec],
    motion: Retargeted,
    engines: Iterable[Engine],
    *,
    grasps: int = 48,
    reference: Engine | None = None,
    progress: NamedProgress = unseen,
) -> Parity:
    """Measure engines against the reference.

    Args:
        robot: the robot.
        objects: geometry; frames of other objects are left out.
        motion: where grasps are taken from.
        engines: the engines to measure.
        grasps: number of closings, and of holds from common states.
        reference: default: the backend ``mujoco``.
        progress: called with (what is being done, tries done, tries in all).

    Raises:
        DemoError: the motion shows no grasp.
    """
    reference = reference or engine(REFERENCE)
    floor = _at_half_timestep(reference)
    everyone = (reference, floor, *engines)
    total = 2 * len(everyone)
    scene = SceneSpec(robot=robot, objects=tuple(objects))

    table = find_grasps(motion, robot, objects, grasps, where="table")
    closings: dict[Engine, tuple[Recording, Recording]] = {}
    for done, tested in enumerate(everyone):
        progress(f"{tested.name}: closing {len(table)} hands", done, total)
        closings[tested] = try_closings(tested, scene, table)
    air = find_grasps(motion, robot, objects, grasps, where="air")
    closed = {tested.name: whole for tested, (_, whole) in closings.items() if tested is not floor}
    common = common_states(scene, table, air, closed, grasps)
    holds: dict[Engine, tuple[Recording, ...]] = {}
    for done, tested in enumerate(everyone, len(everyone)):
        progress(f"{tested.name}: holding {len(common.label)} objects", done, total)
        holds[tested] = try_holds(tested, scene, common)
    progress("", total, total)

    surfaces = [
        torch.as_tensor(surface_points(o, SURFACE_POINTS), dtype=torch.float32) for o in objects
    ]
    points = torch.stack(surfaces)[common.object_index]
    window = round(PRESS_TIME / scene.control_dt)

    def judged(tested: Engine) -> EngineParity:
        press, closing = closings[tested]
        metrics: tuple[Metric, ...] = ()
        if tested is not reference:
            press_there, closing_there = closings[reference]
            metrics = (
                *press_metrics(press, press_there, window),
                *hold_metrics(holds[tested], holds[reference], points),
                outcome_metric("closing, outcome", [closing], [closing_there]),
            )
        outcomes = {"closing": closing}
        for mu, recording in zip(FRICTIONS, holds[tested], strict=True):
            outcomes[f"hold {mu:g}"] = recording
        return EngineParity(
            engine=tested,
            metrics=metrics,
            carried={name: tuple(carried(r).tolist()) for name, r in outcomes.items()},
            broken=sum(int(r.broken.sum()) for r in (*outcomes.values(), press)),
        )

    return Parity(
        robot=robot,
        objects=tuple(objects),
        reference=judged(reference),
        floor=judged(floor),
        engines=tuple(judged(tested) for tested in everyone[2:]),
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
    most = torch.maximum(press, other)
    most_in_all = torch.maximum(press.sum(-1), other.sum(-1))
    total_error = ((press.sum(-1) - other.sum(-1)).abs() / most_in_all)[most_in_all > PRESS_FLOOR]
    tip_error = ((force - expected).norm(dim=-1) / most)[most > PRESS_FLOOR]
    return [Metric.of("press, total", total_error), Metric.of("press, fingertip", tip_error)]


def hold_metrics(
    found: Sequence[Recording], reference: Sequence[Recording], points: Tensor
) -> list[Metric]:
    """Compare outcome and object pose over all frictions together; points [G, P, 3] of the objects' surfaces."""
    distances = []
    for mine, other in zip(found, reference, strict=True):
        both = carried(mine) & carried(other)
        distances.append(palm_distance(mine, other, points)[both])
    return [
        outcome_metric("hold, outcome", found, reference),
        Metric.of("hold, object in palm", 1e3 * torch.cat(distances)),
    ]


def carried(recording: Recording) -> Tensor:
    """[G] bool: whether the object ends at least half as far above its start as the palm was lifted."""
    return (recording.lifted > LIFT_HEIGHT / 2) & ~recording.broken


def outcome_metric(name: str, found: Sequence[Recording], reference: Sequence[Recording]) -> Metric:
    """Return the share of the tries that end alike, carried or not."""
    same = [carried(a) == carried(b) for a, b in zip(found, reference, strict=True)]
    return Metric.of(name, torch.cat(same), mean=True)


def palm_distance(found: Recording, reference: Recording, points: Tensor) -> Tensor:
    """[G] mean distance of the surface points [G, P, 3] in the palm's frame at the end [m]."""
    return (found.in_palm(points) - reference.in_palm(points)).norm(dim=-1).mean(-1)
