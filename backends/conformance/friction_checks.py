"""Checks of friction on the table: Coulomb's law for the pair, in every direction, sliding and at rest."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from xreset.backends.conformance.harness import Bench, Worlds, named, replace_fields
from xreset.backends.conformance.results import Measured
from xreset.backends.conformance.scene import ball, flat_objects
from xreset.spec import GRAVITY

_CASES = [(mu, degrees) for mu in (0.2, 0.5, 0.8, 1.2) for degrees in (0, 45)]  # noqa: XR002
"""Coefficient with the table, and direction of motion."""
_DISTANCE = 0.2  # m that every object slides


def sliding_distance(bench: Bench) -> Measured:
    """Push boxes off at the speed v with which Coulomb friction stops them after v^2 / (2 mu g) = 0.2 m."""
    shapes = flat_objects()[:3]
    scene = replace(bench.scene, objects=shapes)
    which = [*range(len(shapes))] * len(_CASES)
    mu, direction = _cases(bench, len(shapes))
    speed = (2.0 * mu * GRAVITY * _DISTANCE).sqrt()
    start = bench.initial(scene, which)
    start = replace_fields(start, object_linvel=speed[:, None] * direction)
    with bench.other(scene, which) as worlds:
        worlds.set_parameter("friction", _pairs(bench, mu))
        end = worlds.advance(start, round(1.0 / scene.timestep))
    way = ((end.object_pos - start.object_pos) * direction).sum(-1)
    off = (way / _DISTANCE - 1.0).abs().view(len(_CASES), len(shapes))
    errors = {}
    for (coefficient, degrees), row in zip(_CASES, off, strict=True):
        errors[f"mu {coefficient}, {degrees} degrees"] = named([shape.name for shape in shapes], row)
    return errors


def slope(bench: Bench) -> Measured:
    """Load a box sideways, as a slope does, with 0.95 and 1.05 of mu m g: it must stay, and slide with 0.05 mu g."""
    box = flat_objects()[0]
    scene = replace(bench.scene, objects=(box,))
    mu, direction = _cases(bench, 2)  # two worlds a case: one below the cone, one beyond it
    ratio = torch.tensor([0.95, 1.05]).repeat(len(_CASES))
    which = [0] * len(mu)
    force = (ratio * mu * box.mass * GRAVITY)[:, None] * direction
    quarter = round(0.25 / scene.timestep)
    half = round(0.5 / scene.timestep)
    with bench.other(scene, which) as worlds:
        worlds.set_parameter("friction", _pairs(bench, mu))
        worlds.advance(bench.initial(scene, which), quarter)
        worlds.push(force, torch.zeros(3))
        worlds.step(quarter)
        first = worlds.state()
        worlds.step(half)
        last = worlds.state()
    duration = half * scene.timestep
    creep = (last.object_pos - first.object_pos).norm(dim=-1) / duration
    acceleration = ((last.object_linvel - first.object_linvel) * direction).sum(-1) / duration
    off = acceleration / (0.05 * mu * GRAVITY) - 1.0
    errors = {}
    for i, (coefficient, degrees) in enumerate(_CASES):
        case = f"mu {coefficient}, {degrees} degrees"
        errors[f"creep, {case}"] = creep[2 * i]
        errors[f"acceleration, {case}"] = off[2 * i + 1]
    return errors


def torsional_friction(bench: Bench) -> Measured:
    """Spin a ball on the table with two sliding frictions: torsional friction brakes it with the same torque in both.

    I domega/dt = -t m g, with t the torsional friction, a length.
    """
    friction = _pairs(bench, torch.tensor([0.3, 1.0]))
    # A long time, so that what an unsteady contact takes and gives evens out.
    lost = _spin_lost(bench, 2, 0.8, lambda worlds: worlds.set_parameter("friction", friction))
    return {"spin lost": lost - 1.0}


def torsional_friction_set(bench: Bench) -> Measured:
    """Spin balls whose torsional friction was set world by world, then a state: each is braked by its own.

    I domega/dt = -t m g, with none, half, all and twice of what the scene says.
    """
    factors = torch.tensor([0.0, 0.5, 1.0, 2.0])

    def prepare(worlds: Worlds) -> None:
        for rows in ([3, 1], [0]):
            worlds.set_parameter("torsional_friction", factors * bench.scene.friction.torsional, rows)

    return {"spin lost": _spin_lost(bench, len(factors), 0.4, prepare) - factors}


def _spin_lost(bench: Bench, count: int, seconds: float, prepare: Callable[[Worlds], None]) -> Tensor:
    """[count] what balls on the table lose of their spin, as a share of what the scene's torsional friction takes."""
    thing = ball()
    scene = replace(bench.scene, objects=(thing,))
    which = [0] * count
    start = replace_fields(bench.initial(scene, which), object_angvel=torch.tensor([0.0, 0.0, 10.0]))
    steps = round(seconds / scene.timestep)
    with bench.other(scene, which) as worlds:
        prepare(worlds)
        lost = 10.0 - worlds.advance(start, steps).object_angvel[:, 2]
    braking = scene.friction.torsional * thing.mass * GRAVITY / float(thing.inertia[2, 2])
    return lost / (braking * steps * scene.timestep)


def _cases(bench: Bench, each: int) -> tuple[Tensor, Tensor]:
    """Coefficient [N] and direction [N, 3], towards the table's middle, of the worlds, ``each`` of them a case."""
    mu = torch.tensor([mu for mu, _ in _CASES]).repeat_interleave(each)
    angle = torch.tensor([math.radians(degrees) for _, degrees in _CASES]).repeat_interleave(each)
    towards = [math.copysign(1.0, c - p) for c, p in zip(bench.scene.table.center, bench.place, strict=True)]
    direction = torch.stack((angle.cos(), angle.sin(), torch.zeros_like(angle)), dim=1)
    return mu, direction * torch.tensor([*towards, 0.0])


def _pairs(bench: Bench, table: Tensor) -> Tensor:
    """[N, 3] friction of the pairs, given the friction with the table."""
    friction = bench.scene.friction
    return torch.stack((torch.full_like(table, friction.tip), torch.full_like(table, friction.link), table), dim=1)
