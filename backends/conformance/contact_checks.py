"""Checks of objects that rest on the table: forces and their signs, heights, and what mass and friction change."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch

from xreset.backends.conformance.harness import (
    Bench,
    advanced,
    largest,
    random_state,
    replace_fields,
    rotation_angle,
    snapshot,
    worst_of,
)
from xreset.backends.conformance.results import Measure, checks_of
from xreset.backends.conformance.scene import flat_objects
from xreset.physics import Backend, State
from xreset.spec import GRAVITY, ObjectSpec, PairFriction, Shape, lowest_point

check = checks_of("contact")

_SETTLE = 120  # steps


@check(
    "the table pushes a resting object up with m g; nothing else does, and nothing right after setting",
    "a contact force has the wrong sign, frame, scale or step; or readings survive setting a state; or contacts overflow",
)
def resting_weight(bench: Bench) -> list[Measure]:
    """Put objects on the table: no force right after setting, and after half a second the table pushes them up with their weight."""
    backend = bench.backend()
    fresh = backend.contacts()
    at_once = max(largest(fresh.table_force), largest(fresh.tip_force))
    backend.step(_SETTLE)
    contacts, state = backend.contacts(), snapshot(backend.state())
    weight = GRAVITY * torch.tensor([o.mass for o in bench.objects])
    force = contacts.table_force.cpu()
    return [
        Measure("force right after setting", at_once, 1e-6, "N"),
        Measure("vertical force", largest(force[:, 2] / weight - 1.0), 0.02, "of m g"),
        Measure("horizontal force", largest(force[:, :2] / weight[:, None]), 0.02, "of m g"),
        Measure("force of the fingers", largest(contacts.tip_force), 1e-6, "N"),
        Measure("fingers that say they touch", float(contacts.tip_touch.sum()), 0.5),
        Measure("sinking", largest(state.object_pos[:, 2] - bench.start().object_pos[:, 2]), 2e-3, "m"),
        Measure("sliding", largest(state.object_pos[:, :2] - bench.start().object_pos[:, :2]), 2e-3, "m"),
    ]


@check(
    "the force of the table is along the world's z, however the object lies",
    "contact forces are given in the frame of the object or of the contact",
)
def resting_on_a_side(bench: Bench) -> list[Measure]:
    """Lay objects on one of their sides: the table's force is m g along the world's z, not along the object's."""
    backend = bench.backend()
    turn = torch.tensor([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0])  # by 90 degrees about x
    start = replace_fields(bench.start(), object_quat=turn)
    start.object_pos[:, 2] = torch.tensor([_height_on_side(thing) for thing in bench.objects])
    advanced(backend, start, _SETTLE)
    weight = GRAVITY * torch.tensor([o.mass for o in bench.objects])
    stable = [i for i, thing in enumerate(bench.objects) if thing.name != "can"]  # a can rolls
    force = (backend.contacts().table_force.cpu() / weight[:, None])[stable]
    return [
        Measure("vertical force", largest(force[:, 2] - 1.0), 0.02, "of m g"),
        Measure("horizontal force", largest(force[:, :2]), 0.02, "of m g"),
    ]


def _height_on_side(thing: ObjectSpec) -> float:
    T = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    return -lowest_point(
        [Shape(geometry=piece.geometry, T_body_shape=T @ piece.T_body_shape) for piece in thing.pieces]
    )


@check(
    "flat objects rest at their height and hardly bounce",
    "collision margins or contact offsets lift objects, soft contacts let them sink; restitution is not 0 by default",
    own_robot_only=True,
)
def rest_and_bounce(bench: Bench) -> list[Measure]:
    """Put flat objects on the table, then drop them from 30 mm: their height after a second, and how far they bounce up."""
    objects = flat_objects()
    scene = replace(bench.scene, objects=objects)
    which = torch.arange(len(objects))
    start = bench.placed(State.initial(scene, which))
    height = start.object_pos[:, 2]
    with bench.other(scene, len(objects), which) as backend:

        def heights(above: float) -> torch.Tensor:
            """[T, N] heights over 1 s, one each physics step."""
            backend.set_state(
                replace_fields(start, object_pos=start.object_pos + torch.tensor([0.0, 0.0, above])).to(backend.device)
            )
            rows = []
            for _ in range(round(1.0 / scene.timestep)):
                backend.step(1)
                rows.append(backend.state().object_pos[:, 2].cpu().clone())
            return torch.stack(rows)

        resting, dropped = heights(0.0), heights(0.03)
    lowest = dropped.argmin(dim=0)
    bounce = torch.stack([dropped[first:, i].max() - height[i] for i, first in enumerate(lowest.tolist())])
    names = [thing.name for thing in objects]
    return [
        worst_of("height after 1 s", (resting[-1] - height).abs(), 2e-4, "m", names),
        worst_of("height 1 s after a drop", (dropped[-1] - height).abs(), 2e-4, "m", names),
        worst_of("bounce", bounce, 2e-3, "m", names),
    ]


@check(
    "the object's mass is set world by world, and setting a state keeps it",
    "mass is shared by all worlds or lost with the state, or what derives from it is stale",
    capabilities=("object_mass",),
)
def object_mass(bench: Bench) -> list[Measure]:
    """Give the objects other masses, then set a state: the table must carry those."""
    backend = bench.altered()
    mass = torch.tensor([o.mass for o in bench.objects]).float() * torch.tensor([2.0, 0.5, 1.5, 0.7])
    backend.set_object_mass(mass[[0, 2, 3]].to(backend.device), torch.tensor([0, 2, 3], device=backend.device))
    backend.set_object_mass(mass[[1]].to(backend.device), torch.tensor([1], device=backend.device))
    advanced(backend, bench.start(), _SETTLE)
    force = backend.contacts().table_force[:, 2].cpu()
    return [Measure("vertical force", largest(force / (GRAVITY * mass) - 1.0), 0.02, "of m g")]


@check(
    "a world whose mass and friction were set does what a world built with them does, contacts included",
    "inertia, the solver's inverse weights, torsional friction or another quantity that derives from mass or friction is stale",
    capabilities=("object_mass", "friction"),
)
def set_as_built(bench: Bench) -> list[Measure]:
    """Set mass and friction in some worlds, and build others with them: an object that slides and turns must do the same in both.

    Masses change by powers of two, which every product and every eigenvector carries without rounding: contacts make much of a last bit,
    and which way it is rounded depends on the processor's matrix kernels.
    """
    backend = bench.altered()
    factors = torch.tensor([2.0, 0.5, 4.0, 0.25])
    friction = torch.tensor([[0.8, 0.4, 0.3], [0.7, 0.5, 0.9], [0.6, 0.3, 0.45], [0.9, 0.6, 0.2]])
    mass = (factors * torch.tensor([thing.mass for thing in bench.objects])).float()
    backend.set_object_mass(mass.to(backend.device))
    backend.set_friction(friction.to(backend.device))
    found = _slide(bench, backend, range(bench.NUM_WORLDS))
    errors: dict[str, list[float]] = {"pos": [], "angle": [], "force": []}
    things = bench.scene.objects
    for i, thing in enumerate(things):
        built = replace(thing, mass=float(mass[i]), inertia=float(factors[i]) * np.asarray(thing.inertia))
        tip, link, table = friction[i].tolist()
        pairs = PairFriction(tip=tip, link=link, table=table, torsional=bench.scene.friction.torsional)
        with bench.other(replace(bench.scene, objects=(built,), friction=pairs), 1) as other:
            expected = _slide(bench, other, [i])
        errors["pos"].append(largest(found[0].object_pos[i] - expected[0].object_pos[0]))
        errors["angle"].append(largest(rotation_angle(found[0].object_quat[i], expected[0].object_quat[0])))
        errors["force"].append(largest(found[1][i] - expected[1][0]) / (GRAVITY * float(mass[i])))
    limits = {"pos": (1e-5, "m"), "angle": (2e-4, "rad"), "force": (0.01, "of m g")}
    return [worst_of(what, errors[what], *limit, [thing.name for thing in things]) for what, limit in limits.items()]


def _slide(bench: Bench, backend: Backend, worlds: Sequence[int]) -> tuple[State, torch.Tensor]:
    """State and table force after the objects of some of the bench's worlds have slid and turned on the table for a moment."""
    start = bench.start()[list(worlds)]
    start = replace_fields(
        start, object_linvel=torch.tensor([0.25, 0.1, 0.0]), object_angvel=torch.tensor([0.0, 0.0, 3.0])
    )
    end = advanced(backend, start, 4)  # later, the patter of contacts has made much of a difference in the last bit
    return end, backend.contacts().table_force.cpu().clone()


@check(
    "a world whose object's inertia was set does what a world built with it does, in the air and on the table",
    "the inertia is shared by all worlds, set once and scaled again, or forgotten when the mass is set",
    capabilities=("object_inertia", "object_wrench"),
)
def object_inertia_set(bench: Bench) -> list[Measure]:
    """Set the inertia of some worlds' objects, and build others so: tumbling and sliding objects must do the same in both."""
    factors = torch.tensor([2.0, 0.5, 4.0, 0.25])

    def built(thing: ObjectSpec, i: int) -> ObjectSpec:
        return replace(thing, inertia=float(factors[i]) * np.asarray(thing.inertia))

    return _compared(
        bench, lambda backend, worlds: backend.set_object_inertia(factors.to(backend.device)[worlds], worlds), built
    )


@check(
    "a world whose object's centre of mass was moved does what a world built so does, in the air and on the table",
    "the shapes move with the centre of mass, weight acts at the former one, or velocities are converted with it",
    capabilities=("object_com", "object_wrench"),
)
def object_com_set(bench: Bench) -> list[Measure]:
    """Move the centre of mass of some worlds' objects, and build others so: tumbling and sliding objects must do the same in both."""
    offsets = torch.tensor(
        [[0.0078125, 0.0, 0.0], [0.0, -0.0078125, 0.00390625], [0.00390625, 0.00390625, -0.00390625], [0.0, 0.0, 0.0]]
    )

    def built(thing: ObjectSpec, i: int) -> ObjectSpec:
        return replace(thing, com=np.asarray(thing.com) + offsets[i].numpy())

    return _compared(
        bench, lambda backend, worlds: backend.set_object_com(offsets.to(backend.device)[worlds], worlds), built
    )


def _compared(
    bench: Bench, change: Callable[[Backend, torch.Tensor], None], built: Callable[[ObjectSpec, int], ObjectSpec]
) -> list[Measure]:
    """Worlds in two batches are changed, and compared with worlds that were built as world i's object should be."""
    backend = bench.altered()
    for worlds in ([3, 0], [1, 2]):
        change(backend, torch.tensor(worlds, device=backend.device))
    everyone = range(bench.NUM_WORLDS)
    found = _tumble(bench, backend, everyone), *_slide(bench, backend, everyone)
    errors = []
    for i, thing in enumerate(bench.objects):
        with bench.other(replace(bench.scene, objects=(built(thing, i),)), 1) as other:
            tumbled, (slid, force) = _tumble(bench, other, [i]), _slide(bench, other, [i])
        errors.append((
            largest(found[0].object_pos[i] - tumbled.object_pos[0]),
            largest(rotation_angle(found[0].object_quat[i], tumbled.object_quat[0])),
            largest(found[1].object_pos[i] - slid.object_pos[0]),
            largest(found[2][i] - force[0]) / (GRAVITY * thing.mass),
        ))  # fmt: skip
    tumbling, tumbling_angle, sliding, sliding_force = np.max(errors, axis=0).tolist()
    return [
        Measure("tumbling, pos", tumbling, 1e-5, "m"),
        Measure("tumbling, angle", tumbling_angle, 2e-4, "rad"),
        Measure("sliding, pos", sliding, 1e-5, "m"),
        Measure("sliding, force", sliding_force, 0.01, "of m g"),
    ]


def _tumble(bench: Bench, backend: Backend, worlds: Sequence[int]) -> State:
    """State after the objects of some of the bench's worlds have tumbled through the air for a moment, under a torque."""
    n = len(worlds)
    start = random_state(bench, bench.scene, bench.NUM_WORLDS, seed=21)[list(worlds)]
    backend.set_state(start.to(backend.device))
    size = torch.tensor([float(np.trace(bench.objects[i].inertia)) for i in worlds])
    torque = size[:, None] * torch.tensor([20.0, -10.0, 5.0])  # some rad/s^2
    backend.set_object_wrench(torch.zeros(n, 3, device=backend.device), torque.float().to(backend.device))
    backend.step(24)
    return snapshot(backend.state())
