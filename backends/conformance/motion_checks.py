"""Checks of free motion: gravity, inertia, external forces, drives."""

from __future__ import annotations

import numpy as np
import torch
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from xreset.backends.conformance.harness import Bench, largest, replace_fields, snapshot
from xreset.backends.conformance.results import Check, Measure
from xreset.spec import GRAVITY, ObjectSpec

_HEIGHT = 1.5  # m, above everything
_STEPS = 24


def free_fall(bench: Bench) -> list[Measure]:
    """Throw objects without spin for half a second: they fall with g, keep their horizontal velocity, and do not begin to turn.

    A semi-implicit step of length h falls g t h / 2 lower than the parabola; the vertical tolerance allows for that much either way.
    """
    backend = bench.backend()
    throw = torch.tensor([0.6, -0.4, 0.8])
    start = replace_fields(bench.start(), object_pos=torch.tensor([*bench.place, _HEIGHT]), object_linvel=throw)
    backend.set_state(start.to(backend.device))
    h = bench.scene.timestep
    steps = round(0.5 / h)
    backend.step(steps)
    end, t = snapshot(backend.state()), steps * h
    gravity = torch.tensor([0.0, 0.0, -GRAVITY])
    off = end.object_pos - (start.object_pos + throw * t + gravity * t * t / 2)
    return [
        Measure(what="velocity", measured=largest(end.object_linvel - throw - gravity * t), tolerance=2e-3, unit="m/s"),
        Measure(what="pos, horizontal", measured=largest(off[:, :2]), tolerance=5e-4, unit="m"),
        Measure(what="pos, vertical", measured=largest(off[:, 2]), tolerance=1.1 * GRAVITY * t * h / 2 + 5e-4, unit="m"),
        Measure(what="spin", measured=largest(end.object_angvel), tolerance=1e-3, unit="rad/s"),
    ]


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
    backend.set_state(start.to(backend.device))
    backend.step(_STEPS)
    end = snapshot(backend.state())

    h = bench.scene.timestep
    t = _STEPS * h
    errors: dict[str, float] = dict.fromkeys(("pos, horizontal", "pos, vertical", "linvel", "orientation", "angvel"), 0.0)
    for i, thing in enumerate(bench.objects):
        turn, omega = _spin(thing, quat, angvel, t)
        arm = Rotation.from_quat(quat, scalar_first=True).apply(thing.com)
        com_velocity = linvel + np.cross(angvel, arm)
        com = start.object_pos[i].double().numpy() + arm + com_velocity * t - np.array([0.0, 0.0, GRAVITY * t * t / 2])
        velocity = com_velocity - np.array([0.0, 0.0, GRAVITY * t]) - np.cross(omega, turn.apply(thing.com))
        off = end.object_pos[i].double().numpy() - (com - turn.apply(thing.com))
        found = Rotation.from_quat(end.object_quat[i].double().numpy(), scalar_first=True)
        for name, error in {
            "pos, horizontal": np.abs(off[:2]).max(),
            "pos, vertical": abs(off[2]),
            "linvel": np.abs(end.object_linvel[i].double().numpy() - velocity).max(),
            "orientation": (found * turn.inv()).magnitude(),
            "angvel": np.abs(end.object_angvel[i].double().numpy() - omega).max(),
        }.items():
            errors[name] = max(errors[name], float(error)) if np.isfinite(error) else float("nan")
    limits = {
        "pos, horizontal": (5e-4, "m"),
        "pos, vertical": (1.1 * GRAVITY * t * h / 2 + 5e-4, "m"),
        "linvel": (3e-3, "m/s"),
        "orientation": (5e-3, "rad"),
        "angvel": (0.05, "rad/s"),  # engines differ in how they treat gyroscopic torque
    }
    return [Measure(what=name, measured=error, tolerance=limits[name][0], unit=limits[name][1]) for name, error in errors.items()]


def object_gravity(bench: Bench) -> list[Measure]:
    """Let objects fall with different gravity fractions, set before the state."""
    backend = bench.altered()
    fraction = torch.tensor([0.0, 0.5, 1.0, 0.25])
    backend.set_object_gravity(fraction.to(backend.device))
    backend.set_state(_in_the_air(bench).to(backend.device))
    backend.step(_STEPS)
    fallen = -snapshot(backend.state()).object_linvel[:, 2]
    expected = fraction * GRAVITY * _STEPS * bench.scene.timestep
    full = GRAVITY * _STEPS * bench.scene.timestep
    spin = largest(backend.state().object_angvel)
    return [
        Measure(what="velocity gained", measured=largest(fallen - expected) / full, tolerance=0.005, unit="of g t"),
        Measure(what="spin gained", measured=spin, tolerance=0.01, unit="rad/s"),
    ]


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
        angular = max(angular, float(np.abs(state.object_angvel[i].double().numpy() - omega).max() / np.abs(omega).max()))
    backend.set_state(_in_the_air(bench).to(device))
    backend.step(steps)
    rest = largest(snapshot(backend.state()).object_linvel[:, :2])
    return [
        Measure(what="velocity of the centre of mass", measured=linear, tolerance=0.01, unit="of its own"),
        Measure(what="angular velocity", measured=angular, tolerance=0.05, unit="of its own"),
        Measure(what="push after the state was set", measured=rest, tolerance=1e-3, unit="m/s"),
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


CHECKS = (
    Check(
        name="free_fall",
        group="object",
        statement="objects fall with g and nothing brakes or turns them",
        cause="the engine damps by default, limits speeds, or gravity acts off the centre of mass, twice, or not at all",
        run=free_fall,
    ),
    Check(
        name="free_spin",
        group="object",
        statement="spinning objects turn as Euler's equations say; linear velocity is that of the mesh-frame origin, angular in the world",
        cause="linear velocity refers to the centre of mass; or angular velocity is in the body's frame; or inertia is turned or damped",
        run=free_spin,
    ),
    Check(
        name="object_gravity",
        group="object",
        statement="the object feels its gravity fraction, world by world, and setting a state keeps it",
        cause="the fraction is ignored, shared by all worlds, lost with the state, or acts off the centre of mass",
        run=object_gravity,
        capabilities=("object_gravity",),
    ),
    Check(
        name="object_wrench",
        group="object",
        statement="a wrench accelerates the object by F/m and I^-1 tau, until a state is set",
        cause="the force acts at the mesh-frame origin, is cleared after one step, or survives the state; or inertia ignores the mass",
        run=object_wrench,
        capabilities=("object_wrench",),
    ),
)
