"""The processes behind :mod:`xreset.backends.pool`: shared arrays, the worlds of one process, and worker processes.

Each worker is a fresh interpreter (``python -c``), so it inherits neither torch's threads nor the caller's ``__main__``: scripts need no
main guard. Numbers travel through one file that every process maps and that the parent then unlinks; commands travel through the worker's
standard input, and the worker ends with it. So whatever way the parent dies, its workers end and nothing is left behind.
"""

from __future__ import annotations

import contextlib
import fcntl
import mmap
import os
import pickle
import select
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from xreset.backends.rigid import object_inertia
from xreset.errors import XResetError
from xreset.physics import Parameter, State
from xreset.spec import RobotSpec, SceneSpec

if TYPE_CHECKING:
    from xreset.backends.pool import World

# Shared arrays -------------------------------------------------------------------------------------------------------------------------

STATE_FIELDS = tuple(field.name for field in fields(State))
Layout = Mapping[str, tuple[tuple[int, ...], type]]


def layout_of(n: int, robot: RobotSpec) -> Layout:
    """Name -> shape and type of every shared array. The state is both what a world is set to and what it reports."""
    joints, tips = len(robot.joints), len(robot.fingertips)
    links, bodies = 1 + tips, joints + len(robot.mimics) + 1
    f = np.float32
    return {
        "joint_pos": ((n, joints), f),
        "joint_vel": ((n, joints), f),
        "joint_target": ((n, joints), f),
        "object_pos": ((n, 3), f),
        "object_quat": ((n, 4), f),
        "object_linvel": ((n, 3), f),
        "object_angvel": ((n, 3), f),
        "link_pos": ((n, links, 3), f),
        "link_quat": ((n, links, 4), f),
        "link_linvel": ((n, links, 3), f),
        "link_angvel": ((n, links, 3), f),
        "tip_force": ((n, tips, 3), f),
        "tip_touch": ((n, tips), np.bool_),
        "table_force": ((n, 3), f),
        "nonfinite": ((n,), np.bool_),
        "overflow": ((n,), np.bool_),
        "friction": ((n, 3), f),
        "torsional_friction": ((n,), f),
        "object_mass": ((n,), f),
        "object_inertia": ((n,), f),
        "object_com": ((n, 3), f),
        "object_gravity": ((n,), f),
        "drives": ((n, 3, joints), f),
        "wrench": ((n, 6), f),
        "body_mass": ((n, bodies), f),
        "body_com": ((n, bodies, 3), f),
        "body_inertia": ((n, bodies, 3, 3), f),
    }


_ALIGNMENT = 64


def _size(layout: Layout) -> int:
    return sum(
        -(-int(np.prod(shape)) * np.dtype(dtype).itemsize // _ALIGNMENT) * _ALIGNMENT
        for shape, dtype in layout.values()
    )


def _map(path: str, layout: Layout) -> dict[str, np.ndarray]:
    """The arrays of a layout over a file that all processes map."""
    with open(path, "r+b") as file:
        memory = mmap.mmap(file.fileno(), _size(layout))
    arrays, offset = {}, 0
    for name, (shape, dtype) in layout.items():
        count = int(np.prod(shape))
        arrays[name] = np.frombuffer(memory, dtype, count, offset).reshape(shape)
        offset += -(-count * np.dtype(dtype).itemsize // _ALIGNMENT) * _ALIGNMENT
    return arrays


def usable_cores() -> int:
    """Cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


# The worlds of one process -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Job:
    """Which worlds a process runs: ``first``, ``first + 1``, ... as many as it has object indices."""

    backend: str
    world_class: type[World]
    options: Mapping[str, Any]
    scene: SceneSpec
    first: int
    object_index: tuple[int, ...]


class WorldFailure(Exception):
    """A world raised. Crosses process boundaries, so it holds text; ``kind`` is set for errors that the user can mend."""

    def __init__(self, world: int, kind: type[XResetError] | None, message: str, trace: str) -> None:
        super().__init__(world, kind, message, trace)
        self.world, self.kind, self.message, self.trace = world, kind, message, trace


_MOVING = frozenset(("build", "set_state", "step"))
"""Commands after which a world reports something else than before."""

READINGS = frozenset(("links", "contacts"))
"""What is read from a world only where somebody wants it."""

_GIVEN = {
    "build": STATE_FIELDS,
    "set_state": STATE_FIELDS,
    "step": ("joint_target", "wrench"),
}
"""Arrays that a command's worlds are given, in double precision."""


_OF_INERTIA = {"object_mass": "mass", "object_inertia": "scale", "object_com": "offset"}
"""Parameters of the object's mass properties -> arguments of :meth:`Inertia.changed`."""


class LocalWorlds:
    """The worlds of one job in this process."""

    def __init__(self, job: Job, arrays: Mapping[str, np.ndarray]) -> None:
        self._job = job
        mine = slice(job.first, job.first + len(job.object_index))
        self._arrays = {name: array[mine] for name, array in arrays.items()}
        """Of the worlds of this job."""
        self._given: dict[str, np.ndarray] = {}
        self._worlds: list[World] = []
        self._changes: list[dict[str, Any]] = [{} for _ in job.object_index]
        """What has been set of the objects' mass properties."""

    def command(self, method: str, worlds: np.ndarray | None, argument: Any, readings: frozenset[str]) -> None:
        """Run one of the methods below for the given worlds (all if None), and publish what they then report, and the readings.

        All worlds act before any is published: engine and Python code take turns in the processor's caches once, not once per world.
        """
        rows = range(len(self._job.object_index)) if worlds is None else (worlds - self._job.first).tolist()
        self._given = {name: self._arrays[name].astype(np.float64) for name in _GIVEN.get(method, ())}
        row, action = 0, getattr(self, f"_{method}")
        try:
            for row in rows:
                action(row, argument)
            for row in rows:
                if method in _MOVING:
                    self._publish(row)
                if "links" in readings:
                    self._publish_links(row)
                if "contacts" in readings:
                    self._publish_contacts(row)
        except XResetError as error:
            raise WorldFailure(self._job.first + row, type(error), str(error), traceback.format_exc()) from error
        except Exception as error:
            text = f"{type(error).__name__}: {error}"
            raise WorldFailure(self._job.first + row, None, text, traceback.format_exc()) from error

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
        self._arrays["nonfinite"][i] = self._arrays["overflow"][i] = False

    def _step(self, i: int, n: int) -> None:
        if self._arrays["nonfinite"][i]:
            return
        world, wrench = self._worlds[i], self._given["wrench"][i]
        world.set_joint_targets(self._given["joint_target"][i])
        world.set_object_wrench(wrench[:3], wrench[3:])
        world.step(n)

    def _read(self, i: int, _) -> None:
        """Nothing moves: the readings alone are published."""

    def _mass_properties(self, i: int, _) -> None:
        for k, body in enumerate(self._worlds[i].mass_properties()):
            self._arrays["body_mass"][i, k], self._arrays["body_com"][i, k] = body.mass, body.com
            self._arrays["body_inertia"][i, k] = body.matrix

    def _set_parameter(self, i: int, name: Parameter) -> None:
        value = self._arrays[name][i].astype(np.float64)
        value = value if value.ndim else float(value)
        if name in _OF_INERTIA:
            self._changes[i][_OF_INERTIA[name]] = value
            nominal = object_inertia(self._job.scene.objects[self._job.object_index[i]])
            self._worlds[i].set_object_inertia(nominal.changed(**self._changes[i]))
        else:
            getattr(self._worlds[i], f"set_{name}")(value)

    def _publish(self, i: int) -> None:
        world, arrays = self._worlds[i], self._arrays
        if arrays["nonfinite"][i]:  # nothing has moved since that was said
            return
        state = world.get_state()
        for name, value in state.items():
            arrays[name][i] = value
        nonfinite, overflow = world.health(state)
        if nonfinite:
            arrays["nonfinite"][i] = True
        if overflow:
            arrays["overflow"][i] = True

    def _publish_links(self, i: int) -> None:
        arrays = self._arrays
        arrays["link_pos"][i], arrays["link_quat"][i], arrays["link_linvel"][i], arrays["link_angvel"][i] = (
            self._worlds[i].links()
        )

    def _publish_contacts(self, i: int) -> None:
        arrays = self._arrays
        arrays["tip_force"][i], arrays["tip_touch"][i], arrays["table_force"][i] = self._worlds[i].contacts()


# Worker processes ----------------------------------------------------------------------------------------------------------------------

_BOOT = "import sys; sys.path[:] = {path!r}; from xreset.backends.workers import serve; serve()"
_DONE, _FAILED = b"+", b"-"
"""How a worker's reply begins; an exception follows a failure."""
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


class WorkerTeam:
    """Worker processes, each with one job."""

    def __init__(self, jobs: Sequence[Job], layout: Layout) -> None:
        world_class = jobs[0].world_class
        if world_class.__module__ == "__main__" or "<locals>" in world_class.__qualname__:
            raise XResetError(
                f"{world_class.__qualname__} is defined in {world_class.__module__!r}, where worker processes cannot import it. "
                "Move it to a module, or pass workers=0."
            )
        shared = Path("/dev/shm")
        folder = shared if os.access(shared, os.W_OK) else Path(tempfile.gettempdir())  # memory where there is some
        _sweep(folder)
        descriptor, path = tempfile.mkstemp(prefix="xreset-", dir=folder)
        self._workers: list[_Worker] = []
        try:
            fcntl.flock(descriptor, fcntl.LOCK_SH)
            os.truncate(descriptor, _size(layout))
            self.arrays = _map(path, layout)
            self._workers += [_Worker(job) for job in jobs]  # they start while others are still being asked
            for worker in self._workers:
                worker.send(pickle.dumps((path, layout, worker.job)))
            for worker in self._workers:
                worker.receive("start")
        except BaseException:
            self.close()
            raise
        finally:
            os.unlink(path)
            os.close(descriptor)

    def command(self, method: str, worlds: np.ndarray | None, argument: Any, readings: frozenset[str]) -> None:
        """Have all workers concerned run it at the same time, and wait for all of them."""
        asked, to_all = [], pickle.dumps((method, None, argument, readings))
        for worker in self._workers:
            mine = None if worlds is None else worlds[(worlds >= worker.first) & (worlds < worker.stop)]
            if mine is None or mine.size:
                worker.send(to_all if mine is None else pickle.dumps((method, mine, argument, readings)))
                asked.append(worker)
        failures = []
        for worker in asked:
            try:
                worker.receive(method)
            except WorldFailure as failure:
                failures.append(failure)
        if failures:
            raise failures[0]

    def close(self) -> None:
        """Close the workers' input, which ends them; kill those that do not end in time."""
        for worker in self._workers:
            worker.hang_up()
        for worker in self._workers:
            worker.wait()
        self._workers.clear()


def _sweep(folder: Path) -> None:
    """Remove the files of processes that were killed before they could: nobody holds them any more."""
    for path in folder.glob("xreset-*"):
        with contextlib.suppress(OSError), open(path, "rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if (
                time.time() - os.fstat(file.fileno()).st_mtime > 60.0
            ):  # a young one's owner may not have come to hold it yet
                path.unlink()


class _Worker:
    """One worker process, as its parent sees it."""

    _PATIENCE = 5.0
    """Seconds that a worker may take to end."""
    _ANSWER = 600.0
    """Seconds that it may take to answer: building an engine's worlds takes some, a command far less than one."""

    def __init__(self, job: Job) -> None:
        self.job = job
        self.first, self.stop = job.first, job.first + len(job.object_index)
        path = [str(Path(entry or ".").absolute()) for entry in sys.path]
        self._process = subprocess.Popen(
            [sys.executable, "-c", _BOOT.format(path=path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, **_ONE_THREAD},
            start_new_session=True,  # Ctrl-C is for the parent, which then hangs up
        )

    def send(self, message: bytes) -> None:
        """Send a pickled message; a dead worker is noticed at the reply."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write(message)
            self._process.stdin.flush()

    def receive(self, doing: str) -> None:
        """Wait for the reply, and raise what it says has gone wrong."""
        assert self._process.stdout is not None
        if not select.select([self._process.stdout], [], [], self._ANSWER)[0]:
            self._process.kill()
            raise XResetError(
                f"a worker process of the backend {self.job.backend!r} has not answered {doing!r} for {self._ANSWER:.0f} s and was ended; "
                f"it ran worlds {self.first} to {self.stop - 1}. workers=0 runs the worlds in this process, where a debugger can see them."
            )
        if self._process.stdout.read(len(_DONE)) == _DONE:
            return
        try:
            failure = pickle.load(self._process.stdout)
        except (EOFError, pickle.UnpicklingError) as error:
            raise XResetError(self._obituary(doing)) from error
        raise failure

    def hang_up(self) -> None:
        """Close the worker's input."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()

    def wait(self) -> None:
        """Wait for the end, and force it if need be."""
        assert self._process.stdout is not None
        try:
            self._process.wait(self._PATIENCE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()

    def _obituary(self, doing: str) -> str:
        self.hang_up()
        self.wait()
        code = self._process.returncode
        how = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        hint = " It may have run out of memory: use fewer worlds or workers." if code == -signal.SIGKILL else ""
        return (
            f"a worker process of the backend {self.job.backend!r} {how} during {doing!r}; it ran worlds {self.first} to {self.stop - 1}."
            f"{hint} What it said is on standard error; workers=0 runs the worlds in this process, where a debugger can see them."
        )


def serve() -> None:
    """Main function of a worker process: read a job and then commands from standard input until it ends, reply on standard output.

    Whatever the engine prints goes to standard error instead.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    commands, replies = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)

    def attempt(action, *arguments) -> Any:
        error, result = None, None
        try:
            result = action(*arguments)
        except WorldFailure as failure:
            error = failure
        except Exception:
            error = XResetError(f"a worker process failed:\n{traceback.format_exc()}")
        replies.write(_DONE if error is None else _FAILED + pickle.dumps(error))
        replies.flush()
        return result

    def start() -> LocalWorlds:
        path, layout, job = pickle.load(commands)
        return LocalWorlds(job, _map(path, layout))

    with contextlib.suppress(EOFError, pickle.UnpicklingError, BrokenPipeError):  # the parent is gone, or done with us
        local = attempt(start)
        while local is not None:
            attempt(local.command, *pickle.load(commands))
