"""Checks of friction on the table, with Coulomb's law: coefficients are those of the pair, in every direction, sliding and at rest."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from xreset.backends.conformance.harness import Bench, advanced, largest, replace_fields, snapshot, worst_of
from xreset.backends.conformance.results import Measure, checks_of
from xreset.backends.conformance.scene import ball, flat_objects
from xreset.physics import Backend, State
from xreset.spec import GRAVITY

check = checks_of("contact")

_COEFFICIENTS = (0.2, 0.5, 0.8, 1.2)
_DEGREES = (0, 45)
_DISTANCE = 0.2  # m that every object slides
_CASES = [(mu, degrees) for mu in _COEFFICIENTS for degrees in _DEGREES]


@check(
    "sliding objects stop after v^2 / (2 mu g), with mu that of the pair, from 0.2 to 1.2, along the axes and diagonally",
    "friction is combined (product, average) from coefficients not solved for the pair, shared by all worlds, or a pyramid's",
    capabilities=("friction",),
    own_robot_only=True,
)
def sliding_distance(bench: Bench) -> list[Measure]:
    """Push boxes off at the speed with which Coulomb friction stops them after 0.2 m, over several coefficients, along and across.

    v^2 / (2 mu g) is the way to stop.
    """
    shapes = flat_objects()[:3]
    scene = replace(bench.scene, objects=shapes)
    which = torch.arange(len(shapes)).repeat(len(_CASES))
    mu, direction = _cases(bench, len(shapes))
    start = bench.placed(State.initial(scene, which))
    speed = (2.0 * mu * GRAVITY * _DISTANCE).sqrt()
    with bench.other(scene, len(which), which) as backend:
        backend.set_friction(_pairs(bench, mu).to(backend.device))
        end = advanced(
            backend, replace_fields(start, object_linvel=speed[:, None] * direction), round(1.0 / scene.timestep)
        )
    way = ((end.object_pos - start.object_pos) * direction).sum(-1)
    off = (way / _DISTANCE - 1.0).abs().view(len(_CASES), len(shapes))
    names = [shape.name for shape in shapes]
    return [
        worst_of(f"mu {mu}, {degrees} degrees", row, 0.06, "of v^2 / (2 mu g)", names)
        for row, (mu, degrees) in zip(off, _CASES, strict=True)
    ]


@check(
    "an object stays on a slope of 0.95 of the friction cone and slides down one of 1.05",
    "friction is regularised so that objects creep, is a pyramid, or is shared by all worlds or lost with the state",
    capabilities=("friction", "object_wrench"),
    own_robot_only=True,
)
def slope(bench: Bench) -> list[Measure]:
    """Load a box sideways, as a slope does, with 0.95 and 1.05 of mu m g: it must stay, and slide with 0.05 mu g, in every direction."""
    box = flat_objects()[0]
    scene = replace(bench.scene, objects=(box,))
    mu, direction = _cases(bench, 2)  # two worlds a case: one below the cone, one beyond it
    ratio = torch.tensor([0.95, 1.05]).repeat(len(_CASES))
    n = len(mu)
    which = torch.zeros(n, dtype=torch.long)
    start = bench.placed(State.initial(scene, which))
    with bench.other(scene, n, which) as backend:
        backend.set_friction(_pairs(bench, mu).to(backend.device))
        advanced(backend, start, round(0.25 / scene.timestep))
        force = (ratio * mu * box.mass * GRAVITY)[:, None] * direction
        backend.set_object_wrench(force.to(backend.device), torch.zeros(n, 3, device=backend.device))
        backend.step(round(0.25 / scene.timestep))
        first = snapshot(backend.state())
        duration = round(0.5 / scene.timestep) * scene.timestep
        backend.step(round(0.5 / scene.timestep))
        last = snapshot(backend.state())
    creep = (last.object_pos - first.object_pos).norm(dim=-1) / duration
    acceleration = ((last.object_linvel - first.object_linvel) * direction).sum(-1) / duration
    off = (acceleration / (0.05 * mu * GRAVITY) - 1.0).abs()
    measures = []
    for i, (value, degrees) in enumerate(_CASES):
        case = f"mu {value}, {degrees} degrees"
        measures.append(Measure(f"creep, {case}", float(creep[2 * i]), 5e-4, "m/s"))
        measures.append(Measure(f"acceleration, {case}", float(off[2 * i + 1]), 1 / 3, "of 0.05 mu g"))
    return measures


@check(
    "torsional friction brakes a spinning ball as stated for the pair, whatever its sliding friction",
    "torsional friction is missing, is multiplied by the sliding friction, or comes from the size of a contact patch",
    capabilities=("friction",),
    own_robot_only=True,
)
def torsional_friction(bench: Bench) -> list[Measure]:
    """Spin a ball on the table, with two coefficients of sliding friction: torsional friction brakes it with the same torque in both.

    I domega/dt = -t m g, with t the torsional friction, a length.
    """
    friction = _pairs(bench, torch.tensor([0.3, 1.0]))
    # long enough for what a contact that patters takes and gives to even out
    lost = _spin_lost(bench, 2, 0.8, lambda backend: backend.set_friction(friction.to(backend.device)))
    return [Measure("spin lost", largest(lost - 1.0), 0.01, "of t m g / I")]


@check(
    "torsional friction is set world by world, none too, and setting a state keeps it",
    "torsional friction is shared by all worlds, is set on one of two surfaces, or is lost with the state",
    capabilities=("torsional_friction",),
    own_robot_only=True,
)
def torsional_friction_set(bench: Bench) -> list[Measure]:
    """Spin balls whose torsional friction was set world by world, then a state: each is braked by its own.

    I domega/dt = -t m g, with none, half, all and twice of what the scene says.
    """
    factors = torch.tensor([0.0, 0.5, 1.0, 2.0])

    def prepare(backend: Backend) -> None:
        torsional = (factors * bench.scene.friction.torsional).to(backend.device)
        for worlds in ([3, 1], [0]):
            index = torch.tensor(worlds, device=backend.device)
            backend.set_torsional_friction(torsional[index], index)

    lost = _spin_lost(bench, len(factors), 0.4, prepare)
    return [Measure("spin lost", largest(lost - factors), 0.02, "of t m g / I")]


def _spin_lost(bench: Bench, count: int, seconds: float, prepare: Callable[[Backend], None]) -> Tensor:
    """[count] what balls on the table lose of their spin, as a share of what the scene's torsional friction takes."""
    thing = ball()
    scene = replace(bench.scene, objects=(thing,))
    which = torch.zeros(count, dtype=torch.long)
    start = replace_fields(bench.placed(State.initial(scene, which)), object_angvel=torch.tensor([0.0, 0.0, 10.0]))
    steps = round(seconds / scene.timestep)
    with bench.other(scene, count, which) as backend:
        prepare(backend)
        lost = 10.0 - advanced(backend, start, steps).object_angvel[:, 2]
    return lost / (
        scene.friction.torsional * thing.mass * GRAVITY / float(thing.inertia[2, 2]) * steps * scene.timestep
    )


def _cases(bench: Bench, each: int) -> tuple[Tensor, Tensor]:
    """Coefficient [N] and direction [N, 3], towards the table's middle, of the worlds, ``each`` of them a case."""
    (x, y), (px, py) = bench.scene.table.center, bench.place
    mu = torch.tensor([mu for mu, _ in _CASES]).repeat_interleave(each)
    angle = torch.tensor([math.radians(degrees) for _, degrees in _CASES]).repeat_interleave(each)
    towards = torch.tensor([math.copysign(1.0, x - px), math.copysign(1.0, y - py), 0.0])
    return mu, torch.stack((angle.cos(), angle.sin(), torch.zeros_like(angle)), dim=1) * towards


def _pairs(bench: Bench, table: Tensor) -> Tensor:
    """[N, 3] friction of the pairs, that of the table given."""
    friction = bench.scene.friction
    return torch.stack((torch.full_like(table, friction.tip), torch.full_like(table, friction.link), table), dim=1)
