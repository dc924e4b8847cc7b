"""Worlds of a CPU engine in a pool of processes, behind :class:`~xreset.physics.Backend`.

An engine is added by writing a :class:`World` (one world, numpy) and a :class:`PoolBackend` that names it.

Shape letters are those of :mod:`xreset.physics`; arrays of one world have no leading N.
"""

from __future__ import annotations

import math
import weakref
from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import fields
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np

from xreset.backends.rigid import ContactArrays, Inertia, LinkArrays, StateArrays
from xreset.backends.workers import (
    Job,
    LocalWorlds,
    WorkerTeam,
    arrays_in,
    layout_of,
    usable_cores,
)
from xreset.errors import CapabilityError, WrongValueError, XResetError
from xreset.physics import Backend, Contacts, Health, Links, MassProperties, Parameter, State
from xreset.physics.plugins import refuse_unknown_options
from xreset.physics.tensors import Tensors
from xreset.spec import SceneSpec

if TYPE_CHECKING:  # functions import torch, because one world plays without it
    from torch import Tensor

_Bundle = TypeVar("_Bundle", bound=Tensors)


class World(ABC):
    """One world of a scene in one process. Arrays are numpy float64; conventions are those of :class:`Backend`.

    The state is undefined until :meth:`set_state`, which the pool calls first. After each :meth:`set_state` and
    :meth:`step`, the pool calls :meth:`get_state`, :meth:`health` and :meth:`links` once, in this order;
    :meth:`contacts`, between the latter two, only after a step. A world that reports a non-finite state is not stepped
    again before its state is set. The first readings of a world are checked: names, shapes and types.
    """

    force = torque = np.zeros(3)
    """Wrench on the object until the next step: see :meth:`set_object_wrench`."""
    gravity_fraction = 0.0
    """Zero, for worlds written for xreset 0.3, which add this share of the weight: :attr:`force` has it now."""

    @abstractmethod
    def __init__(self, scene: SceneSpec, object_index: int) -> None:
        """Build the world with ``scene.objects[object_index]`` in it."""

    @abstractmethod
    def set_state(self, state: StateArrays) -> None:
        """Set every field of :class:`State`; nothing of the past may remain, except physical parameters."""

    @abstractmethod
    def get_state(self) -> StateArrays:
        """Return every field of :class:`State`.

        The arrays may be views of the engine's memory, which the next call that changes the world overwrites.
        """

    @abstractmethod
    def set_joint_targets(self, targets: np.ndarray) -> None:
        """Set the drive targets [J]."""

    @abstractmethod
    def step(self, n: int) -> None:
        """Advance by n physics steps."""

    def links(self) -> LinkArrays | None:
        """Return position [K, 3], orientation [K, 4], velocity of the origin [K, 3], angular velocity [K, 3] of links.

        None, as here: the pool computes them from the state, with mimic joints where their sources put them. Override
        it where mimic joints can lag, with the engine's own frames or :class:`~xreset.backends.rigid.TrackedLinks`. The
        arrays may be views of the engine's memory, which the next call that changes the world overwrites.
        """
        return None

    @abstractmethod
    def contacts(self) -> Iterable[tuple[int, np.ndarray]] | ContactArrays:
        """Return the contacts of the object in the last internal step.

        Either a list with a pair for each contact: what touches the object (an index of a fingertip, or ``TABLE`` or
        ``OTHER_LINK`` of :mod:`~xreset.backends.rigid`), and its force on the object [3]; with no force it is no touch.
        Or a tuple of their sums: tip force [E, 3], tip touch [E] bool and table force [3].
        """

    def health(self, state: StateArrays) -> tuple[bool, bool]:
        """Return whether the state is not finite, and whether contacts overflowed in the last :meth:`step`.

        ``state`` is what :meth:`get_state` has just returned, so nothing has to be read again.
        """
        return not is_finite(state), False

    def mass_properties(self) -> list[Inertia]:
        """Return what the engine itself holds: each moving body of the robot in the mechanism's order, then the object.

        Called only where the backend has the capability ``mass_properties``.
        """
        raise NotImplementedError

    @abstractmethod
    def set_object_inertia(self, inertia: Inertia) -> None:
        """Set the object's mass properties.

        The centre of mass changes only where the backend has the capability ``object_com``.
        """

    @abstractmethod
    def set_friction(self, friction: np.ndarray) -> None:
        """Set the friction of the pairs object-tip, object-other link, object-table [3]."""

    def set_object_gravity(self, fraction: float) -> None:
        """Set the object's gravity fraction.

        Override it only where the engine's own gravity pulls the object. Else the pool does not call it, and adds the
        weight to the force.
        """
        self.gravity_fraction = fraction

    def set_object_wrench(self, force: np.ndarray, torque: np.ndarray) -> None:
        """Set the force [3] at the object's centre of mass, its weight included, and the torque [3]; called before
        every :meth:`step`."""
        self.force = force
        self.torque = torque

    # The next two are called only where the backend has the capability.

    def set_torsional_friction(self, torsional: float) -> None:
        """Set the torsional friction of the object's pairs [m]."""
        raise NotImplementedError

    def set_drives(self, scale: np.ndarray) -> None:
        """Set factors [3, J] on the drives' stiffness, damping and effort limit."""
        raise NotImplementedError

    def close(self) -> None:  # noqa: B027 (most engines need nothing)
        """Free what the engine holds."""


def lacks_weight(world: type[World]) -> bool:
    """Return whether the engine's own gravity does not pull the object, so that its weight is added to the force."""
    return world.set_object_gravity is World.set_object_gravity


def is_finite(state: StateArrays) -> bool:
    """Return whether all numbers of a state are finite.

    One bad number spoils the sum, which costs less than looking at each.
    """
    return math.isfinite(sum(x.dot(x) for x in state.values()))


class PoolBackend(Backend):
    """N worlds of a CPU engine, spread over worker processes.

    A subclass sets ``name``, ``capabilities`` and ``world_class`` and returns its engine's version. Getters return
    views of shared memory; inputs are read at the next step.

    One :meth:`step` is one round trip to each worker, after which all readings are there.
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
            scene: see :class:`Backend`.
            num_worlds: see :class:`Backend`.
            object_index: see :class:`Backend`.
            device: ``cpu``.
            workers: number of processes; 0 runs the worlds in this process. Default: one per usable core, but no more
                than worlds; this process if there is only one world or one core.
            world_options: further keywords of the world class (picklable).

        Raises:
            CapabilityError: the device is not the CPU.
            XResetError: the world class has no such keyword.
        """
        import torch

        if torch.device(device).type != "cpu":
            raise CapabilityError(
                f"The engine {self.name!r} runs on the CPU only, found device {device!r}. "
                "Use device 'cpu', or the engine 'mujoco-warp'."
            )
        own = ("object_index", "device", "workers")
        refuse_unknown_options(self.name, world_options, self.world_class, own)
        super().__init__(scene, num_worlds, object_index=object_index, device=device)
        if workers is None:
            workers = min(num_worlds, usable_cores())
            if workers == 1:
                workers = 0
        if workers < 0:
            raise WrongValueError(f"workers is {workers}, expected 0 or more")
        layout = layout_of(scene, self.object_index)
        jobs = []
        count = max(min(workers, num_worlds), 1)
        for first in range(count):
            # neighbours often hold the same object, and some objects take more time
            worlds = range(first, num_worlds, count)
            held = tuple(self.object_index[worlds].tolist())
            job = Job(
                backend=self.name,
                world_class=self.world_class,
                adds_weight=lacks_weight(self.world_class),
                options=world_options,
                scene=scene,
                worlds=worlds,
                object_index=held,
            )
            jobs.append(job)
        if workers == 0:
            self._arrays = arrays_in(bytearray(layout.itemsize), layout)
            self._team: LocalWorlds | WorkerTeam = LocalWorlds(jobs[0], self._arrays)
        else:
            self._team = WorkerTeam(jobs, layout)
            self._arrays = self._team.arrays
        # also runs when the interpreter exits
        self._close = weakref.finalize(self, self._team.close)
        self._state = self._views(State)
        self._links = self._views(Links)
        self._contacts = self._views(Contacts)
        self._health = self._views(Health)
        self._wrench = torch.from_numpy(self._arrays["wrench"])
        self._state.map(torch.Tensor.copy_, State.initial(scene, self.object_index))
        try:
            self._command("build")
        except BaseException:
            self.close()
            raise

    def set_state(self, state: State, worlds: Tensor | None = None) -> None:
        index = self._indices(worlds).numpy()
        for name, value in vars(self._checked_state(state, len(index))).items():
            self._arrays[name][index] = value
        self._arrays["wrench"][index] = 0.0
        self._command("set_state", index)

    def step(self, substeps: int | None = None) -> None:
        self._command("step", argument=self._checked_substeps(substeps))

    def mass_properties(self) -> MassProperties:
        self._require("mass_properties")
        self._command("mass_properties")
        return self._views(MassProperties, "body_").clone()

    def close(self) -> None:
        self._close()

    def _set(self, name: Parameter, value: Tensor, worlds: Tensor | None) -> None:
        self._require(name)
        index = self._indices(worlds).numpy()
        present = self._arrays[name]
        shape = (len(index), *present.shape[1:])
        present[index] = self._checked_parameter(name, value, shape).numpy()
        self._command("set_parameter", index, name)

    def _views(self, bundle: type[_Bundle], prefix: str = "") -> _Bundle:
        """Return views of the shared arrays of a bundle's fields."""
        import torch

        names = [field.name for field in fields(bundle)]
        return bundle(**{name: torch.from_numpy(self._arrays[prefix + name]) for name in names})

    def _command(self, method: str, worlds: np.ndarray | None = None, argument: Any = None) -> None:
        """Run a command in the workers."""
        self._must_be_open()
        try:
            failure = self._team.command(method, worlds, argument)
        except BaseException:  # after Ctrl-C or a worker's death, nobody knows what has been done
            self.close()
            raise
        if failure is not None:
            raise failure

    def _must_be_open(self) -> None:
        if not self._close.alive:
            raise XResetError(
                f"The engine {self.name!r} is closed (by close(), Ctrl-C or the death of a worker). Build a new one."
            )
