"""Compare engines: they try the same grasps, and are measured against a reference.

Where two recordings of the same episode are compared, the first is from the tested engine, the second from the
reference. Shape letters as in :mod:`xreset.eval.engines.recording`.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

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
from xreset.files.checks import frozen
from xreset.files.progress import NamedProgress, unseen
from xreset.geometry.kinematics import Kinematics
from xreset.objects.sampling import surface_points
from xreset.physics import Backend, State
from xreset.retarget.file import Retargeted
from xreset.spec import ObjectSpec, RobotSpec, SceneSpec

REFERENCE = "mujoco"
SURFACE_POINTS = 64
"""Points on an object's surface for the distance between two poses."""
FRICTIONS = (0.5, 0.8)
"""Pair frictions of hand and object in the holds."""
IN_AIR = 1 / 3
"""Share of the common states that come from demonstrations in the air; the others come from closings."""
PRESS_MASS = 1e6
"""Factor on the mass of an object that nothing can move."""
PRESS_FLOOR = 0.5
"""Forces below this in both engines are not compared [N]."""
PRESS_TIME = 0.25
"""Forces are averaged over this time at the end of a press [s]."""

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
    """Median or mean; None if nothing could be compared."""
    n: int
    """Number of values of this median or mean."""
    verdict: str
    """``met`` or ``missed``. The target is missed if nothing could be compared."""

    @classmethod
    def of(cls, name: str, values: Tensor, mean: bool = False) -> Metric:
        """Return the row of a metric, for the median, or the mean, of some values [n]."""
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


def try_closings(tested: Engine, scene: SceneSpec, grasps: Grasps) -> dict[str, Recording]:
    """Close each hand, with the scene's friction.

    Returns:
        ``closing``: the hand closes around an object at rest on the table, lifts and shakes it. ``press``: the hand
        closes around an object that is too heavy to move.
    """
    start, targets = closing_episode(scene, grasps)
    with tested.make(scene, len(grasps), grasps.object_index) as backend:
        whole = play(backend, start, targets)
        mass = torch.tensor([obj.mass for obj in scene.objects])[grasps.object_index]
        backend.set_object_mass(PRESS_MASS * mass.to(backend.device))
        backend.set_object_gravity(torch.zeros_like(mass, device=backend.device))
        press = play(backend, start, targets[: closing_steps(scene.control_dt)])
        return {"press": press, "closing": whole}


def try_holds(tested: Engine, scene: SceneSpec, common: Grasps) -> dict[str, Recording]:
    """Lift and shake the objects from common states, once with each of :data:`FRICTIONS`."""
    targets = lifting_targets(scene, common.start)
    recordings = {}
    with tested.make(scene, len(common), common.object_index) as backend:
        for mu in FRICTIONS:
            friction = torch.tensor([mu, mu, scene.friction.table], device=backend.device)
            backend.set_friction(friction.repeat(backend.num_worlds, 1))
            recordings[f"hold {mu:g}"] = play(backend, common.start, targets)
    return recordings


def common_states(
    scene: SceneSpec, table: Grasps, air: Grasps, closings: Mapping[str, Recording], count: int
) -> Grasps:
    """Return grasps that favor no engine: some from demonstrations in the air, the others from the closings of all
    engines in turn. Labels state the origin.

    A closing counts if a fingertip touches the object when the hand has closed.

    Args:
        scene: robot and control step.
        table: grasps of the closings.
        air: grasps in the air.
        closings: whole closings, by engine.
        count: largest number of grasps; there are fewer if hands have closed on nothing.
    """
    shown = air[: round(count * IN_AIR)]
    held = shown.start
    closed = squeezed(Kinematics(scene.robot), held.joint_pos)
    states = [State.at_rest(held.joint_pos, held.object_pos, held.object_quat, closed)]
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
    return Grasps(label=tuple(labels), object_index=torch.cat(index), start=State.cat(states))


@frozen
class EngineParity:
    """Results of one engine."""

    engine: str
    version: str
    device: str
    metrics: tuple[Metric, ...]
    """Against the reference; empty for the reference itself."""
    carried: dict[str, tuple[bool, ...]]
    """Kind of try (``closing``, ``hold 0.5``, ...) -> whether each grasp carried its object."""
    broken_worlds: int
    """Worlds that were not finite or dropped contacts, over all tries."""


@frozen
class Parity:
    """Results of a comparison, as they are written."""

    robot: str
    robot_fingerprint: str
    objects: list[dict[str, str]]
    """Name and source of each object."""
    reference: EngineParity
    floor: EngineParity
    """The reference with half its timestep: how far two valid solutions of the same equations differ."""
    engines: tuple[EngineParity, ...]
    grasps: dict[str, list[dict[str, str]]]
    """``closing`` and ``hold`` -> label and object of each grasp."""

    @property
    def missed(self) -> list[str]:
        """Engine and name of every metric that misses its target."""
        names = []
        for tested in self.engines:
            names += [f"{tested.engine}: {m.metric}" for m in tested.metrics if not m.ok]
        return names


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
        reference: default: the engine ``mujoco``.
        progress: called with (current try, tries done, tries in all).

    Raises:
        DemoError: the motion shows no grasp.
    """
    reference = reference or engine(REFERENCE)
    floor = _at_half_timestep(reference)
    everyone = (reference, floor, *engines)
    total = 2 * len(everyone)
    scene = SceneSpec(robot=robot, objects=tuple(objects))

    table = find_grasps(motion, robot, objects, grasps, where="table")
    tries: dict[Engine, dict[str, Recording]] = {}
    for done, tested in enumerate(everyone):
        progress(f"{tested.name}: closing {len(table)} hands", done, total)
        tries[tested] = try_closings(tested, scene, table)
    air = find_grasps(motion, robot, objects, grasps, where="air")
    closed = {tested.name: own["closing"] for tested, own in tries.items() if tested is not floor}
    common = common_states(scene, table, air, closed, grasps)
    for done, tested in enumerate(everyone, len(everyone)):
        progress(f"{tested.name}: holding {len(common)} objects", done, total)
        tries[tested] |= try_holds(tested, scene, common)
    progress("", total, total)

    surfaces = [
        torch.as_tensor(surface_points(o, SURFACE_POINTS), dtype=torch.float32) for o in objects
    ]
    points = torch.stack(surfaces)[common.object_index]
    window = round(PRESS_TIME / scene.control_dt)
    results = []
    for tested, own in tries.items():
        metrics: tuple[Metric, ...] = ()
        if tested is not reference:
            metrics = tuple(_metrics(own, tries[reference], points, window))
        results.append(_engine_parity(tested, own, metrics))
    return Parity(
        robot=robot.name,
        robot_fingerprint=robot.fingerprint,
        objects=[{"name": o.name, "source": o.source} for o in objects],
        reference=results[0],
        floor=results[1],
        engines=tuple(results[2:]),
        grasps={"closing": _listed(table, objects), "hold": _listed(common, objects)},
    )


def _engine_parity(
    tested: Engine, tries: dict[str, Recording], metrics: tuple[Metric, ...]
) -> EngineParity:
    return EngineParity(
        engine=tested.name,
        version=tested.version,
        device=tested.device,
        metrics=metrics,
        carried={
            name: tuple(carried(tried).tolist()) for name, tried in tries.items() if name != "press"
        },
        broken_worlds=sum(int(tried.broken.sum()) for tried in tries.values()),
    )


def _listed(grasps: Grasps, objects: Sequence[ObjectSpec]) -> list[dict[str, str]]:
    """Return label and object of each grasp."""
    names = [objects[i].name for i in grasps.object_index.tolist()]
    return [
        {"grasp": label, "object": name} for label, name in zip(grasps.label, names, strict=True)
    ]


def _at_half_timestep(base: Engine) -> Engine:
    def make(scene: SceneSpec, num_worlds: int, object_index: Tensor) -> Backend:
        finer = replace(scene, timestep=scene.timestep / 2, substeps=2 * scene.substeps)
        return base.make(finer, num_worlds, object_index)

    return replace(base, name=f"{base.name} at half the timestep", make=make)


# Metrics -------------------------------------------------------------------------------------------------------------


def _metrics(
    found: dict[str, Recording], reference: dict[str, Recording], points: Tensor, window: int
) -> Iterator[Metric]:
    """Yield the rows of the table.

    Args:
        found: tries of the tested engine, by kind.
        reference: tries of the reference.
        points: [G, P, 3] of the held objects' surfaces.
        window: control steps over which forces of a press are averaged.
    """
    yield from press_metrics(found["press"], reference["press"], window)
    holds = [name for name in found if name.startswith("hold")]
    yield outcome_metric("hold, outcome", [(found[name], reference[name]) for name in holds])
    distances = []
    for name in holds:
        both = carried(found[name]) & carried(reference[name])
        distances.append(palm_distance(found[name], reference[name], points)[both])
    yield Metric.of("hold, object in palm", 1e3 * torch.cat(distances))
    yield outcome_metric("closing, outcome", [(found["closing"], reference["closing"])])


def press_metrics(found: Recording, reference: Recording, steps: int) -> list[Metric]:
    """Compare the fingertip forces on an object that does not move, averaged over the last ``steps`` control steps."""
    force = found.tip_force[-steps:].mean(0)
    expected = reference.tip_force[-steps:].mean(0)
    press = force.norm(dim=-1)
    other = expected.norm(dim=-1)
    most = torch.maximum(press, other)
    most_in_all = torch.maximum(press.sum(-1), other.sum(-1))
    total_error = ((press.sum(-1) - other.sum(-1)).abs() / most_in_all)[most_in_all > PRESS_FLOOR]
    tip_error = ((force - expected).norm(dim=-1) / most)[most > PRESS_FLOOR]
    return [Metric.of("press, total", total_error), Metric.of("press, fingertip", tip_error)]


def carried(recording: Recording) -> Tensor:
    """[G] bool: whether the object was lifted by more than half of the palm's lift, and its world is not broken."""
    return (recording.lifted > LIFT_HEIGHT / 2) & ~recording.broken


def outcome_metric(name: str, pairs: Iterable[tuple[Recording, Recording]]) -> Metric:
    """Return the share of the tries with the same outcome, carried or not, in both recordings of a pair."""
    same = [carried(a) == carried(b) for a, b in pairs]
    return Metric.of(name, torch.cat(same), mean=True)


def palm_distance(found: Recording, reference: Recording, points: Tensor) -> Tensor:
    """[G] mean distance of the surface points [G, P, 3] in the palm's frame at the end [m]."""
    return (found.in_palm(points) - reference.in_palm(points)).norm(dim=-1).mean(-1)
