"""Checks of objects on the table: forces, heights, friction, and what setting mass, inertia and friction changes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import product

import numpy as np
import torch
from torch import Tensor

from xreset.backends.conformance.harness import FRICTIONS, SETTLE, Bench, Worlds, replace_fields
from xreset.backends.conformance.results import Differences, Measured
from xreset.backends.conformance.scene import ball, flat_objects
from xreset.geometry.rotations import quat_angle
from xreset.physics import Parameter, Parameters, State
from xreset.spec import GRAVITY, ObjectSpec, SceneSpec, lowest_point

_FACTORS = torch.tensor([2.0, 0.5, 4.0, 0.25])

Motion = Callable[[Bench, Worlds, Sequence[int]], tuple[State, Tensor]]
"""Moves worlds that hold the objects of some of the bench's worlds. Returns the end and the table's forces [N, 3]."""


def resting_weight(bench: Bench) -> Measured:
    """Put objects on the table: no force right after setting; after half a second the table carries their weight.
    Setting some of the worlds then leaves the forces of the others as they are."""
    worlds = bench.worlds()
    start = bench.start()
    fresh = worlds.contacts()
    worlds.step(SETTLE)
    contacts = worlds.contacts()
    moved = worlds.state().object_pos - start.object_pos
    weight = GRAVITY * bench.masses
    worlds.set(start, [3, 1])
    left = contacts.table_force.clone()
    left[[3, 1]] = 0.0
    return bench.by_object(
        {
            "force right after setting": torch.cat(
                (fresh.table_force[:, None], fresh.tip_force), dim=1
            ),
            "force after some were set": worlds.contacts().table_force - left,
            "vertical force": contacts.table_force[:, 2] / weight - 1.0,
            "horizontal force": contacts.table_force[:, :2] / weight[:, None],
            "force of the fingers": contacts.tip_force,
            "fingers that say they touch": contacts.tip_touch.sum(dim=1),
            "sinking": moved[:, 2],
            "sliding": moved[:, :2],
        }
    )


def resting_on_a_side(bench: Bench) -> Measured:
    """Lay objects on one of their sides: the table's force is m g along the world's z, not along the object's."""
    quat = torch.tensor([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0])  # by 90 degrees about x
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    start = replace_fields(bench.start(), object_quat=quat)
    heights = [-lowest_point(obj.pieces, turn) for obj in bench.objects]
    start.object_pos[:, 2] = torch.tensor(heights)
    worlds = bench.worlds()
    worlds.advance(start, SETTLE)
    force = worlds.contacts().table_force / (GRAVITY * bench.masses)[:, None]
    force[[obj.name == "can" for obj in bench.objects]] = torch.tensor([0.0, 0.0, 1.0])  # it rolls
    return bench.by_object({"vertical force": force[:, 2] - 1.0, "horizontal force": force[:, :2]})


def rest_and_bounce(bench: Bench) -> Measured:
    """Put flat objects on the table, then drop them from 30 mm: their height after a second, and their bounce."""
    objects = flat_objects()
    names = [obj.name for obj in objects]
    scene = replace(bench.scene, objects=objects)
    object_index = range(len(objects))
    start = bench.initial(scene, object_index)
    height = start.object_pos[:, 2]

    above = replace_fields(start, object_pos=start.object_pos + torch.tensor([0.0, 0.0, 0.03]))
    second = round(1.0 / scene.timestep)
    rows = []
    with bench.other(scene, object_index) as worlds:
        resting = worlds.advance(start, second).object_pos[:, 2]
        worlds.set(above)
        for _ in range(second):
            worlds.step(1)
            rows.append(worlds.state().object_pos[:, 2])
    dropped = torch.stack(rows)
    bounce = []
    for i, lowest in enumerate(dropped.argmin(dim=0).tolist()):
        bounce.append((dropped[lowest:, i].max() - height[i]).clamp_min(0.0))
    return {
        "height after 1 s": zip(names, resting - height),
        "height 1 s after a drop": zip(names, dropped[-1] - height),
        "bounce": zip(names, bounce),
    }


def set_as_built(bench: Bench) -> Measured:
    """Set mass and friction in some worlds and build others with them: objects must do the same in both.

    Masses change by powers of two, so that no product is rounded. Contacts amplify a rounding error, and rounding
    depends on the processor's matrix kernels.
    """
    mass = _FACTORS * bench.masses
    parameters: dict[Parameter, Tensor] = {"object_mass": mass, "friction": FRICTIONS}
    return _against_built(bench, parameters, {"sliding": _slide})


def object_inertia_set(bench: Bench) -> Measured:
    """Set the inertia of some worlds' objects and build others so: tumbling and sliding must be the same in both."""
    return _against_built(bench, {"object_inertia": _FACTORS}, _FREE_AND_SLIDING)


def object_com_set(bench: Bench) -> Measured:
    """Move the centre of mass of some worlds' objects and build others so: both must tumble and slide alike."""
    offsets = torch.tensor([[2.0, 0, 0], [0, -2, 1], [1, 1, -1], [0, 0, 0]]) / 256  # no rounding
    return _against_built(bench, {"object_com": offsets}, _FREE_AND_SLIDING)


_BUILT_IN: tuple[Parameter, ...] = ("object_mass", "friction", "torsional_friction")
"""Parameters that worlds are built with and whose nominal values single precision rounds."""


def _against_built(
    bench: Bench, parameters: dict[Parameter, Tensor], motions: dict[str, Motion]
) -> Measured:
    """Compare each world, whose parameters are set, with one that was built with them: place, angle and force per
    weight."""
    worlds = bench.worlds()
    # Parameters are single precision. A rounded friction alone moves the points where a can touches the table.
    nominal = Parameters.nominal(bench.scene, torch.tensor(bench.object_index)).given()
    usual: dict[Parameter, Tensor] = {}
    for name in _BUILT_IN:
        if name in bench.backend.capabilities:
            usual[name] = nominal[name]
    parameters = usual | parameters
    for name, value in parameters.items():
        for rows in ([3, 0], [1, 2]):
            worlds.set_parameter(name, value, rows)
    found = {name: move(bench, worlds, range(bench.NUM_WORLDS)) for name, move in motions.items()}
    errors: dict[str, list[tuple[str, Differences]]] = defaultdict(list)
    for i, obj in enumerate(bench.objects):
        given = {name: value[i].double().numpy() for name, value in parameters.items()}
        scene = _built_with(replace(bench.scene, objects=(obj,)), given)
        weight = GRAVITY * scene.objects[0].mass
        with bench.other(scene) as other:
            for motion, move in motions.items():
                # A difference of 1e-10 moves the points where a can touches the table, and turns it by 0.4 mrad.
                if move is _slide and obj.name == "can" and not worlds.exact:
                    continue
                state, force = found[motion]
                built, force_built = move(bench, other, [i])
                quat = state.object_quat[i].double()
                off = {
                    "pos": state.object_pos[i] - built.object_pos[0],
                    "angle": quat_angle(quat, built.object_quat[0].double()),
                    "force": (force[i] - force_built[0]) / weight,
                }
                for what, error in off.items():
                    errors[f"{motion}, {what}"].append((obj.name, error))
    return errors


def _built_with(scene: SceneSpec, given: Mapping[str, np.ndarray]) -> SceneSpec:
    """Return a scene of one object whose specification has the values that a world was given."""
    (obj,) = scene.objects
    mass = float(given.get("object_mass", obj.mass))
    growth = given.get("object_inertia", 1.0) * mass / obj.mass
    changed = replace(
        obj,
        mass=mass,
        inertia=growth * obj.inertia,
        com=obj.com + given.get("object_com", 0.0),
    )
    friction = scene.friction
    if "friction" in given:
        tip, link, table = given["friction"].tolist()
        friction = replace(friction, tip=tip, link=link, table=table)
    if "torsional_friction" in given:
        friction = replace(friction, torsional=float(given["torsional_friction"]))
    return replace(scene, objects=(changed,), friction=friction)


def _slide(bench: Bench, worlds: Worlds, rows: Sequence[int]) -> tuple[State, Tensor]:
    """Let objects slide and turn on the table, only for a moment, because contacts amplify rounding errors."""
    start = bench.start()[list(rows)]
    start = replace_fields(
        start,
        object_linvel=torch.tensor([0.25, 0.1, 0.0]),
        object_angvel=torch.tensor([0.0, 0.0, 3.0]),
    )
    end = worlds.advance(start, 2)
    return end, worlds.contacts().table_force


def _tumble(bench: Bench, worlds: Worlds, rows: Sequence[int]) -> tuple[State, Tensor]:
    """Let objects tumble through the air for a moment, under a torque."""
    start = bench.random_state(seed=21)[list(rows)]
    worlds.set(start)
    size = torch.tensor([float(np.trace(bench.objects[i].inertia)) for i in rows])
    torque = size[:, None] * torch.tensor([20.0, -10.0, 5.0])  # some rad/s^2
    worlds.push(torch.zeros(3), torque)
    worlds.step(24)
    return worlds.state(), torch.zeros(len(rows), 3)


_FREE_AND_SLIDING: dict[str, Motion] = {"tumbling": _tumble, "sliding": _slide}

# Friction -------------------------------------------------------------------------------------------------------------

_CASES = list(product((0.2, 0.5, 0.8, 1.2), (0, 45)))
"""Coefficient with the table, and direction of motion."""
_CASE_NAMES = [f"mu {mu}, {degrees} degrees" for mu, degrees in _CASES]
_DISTANCE = 0.2  # m that every object slides


def sliding_distance(bench: Bench) -> Measured:
    """Push boxes off at the speed v with which Coulomb friction stops them after v^2 / (2 mu g) = 0.2 m."""
    shapes = flat_objects()[:3]
    mu, direction = _cases(bench, len(shapes))
    speed = (2.0 * mu * GRAVITY * _DISTANCE).sqrt()
    start, path = _sliding(bench, shapes, mu, speed[:, None] * direction, each_step=False)
    way = ((path[-1] - start) * direction).sum(-1)
    off = (way / _DISTANCE - 1.0).view(len(_CASES), len(shapes))
    names = [shape.name for shape in shapes]
    return {case: zip(names, row) for case, row in zip(_CASE_NAMES, off, strict=True)}


def sliding_height(bench: Bench) -> Measured:
    """Push boxes off at 1 m/s on a table of friction 0.6, and look at the whole path: they stay on the table."""
    shapes = flat_objects()[:3]
    mu, direction = _cases(bench, len(shapes), ((0.6, 0), (0.6, 45)))
    start, path = _sliding(bench, shapes * 2, mu, direction, each_step=True)
    height = (path - start)[..., 2]
    names = [shape.name for shape in shapes] * 2
    return {
        "above the table": zip(names, height.amax(dim=0).clamp_min(0.0)),
        "in the table": zip(names, height.amin(dim=0).clamp_max(0.0)),
    }


def _sliding(
    bench: Bench, shapes: Sequence[ObjectSpec], mu: Tensor, velocity: Tensor, *, each_step: bool
) -> tuple[Tensor, Tensor]:
    """Return places [N, 3] at the start, and at every step of a second or at its end [T, N, 3], of objects that
    slide."""
    scene = replace(bench.scene, objects=tuple(shapes))
    object_index = [i % len(shapes) for i in range(len(mu))]
    start = replace_fields(bench.initial(scene, object_index), object_linvel=velocity)
    path = []
    with bench.other(scene, object_index) as worlds:
        worlds.set_parameter("friction", _same_for_all_pairs(mu))
        worlds.set(start)
        second = round(1.0 / scene.timestep)
        at_once = 1 if each_step else second  # engines read contacts and links after every call
        for _ in range(0, second, at_once):
            worlds.step(at_once)
            path.append(worlds.state().object_pos)
    return start.object_pos, torch.stack(path)


def slope(bench: Bench) -> Measured:
    """Load a box sideways, as a slope does, with 0.95 and 1.05 of mu m g: it must stay, and slide with 0.05 mu g."""
    box = flat_objects()[0]
    scene = replace(bench.scene, objects=(box,))
    mu, direction = _cases(bench, 2)  # two worlds a case: one below the cone, one beyond it
    ratio = torch.tensor([0.95, 1.05]).repeat(len(_CASES))
    object_index = [0] * len(mu)
    force = (ratio * mu * box.mass * GRAVITY)[:, None] * direction
    quarter = round(0.25 / scene.timestep)
    half = round(0.5 / scene.timestep)
    with bench.other(scene, object_index) as worlds:
        worlds.set_parameter("friction", _same_for_all_pairs(mu))
        worlds.advance(bench.initial(scene, object_index), quarter)
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
    for i, case in enumerate(_CASE_NAMES):
        errors[f"creep, {case}"] = creep[2 * i]
        errors[f"acceleration, {case}"] = off[2 * i + 1]
    return errors


def torsional_friction(bench: Bench) -> Measured:
    """Spin a ball on the table with two sliding frictions: torsional friction brakes it with the same torque in both.

    I domega/dt = -t m g, with t the torsional friction, a length.
    """
    friction = _same_for_all_pairs(torch.tensor([0.3, 1.0]))
    # The time is long, so that the variations of an unsteady contact average out.
    lost = _spin_lost(bench, 2, 0.8, lambda worlds: worlds.set_parameter("friction", friction))
    return {"spin lost": lost - 1.0}


def torsional_friction_set(bench: Bench) -> Measured:
    """Spin balls whose torsional friction was set world by world, then a state: each is braked by its own.

    I domega/dt = -t m g, with t from none to twice the scene's torsional friction.
    """
    factors = torch.tensor([0.0, 0.5, 1.0, 2.0])

    def prepare(worlds: Worlds) -> None:
        for rows in ([3, 1], [0]):
            worlds.set_parameter(
                "torsional_friction", factors * bench.scene.friction.torsional, rows
            )

    return {"spin lost": _spin_lost(bench, len(factors), 0.4, prepare) - factors}


def _spin_lost(
    bench: Bench, count: int, seconds: float, prepare: Callable[[Worlds], None]
) -> Tensor:
    """[count] spin that balls on the table lose, as a share of the loss by the scene's torsional friction."""
    obj = ball()
    scene = replace(bench.scene, objects=(obj,))
    object_index = [0] * count
    start = replace_fields(
        bench.initial(scene, object_index), object_angvel=torch.tensor([0.0, 0.0, 10.0])
    )
    steps = round(seconds / scene.timestep)
    with bench.other(scene, object_index) as worlds:
        prepare(worlds)
        lost = 10.0 - worlds.advance(start, steps).object_angvel[:, 2]
    braking = scene.friction.torsional * obj.mass * GRAVITY / float(obj.inertia[2, 2])
    return lost / (braking * steps * scene.timestep)


def _cases(
    bench: Bench, each: int, cases: Sequence[tuple[float, int]] = _CASES
) -> tuple[Tensor, Tensor]:
    """Coefficient [N] and direction [N, 3], towards the table's middle, of the worlds, ``each`` of them a case."""
    mu, degrees = torch.tensor(cases).repeat_interleave(each, dim=0).T
    angle = degrees.deg2rad()
    towards = torch.tensor(bench.scene.table.center) - torch.tensor(bench.place)
    direction = torch.zeros(len(mu), 3)
    direction[:, :2] = torch.stack((angle.cos(), angle.sin()), dim=1) * towards.sign()
    return mu, direction


def _same_for_all_pairs(mu: Tensor) -> Tensor:
    """[N, 3] the same friction [N] for all pairs; only the table is touched."""
    return mu[:, None].expand(-1, 3)
