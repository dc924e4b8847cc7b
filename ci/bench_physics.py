"""physics: control steps per second of each engine while a grasp is held, bare, in a plain loop and behind the interface.

bare      the time within the engine's own step function alone; of mujoco-warp its physics kernels (on a GPU: the captured graph)
raw       the loop that one would write directly against the engine, on one core, over as many worlds: targets set, every physics step with
          the object's weight and the drives that the engine lacks, joints and object read once per control step
forces    the same, and the contact forces on the object are read, too; for PhysX that means to work out friction, which it does not tell
processes the backend: targets set and one control step, all readings (links, contact forces, health) published; beside it the share of
          raw and of forces that each of its processes reaches

Everything runs in turns within one go, and shares are medians over turns; they mean something only while nothing else runs.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import fields
from typing import Any
from unittest import mock

import numpy as np
from benchlib import OBJECT, Options, engines, held_grasp, rate, seconds_of
from rich.console import Console
from rich.table import Table

from xreset import robots
from xreset.backends import make_backend
from xreset.backends.base import Backend, State
from xreset.backends.pool import PoolBackend, World, usable_cores
from xreset.backends.registry import backend_class
from xreset.env import make_scene
from xreset.objects import load_objects
from xreset.spec import GRAVITY, SceneSpec
from xreset.task.config import TaskConfig

_BURST = 10
"""Control steps between two looks at the clock."""
_TURNS = 6
"""Turns after which the grasp starts anew: in minutes any object creeps out of a hand."""
_SETTLE = 20
"""Control steps before the clock runs: the hand closes."""


def run(options: Options, console: Console) -> None:
    robot, task = robots.load(options.robot), TaskConfig()
    scene = make_scene(robot, tuple(load_objects([OBJECT], None)), task)
    grasp = held_grasp(robot, scene.objects)
    grasp = State(**{f.name: getattr(grasp, f.name).expand(options.num_envs, -1).contiguous() for f in fields(State)})
    pools = sorted({1, min(2, usable_cores()), min(usable_cores(), options.num_envs)})
    columns = ["engine", "device", "bare", "raw", "forces", *(f"{n} process{'es' * (n > 1)} (of raw, of forces)" for n in pools), "held"]
    table = Table(*columns, title=f"physics: control steps per second, {options.robot}, {options.num_envs} worlds")
    for name, device in engines(options, console):
        if issubclass(backend_class(name), PoolBackend):
            table.add_row(name, device, *_pooled(name, scene, grasp, pools, options.seconds))
        else:
            bare, wrapped, held = _batched(name, scene, grasp, device, options.seconds)
            cells = ["", "", f"{wrapped:,.0f} ({wrapped / bare:.2f} of bare)", *[""] * (len(pools) - 1)]
            table.add_row(name, device, f"{bare:,.0f}", *cells, held)
    console.print(table)


def _held(backend: Backend, grasp: State) -> str:
    """How many worlds hold their object, and with how many fingers."""
    up = (backend.state().object_pos - grasp.object_pos.to(backend.device)).norm(dim=-1) < 0.02
    fingers = backend.contacts().tip_touch.sum(-1)
    return f"{int((up & (fingers > 1)).sum())} of {len(up)}, by {float(fingers.float().mean()):.1f} fingers"


def _batched(name: str, scene: SceneSpec, grasp: State, device: str, seconds: float) -> tuple[float, float, str]:
    """Bare and wrapped rate of a backend that steps all worlds at once."""
    with make_backend(name, scene, len(grasp.joint_pos), device=device) as backend:
        _start(backend, grasp)
        with backend._on_stream():  # pyright: ignore[reportAttributeAccessIssue]
            bare = rate(lambda: [backend._run("step") for _ in range(scene.substeps)], seconds, device)  # pyright: ignore[reportAttributeAccessIssue]
        _start(backend, grasp)
        wrapped = rate(lambda: _control_step(backend, grasp), seconds, device)
        return bare * backend.num_worlds, wrapped * backend.num_worlds, _held(backend, grasp)


def _pooled(name: str, scene: SceneSpec, grasp: State, pools: list[int], seconds: float) -> list[str]:
    """Cells of the table for an engine that runs a world at a time."""
    n = len(grasp.joint_pos)
    worlds = [backend_class(name).world_class(scene, 0) for _ in range(n)]
    backends = [make_backend(name, scene, n, workers=workers) for workers in pools]
    rates: list[list[float]] = []
    try:
        loops = [
            [_LOOPS.get(name, _world_loop)(world, grasp.joint_target[i].double().numpy(), scene, forces) for i, world in enumerate(worlds)]
            for forces in (False, True)
        ]

        def raw(forces: bool = False) -> None:
            for loop in loops[forces]:
                loop()

        end = time.perf_counter() + seconds * (2 + len(pools))
        while len(rates) < 3 or time.perf_counter() < end:
            if len(rates) % _TURNS == 0:
                for i, world in enumerate(worlds):
                    world.set_state({f.name: getattr(grasp, f.name)[i].double().numpy() for f in fields(State)})
                for _ in range(_SETTLE):
                    raw()
                for backend in backends:
                    _start(backend, grasp)
            turn = [_seconds_within(*_step_function(name, worlds[0]), lambda: _repeat(raw))]
            turn += [seconds_of(lambda: _repeat(raw)), seconds_of(lambda: _repeat(lambda: raw(forces=True)))]
            turn += [seconds_of(lambda b=backend: _repeat(lambda: _control_step(b, grasp))) for backend in backends]
            rates.append([n * _BURST / spent for spent in turn])
        measured = np.array(rates)
        shares = [np.median(measured[:, 3:] / measured[:, [i]], axis=0) / pools for i in (1, 2)]
        rate_of = np.median(measured, axis=0)
        plain = [f"{value:,.0f}" for value in rate_of[:3]]
        wrapped = [f"{value:,.0f} ({a:.2f}, {b:.2f})" for value, a, b in zip(rate_of[3:], *shares, strict=True)]
        return [*plain, *wrapped, _held(backends[-1], grasp)]
    finally:
        for thing in (*worlds, *backends):
            thing.close()


def _start(backend: Backend, grasp: State) -> None:
    backend.set_state(grasp.to(backend.device))
    for _ in range(_SETTLE):
        backend.step()


def _control_step(backend: Backend, grasp: State) -> None:
    backend.set_joint_targets(grasp.joint_target)
    backend.step()


def _repeat(step: Callable[[], object]) -> None:
    for _ in range(_BURST):
        step()


def _seconds_within(owner: Any, name: str, action: Callable[[], object]) -> float:
    """Time that an action spends within ``owner.name``."""
    inner, spent = getattr(owner, name), 0.0

    def timed(*arguments, **keywords) -> None:
        nonlocal spent
        start = time.perf_counter()
        inner(*arguments, **keywords)
        spent += time.perf_counter() - start

    with mock.patch.object(owner, name, timed):
        action()
    return spent


# The loops that a user would write --------------------------------------------------------------------------------------------------------


def _mujoco_loop(world: Any, targets: np.ndarray, scene: SceneSpec, forces: bool) -> Callable[[], object]:
    import mujoco

    model, data = world._model, world._data

    def loop() -> object:
        data.ctrl[:] = targets
        mujoco.mj_step(model, data, scene.substeps)
        if forces:
            world._option.disableflags = world._sensing
            mujoco.mj_sensorAcc(model, data)
            world._option.disableflags = world._silent
        return data.qpos.copy(), data.qvel.copy(), world.contacts() if forces else None

    return loop


def _pybullet_loop(world: Any, targets: np.ndarray, scene: SceneSpec, forces: bool) -> Callable[[], object]:
    p, client, drives = world._p, world._client, world._drives
    robot, thing, joints = world._robot.body, world._object.body, drives._links
    weight = [0.0, 0.0, -GRAVITY * scene.objects[0].mass]

    def loop() -> object:
        drives.target = targets
        for _ in range(scene.substeps * world._internal_steps):
            drives.apply()
            com, _ = p.getBasePositionAndOrientation(thing, physicsClientId=client)
            p.applyExternalForce(thing, -1, weight, com, p.WORLD_FRAME, physicsClientId=client)
            p.stepSimulation(physicsClientId=client)
        states = p.getJointStates(robot, joints, physicsClientId=client)
        joint_pos, joint_vel = np.array([s[0] for s in states]), np.array([s[1] for s in states])
        pose = p.getBasePositionAndOrientation(thing, physicsClientId=client)
        world._fresh = False
        velocity = p.getBaseVelocity(thing, physicsClientId=client)
        return joint_pos, joint_vel, pose, velocity, world.contacts() if forces else None

    return loop


def _sapien_loop(world: Any, targets: np.ndarray, scene: SceneSpec, forces: bool) -> Callable[[], object]:
    from xreset.backends.sapien import _Motion

    thing, joints = world._object, world._joints
    articulation, drives, brakes = joints._articulation, joints._drives, joints._loss.any()
    weight, nothing = np.array([0.0, 0.0, -GRAVITY * scene.objects[0].mass]), np.zeros(3)

    def loop() -> object:
        for joint, target in zip(drives, targets, strict=True):
            joint.set_drive_target(target)
        for remaining in reversed(range(scene.substeps)):
            if brakes:
                joints.brake()
            thing.add_force_torque(weight, nothing)
            if forces and not remaining:
                start = _Motion(thing.linear_velocity, thing.angular_velocity, thing.entity_pose.q)
                world._last_step = start, weight, nothing
            world._system.step()  # set_state makes a new one
        pose = thing.entity_pose
        read = articulation.qpos, articulation.qvel, pose.p, pose.q, thing.linear_velocity, thing.angular_velocity
        return read, world.contacts() if forces else None

    return loop


def _world_loop(world: World, targets: np.ndarray, scene: SceneSpec, forces: bool) -> Callable[[], object]:
    """Of an engine that is not known here."""

    def loop() -> object:
        world.set_joint_targets(targets)
        world.step(scene.substeps)
        return world.get_state(), world.contacts() if forces else None

    return loop


_LOOPS: dict[str, Callable[[Any, np.ndarray, SceneSpec, bool], Callable[[], object]]] = {
    "mujoco": _mujoco_loop,
    "pybullet": _pybullet_loop,
    "sapien": _sapien_loop,
}


def _step_function(name: str, world: Any) -> tuple[object, str]:
    """Where the function is that advances the engine."""
    if name == "mujoco":
        import mujoco

        return mujoco, "mj_step"
    if name == "pybullet":
        return world._p, "stepSimulation"
    if name == "sapien":
        return type(world._system), "step"
    return type(world), "step"
