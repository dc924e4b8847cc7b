"""Checks of free motion: gravity, inertia, external forces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.integrate import solve_ivp
from torch import Tensor

from xreset.backends.conformance.harness import Bench, replace_fields
from xreset.backends.conformance.results import Measured
from xreset.geometry.rotations import matvec, quat_rotate, quat_to_matrix
from xreset.geometry.shapes import turn_of
from xreset.physics import State
from xreset.spec import GRAVITY, ObjectSpec

_STEPS = 24
_TILTED = torch.tensor([0.5, 0.5, 0.5, 0.5])  # the object's x along the world's y, y along z


def free_fall(bench: Bench) -> Measured:
    """Throw objects without spin for half a second: they keep their horizontal velocity and do not begin to turn.

    A semi-implicit step of length h falls g t h / 2 lower than the parabola. The vertical tolerance allows for that
    much either way.
    """
    throw = torch.tensor([0.6, -0.4, 0.8])
    start = replace_fields(bench.in_the_air(), object_linvel=throw)
    h = bench.scene.timestep
    steps = round(0.5 / h)
    end = bench.worlds().advance(start, steps)
    t = steps * h
    gravity = torch.tensor([0.0, 0.0, -GRAVITY])
    off = end.object_pos - (start.object_pos + throw * t + gravity * t * t / 2)
    return bench.by_object(
        {
            "velocity": end.object_linvel - throw - gravity * t,
            "pos, horizontal": off[:, :2],
            "pos, vertical": off[:, 2],
            "spin": end.object_angvel,
        }
    )


def free_spin(bench: Bench) -> Measured:
    """Throw spinning objects: each centre of mass flies a parabola, and the axes turn as Euler's equations say.

    The mesh-frame origin is off the centre of mass, so it matters what the linear velocity refers to. The vertical
    tolerance is that of :func:`free_fall`.
    """
    linvel = np.array([0.4, -0.3, 0.6])
    angvel = np.array([3.0, -2.0, 4.0])
    quat = np.array([0.8, 0.2, -0.4, 0.4])
    quat = quat / np.linalg.norm(quat)
    start = replace_fields(
        bench.in_the_air(),
        object_quat=torch.tensor(quat),
        object_linvel=torch.tensor(linvel),
        object_angvel=torch.tensor(angvel),
    )
    end = bench.worlds().advance(start, _STEPS).map(Tensor.double)
    t = _STEPS * bench.scene.timestep
    gravity = np.array([0.0, 0.0, -GRAVITY])
    com = np.array([obj.com for obj in bench.objects])
    spins = np.array([_spin(obj, quat, angvel, t) for obj in bench.objects])
    turn = turn_of(spins[:, :4])
    omega = turn.apply(spins[:, 4:])
    arm_at_start = turn_of(quat).apply(com)
    arm = turn.apply(com)
    com_velocity = linvel + np.cross(angvel, arm_at_start)
    moved = arm_at_start + com_velocity * t + gravity * t * t / 2 - arm
    off = end.object_pos - start.object_pos - torch.tensor(moved)
    velocity = com_velocity + gravity * t - np.cross(omega, arm)
    orientation = turn_of(end.object_quat)
    return bench.by_object(
        {
            "pos, horizontal": off[:, :2],
            "pos, vertical": off[:, 2],
            "linvel": end.object_linvel - torch.tensor(velocity),
            "orientation": torch.tensor((orientation * turn.inv()).magnitude()),
            "angvel": end.object_angvel - torch.tensor(omega),
        }
    )


def long_spin(bench: Bench) -> Measured:
    """Spin weightless objects for a second: angular momentum stays, and so does the centre of mass."""
    worlds = bench.worlds()
    worlds.set_parameter("object_gravity", torch.zeros(bench.NUM_WORLDS))
    start = bench.in_the_air().map(Tensor.double)
    com = torch.tensor(np.array([obj.com for obj in bench.objects]))
    inertia = torch.tensor(np.array([obj.inertia for obj in bench.objects]))
    spin = torch.tensor([5.0, -3.0, 5.5], dtype=torch.float64).expand_as(com)
    start = replace(start, object_angvel=spin, object_linvel=-torch.linalg.cross(spin, com))
    steps = round(1.0 / bench.scene.timestep)
    end = worlds.advance(start.map(Tensor.float), steps).map(Tensor.double)

    def momentum(state: State) -> Tensor:
        """[N, 3] angular momentum about the centre of mass."""
        R = quat_to_matrix(state.object_quat)
        return matvec(R @ inertia @ R.mT, state.object_angvel)

    def center(state: State) -> Tensor:
        """[N, 3] centre of mass."""
        return state.object_pos + quat_rotate(state.object_quat, com)

    before = momentum(start)
    return bench.by_object(
        {
            "angular momentum": (momentum(end) - before).norm(dim=1) / before.norm(dim=1),
            "centre of mass": center(end) - center(start),
        }
    )


def object_gravity(bench: Bench) -> Measured:
    """Let objects fall with different gravity fractions, set before the state."""
    worlds = bench.worlds()
    fraction = torch.tensor([0.0, 0.5, 1.0, 0.25])
    worlds.set_parameter("object_gravity", fraction)
    end = worlds.advance(bench.in_the_air(), _STEPS)
    full = GRAVITY * _STEPS * bench.scene.timestep
    off = -end.object_linvel[:, 2] - fraction * full
    return bench.by_object({"velocity gained": off / full, "spin gained": end.object_angvel})


def object_wrench(bench: Bench) -> Measured:
    """Push and twist tilted objects in the air, with other masses if those can be set; setting a state ends the
    wrench."""
    worlds = bench.worlds()
    factor = torch.ones(bench.NUM_WORLDS)
    if "object_mass" in worlds.backend.capabilities:
        factor = torch.tensor([1.5, 1.0, 0.5, 2.0])
        worlds.set_parameter("object_mass", factor * bench.masses)
    start = replace_fields(bench.in_the_air(), object_quat=_TILTED)
    worlds.set(start)
    force = torch.tensor([1.2, -0.8, 0.5])
    twist = torch.tensor([2e-3, -1e-3, 1.5e-3])
    worlds.push(force, twist)
    steps = 8
    worlds.step(steps)
    state = worlds.state()
    after = worlds.advance(start, steps)
    t = steps * bench.scene.timestep
    com = torch.tensor(np.stack([obj.com for obj in bench.objects])).float()
    inertia = torch.tensor(np.stack([obj.inertia for obj in bench.objects])).float()
    R = quat_to_matrix(start.object_quat)
    inertia = factor[:, None, None] * (R @ inertia @ R.mT)
    gained = force / (factor * bench.masses)[:, None] * t - torch.tensor([0.0, 0.0, GRAVITY * t])
    omega = torch.linalg.solve(inertia, twist.expand_as(com)) * t  # the object has hardly turned
    arm = quat_rotate(state.object_quat, com)
    com_velocity = state.object_linvel + torch.linalg.cross(state.object_angvel, arm)
    return bench.by_object(
        {
            "velocity of the centre of mass": _relative_difference(com_velocity, gained),
            "angular velocity": _relative_difference(state.object_angvel, omega),
            "push after the state was set": after.object_linvel[:, :2],
        }
    )


def _relative_difference(found: Tensor, expected: Tensor) -> Tensor:
    """[N] largest difference of each row as a share of the expected row's largest number."""
    return (found - expected).abs().amax(dim=1) / expected.abs().amax(dim=1)


def _spin(obj: ObjectSpec, quat: np.ndarray, angvel: np.ndarray, t: float) -> np.ndarray:
    """[7] orientation, and angular velocity in the body's frame, after a time t without torque: Euler's equations."""
    body = turn_of(quat)

    def motion(_, y: np.ndarray) -> np.ndarray:
        w = y[0]
        v = y[1:4]
        omega = y[4:]
        quat_rate = 0.5 * np.array([-v @ omega, *(w * omega + np.cross(v, omega))])
        return np.concatenate(
            (quat_rate, np.linalg.solve(obj.inertia, -np.cross(omega, obj.inertia @ omega)))
        )

    start = np.concatenate((quat, body.inv().apply(angvel)))
    return solve_ivp(motion, (0.0, t), start, rtol=1e-9, atol=1e-9).y[:, -1]
