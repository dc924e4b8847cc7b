"""The processes behind :mod:`xreset.backends.pool`: the worlds of one process, and worker processes.

Each worker is a fresh interpreter, so it inherits neither torch's threads nor the caller's ``__main__``: scripts need
no main guard. Commands and readings travel through a pipe. The system closes it whichever way the parent ends, so its
workers end too and nothing is left behind.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import subprocess
import sys
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from xreset.backends.rigid import object_inertia
from xreset.errors import XResetError
from xreset.physics import Contacts, Links, State
from xreset.spec import SceneSpec

if TYPE_CHECKING:
    from xreset.backends.pool import World

STATE_FIELDS = tuple(field.name for field in fields(State))
LINK_FIELDS = tuple(field.name for field in fields(Links))
CONTACT_FIELDS = tuple(field.name for field in fields(Contacts))

Arrays = dict[str, np.ndarray]
"""Rows of numbers of worlds, by name: in single precision, or bool."""


def usable_cores() -> int:
    """Return the number of cores that this process may run on."""
    return len(os.sched_getaffinity(0))


# The worlds of one process --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Job:
    """Which worlds a process runs: ``first``, ``first + 1``, ..., one for each object index."""

    backend: str
    world_class: type[World]
    options: Mapping[str, Any]
    scene: SceneSpec
    first: int
    object_index: tuple[int, ...]

    @property
    def stop(self) -> int:
        """The number after that of its last world."""
        return self.first + len(self.object_index)


_MOVING = ("build", "set_state", "step")
"""Commands after which a world reports another state than before."""

_INERTIA_ARGUMENT = {"object_mass": "mass", "object_inertia": "scale", "object_com": "offset"}
"""Parameters of the object's mass properties -> arguments of :meth:`Inertia.changed`."""


class LocalWorlds:
    """The worlds of one job in this process."""

    def __init__(self, job: Job) -> None:
        self._job = job
        count = len(job.object_index)
        self.arrays: Arrays = {name: np.zeros(count, bool) for name in ("nonfinite", "overflow")}
        """What the worlds report."""
        self._worlds: list[World] = []
        self._inertia_changes: list[dict[str, Any]] = [{} for _ in job.object_index]

    def command(
        self, method: str, worlds: np.ndarray, values: Arrays, argument: Any
    ) -> Exception | None:
        """Run one of the methods below for the given worlds with their rows of values, then read what they report.

        All worlds act before any is read: engine and Python code then take turns in the processor's caches once instead
        of once per world.

        Returns:
            What to raise because a world raised. It crosses process boundaries, so it holds the trace as text.
        """
        rows = (worlds - self._job.first).tolist()
        action = getattr(self, f"_{method}")
        row = 0
        try:
            for number, row in enumerate(rows):
                given = {name: value[number].astype(np.float64) for name, value in values.items()}
                action(row, given, argument)
            if method in _MOVING:
                for row in rows:
                    self._read(row)
        except Exception as error:
            world = f"world {self._job.first + row}"
            if isinstance(error, XResetError):  # one that the user can fix
                return type(error)(f"{world}: {error}")
            return RuntimeError(
                f"backend {self._job.backend!r}, {world}, {method}: {type(error).__name__}: {error}\n"
                f"{traceback.format_exc()}"
            )
        return None

    def readings(self, worlds: np.ndarray) -> Arrays:
        """Return what the given worlds report."""
        return {name: array[worlds - self._job.first] for name, array in self.arrays.items()}

    def close(self) -> None:
        """Close the worlds."""
        while self._worlds:
            self._worlds.pop().close()

    def _build(self, i: int, given: Arrays, _) -> None:
        job = self._job
        self._worlds.append(job.world_class(job.scene, job.object_index[i], **job.options))
        self._set_state(i, given, _)

    def _set_state(self, i: int, given: Arrays, _) -> None:
        self._worlds[i].set_state(given)
        self.arrays["nonfinite"][i] = False
        self.arrays["overflow"][i] = False

    def _step(self, i: int, given: Arrays, n: int) -> None:
        if self.arrays["nonfinite"][i]:
            return
        world = self._worlds[i]
        world.set_joint_targets(given["joint_target"])
        world.set_object_wrench(given["wrench"][:3], given["wrench"][3:])
        world.step(n)

    def _mass_properties(self, i: int, *_) -> None:
        bodies = self._worlds[i].mass_properties()
        self._write("mass", i, [body.mass for body in bodies])
        self._write("com", i, [body.com for body in bodies])
        self._write("inertia", i, [body.matrix for body in bodies])

    def _set_parameter(self, i: int, given: Arrays, _) -> None:
        ((name, value),) = given.items()
        if not value.ndim:
            value = float(value)
        if name not in _INERTIA_ARGUMENT:
            getattr(self._worlds[i], f"set_{name}")(value)
            return
        changes = self._inertia_changes[i]
        changes[_INERTIA_ARGUMENT[name]] = value
        nominal = object_inertia(self._job.scene.objects[self._job.object_index[i]])
        self._worlds[i].set_object_inertia(nominal.changed(**changes))

    def _read(self, i: int) -> None:
        if self.arrays["nonfinite"][i]:  # nothing has moved since that was read
            return
        world = self._worlds[i]
        state = world.get_state()
        for name, value in state.items():
            self._write(name, i, value)
        nonfinite, overflow = world.health(state)
        self.arrays["nonfinite"][i] |= nonfinite
        self.arrays["overflow"][i] |= overflow
        readings = (*world.contacts(), *world.links())
        for name, value in zip((*CONTACT_FIELDS, *LINK_FIELDS), readings, strict=True):
            self._write(name, i, value)

    def _write(self, name: str, i: int, value: ArrayLike) -> None:
        if name not in self.arrays:
            first = np.asarray(value)
            kind = first.dtype if first.dtype == bool else np.float32
            self.arrays[name] = np.zeros((len(self._job.object_index), *first.shape), kind)
        self.arrays[name][i] = value


# Worker processes -----------------------------------------------------------------------------------------------------

_BOOT = (
    "import sys; sys.path[:] = {path!r}; from xreset.backends.workers import serve; serve({pipe})"
)
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


class WorkerTeam:
    """Worker processes, each with one job."""

    def __init__(self, jobs: Sequence[Job]) -> None:
        world_class = jobs[0].world_class
        if world_class.__module__ == "__main__" or "<locals>" in world_class.__qualname__:
            raise XResetError(
                f"{world_class.__qualname__} is defined in {world_class.__module__!r}, where worker processes cannot "
                "import it. Move it to a module, or pass workers=0."
            )
        self.arrays: Arrays = {}
        """What all worlds report."""
        self._workers: list[_Worker] = []
        try:
            for job in jobs:
                self._workers.append(_Worker(job))
            for worker in self._workers:
                failure, _ = worker.receive("start")
                if failure is not None:
                    raise failure
        except BaseException:
            self.close()
            raise

    def command(
        self, method: str, worlds: np.ndarray, values: Arrays, argument: Any
    ) -> Exception | None:
        """Have all workers concerned run a command at the same time, and wait for all of them: see
        :meth:`LocalWorlds.command`."""
        asked = []
        for worker in self._workers:
            mine = (worlds >= worker.job.first) & (worlds < worker.job.stop)
            if mine.any():
                rows = {name: value[mine] for name, value in values.items()}
                worker.send((method, worlds[mine], rows, argument))
                asked.append((worker, worlds[mine]))
        failures = []
        for worker, concerned in asked:
            failure, readings = worker.receive(method)
            failures.append(failure)
            for name, rows in readings.items():
                if name not in self.arrays:
                    shape = (self._workers[-1].job.stop, *rows.shape[1:])
                    self.arrays[name] = np.zeros(shape, rows.dtype)
                self.arrays[name][concerned] = rows
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

    def __init__(self, job: Job) -> None:
        self.job = job
        self.pipe, pipe_of_worker = Pipe()
        path = [os.path.abspath(entry) for entry in sys.path]
        with pipe_of_worker:
            boot = _BOOT.format(path=path, pipe=pipe_of_worker.fileno())
            self._process = subprocess.Popen(
                [sys.executable, "-c", boot],
                pass_fds=(pipe_of_worker.fileno(),),
                stdin=subprocess.DEVNULL,
                stdout=2,  # engines print; the caller's standard output is not theirs
                env={**os.environ, **_ONE_THREAD},
                start_new_session=True,  # Ctrl-C is for the parent, which then closes the pipe
            )
        self.send(job)

    def send(self, message: Any) -> None:
        """Send a message; a dead worker is noticed at the reply."""
        with contextlib.suppress(OSError):
            self.pipe.send_bytes(pickle.dumps(message))

    def receive(self, command: str) -> tuple[Exception | None, Arrays]:
        """Wait for the reply: a failure, and readings."""
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
            f"A worker process of the backend {job.backend!r} {how} during {command!r}; it ran worlds "
            f"{job.first} to {job.stop - 1}. Its messages are on standard error. After SIGKILL, it may have run out "
            "of memory: use fewer worlds or workers. workers=0 runs the worlds in this process, for a debugger."
        )


def serve(pipe: int) -> None:
    """Run a worker process: receive a job and then commands through a pipe with this file descriptor, and answer each
    with a failure or None, and readings, until the end."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    connection = Connection(pipe)
    worlds = None
    with contextlib.suppress(EOFError, OSError):  # the parent is gone, or done with this worker
        while True:
            failure = None
            readings = {}
            message = connection.recv_bytes()
            try:
                if worlds is None:
                    worlds = LocalWorlds(pickle.loads(message))
                else:
                    method, concerned, *inputs = pickle.loads(message)
                    failure = worlds.command(method, concerned, *inputs)
                    if failure is None and method != "set_parameter":
                        readings = worlds.readings(concerned)
            except Exception:
                failure = XResetError(f"A worker process failed:\n{traceback.format_exc()}")
            connection.send_bytes(pickle.dumps((failure, readings)))
            if worlds is None:
                return
