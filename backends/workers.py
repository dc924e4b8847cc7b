"""The processes behind :mod:`xreset.backends.pool`: shared arrays, the worlds of one process, and worker processes.

Each worker is a fresh interpreter, so it inherits neither torch's threads nor the caller's ``__main__``: scripts need
no main guard. Numbers travel through a file without a name that every process maps, commands through a pipe. The
system closes both whichever way the parent ends, so its workers end too and nothing is left behind.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import pickle
import signal
import subprocess
import sys
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any

import numpy as np

from xreset.backends.rigid import (
    Inertia,
    MovingJoints,
    TrackedLinks,
    mechanism,
    object_inertia,
    sum_contacts,
)
from xreset.errors import WrongValueError, XResetError
from xreset.files.text import shown
from xreset.physics import Contacts, Links, Parameter, Parameters, State, no_readings
from xreset.spec import GRAVITY, SceneSpec

if TYPE_CHECKING:
    from torch import Tensor

    from xreset.backends.pool import World

# Shared arrays --------------------------------------------------------------------------------------------------------

STATE_FIELDS = tuple(field.name for field in fields(State))
LINK_FIELDS = tuple(field.name for field in fields(Links))
CONTACT_FIELDS = tuple(field.name for field in fields(Contacts))


def layout_of(scene: SceneSpec, object_index: Tensor) -> np.dtype:
    """Return the shared arrays of worlds with these objects [N] as the fields of one record.

    The state is both what a world is set to and what it reports.
    """
    robot = scene.robot
    n = len(object_index)
    bodies = len(robot.joints) + len(robot.mimics) + 1
    arrays = []
    for bundle in (
        State.initial(scene, object_index),
        Parameters.nominal(scene, object_index),
        *no_readings(robot, n),
    ):
        for name, value in vars(bundle).items():
            arrays.append((name, value.numpy().dtype, tuple(value.shape)))
    for name, shape in (
        ("wrench", (6,)),
        ("body_mass", (bodies,)),
        ("body_com", (bodies, 3)),
        ("body_inertia", (bodies, 3, 3)),
    ):
        arrays.append((name, np.float32, (n, *shape)))
    return np.dtype(arrays, align=True)  # a number may follow any number of flags


def arrays_in(memory: Any, layout: np.dtype) -> dict[str, np.ndarray]:
    """Return the arrays of a layout in a block of memory."""
    record = np.frombuffer(memory, layout)
    return {name: record[name][0] for name in layout.fields or ()}


def usable_cores() -> int:
    """Return the number of cores that this process may run on."""
    return len(os.sched_getaffinity(0))


# The worlds of one process --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Job:
    """Which worlds a process runs."""

    backend: str
    world_class: type[World]
    adds_weight: bool
    """Whether the object's weight is part of the force that its world is given."""
    options: Mapping[str, Any]
    scene: SceneSpec
    worlds: range
    """Numbers of its worlds."""
    object_index: tuple[int, ...]
    """Object of each of its worlds."""


_MOVING = ("build", "set_state", "step")
"""Commands after which a world reports something else than before."""

_GIVEN = {"build": STATE_FIELDS, "set_state": STATE_FIELDS, "step": ("joint_target", "wrench")}
"""Arrays that a command gives to the worlds, in double precision."""

_INERTIA_ARGUMENT = {"object_mass": "mass", "object_inertia": "scale", "object_com": "offset"}
"""Parameters of the object's mass properties -> arguments of :meth:`Inertia.changed`."""


class LocalWorlds:
    """The worlds of one job in this process."""

    def __init__(self, job: Job, arrays: Mapping[str, np.ndarray]) -> None:
        self._job = job
        own = slice(job.worlds.start, None, job.worlds.step)
        self._arrays = {name: array[own] for name, array in arrays.items()}
        self._given: dict[str, np.ndarray] = {}
        self._worlds: list[World] = []
        count = len(job.object_index)
        self._inertia_changes: list[dict[str, Any]] = [{} for _ in range(count)]
        objects = [job.scene.objects[i] for i in job.object_index]
        self._masses = [float(obj.mass) for obj in objects]
        self._gravity = [1.0] * count
        """Gravity fraction of each world's object."""
        self._unread = [{"get_state", "health", "contacts", "links"} for _ in range(count)]
        """Readings of each world that have not been checked yet."""
        robot = job.scene.robot
        self._tips = len(robot.fingertips)

    def command(self, method: str, worlds: np.ndarray | None, argument: Any) -> Exception | None:
        """Run one of the methods below for the given worlds (all if None), then publish what they report.

        All worlds act before any is published: engine and Python code then take turns in the processor's caches once
        instead of once per world.

        Returns:
            What to raise because a world raised. It crosses process boundaries, so it holds the trace as text.
        """
        own = self._job.worlds
        rows = range(len(own)) if worlds is None else [own.index(i) for i in worlds.tolist()]
        self._given = {
            name: self._arrays[name].astype(np.float64) for name in _GIVEN.get(method, ())
        }
        action = getattr(self, f"_{method}")
        row = 0
        try:
            for row in rows:
                action(row, argument)
            if method in _MOVING:
                for row in rows:
                    self._publish(row, stepped=method == "step")
        except Exception as error:
            world = f"world {own[row]}"
            if isinstance(error, XResetError):  # one that the user can fix
                return type(error)(f"{world}: {error}")
            return RuntimeError(
                f"backend {self._job.backend!r}, {world}, {method}: {type(error).__name__}: {error}\n"
                f"{traceback.format_exc()}"
            )
        return None

    def close(self) -> None:
        """Close the worlds."""
        while self._worlds:
            self._worlds.pop().close()

    def _build(self, i: int, _) -> None:
        job = self._job
        self._worlds.append(job.world_class(job.scene, job.object_index[i], **job.options))
        self._set_state(i, _)

    def _set_state(self, i: int, _) -> None:
        self._worlds[i].set_state({name: self._given[name][i] for name in STATE_FIELDS})
        self._arrays["nonfinite"][i] = False
        self._arrays["overflow"][i] = False

    def _step(self, i: int, n: int) -> None:
        if self._arrays["nonfinite"][i]:
            return
        world = self._worlds[i]
        wrench = self._given["wrench"][i]
        if self._job.adds_weight:
            wrench[2] += self._masses[i] * (-GRAVITY * self._gravity[i])
        world.set_joint_targets(self._given["joint_target"][i])
        world.set_object_wrench(wrench[:3], wrench[3:])
        world.step(n)

    @cached_property
    def _tracked(self) -> tuple[MovingJoints, TrackedLinks]:
        robot = mechanism(self._job.scene.robot)
        return MovingJoints(robot.robot, robot.joint_names), TrackedLinks(robot)

    def _mass_properties(self, i: int, _) -> None:
        world = self._worlds[i]
        bodies = world.mass_properties()
        count = self._arrays["body_mass"].shape[1]
        if len(bodies) != count or not all(isinstance(body, Inertia) for body in bodies):
            raise WrongValueError(
                f"{type(world).__qualname__}.mass_properties() returns {shown(bodies)}, expected {count} Inertia: of "
                "each moving body of the robot, then of the object"
            )
        for k, body in enumerate(bodies):
            self._arrays["body_mass"][i, k] = body.mass
            self._arrays["body_com"][i, k] = body.com
            self._arrays["body_inertia"][i, k] = body.matrix

    def _set_parameter(self, i: int, name: Parameter) -> None:
        value = self._arrays[name][i].astype(np.float64)
        if not value.ndim:
            value = float(value)
        world = self._worlds[i]
        if name == "object_gravity":
            self._gravity[i] = value
            if self._job.adds_weight:
                return
        if name not in _INERTIA_ARGUMENT:
            getattr(world, f"set_{name}")(value)
            return
        changes = self._inertia_changes[i]
        changes[_INERTIA_ARGUMENT[name]] = value
        nominal = object_inertia(self._job.scene.objects[self._job.object_index[i]])
        inertia = nominal.changed(**changes)
        self._masses[i] = inertia.mass
        world.set_object_inertia(inertia)

    def _publish(self, i: int, stepped: bool) -> None:
        """Copy what a world reports to the shared arrays."""
        arrays = self._arrays
        if arrays["nonfinite"][i]:  # nothing has moved since that was published
            return
        world = self._worlds[i]
        state = world.get_state()
        self._take(i, "get_state", STATE_FIELDS, state)
        health = world.health(state)
        self._check(i, "health", ("nonfinite", "overflow"), health)
        for name, value in zip(("nonfinite", "overflow"), health, strict=True):
            arrays[name][i] |= value
        if stepped:
            contacts = sum_contacts(self._tips, world.contacts())
            self._take(i, "contacts", CONTACT_FIELDS, contacts)
        else:
            for name in CONTACT_FIELDS:
                arrays[name][i] = 0
        links = world.links()
        if links is None:
            joints, tracked = self._tracked
            links = tracked.locate(*joints.spread(state["joint_pos"], state["joint_vel"]))
        self._take(i, "links", LINK_FIELDS, links)

    def _take(self, i: int, reading: str, names: Sequence[str], found: Any) -> None:
        """Copy a reading of a world to the shared arrays."""
        self._check(i, reading, names, found)
        values = found.items() if isinstance(found, Mapping) else zip(names, found, strict=True)
        for name, value in values:
            self._arrays[name][i] = value

    def _check(self, i: int, reading: str, names: Sequence[str], found: Any) -> None:
        """Refuse the first reading of a world whose names, shapes or types are not those of the contract."""
        if reading not in self._unread[i]:
            return
        wanted = {name: self._arrays[name][i] for name in names}
        check_reading(f"{type(self._worlds[i]).__qualname__}.{reading}()", wanted, found)
        self._unread[i].remove(reading)


def check_reading(what: str, wanted: Mapping[str, np.ndarray], found: Any) -> None:
    """Refuse a reading of a world that is not what the contract says; ``WrongValueError`` names the field.

    Args:
        what: the method that returned it.
        wanted: arrays with the shapes and kinds of numbers that it should have, by name.
        found: arrays by name, or in a sequence in this order.
    """
    if isinstance(found, tuple | list) and len(found) == len(wanted):
        found = dict(zip(wanted, found, strict=True))
    if not isinstance(found, Mapping):
        raise WrongValueError(f"{what} returns {shown(found)}, expected {', '.join(wanted)}")
    if unknown := found.keys() - wanted.keys():
        raise WrongValueError(
            f"{what} has the unknown field {', '.join(sorted(map(str, unknown)))}, expected {', '.join(wanted)}"
        )
    if missing := wanted.keys() - found.keys():
        raise WrongValueError(f"{what} lacks {', '.join(sorted(missing))}: add it")
    for name, value in found.items():
        array = np.asarray(value)
        like = wanted[name]
        kind = "bool" if like.dtype == bool else "float"
        if array.shape != like.shape or array.dtype.kind != kind[0]:
            raise WrongValueError(
                f"{what}: {name} has shape {array.shape} and type {array.dtype}, expected {like.shape} and {kind}"
            )


# Worker processes -----------------------------------------------------------------------------------------------------

_BOOT = "import sys; sys.path[:] = {path!r}; from xreset.backends.workers import serve; serve({pipe}, {memory})"
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


class WorkerTeam:
    """Worker processes, each with one job."""

    def __init__(self, jobs: Sequence[Job], layout: np.dtype) -> None:
        world_class = jobs[0].world_class
        if world_class.__module__ == "__main__" or "<locals>" in world_class.__qualname__:
            raise XResetError(
                f"{world_class.__qualname__} is defined in {world_class.__module__!r}, where worker processes cannot "
                "import it. Move it to a module, or pass workers=0."
            )
        self._workers: list[_Worker] = []
        try:
            with open(os.memfd_create("xreset"), "wb") as file:
                file.truncate(layout.itemsize)
                self.arrays = arrays_in(mmap.mmap(file.fileno(), layout.itemsize), layout)
                for job in jobs:
                    self._workers.append(_Worker(job, file.fileno()))
            for worker in self._workers:
                worker.send((layout, worker.job))
            for worker in self._workers:
                if failure := worker.receive("start"):
                    raise failure
        except BaseException:
            self.close()
            raise

    def command(self, method: str, worlds: np.ndarray | None, argument: Any) -> Exception | None:
        """Have all workers concerned run a command at the same time, wait for all of them, and return the first
        failure."""
        asked = []
        for worker in self._workers:
            mine = worlds
            if worlds is not None:
                mine = worlds[np.isin(worlds, worker.job.worlds)]
                if not mine.size:
                    continue
            worker.send((method, mine, argument))
            asked.append(worker)
        failures = [worker.receive(method) for worker in asked]
        return next(filter(None, failures), None)

    def close(self) -> None:
        """Close the pipes, which ends the workers; kill those that do not end in time."""
        for worker in self._workers:
            worker.pipe.close()
        for worker in self._workers:
            worker.wait()
        self._workers.clear()


class _Worker:
    """One worker process, as its parent sees it."""

    _END_WITHIN = 5.0
    """Seconds that a worker may take to end."""

    def __init__(self, job: Job, memory: int) -> None:
        self.job = job
        self.pipe, pipe_of_worker = Pipe()
        path = [os.path.abspath(entry) for entry in sys.path]
        with pipe_of_worker:
            boot = _BOOT.format(path=path, pipe=pipe_of_worker.fileno(), memory=memory)
            self._process = subprocess.Popen(
                [sys.executable, "-c", boot],
                pass_fds=(pipe_of_worker.fileno(), memory),
                stdin=subprocess.DEVNULL,
                stdout=2,  # engines print; the caller's standard output is not theirs
                env={**os.environ, **_ONE_THREAD},
                start_new_session=True,  # Ctrl-C is for the parent, which then closes the pipe
            )

    def send(self, message: tuple[Any, ...]) -> None:
        """Send a message; a dead worker is noticed at the reply."""
        with contextlib.suppress(OSError):
            self.pipe.send_bytes(pickle.dumps(message))

    def receive(self, command: str) -> Exception | None:
        """Wait for the reply, and return the failure that it holds."""
        try:
            return pickle.loads(self.pipe.recv_bytes())
        except (EOFError, OSError) as error:
            raise XResetError(self._cause_of_death(command)) from error

    def wait(self) -> None:
        """Wait for the end, and force it if need be."""
        try:
            self._process.wait(self._END_WITHIN)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _cause_of_death(self, command: str) -> str:
        self.pipe.close()
        self.wait()
        code = self._process.returncode
        job = self.job
        how = (
            f"was ended by {signal.Signals(-code).name}"
            if code < 0
            else f"ended with exit code {code}"
        )
        return (
            f"A worker process of the engine {job.backend!r} {how} during {command!r}; it ran the worlds "
            f"{shown(list(job.worlds))}. Its messages are on standard error. After SIGKILL, it may have run out of "
            "memory: use fewer worlds or workers. workers=0 runs the worlds in this process, for a debugger."
        )


def serve(pipe: int, memory: int) -> None:
    """Run a worker process: receive a job and then commands, and answer each with None or a failure, until the end.

    Args:
        pipe: file descriptor of the pipe to the parent.
        memory: file descriptor of the shared arrays.
    """
    # A scheduler may send signals to all processes of a job. They are for the parent, which then closes the pipe.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    connection = Connection(pipe)
    worlds = None
    with contextlib.suppress(EOFError, OSError):  # the parent is gone, or done with this worker
        while True:
            failure = None
            message = connection.recv_bytes()
            try:
                if worlds is None:
                    layout, job = pickle.loads(message)
                    worlds = LocalWorlds(job, arrays_in(mmap.mmap(memory, layout.itemsize), layout))
                else:
                    failure = worlds.command(*pickle.loads(message))
            except Exception:
                failure = XResetError(f"A worker process failed:\n{traceback.format_exc()}")
            connection.send_bytes(pickle.dumps(failure))
            if worlds is None:
                return
