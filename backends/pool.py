"""Worlds of a CPU engine in a pool of processes, behind :class:`~xreset.physics.Backend`.

An engine is added by writing a :class:`World` (one world, numpy) and a :class:`PoolBackend` that names it.

Each worker is a fresh interpreter (``python -c``), so it inherits neither torch's threads nor the caller's ``__main__``: scripts need no
main guard. Numbers travel through one file that every process maps and that the parent then unlinks; commands travel through the worker's
standard input, and the worker ends with it. So whatever way the parent dies, its workers end and nothing is left behind.

Shape letters as in :mod:`xreset.physics`; arrays of one world have no leading N.
"""

from __future__ import annotations

import contextlib
import fcntl
import math
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
import weakref
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from xreset.backends.rigid import Inertia
from xreset.errors import CapabilityError, XResetError
from xreset.physics import Backend, Contacts, Health, Links, MassProperties, Parameter, State
from xreset.spec import RobotSpec, SceneSpec, Shape

STATE_FIELDS = tuple(field.name for field in fields(State))


class World(ABC):
    """One world of a scene in one process. Arrays are numpy float64; conventions are those of :class:`~xreset.physics.Backend`.

    The state is undefined until :meth:`set_state`, which the pool calls first. A world that reports a non-finite state is not stepped
    again before its state is set. :meth:`links` and :meth:`contacts` are called only where somebody wants them, in any order, once or
    often: they must move nothing, and speak of the last step. No parameter changes between that step and the call.
    """

    @abstractmethod
    def __init__(self, scene: SceneSpec, object_index: int) -> None:
        """Build the world with ``scene.objects[object_index]`` in it."""

    @abstractmethod
    def set_state(self, state: Mapping[str, np.ndarray]) -> None:
        """Set every field of :class:`~xreset.physics.State`; nothing of the past may remain (but physical parameters do)."""

    @abstractmethod
    def get_state(self) -> dict[str, np.ndarray]:
        """Every field of :class:`~xreset.physics.State`.

        They may be views of the engine's memory, which the next call that changes the world overwrites.
        """

    @abstractmethod
    def set_joint_targets(self, targets: np.ndarray) -> None:
        """Set the drive targets (J,)."""

    @abstractmethod
    def step(self, n: int) -> None:
        """Advance by n physics steps."""

    @abstractmethod
    def links(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Tracked links: position (K, 3), orientation (K, 4), velocity of the origin (K, 3), angular velocity (K, 3).

        They may be views of the engine's memory, which the next call that changes the world overwrites.
        """

    @abstractmethod
    def contacts(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """On the object in the last physics step: tip force (E, 3), tip touch (E,) bool, table force (3,). Zero right after set_state."""

    @abstractmethod
    def health(self, state: Mapping[str, np.ndarray]) -> tuple[bool, bool]:
        """Whether the state is not finite, and whether contacts overflowed in the last :meth:`step`.

        ``state`` is what :meth:`get_state` has just returned: nothing has to be read again. See :func:`is_finite`.
        """

    def mass_properties(self) -> list[Inertia]:
        """What the engine itself holds: of each moving body of the robot, in the order of the mechanism, then of the object.

        Asked for only where the backend has the capability ``mass_properties``.
        """
        raise NotImplementedError

    @abstractmethod
    def set_object_mass(self, mass: float) -> None:
        """Set the object's mass [kg]; the inertia scales with it."""

    @abstractmethod
    def set_friction(self, friction: np.ndarray) -> None:
        """Set the friction of the pairs object-tip, object-other link, object-table (3,)."""

    @abstractmethod
    def set_object_gravity(self, fraction: float) -> None:
        """Set the object's gravity fraction."""

    # The next four are called only where the backend has the capability.

    def set_torsional_friction(self, torsional: float) -> None:
        """Set the torsional friction of the object's pairs [m]."""
        raise NotImplementedError

    def set_object_inertia(self, scale: float) -> None:
        """Set the factor on the object's inertia beside what its mass does."""
        raise NotImplementedError

    def set_object_com(self, offset: np.ndarray) -> None:
        """Move the object's centre of mass by (3,) m from where its spec has it."""
        raise NotImplementedError

    def set_drives(self, scale: np.ndarray) -> None:
        """Set factors (3, J) on the drives' stiffness, damping and effort limit."""
        raise NotImplementedError

    @abstractmethod
    def set_object_wrench(self, force: np.ndarray, torque: np.ndarray) -> None:
        """Set the force (3,) at the object's centre of mass and the torque (3,); called before every :meth:`step`."""

    def close(self) -> None:  # noqa: B027 (most engines need nothing)
        """Free what the engine holds."""


def is_finite(state: Mapping[str, np.ndarray]) -> bool:
    """Whether all numbers of a state are. One bad number spoils the sum, which costs less than looking at each."""
    return math.isfinite(sum(x.dot(x) for x in state.values()))


class PoolBackend(Backend):
    """N worlds of a CPU engine, spread over worker processes.

    A subclass sets ``name``, ``capabilities`` and ``world_class`` and says its engine's version. Getters return views of shared memory.

    One :meth:`step` is one round trip to each worker, after which state and health are there. Links and contacts cost time to read, so a
    step brings those that were asked for after the step before; asked for anew, they take a round trip of their own, once.
    """

    world_class: ClassVar[type[World]]
    """Must be importable by name: a class that a script defines in ``__main__`` works with ``workers=0`` only."""

    def __init__(
        self,
        scene: SceneSpec,
        num_worlds: int,
        *,
        object_index: Tensor | None = None,
        device: str = "cpu",
        workers: int | None = None,
        **world_options: Any,
    ) -> None:
        """Build the worlds.

        Args:
            scene: what to simulate.
            num_worlds: N.
            object_index: [N] which object each world holds.
            device: ``cpu``.
            workers: number of processes; 0 runs the worlds in this process. Default: one per usable core, but no more than worlds, and
                this process if there is one world only.
            world_options: further keywords of the world class (picklable).

        Raises:
            CapabilityError: the device is not the CPU.
        """
        if torch.device(device).type != "cpu":
            raise CapabilityError(
                f"the backend {self.name!r} runs on the CPU only, found device {device!r}. Use device 'cpu', or the backend 'mujoco-warp'."
            )
        super().__init__(scene, num_worlds, object_index=object_index, device=device)
        if workers is None:
            workers = 0 if num_worlds == 1 else min(usable_cores(), num_worlds)
        if workers < 0:
            raise ValueError(f"workers is {workers}, expected 0 or more")
        workers = min(workers, num_worlds)
        layout = _layout(num_worlds, scene.robot)
        owned = np.array_split(np.arange(num_worlds), max(workers, 1))
        jobs = [
            _Job(self.name, self.world_class, dict(world_options), scene, int(w[0]), tuple(self.object_index[w].tolist())) for w in owned
        ]
        if workers == 0:
            self._arrays = {name: np.zeros(shape, dtype) for name, (shape, dtype) in layout.items()}
            self._team: _Local | _Team = _Local(jobs[0], self._arrays)
        else:
            self._team = _Team(jobs, layout)
            self._arrays = self._team.arrays
        self._close = weakref.finalize(self, self._team.close)  # also runs when the interpreter exits
        self._present = _READINGS
        """Readings that are up to date in the shared arrays."""
        self._asked = _READINGS
        """Readings that somebody has asked for since the last step: the next step brings them."""

        views = {name: torch.from_numpy(array) for name, array in self._arrays.items()}
        self._state = State(**{name: views[name] for name in STATE_FIELDS})
        self._links = Links(pos=views["link_pos"], quat=views["link_quat"], linvel=views["link_linvel"], angvel=views["link_angvel"])
        self._contacts = Contacts(tip_force=views["tip_force"], tip_touch=views["tip_touch"], table_force=views["table_force"])
        self._health = Health(nonfinite=views["nonfinite"], overflow=views["overflow"])
        for i, index in enumerate(self.object_index.tolist()):
            for name, value in initial_state(scene, index).items():
                self._arrays[name][i] = value
        try:
            self._command("build", readings=_READINGS)
        except BaseException:
            self.close()
            raise

    def set_state(self, state: State, worlds: Tensor | None = None) -> None:
        """See :meth:`Backend.set_state`. The external wrench of those worlds ends."""
        index = self._selected(worlds)
        values = {name: self._checked(name, getattr(state, name), len(index)) for name in STATE_FIELDS}
        for name, value in values.items():
            self._arrays[name][index] = value
        self._arrays["wrench"][index] = 0.0
        self._move("set_state", index, readings=self._present)

    def state(self) -> State:
        """See :meth:`Backend.state`: views of shared memory."""
        self._must_be_open()
        return self._state

    def set_joint_targets(self, targets: Tensor) -> None:
        """See :meth:`Backend.set_joint_targets`; the worlds read them at the next step."""
        self._must_be_open()
        self._arrays["joint_target"][:] = self._checked("joint_target", targets, self.num_worlds)

    def step(self, substeps: int | None = None) -> None:
        """See :meth:`Backend.step`."""
        substeps = self.scene.substeps if substeps is None else substeps
        if substeps < 1:
            raise ValueError(f"substeps is {substeps}, expected at least 1")
        asked, self._asked = self._asked, frozenset[str]()
        self._move("step", argument=substeps, readings=asked)

    def links(self) -> Links:
        """See :meth:`Backend.links`: views of shared memory."""
        self._ask(frozenset(("links",)))
        return self._links

    def contacts(self) -> Contacts:
        """See :meth:`Backend.contacts`: views of shared memory."""
        self._ask(frozenset(("contacts",)))
        return self._contacts

    def health(self) -> Health:
        """See :meth:`Backend.health`: views of shared memory."""
        self._must_be_open()
        return self._health

    def mass_properties(self) -> MassProperties:
        """See :meth:`Backend.mass_properties`."""
        if "mass_properties" not in self.capabilities:
            return super().mass_properties()
        self._command("mass_properties")
        mass, com, inertia = (torch.from_numpy(self._arrays[f"body_{name}"].copy()) for name in ("mass", "com", "inertia"))
        return MassProperties(mass=mass, com=com, inertia=inertia)

    def set_object_mass(self, mass: Tensor, worlds: Tensor | None = None) -> None:
        """See :meth:`Backend.set_object_mass`."""
        self._set_parameter("object_mass", mass, worlds)

    def set_friction(self, friction: Tensor, worlds: Tensor | None = None) -> None:
        """See :meth:`Backend.set_friction`."""
        self._set_parameter("friction", friction, worlds)

    def set_torsional_friction(self, torsional: Tensor, worlds: Tensor | None = None) -> None:
        """See :meth:`Backend.set_torsional_friction`."""
        self._set_parameter("torsional_friction", torsional, worlds)

    def set_object_inertia(self, scale: Tensor, worlds: Tensor | None = None) -> None:
        """See :meth:`Backend.set_object_inertia`."""
        self._set_parameter("object_inertia", scale, worlds)

    def set_object_com(self, offset: Tensor, worlds: Tensor | None = None) -> None:
        """See :meth:`Backend.set_object_com`."""
        self._set_parameter("object_com", offset, worlds)

    def set_object_gravity(self, fraction: Tensor, worlds: Tensor | None = None) -> None:
        """See :meth:`Backend.set_object_gravity`."""
        self._set_parameter("object_gravity", fraction, worlds)

    def set_drives(self, scale: Tensor, worlds: Tensor | None = None) -> None:
        """See :meth:`Backend.set_drives`."""
        self._set_parameter("drives", scale, worlds)

    def set_object_wrench(self, force: Tensor, torque: Tensor) -> None:
        """See :meth:`Backend.set_object_wrench`; the worlds read it at the next step."""
        self._require("object_wrench")
        self._must_be_open()
        wrench = torch.cat((torch.as_tensor(force), torch.as_tensor(torque)), dim=-1)
        self._arrays["wrench"][:] = self._checked("wrench", wrench, self.num_worlds)

    def close(self) -> None:
        """End the workers. Calling it twice does no harm."""
        self._close()

    def _set_parameter(self, name: Parameter, value: Tensor, worlds: Tensor | None) -> None:
        self._require(name)
        index = self._selected(worlds)
        given = self._checked(name, value, len(index))
        self._bring(_READINGS)  # they are of the last step, and an engine may work them out from its parameters
        self._arrays[name][index] = given
        self._command("set_parameter", index, name)

    def _move(self, method: str, worlds: np.ndarray | None = None, argument: Any = None, *, readings: frozenset[str]) -> None:
        """Run a command that changes what worlds report; these readings are present afterwards."""
        self._present = frozenset[str]()
        self._command(method, worlds, argument, readings)
        self._present = readings

    def _ask(self, readings: frozenset[str]) -> None:
        """Have readings present, after the next step too."""
        self._must_be_open()
        self._bring(readings)
        self._asked |= readings

    def _bring(self, readings: frozenset[str]) -> None:
        if missing := readings - self._present:
            self._command("read", readings=missing)
            self._present |= missing

    def _selected(self, worlds: Tensor | None) -> np.ndarray:
        if worlds is None:
            return np.arange(self.num_worlds)
        index = torch.as_tensor(worlds, dtype=torch.long).detach().cpu().numpy()
        if index.ndim != 1 or (index.size and (index.min() < 0 or index.max() >= self.num_worlds)):
            raise ValueError(f"worlds must be a list of indices in 0..{self.num_worlds - 1}, found {worlds}")
        return index

    def _checked(self, name: str, value: Tensor, rows: int) -> np.ndarray:
        array = torch.as_tensor(value).numpy(force=True)
        expected = (rows, *self._arrays[name].shape[1:])
        if array.shape != expected:
            raise ValueError(f"{name} has shape {array.shape}, expected {expected}")
        return array

    def _command(self, method: str, worlds: np.ndarray | None = None, argument: Any = None, readings: frozenset[str] = frozenset()) -> None:
        self._must_be_open()
        try:
            self._team.command(method, worlds, argument, readings)
        except _WorldFailure as failure:
            if failure.kind is not None:
                raise failure.kind(f"world {failure.world}: {failure.message}") from failure
            raise RuntimeError(f"backend {self.name!r}, world {failure.world}, {method}: {failure.message}\n{failure.trace}") from failure
        except BaseException:  # the workers and this process no longer agree on what has been done (Ctrl-C, a dead worker)
            self.close()
            raise

    def _must_be_open(self) -> None:
        if not self._close.alive:
            raise XResetError(f"the backend {self.name!r} is closed (by close(), Ctrl-C or the death of a worker). Build a new one.")


# The state that every world starts in --------------------------------------------------------------------------------------------------


def initial_state(scene: SceneSpec, object_index: int) -> dict[str, np.ndarray]:
    """Fields of :class:`~xreset.physics.State` for one world: robot at home and at rest, object upright on the table's centre."""
    robot = scene.robot
    height = -lowest_point(scene.objects[object_index].pieces)
    return {
        "joint_pos": robot.home,
        "joint_vel": np.zeros(len(robot.joints)),
        "joint_target": robot.home,
        "object_pos": np.array([*scene.table.center, height]),
        "object_quat": np.array([1.0, 0.0, 0.0, 0.0]),
        "object_linvel": np.zeros(3),
        "object_angvel": np.zeros(3),
    }


def lowest_point(shapes: Sequence[Shape]) -> float:
    """Smallest z of the shapes, in the frame of their body [m]."""
    return min(_lowest(shape) for shape in shapes)


def _lowest(shape: Shape) -> float:
    geometry, z = shape.geometry, shape.T_body_shape[2, 3]
    row = shape.T_body_shape[2, :3]  # height of a point p of the shape's own frame: z + row . p
    if geometry.kind == "hull":
        return float(z + (geometry.vertices @ row).min())
    if geometry.kind == "box":
        return float(z - np.abs(row) @ geometry.size)
    if geometry.kind == "sphere":
        return float(z - geometry.size[0])
    radius, half = geometry.size
    if geometry.kind == "capsule":
        return float(z - abs(row[2]) * half - radius)
    return float(z - abs(row[2]) * half - radius * np.hypot(row[0], row[1]))


# Shared arrays -------------------------------------------------------------------------------------------------------------------------

Layout = Mapping[str, tuple[tuple[int, ...], type]]


def _layout(n: int, robot: RobotSpec) -> Layout:
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
    return sum(-(-int(np.prod(shape)) * np.dtype(dtype).itemsize // _ALIGNMENT) * _ALIGNMENT for shape, dtype in layout.values())


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
class _Job:
    """Which worlds a process runs: ``first``, ``first + 1``, ... as many as it has object indices."""

    backend: str
    world_class: type[World]
    options: Mapping[str, Any]
    scene: SceneSpec
    first: int
    object_index: tuple[int, ...]


class _WorldFailure(Exception):
    """A world raised. Crosses process boundaries, so it holds text; ``kind`` is set for errors that the user can mend."""

    def __init__(self, world: int, kind: type[XResetError] | None, message: str, trace: str) -> None:
        super().__init__(world, kind, message, trace)
        self.world, self.kind, self.message, self.trace = world, kind, message, trace


_MOVING = frozenset(("build", "set_state", "step"))
"""Commands after which a world reports something else than before."""

_READINGS = frozenset(("links", "contacts"))
"""What is read from a world only where somebody wants it."""

_GIVEN = {
    "build": STATE_FIELDS,
    "set_state": STATE_FIELDS,
    "step": ("joint_target", "wrench"),
}
"""Arrays that a command's worlds are given, in double precision."""


class _Local:
    """The worlds of one job in this process."""

    def __init__(self, job: _Job, arrays: Mapping[str, np.ndarray]) -> None:
        self._job = job
        mine = slice(job.first, job.first + len(job.object_index))
        self._arrays = {name: array[mine] for name, array in arrays.items()}
        """Of the worlds of this job."""
        self._given: dict[str, np.ndarray] = {}
        self._worlds: list[World] = []

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
            raise _WorldFailure(self._job.first + row, type(error), str(error), traceback.format_exc()) from error
        except Exception as error:
            text = f"{type(error).__name__}: {error}"
            raise _WorldFailure(self._job.first + row, None, text, traceback.format_exc()) from error

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
        getattr(self._worlds[i], f"set_{name}")(value if value.ndim else float(value))

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
        arrays["link_pos"][i], arrays["link_quat"][i], arrays["link_linvel"][i], arrays["link_angvel"][i] = self._worlds[i].links()

    def _publish_contacts(self, i: int) -> None:
        arrays = self._arrays
        arrays["tip_force"][i], arrays["tip_touch"][i], arrays["table_force"][i] = self._worlds[i].contacts()


# Worker processes ----------------------------------------------------------------------------------------------------------------------

_BOOT = "import sys; sys.path[:] = {path!r}; from xreset.backends.pool import serve; serve()"
_DONE, _FAILED = b"+", b"-"
"""How a worker's reply begins; an exception follows a failure."""
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


class _Team:
    """Worker processes, each with one job."""

    def __init__(self, jobs: Sequence[_Job], layout: Layout) -> None:
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
            except _WorldFailure as failure:
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
            if time.time() - os.fstat(file.fileno()).st_mtime > 60.0:  # a young one's owner may not have come to hold it yet
                path.unlink()


class _Worker:
    """One worker process, as its parent sees it."""

    _PATIENCE = 5.0
    """Seconds that a worker may take to end."""
    _ANSWER = 600.0
    """Seconds that it may take to answer: building an engine's worlds takes some, a command far less than one."""

    def __init__(self, job: _Job) -> None:
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
        except _WorldFailure as failure:
            error = failure
        except Exception:
            error = XResetError(f"a worker process failed:\n{traceback.format_exc()}")
        replies.write(_DONE if error is None else _FAILED + pickle.dumps(error))
        replies.flush()
        return result

    def start() -> _Local:
        path, layout, job = pickle.load(commands)
        return _Local(job, _map(path, layout))

    with contextlib.suppress(EOFError, pickle.UnpicklingError, BrokenPipeError):  # the parent is gone, or done with us
        local = attempt(start)
        while local is not None:
            attempt(local.command, *pickle.load(commands))
