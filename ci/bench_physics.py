"""physics: a user's own loop against each engine and the same work behind the interface, side by side, while a grasp is held.

raw       the loop that one would write directly against the engine, in one process, over as many worlds: drive targets set, every physics
          step with the object's weight and the drives that the engine lacks, and then the readings taken, once per control step
processes the backend with that many worker processes: targets set, one control step, the same readings (and health) published
bare      the time within the engine's own step function alone; of mujoco-warp its physics kernels (on a GPU: the captured graph)

Two kinds of readings. "state": positions and velocities of joints and object. "all": also poses and velocities of palm and fingertips, as
the engine has them (of MuJoCo from before its last physics step, where the backend's are of now), and the contact forces on the object;
PhysX does not tell friction, so both work it out.

Raw and bare are control steps per second of CPU time, the processes per second of wall time. "of raw" is the CPU time of the raw loop
through that of all processes of the backend, this one included; in brackets the same by the wall clock, per process. Contenders take turns
in slices of some hundredths of a second, every other time in reverse, each slice after a control step that is not counted; ratios are of
slices of one turn, and figures are medians over turns. So other programs on the machine change the wall clock, and not the CPU's share.

By default there are 64 worlds, as many as `xreset eval`, `stress` and `resets` run at a time. To wake a process costs the same whatever
it then has to do, as much as half a world of MuJoCo, so what the pool loses shows more, the fewer worlds there are: see --num-envs 8.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal
from unittest import mock

import numpy as np
from benchlib import OBJECT, Options, engines, held_grasp, rate
from rich.console import Console
from rich.table import Table

from xreset import robots
from xreset.backends.pool import PoolBackend, World
from xreset.backends.workers import usable_cores
from xreset.env.manipulation import make_scene
from xreset.objects.catalogue import load_objects
from xreset.physics import Backend, State
from xreset.physics.plugins import backend_class, make_backend
from xreset.spec import GRAVITY, SceneSpec
from xreset.task.config import TaskConfig

NUM_ENVS = 64
"""Worlds, unless told otherwise: the docstring above says why."""

Readings = Literal["state", "all"]

_SLICE = 0.04
"""Seconds that a slice of the raw loop takes."""
_HOLD = 120
"""Control steps, about, after which the grasp starts again: in minutes any object creeps out of a hand."""
_SETTLE = 20
"""Control steps before the clock runs: the hand closes."""


def run(options: Options, console: Console) -> None:
    robot = robots.load(options.robot)
    task = TaskConfig()
    scene = make_scene(robot, tuple(load_objects([OBJECT], None)), task)
    grasp = held_grasp(robot, scene.objects)
    grasp = grasp.map(lambda x: x.expand(options.num_envs, -1).contiguous())
    pools = sorted({1, min(2, usable_cores()), min(usable_cores(), options.num_envs)})
    processes = []
    for n in pools:
        processes += [f"{n} process{'es' * (n > 1)}", "of raw"]
    columns = ["engine", "device", "readings", "bare", "raw", *processes, "held"]
    table = Table(
        *columns,
        title=f"physics: control steps per second, {options.robot}, {options.num_envs} worlds",
    )
    for name, device in engines(options, console):
        if issubclass(backend_class(name), PoolBackend):
            for cells in _pooled(name, scene, grasp, pools, options.seconds):
                table.add_row(name, device, *cells)
        else:
            bare, wrapped, held = _batched(name, scene, grasp, device, options.seconds)
            cells = [
                "all",
                f"{bare:,.0f}",
                "",
                f"{wrapped:,.0f}",
                f"{wrapped / bare:.2f} of bare",
                *["", ""] * (len(pools) - 1),
            ]
            table.add_row(name, device, *cells, held)
    console.print(table)


def _held(backend: Backend, grasp: State) -> str:
    """How many worlds hold their object, and with how many fingers."""
    up = (backend.state().object_pos - grasp.object_pos.to(backend.device)).norm(dim=-1) < 0.02
    fingers = backend.contacts().tip_touch.sum(-1)
    return f"{int((up & (fingers > 1)).sum())} of {len(up)}, by {float(fingers.float().mean()):.1f} fingers"


def _batched(
    name: str, scene: SceneSpec, grasp: State, device: str, seconds: float
) -> tuple[float, float, str]:
    """Bare and wrapped rate of a backend that steps all worlds at once."""
    with make_backend(name, scene, len(grasp.joint_pos), device=device) as backend:
        _start(backend, grasp)
        with backend._on_stream():  # pyright: ignore[reportAttributeAccessIssue]
            bare = rate(
                lambda: [backend._run("step") for _ in range(scene.substeps)], seconds, device
            )  # pyright: ignore[reportAttributeAccessIssue]
        _start(backend, grasp)
        wrapped = rate(lambda: _control_step(backend, grasp, "all"), seconds, device)
        return bare * backend.num_worlds, wrapped * backend.num_worlds, _held(backend, grasp)


@dataclass(frozen=True)
class _Spent:
    """What a slice took, per control step of all worlds."""

    wall: float
    """[s]"""
    cpu: float
    """[s] of all processes."""


def _pooled(
    name: str, scene: SceneSpec, grasp: State, pools: Sequence[int], seconds: float
) -> list[list[str]]:
    """Rows of the table for an engine that runs a world at a time, one for each kind of readings."""
    n = len(grasp.joint_pos)
    kinds: tuple[Readings, ...] = ("state", "all")
    worlds = [backend_class(name).world_class(scene, 0) for _ in range(n)]
    backends: list[PoolBackend] = []
    try:
        backends += [make_backend(name, scene, n, workers=workers) for workers in pools]  # pyright: ignore[reportArgumentType]
        loop = _LOOPS.get(name, _world_loop)
        targets = grasp.joint_target.double().numpy()
        raw = {}
        for kind in kinds:
            raw[kind] = [loop(world, targets[i], scene, kind) for i, world in enumerate(worlds)]

        def start() -> None:
            for i, world in enumerate(worlds):
                world.set_state({name: x[i].double().numpy() for name, x in vars(grasp).items()})
            for _ in range(_SETTLE):
                _each(raw["state"])
            for backend in backends:
                _start(backend, grasp)

        start()
        steps = max(1, round(_SLICE / _spent(partial(_each, raw["state"]), 3, ()).wall))
        contenders: dict[tuple[int | str, Readings], Callable[[], _Spent]] = {
            ("bare", "state"): partial(
                _within, _step_function(name, worlds[0]), partial(_each, raw["state"]), steps
            )
        }
        for kind in kinds:
            contenders["raw", kind] = partial(_spent, partial(_each, raw[kind]), steps, ())
            for workers, backend in zip(pools, backends, strict=True):
                contenders[workers, kind] = partial(
                    _spent,
                    partial(_control_step, backend, grasp, kind),
                    steps,
                    _process_ids(backend),
                )
        turns: list[dict[Any, _Spent]] = []
        end = time.perf_counter() + seconds * len(contenders)
        while len(turns) < 3 or time.perf_counter() < end:
            if turns and len(turns) % max(1, _HOLD // (3 * steps)) == 0:
                start()
            order = list(contenders) if len(turns) % 2 else list(reversed(contenders))
            turns.append({who: contenders[who]() for who in order})
        held = _held(backends[-1], grasp)

        def cells(kind: Readings) -> list[str]:
            row = [
                kind,
                f"{n / _median(t['bare', kind].cpu for t in turns):,.0f}"
                if ("bare", kind) in contenders
                else "",
            ]
            row.append(f"{n / _median(t['raw', kind].cpu for t in turns):,.0f}")
            for workers in pools:
                cpu = _median(t["raw", kind].cpu / t[workers, kind].cpu for t in turns)
                wall = _median(t["raw", kind].wall / t[workers, kind].wall for t in turns) / workers
                row += [
                    f"{n / _median(t[workers, kind].wall for t in turns):,.0f}",
                    f"{cpu:.2f} ({wall:.2f})",
                ]
            return [*row, held]

        return [cells(kind) for kind in kinds]
    finally:
        for thing in (*worlds, *backends):
            thing.close()


def _start(backend: Backend, grasp: State) -> None:
    backend.set_state(grasp.to(backend.device))
    for _ in range(_SETTLE):
        backend.step()


def _control_step(backend: Backend, grasp: State, kind: Readings) -> object:
    backend.set_joint_targets(grasp.joint_target)
    backend.step()
    read = backend.state(), backend.health()
    return (*read, backend.links(), backend.contacts()) if kind == "all" else read


def _each(loops: Sequence[Callable[[], object]]) -> None:
    for loop in loops:
        loop()


def _median(values: Iterable[float]) -> float:
    return float(np.median(list(values)))


def _process_ids(backend: PoolBackend) -> tuple[int, ...]:
    return tuple(worker._process.pid for worker in getattr(backend._team, "_workers", ()))


def _cpu_time(processes: Sequence[int]) -> float:
    """CPU time that this process and others have taken [s]; the clocks are those of Linux' clock_getcpuclockid(3)."""
    return time.process_time() + sum(time.clock_gettime(~process << 3 | 2) for process in processes)


def _spent(step: Callable[[], object], steps: int, processes: Sequence[int]) -> _Spent:
    """What a control step takes on average of some, after one that is not counted."""
    step()
    cpu = _cpu_time(processes)
    wall = time.perf_counter()
    for _ in range(steps):
        step()
    return _Spent((time.perf_counter() - wall) / steps, (_cpu_time(processes) - cpu) / steps)


def _within(function: tuple[object, str], step: Callable[[], object], steps: int) -> _Spent:
    """What of that passes within the function ``(owner, name)``."""
    inner = getattr(*function)
    wall = 0.0
    cpu = 0.0

    def timed(*arguments, **keywords) -> None:
        nonlocal wall, cpu
        start = time.perf_counter(), time.process_time()
        inner(*arguments, **keywords)
        wall = wall + time.perf_counter() - start[0]
        cpu = cpu + time.process_time() - start[1]

    with mock.patch.object(*function, timed):
        for _ in range(steps):
            step()
    return _Spent(wall / steps, cpu / steps)


# The loops that a user would write --------------------------------------------------------------------------------------------------------


def _mujoco_loop(
    world: Any, targets: np.ndarray, scene: SceneSpec, kind: Readings
) -> Callable[[], object]:
    import mujoco

    model = world._model
    data = world._data
    bodies = world._at.link_body

    def loop() -> object:
        data.ctrl[:] = targets
        mujoco.mj_step(model, data, scene.substeps)
        state = data.qpos.copy(), data.qvel.copy()
        if kind == "state":
            return state
        return state, data.xpos[bodies], data.xquat[bodies], data.cvel[bodies], world.contacts()

    return loop


def _pybullet_loop(
    world: Any, targets: np.ndarray, scene: SceneSpec, kind: Readings
) -> Callable[[], object]:
    from xreset.backends.pybullet import INTERNAL_STEPS

    p = world._p
    drives = world._drives
    tracked = world._frames.bodies
    robot = world._robot
    thing = world._object
    joints = drives._links
    weight = [0.0, 0.0, -GRAVITY * scene.objects[0].mass]

    def loop() -> object:
        drives.target = targets
        for _ in range(scene.substeps * INTERNAL_STEPS):
            drives.apply()
            com, _ = p.getBasePositionAndOrientation(thing)
            p.applyExternalForce(thing, -1, weight, com, p.WORLD_FRAME)
            p.stepSimulation()
        states = p.getJointStates(robot, joints)
        joint_pos = np.array([s[0] for s in states])
        joint_vel = np.array([s[1] for s in states])
        pose = p.getBasePositionAndOrientation(thing)
        state = joint_pos, joint_vel, pose, p.getBaseVelocity(thing)
        if kind == "state":
            return state
        links = p.getLinkStates(robot, tracked, computeLinkVelocity=1, computeForwardKinematics=1)
        world._fresh = False
        return state, np.array([s[4] + s[5] + s[6] + s[7] for s in links]), world.contacts()

    return loop


def _sapien_loop(
    world: Any, targets: np.ndarray, scene: SceneSpec, kind: Readings
) -> Callable[[], object]:
    thing = world._object
    joints = world._joints
    tracked = world._tracked
    articulation = joints._articulation
    drives = joints._drives
    brakes = joints._moving.has_dry_friction
    weight = np.array([0.0, 0.0, -GRAVITY * scene.objects[0].mass])
    nothing = np.zeros(3)

    def motion(body: Any) -> tuple[np.ndarray, ...]:
        pose = body.entity_pose
        return pose.p, pose.q, body.linear_velocity, body.angular_velocity

    def loop() -> object:
        for joint, target in zip(drives, targets, strict=True):
            joint.set_drive_target(target)
        for remaining in reversed(range(scene.substeps)):
            if brakes:
                joints.brake()
            thing.add_force_torque(weight, nothing)
            if kind == "all" and not remaining:
                motion_before = (thing.linear_velocity, thing.angular_velocity, thing.entity_pose.q)
                world._last_step = (*motion_before, weight, nothing)
            world._system.step()  # set_state makes a new one
        state = articulation.qpos, articulation.qvel, *motion(thing)
        return (
            state
            if kind == "state"
            else (state, [motion(body) for body in tracked], world.contacts())
        )

    return loop


def _world_loop(
    world: World, targets: np.ndarray, scene: SceneSpec, kind: Readings
) -> Callable[[], object]:
    """Of an engine that is not known here."""

    def loop() -> object:
        world.set_joint_targets(targets)
        world.step(scene.substeps)
        return (
            world.get_state()
            if kind == "state"
            else (world.get_state(), world.links(), world.contacts())
        )

    return loop


_LOOPS: dict[str, Callable[[Any, np.ndarray, SceneSpec, Readings], Callable[[], object]]] = {
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
