"""Checks of free motion: gravity, inertia, external forces, drives."""

from __future__ import annotations

import numpy as np
import torch
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from xreset.backends.conformance.harness import Bench, advanced, largest, replace_fields, snapshot
from xreset.backends.conformance.results import Measure, checks_of
from xreset.spec import GRAVITY, ObjectSpec

check = checks_of("object")

_HEIGHT = 1.5  # m, above everything
_STEPS = 24


@check(
    "objects fall with g and nothing brakes or turns them",
    "the engine damps by default, limits speeds, or gravity acts off the centre of mass, twice, or not at all",
)
def free_fall(bench: Bench) -> list[Measure]:
    """Throw objects without spin for half a second: they fall with g, keep their horizontal velocity, and do not begin to turn.

    A semi-implicit step of length h falls g t h / 2 lower than the parabola; the vertical tolerance allows for that much either way.
    """
    backend = bench.backend()
    throw = torch.tensor([0.6, -0.4, 0.8])
    start = replace_fields(bench.start(), object_pos=torch.tensor([*bench.place, _HEIGHT]), object_linvel=throw)
    h = bench.scene.timestep
    steps = round(0.5 / h)
    end, t = advanced(backend, start, steps), steps * h
    gravity = torch.tensor([0.0, 0.0, -GRAVITY])
    off = end.object_pos - (start.object_pos + throw * t + gravity * t * t / 2)
    return [
        Measure("velocity", largest(end.object_linvel - throw - gravity * t), 2e-3, "m/s"),
        Measure("pos, horizontal", largest(off[:, :2]), 5e-4, "m"),
        Measure("pos, vertical", largest(off[:, 2]), 1.1 * GRAVITY * t * h / 2 + 5e-4, "m"),
        Measure("spin", largest(end.object_angvel), 1e-3, "rad/s"),
    ]


@check(
    "spinning objects turn as Euler's equations say; linear velocity is that of the mesh-frame origin, angular in the world",
    "linear velocity refers to the centre of mass; or angular velocity is in the body's frame; or inertia is turned or damped",
)
def free_spin(bench: Bench) -> list[Measure]:
    """Throw spinning objects; each one's centre of mass must fly a parabola and its axes turn as Euler's equations say.

    The mesh-frame origin is off the centre of mass, so it matters what the linear velocity refers to. A semi-implicit step of length h
    falls g t h / 2 lower than the parabola; the vertical tolerance allows for that much either way.
    """
    backend = bench.backend()
    start = bench.start()
    linvel, angvel, quat = np.array([0.4, -0.3, 0.6]), np.array([3.0, -2.0, 4.0]), np.array([0.8, 0.2, -0.4, 0.4])
    quat = quat / np.linalg.norm(quat)
    start = replace_fields(
        start,
        object_pos=torch.tensor([*bench.place, _HEIGHT]),
        object_quat=torch.tensor(quat),
        object_linvel=torch.tensor(linvel),
        object_angvel=torch.tensor(angvel),
    )
    end = advanced(backend, start, _STEPS)

    h = bench.scene.timestep
    t = _STEPS * h
    limits = {
        "pos, horizontal": (5e-4, "m"),
        "pos, vertical": (1.1 * GRAVITY * t * h / 2 + 5e-4, "m"),
        "linvel": (3e-3, "m/s"),
        "orientation": (5e-3, "rad"),
        "angvel": (0.05, "rad/s"),  # engines differ in how they treat gyroscopic torque
    }
    errors = []
    for i, thing in enumerate(bench.objects):
        turn, omega = _spin(thing, quat, angvel, t)
        arm = Rotation.from_quat(quat, scalar_first=True).apply(thing.com)
        com_velocity = linvel + np.cross(angvel, arm)
        com = start.object_pos[i].double().numpy() + arm + com_velocity * t - np.array([0.0, 0.0, GRAVITY * t * t / 2])
        velocity = com_velocity - np.array([0.0, 0.0, GRAVITY * t]) - np.cross(omega, turn.apply(thing.com))
        off = end.object_pos[i].double().numpy() - (com - turn.apply(thing.com))
        found = Rotation.from_quat(end.object_quat[i].double().numpy(), scalar_first=True)
        errors.append((
            np.abs(off[:2]).max(),
            abs(off[2]),
            np.abs(end.object_linvel[i].double().numpy() - velocity).max(),
            (found * turn.inv()).magnitude(),
            np.abs(end.object_angvel[i].double().numpy() - omega).max(),
        ))  # fmt: skip
    return [
        Measure(name, float(error), *limit)
        for error, (name, limit) in zip(np.max(errors, axis=0), limits.items(), strict=True)
    ]


@check(
    "the object feels its gravity fraction, world by world, and setting a state keeps it",
    "the fraction is ignored, shared by all worlds, lost with the state, or acts off the centre of mass",
    capabilities=("object_gravity",),
)
def object_gravity(bench: Bench) -> list[Measure]:
    """Let objects fall with different gravity fractions, set before the state."""
    backend = bench.altered()
    fraction = torch.tensor([0.0, 0.5, 1.0, 0.25])
    backend.set_object_gravity(fraction.to(backend.device))
    fallen = -advanced(backend, _in_the_air(bench), _STEPS).object_linvel[:, 2]
    expected = fraction * GRAVITY * _STEPS * bench.scene.timestep
    full = GRAVITY * _STEPS * bench.scene.timestep
    spin = largest(backend.state().object_angvel)
    return [
        Measure("velocity gained", largest(fallen - expected) / full, 0.005, "of g t"),
        Measure("spin gained", spin, 0.01, "rad/s"),
    ]


@check(
    "a wrench accelerates the object by F/m and I^-1 tau, until a state is set",
    "the force acts at the mesh-frame origin, is cleared after one step, or survives the state; or inertia ignores the mass",
    capabilities=("object_wrench",),
)
def object_wrench(bench: Bench) -> list[Measure]:
    """Push and twist objects in the air, for one world in two with another mass if that can be set; setting a state ends it."""
    backend = bench.altered()
    factor = torch.ones(bench.NUM_WORLDS)
    if "object_mass" in backend.capabilities:
        factor = torch.tensor([1.5, 1.0, 0.5, 2.0])
        backend.set_object_mass((factor * torch.tensor([o.mass for o in bench.objects])).float().to(backend.device))
    backend.set_state(_in_the_air(bench).to(backend.device))
    force, twist = torch.tensor([1.2, -0.8, 0.5]), torch.tensor([2e-3, -1e-3, 1.5e-3])
    n, device = bench.NUM_WORLDS, backend.device
    backend.set_object_wrench(force.expand(n, 3).contiguous().to(device), twist.expand(n, 3).contiguous().to(device))
    steps = 8
    backend.step(steps)
    state = snapshot(backend.state())
    t = steps * bench.scene.timestep
    linear, angular = 0.0, 0.0
    for i, thing in enumerate(bench.objects):
        mass, inertia = float(factor[i]) * thing.mass, float(factor[i]) * thing.inertia
        gained = force.double().numpy() / mass * t - np.array([0.0, 0.0, GRAVITY * t])
        omega = np.linalg.solve(inertia, twist.double().numpy()) * t  # the object has hardly turned
        arm = Rotation.from_quat(state.object_quat[i].double().numpy(), scalar_first=True).apply(thing.com)
        com_velocity = state.object_linvel[i].double().numpy() + np.cross(state.object_angvel[i].double().numpy(), arm)
        linear = max(linear, float(np.abs(com_velocity - gained).max() / np.abs(gained).max()))
        angular = max(
            angular, float(np.abs(state.object_angvel[i].double().numpy() - omega).max() / np.abs(omega).max())
        )
    rest = largest(advanced(backend, _in_the_air(bench), steps).object_linvel[:, :2])
    return [
        Measure("velocity of the centre of mass", linear, 0.01, "of its own"),
        Measure("angular velocity", angular, 0.05, "of its own"),
        Measure("push after the state was set", rest, 1e-3, "m/s"),
    ]


def _in_the_air(bench: Bench):
    return replace_fields(bench.start(), object_pos=torch.tensor([*bench.place, _HEIGHT]))


def _spin(thing: ObjectSpec, quat: np.ndarray, angvel: np.ndarray, t: float) -> tuple[Rotation, np.ndarray]:
    """Orientation and angular velocity (world) after a time t without torque: Euler's equations in the body's frame."""
    inertia = np.asarray(thing.inertia)
    body = Rotation.from_quat(quat, scalar_first=True)

    def motion(_, y: np.ndarray) -> np.ndarray:
        q, w = y[:4], y[4:]
        turn = 0.5 * np.array([-q[1:] @ w, *(q[0] * w + np.cross(q[1:], w))])
        return np.concatenate((turn, np.linalg.solve(inertia, -np.cross(w, inertia @ w))))

    end = solve_ivp(motion, (0.0, t), np.concatenate((quat, body.inv().apply(angvel))), rtol=1e-9, atol=1e-9).y[:, -1]
    turned = Rotation.from_quat(end[:4], scalar_first=True)
    return turned, turned.apply(end[4:])
